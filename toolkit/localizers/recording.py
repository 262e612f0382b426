"""A piece of a recording in the map: single poses joined by odometry, and what they leave in doubt localized again.

The steps are those of the LaMAR benchmark (Sarlin et al., ECCV 2022): the odometry is laid where most single poses
agree, a pose graph follows, then localization again with the predicted poses as priors, and the graph once more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toolkit import geometry
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import PoseEstimate, RoughPose, agree, stds_of
from toolkit.localizers.bundle import Observations, Observe, adjusted
from toolkit.localizers.gravity import Gravity
from toolkit.localizers.odometry import UNKNOWN_COVARIANCE, Odometry, PosedQueries, place, vote_weights
from toolkit.localizers.pose_graph import PlacedPiece, place_online, place_piece
from toolkit.manifest import SequenceSettings

Again = Callable[[Sequence[tuple[int, RoughPose]]], Sequence[PoseEstimate]]
"""Localizes some frames of a piece, given by their indices, again, each near a pose."""


@dataclass(frozen=True)
class LocalizedPiece:
    """The poses of a piece of odometry, and how they came about."""

    placed: PlacedPiece
    queries: PosedQueries
    """What the poses rest on: the first single poses, and those found again."""
    again: Mapping[int, PoseEstimate]
    """What localization near the predicted pose has found, by the frame."""
    steps: Mapping[str, Floats]
    """world_from_rig (A, 4, 4) of the frames that were asked for, NaN where there is none, after each of `STEPS`."""


GRAPH_AGAIN = "graph again"
"""The step before bundle adjustment, where that is asked for."""
STEPS = ("voted", "graph", "again")
"""Odometry laid as a whole where most single poses agree; the first pose graph; single poses, the doubtful ones found
again. What the second graph makes of these is the result, or bundle adjustment after it."""


def localize_piece(
    odometry: Odometry,
    queries: PosedQueries,
    asked: Ints,
    settings: SequenceSettings,
    again: Again | None = None,
    gravity: Gravity | None = None,
    observe: Observe | None = None,
) -> LocalizedPiece:
    """Return the poses of a piece of odometry: of all frames, or of those that are asked for if `settings.online`.

    Args:
        queries: those with a pose.
        asked: (A,) frames of all queries, ascending.
        again: asked about queries that are not `ok`, or that contradict the others; None: they stay as they are.
        gravity: which direction is up; None: not known. Online it is not used: other pieces tell it.
        observe: what queries show, for `settings.bundle_adjust`.

    Raises:
        ManifestError: GTSAM is not installed.
    """
    first = _placed(odometry, queries, asked, settings, gravity)
    sure = queries.frames[first.used & queries.trusted]
    doubted = [int(frame) for frame in np.setdiff1d(asked, sure) if np.isfinite(first.world_from_rig[frame]).all()]
    answers: dict[int, PoseEstimate] = {}
    if again is not None and doubted:
        stds = zip(*(each.tolist() for each in stds_of(first.covariances[doubted])), strict=True)
        rough = [RoughPose(pose, *std) for pose, std in zip(first.world_from_rig[doubted], stds, strict=True)]
        found = again(list(zip(doubted, rough, strict=True)))
        answers = dict(zip(doubted, found, strict=True))
    every = with_answers(queries, answers)
    second = first if every is queries else _placed(odometry, every, asked, settings, gravity)
    singles = np.full((len(odometry), 4, 4), np.nan)
    singles[queries.frames] = queries.world_from_rig
    voted = np.full((len(asked), 4, 4), np.nan)
    if len(queries) and not settings.online:
        voters = queries if gravity is None else gravity.upright(odometry, queries, settings)
        agreeing = queries.choose(place(odometry, voters, settings)[0].members)
        voted = _laid(odometry, agreeing) @ odometry.odom_from_rig[asked]
    graph = first.world_from_rig[asked]
    for frame, estimate in answers.items():
        if estimate.world_from_rig is not None:
            singles[frame] = estimate.world_from_rig
    steps = dict(zip(STEPS, (voted, graph, singles[asked]), strict=True))
    if settings.bundle_adjust and observe is not None and not settings.online:
        steps[GRAPH_AGAIN] = second.world_from_rig[asked]
        second = _adjusted(odometry, second, every, answers, observe, settings, gravity)
    return LocalizedPiece(second, every, answers, steps)


def _adjusted(
    odometry: Odometry,
    placed: PlacedPiece,
    queries: PosedQueries,
    answers: Mapping[int, PoseEstimate],
    observe: Observe,
    settings: SequenceSettings,
    gravity: Gravity | None,
) -> PlacedPiece:
    """Return a piece after bundle adjustment of what the queries that are used show."""
    used, shown = queries.choose(placed.used), dict[int, Observations]()
    if not np.isfinite(placed.world_from_rig).all():
        return placed
    for frame, pose, trusted in zip(used.frames.tolist(), used.world_from_rig, used.trusted, strict=True):
        answer = answers.get(frame)
        same = answer is not None and answer.world_from_rig is not None and np.allclose(answer.world_from_rig, pose)
        sure = answer is not None and answer.status == "ok" if same else trusted
        seen = observe(frame, answer if same else None) if sure else None
        if seen is not None and len(seen.points):
            shown[frame] = seen
    return adjusted(odometry, placed, used, shown, settings, gravity) if shown else placed


def _placed(
    odometry: Odometry, queries: PosedQueries, asked: Ints, settings: SequenceSettings, gravity: Gravity | None
) -> PlacedPiece:
    if settings.online:
        return place_online(odometry, queries, asked, settings)
    return place_piece(odometry, queries, settings, gravity)


def _laid(odometry: Odometry, agreeing: PosedQueries) -> Floats:
    """Return world_from_odom (4, 4) of that query whose placement is the nearest to the others', in the median."""
    moved, poses = odometry.odom_from_rig[agreeing.frames], agreeing.world_from_rig
    candidates = poses @ geometry.invert(moved)
    laid = (candidates[:, :3] @ moved[:, :, 3].T).transpose(0, 2, 1)
    off_m = np.linalg.norm(laid - poses[:, :3, 3], axis=2)
    return np.asarray(candidates[int(np.argmin(np.median(off_m, axis=1)))])


