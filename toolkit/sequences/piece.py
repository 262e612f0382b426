"""Localize a piece of a recording: join single poses by odometry, and localize doubtful queries again.

The steps follow the LaMAR benchmark (Sarlin et al., ECCV 2022): place the odometry where most single poses agree, solve
a pose graph, localize doubtful queries again with the predicted poses as priors, and solve the graph once more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toolkit import geometry
from toolkit.geometry import Floats, Ints
from toolkit.manifest import SequenceSettings
from toolkit.pose.base import RoughPose
from toolkit.pose.result import QueryResult, Status, agree, stds_of
from toolkit.sequences.odometry import UNKNOWN_COVARIANCE, Odometry, PosedQueries, place, vote_weights
from toolkit.sequences.pose_graph import PlacedPiece, place_online, place_piece
from toolkit.threads import fixed_sums

Relocalize = Callable[[Sequence[tuple[int, RoughPose]]], Sequence[QueryResult]]
"""Function that localizes queries again: takes (frame in the piece, predicted pose) pairs, returns their estimates."""


@dataclass(frozen=True)
class LocalizedPiece:
    """The poses of a piece of odometry, and the intermediate results."""

    placed: PlacedPiece
    queries: PosedQueries
    """The single poses of the final graph: the first ones and those found again."""
    again: Mapping[int, QueryResult]
    """Estimates of the queries that were localized again near their predicted pose, by frame."""
    steps: Mapping[str, Floats]
    """world_from_rig (A, 4, 4) of the query frames after each of `STEPS`, NaN for none."""


STEPS = ("voted", "graph", "again")
"""`voted`: rigid odometry placed where most single poses agree. `graph`: the first pose graph. `again`: single poses,
after doubtful queries were localized again. The second pose graph gives the result."""


@fixed_sums
def localize_piece(
    odometry: Odometry,
    queries: PosedQueries,
    query_frames: Ints,
    settings: SequenceSettings,
    again: Relocalize | None = None,
) -> LocalizedPiece:
    """Return the poses of a piece of odometry: of all frames, or only of the queries if `settings.online`.

    Of all `query_frames` (A,), ascending, those in `queries` have a pose. Those that are not `ok` or do not fit the
    graph are localized `again`; None: they keep their poses. Raise ManifestError if GTSAM is not installed.
    """
    first = _placed(odometry, queries, query_frames, settings)
    sure = queries.frames[first.used & queries.trusted]
    predicted = query_frames[np.isfinite(first.world_from_rig[query_frames]).all(axis=(1, 2))]
    doubtful = np.setdiff1d(predicted, sure).tolist()
    relocalized: dict[int, QueryResult] = {}
    if again is not None and doubtful:
        stds = zip(*(each.tolist() for each in stds_of(first.covariances[doubtful])), strict=True)
        rough = [RoughPose(pose, *std) for pose, std in zip(first.world_from_rig[doubtful], stds, strict=True)]
        relocalized = dict(zip(doubtful, again(list(zip(doubtful, rough, strict=True))), strict=True))
    all_queries = with_relocalized(queries, relocalized)
    second = first if all_queries is queries else _placed(odometry, all_queries, query_frames, settings)
    singles = np.full((len(odometry), 4, 4), np.nan)
    singles[queries.frames] = queries.world_from_rig
    voted = np.full((len(query_frames), 4, 4), np.nan)
    if len(queries) and not settings.online:
        agreeing = queries.choose(place(odometry, queries, settings)[0].members)
        voted = _median_placement(odometry, agreeing) @ odometry.odom_from_rig[query_frames]
    graph = first.world_from_rig[query_frames]
    for frame, estimate in relocalized.items():
        if estimate.world_from_rig is not None:
            singles[frame] = estimate.world_from_rig
    steps = dict(zip(STEPS, (voted, graph, singles[query_frames]), strict=True))
    return LocalizedPiece(second, all_queries, relocalized, steps)


def _placed(odometry: Odometry, queries: PosedQueries, query_frames: Ints, settings: SequenceSettings) -> PlacedPiece:
    if settings.online:
        return place_online(odometry, queries, query_frames, settings)
    return place_piece(odometry, queries, settings)


def _median_placement(odometry: Odometry, agreeing: PosedQueries) -> Floats:
    """Return world_from_odom (4, 4) by the query that predicts the positions of the queries best, in the median."""
    moved, poses = odometry.odom_from_rig[agreeing.frames], agreeing.world_from_rig
    candidates = poses @ geometry.invert(moved)
    predicted = (candidates[:, :3] @ moved[:, :, 3].T).transpose(0, 2, 1)
    off_m = np.linalg.norm(predicted - poses[:, :3, 3], axis=2)
    return np.asarray(candidates[int(np.argmin(np.median(off_m, axis=1)))])


def with_relocalized(queries: PosedQueries, relocalized: Mapping[int, QueryResult]) -> PosedQueries:
    """Return the single poses, updated with poses that were found again near a predicted pose.

    A new pose that agrees with the first pose of its frame replaces it. Any other new pose is added without a vote on
    the placement of the odometry, because it was searched near that placement.
    """
    if not relocalized:
        return queries
    poses, covariances = queries.world_from_rig.copy(), queries.covariances.copy()
    added: dict[int, QueryResult] = {}
    for frame, estimate in relocalized.items():
        if estimate.world_from_rig is None or estimate.covariance is None:
            continue
        same = [row for row in np.flatnonzero(queries.frames == frame) if agree(poses[row], estimate.world_from_rig)]
        if same:
            poses[same[0]], covariances[same[0]] = estimate.world_from_rig, estimate.covariance
        else:
            added[frame] = estimate
    voters = replace(queries, world_from_rig=poses, covariances=covariances)
    silent = replace(queries_of(added), weights=np.zeros(len(added)), trusted=np.zeros(len(added), bool))
    return voters.joined(silent)


def queries_of(estimates: Mapping[int, QueryResult]) -> PosedQueries:
    """Return the estimates with a pose, by frame, as input of a pose graph."""
    posed = {frame: each for frame, each in sorted(estimates.items()) if each.world_from_rig is not None}
    rows = list(posed.values())
    trusted = np.array([each.status is Status.OK for each in rows], bool)
    covariances = [UNKNOWN_COVARIANCE if each.covariance is None else each.covariance for each in rows]
    p_correct = np.array([each.p_correct for each in rows])
    rival_support = np.array([each.rival_support for each in rows])
    return PosedQueries(
        np.array(list(posed), np.int64),
        np.array([each.world_from_rig for each in rows]).reshape(-1, 4, 4),
        np.array(covariances).reshape(-1, 6, 6),
        vote_weights(trusted, p_correct, rival_support),
        trusted,
    )