def with_answers(queries: PosedQueries, answers: Mapping[int, PoseEstimate]) -> PosedQueries:
    """Return single poses with those that were found near a predicted pose.

    One that agrees with the first of its frame replaces it. Another stands beside it, and has no vote on where the
    odometry is: it was sought where the others had put it.
    """
    poses, covariances = queries.world_from_rig.copy(), queries.covariances.copy()
    added: dict[int, PoseEstimate] = {}
    for frame, estimate in answers.items():
        if estimate.world_from_rig is None or estimate.covariance is None:
            continue
        same = [row for row in np.flatnonzero(queries.frames == frame) if agree(poses[row], estimate.world_from_rig)]
        if same:
            poses[same[0]], covariances[same[0]] = estimate.world_from_rig, estimate.covariance
        else:
            added[frame] = estimate
    if not answers:
        return queries
    voters = replace(queries, world_from_rig=poses, covariances=covariances)
    others = replace(queries_of(added), weights=np.zeros(len(added)), trusted=np.zeros(len(added), bool))
    return voters.joined(others)


def queries_of(estimates: Mapping[int, PoseEstimate]) -> PosedQueries:
    """Return the estimates that have a pose, given by their frames, as a pose graph takes them."""
    posed = {frame: each for frame, each in sorted(estimates.items()) if each.world_from_rig is not None}
    trusted = np.array([each.status == "ok" for each in posed.values()], bool)
    return PosedQueries(
        np.array(list(posed), np.int64),
        np.array([each.world_from_rig for each in posed.values()]).reshape(-1, 4, 4),
        np.array(
            [UNKNOWN_COVARIANCE if each.covariance is None else each.covariance for each in posed.values()]
        ).reshape(-1, 6, 6),
        vote_weights(
            trusted,
            np.array([each.p_correct for each in posed.values()]),
            np.array([each.rival_support for each in posed.values()]),
        ),
        trusted,
    )
