"""Pose graph: the most probable poses of a piece of odometry, given the poses of single queries in it.

The steps follow the LaMAR benchmark (Sarlin et al., ECCV 2022): place the odometry where most single poses agree, solve
a pose graph, localize doubtful queries again with the predicted poses as priors, and solve the graph once more.

The variables are all poses of the piece. Each odometry step is a relative pose with the covariance of its drift; each
single query is a pose prior with its own covariance. Solved by GTSAM (F. Dellaert and GTSAM Contributors,
https://gtsam.org).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.errors import ArtifactError, optional
from toolkit.geometry import Floats, Ints
from toolkit.manifest import SequenceSettings
from toolkit.pose.base import QueryResult, RoughPose, Status, agree, stds_of
from toolkit.sequences.odometry import (
    UNKNOWN_COVARIANCE,
    Odometry,
    PosedQueries,
    bounded,
    cut,
    first_guess,
    fitted_scale,
    place,
    vote_weights,
    with_measured_drift,
)
from toolkit.threads import fixed_sums

_CHI2_999 = 22.46
"""99.9 % quantile of the chi-squared distribution with 6 degrees of freedom."""
_ROUNDS = 8
"""Largest number of iterations of solving the graph and choosing the queries that fit."""
MAX_STD_DEG, MAX_STD_M = 2.25, 0.2
"""Largest standard deviation of an `ok` pose, over all axes: 5 degrees and 0.5 m are more than 2.2 times as much."""
FAR, NO_QUERY = "odometry is not sure so far from a query", "no query of this piece has a pose"
"""Reasons of a status."""


@dataclass(frozen=True)
class PlacedPiece:
    """The poses of one piece of odometry in the map."""

    world_from_rig: Floats
    """(N, 4, 4), NaN for frames without a pose: all frames if no query has a pose, online those without a query."""
    covariances: Floats
    """(N, 6, 6) of a small motion in the rig's frame: rotation, radians, then translation, meters."""
    used: NDArray[np.bool_]
    """(Q,) whether each query fits the poses; online, whether it fits the pose of its own frame."""
    status: NDArray[np.object_]
    """(N,) `Status`; online None for frames without a query."""
    reason: NDArray[np.object_]
    """(N,) texts, empty for `ok`."""
    voted: Floats
    """(N, 4, 4) world_from_rig by rigid odometry, placed where most queries agree; NaN online and without a query."""
    scale: float = 1.0
    """Scale factor of the odometry; 1 online and of several pieces."""

    def __len__(self) -> int:
        return len(self.status)

    @classmethod
    def nowhere(cls, frames: int, queries: int, status: Status | None, reason: str = "") -> "PlacedPiece":
        """Return a piece without poses."""
        poses, covariances = (np.full((frames, size, size), np.nan) for size in (4, 6))
        texts = np.array([status] * frames, object), np.full(frames, reason, object)
        return cls(poses, covariances, np.zeros(queries, bool), *texts, poses.copy())

    @classmethod
    def joined(cls, pieces: "Sequence[PlacedPiece]") -> "PlacedPiece":
        """Return several pieces as one."""
        names = vars(pieces[0]).keys() - {"scale"}
        joined: dict[str, Any] = {name: np.concatenate([vars(piece)[name] for piece in pieces]) for name in names}
        return cls(**joined) if len(pieces) > 1 else pieces[0]


def place_online(odometry: Odometry, queries: PosedQueries, frames: Ints, settings: SequenceSettings) -> PlacedPiece:
    """Return the poses of some frames of a piece, each only from the last `settings.length_s` seconds before it."""
    piece = PlacedPiece.nowhere(len(odometry), len(queries), None)
    for frame in frames.tolist():
        until = slice(0, frame + 1)
        past, chosen, drifting = latest_part(odometry.part(until), queries.part(until), settings)
        placed = place_piece(past, chosen, drifting)
        piece.world_from_rig[frame], piece.covariances[frame] = placed.world_from_rig[-1], placed.covariances[-1]
        piece.status[frame], piece.reason[frame] = placed.status[-1], placed.reason[-1]
        piece.used[queries.frames == frame] = placed.used[chosen.frames == len(past) - 1]
    return piece


def latest_part(
    odometry: Odometry, queries: PosedQueries, settings: SequenceSettings
) -> tuple[Odometry, PosedQueries, SequenceSettings]:
    """Return the last `settings.length_s` seconds after the last loss of tracking, and settings of the drift there."""
    times, length_s = odometry.timestamps, settings.length_s
    past = slice(0 if length_s is None else int(np.searchsorted(times, times[-1] - length_s * 1e6)), len(times))
    odometry, queries = odometry.part(past), queries.part(past)
    settings = with_measured_drift([(odometry, queries)], settings)
    last = cut(odometry, queries, settings)[-1]
    return odometry.part(last), queries.part(last), settings


def place_piece(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> PlacedPiece:
    """Return the poses of a piece of odometry, from the poses of single queries in it."""
    count = len(odometry)
    if not len(queries):
        return PlacedPiece.nowhere(count, 0, Status.FAILED, NO_QUERY)
    best = place(odometry, queries, settings)[0]
    used, seen = best.members, set[bytes]()
    for _ in range(_ROUNDS):
        chosen = queries.choose(used)
        scale = fitted_scale(odometry, chosen, settings)
        moved = odometry.scaled(scale)
        poses, covariances = _optimized(moved, chosen, settings)
        seen.add(used.tobytes())
        # Use the queries that fit the solution, whether or not they voted for this placement.
        fit = np.flatnonzero(_chi2(poses, covariances, queries) < _CHI2_999)
        if not len(fit) or fit.tobytes() in seen:
            break
        used = fit
    mask = np.isin(np.arange(len(queries)), used)
    status, reasons = np.array([Status.OK] * count, object), np.full(count, "", object)
    if not best.trusted:
        # `ok` queries that do not fit keep their own poses, because odometry may be what is wrong.
        alone = queries.choose(queries.trusted & ~mask)
        reason = "no query of this piece is sure"
        if 2 * len(alone) > np.count_nonzero(queries.trusted):
            reason = "odometry contradicts the queries"
        elif best.rival_support >= 0.5 * best.support > 0:
            reason = "another place is as likely"
        status[:], reasons[:] = Status.LOW_CONFIDENCE, reason
        status[alone.frames], reasons[alone.frames], poses[alone.frames] = Status.OK, "", alone.world_from_rig
        covariances[alone.frames] = bounded(alone.covariances)
    far = (status == Status.OK) & ~is_sure(covariances)
    status[far], reasons[far] = Status.LOW_CONFIDENCE, FAR
    voted = _median_placement(odometry, queries.choose(best.members)) @ odometry.odom_from_rig
    return PlacedPiece(poses, covariances, mask, status, reasons, voted, scale)


def is_sure(covariances: Floats) -> NDArray[np.bool_]:
    """Return which poses (n,) are certain enough for `ok`, from their covariances (n, 6, 6)."""
    rotation_std_deg, position_std_m = stds_of(covariances)
    return np.asarray((rotation_std_deg <= MAX_STD_DEG) & (position_std_m <= MAX_STD_M))


def _chi2(poses: Floats, covariances: Floats, queries: PosedQueries) -> Floats:
    """Return squared Mahalanobis distances (Q,) of single poses to the graph's, under the sum of their covariances."""
    frames = queries.frames
    difference = geometry.small_motions(geometry.invert(poses[frames]) @ queries.world_from_rig)
    total = bounded(queries.covariances) + covariances[frames]
    return np.asarray(np.einsum("qi,qi->q", difference, np.linalg.solve(total, difference[..., None])[..., 0]))


def _optimized(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> tuple[Floats, Floats]:
    """Solve the pose graph; raise ArtifactError if its linear system is singular in float64.

    Return world_from_rig (N, 4, 4) and covariances (N, 6, 6).
    """
    gtsam = optional("gtsam")
    graph, values = _motion_graph(odometry, queries, settings), gtsam.Values()
    for number, pose in enumerate(first_guess(odometry, queries)):
        values.insert(number, gtsam.Pose3(_rigid(pose)))
    try:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        marginals = gtsam.Marginals(graph, result)
    except RuntimeError as error:
        said = str(error).strip().partition("\n")[0]
        raise ArtifactError(f"The pose graph of {len(odometry)} frames cannot be solved ({said}).") from None
    numbers = range(len(odometry))
    poses = np.stack([result.atPose3(number).matrix() for number in numbers])
    return poses, np.stack([marginals.marginalCovariance(number) for number in numbers])


def _motion_graph(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> Any:
    """Return GTSAM's graph of N poses, with factors for odometry steps and poses of queries."""
    gtsam = optional("gtsam")
    graph = gtsam.NonlinearFactorGraph()
    steps = geometry.invert(odometry.odom_from_rig[:-1]) @ odometry.odom_from_rig[1:]
    first: Ints = np.arange(len(steps))
    rotation_std, position_std = odometry.drift(settings, first, first + 1)
    # The scale also varies along the path.
    position_std = np.hypot(position_std, settings.scale_std * np.linalg.norm(steps[:, :3, 3], axis=1))
    # A device that stands still has no drift; the floor keeps the factors finite.
    rotation_std, position_std = np.maximum(rotation_std, 1e-4), np.maximum(position_std, 1e-3)
    for number, step in enumerate(steps):
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([rotation_std[number], position_std[number]], 3))
        graph.add(gtsam.BetweenFactorPose3(number, number + 1, gtsam.Pose3(_rigid(step)), noise))
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(3.0)
    for frame, pose, covariance in zip(queries.frames.tolist(), queries.world_from_rig, bounded(queries.covariances),
                                       strict=True):  # fmt: skip
        noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(covariance))
        graph.add(gtsam.PriorFactorPose3(frame, gtsam.Pose3(_rigid(pose)), noise))
    return graph


def _rigid(pose: Floats) -> Floats:
    """Return a pose (4, 4) with an exact rotation; rotations in files are rounded."""
    return geometry.pose_from_qt(geometry.qt_from_pose(pose))


Relocalize = Callable[[Sequence[tuple[int, RoughPose]]], Sequence[QueryResult]]
"""Function that localizes queries again: takes (frame, predicted pose) pairs, returns their estimates."""


@dataclass(frozen=True)
class LocalizedPieces:
    """The poses of the frames of one or more pieces of odometry, and the intermediate results."""

    placed: PlacedPiece
    """All pieces joined."""
    piece: Ints
    """(N,) number of each frame's piece."""
    queries: PosedQueries
    """The single poses of the final graph: the first ones and those found again."""
    relocalized: dict[int, QueryResult]
    """Estimates of the queries that were localized again near their predicted pose, by frame."""
    steps: Mapping[str, Floats]
    """world_from_rig (A, 4, 4) of the query frames after each of `STEPS`, NaN for none."""


STEPS = ("voted", "graph", "again")
"""`voted`: rigid odometry placed where most single poses agree. `graph`: the first pose graph. `again`: single poses,
after doubtful queries were localized again. The second pose graph gives the result."""


def pieces_of(
    odometry: Odometry, parts: Sequence[slice], queries: PosedQueries, settings: SequenceSettings
) -> tuple[list[slice], SequenceSettings]:
    """Return the pieces of a device's recordings, and settings with the drift that the queries show.

    `parts` are all frames in order, without a loss of tracking that odometry itself shows. Unless `settings.online`,
    they are cut at those that the queries show.
    """
    if settings.online:  # both use later frames
        return list(parts), settings
    of_parts = [(odometry.part(rows), queries.part(rows)) for rows in parts]
    settings = with_measured_drift(of_parts, settings)
    cuts = zip(parts, (cut(*of_part, settings) for of_part in of_parts), strict=True)
    return [slice(rows.start + at.start, rows.start + at.stop) for rows, within in cuts for at in within], settings


@fixed_sums
def localize_pieces(
    odometry: Odometry,
    queries: PosedQueries,
    query_frames: Ints,
    settings: SequenceSettings,
    relocalize: Relocalize | None = None,
    pieces: Sequence[slice] = (),
) -> LocalizedPieces:
    """Return the poses of pieces of odometry: of all frames, or only of the queries if `settings.online`.

    Of all `query_frames` (A,), ascending, those in `queries` have a pose. Those that are not `ok` or do not fit the
    graph are localized by `relocalize`; None, or `settings.relocalize` is false: they keep their poses. `pieces` are
    all frames in order; none: the odometry is one piece. Raise ManifestError if GTSAM is not installed.
    """
    pieces = pieces or [slice(0, len(odometry))]

    def placed(queries: PosedQueries, rows: slice) -> PlacedPiece:
        of_piece = odometry.part(rows), queries.part(rows)
        if not settings.online:
            return place_piece(*of_piece, settings)
        within = (query_frames >= rows.start) & (query_frames < rows.stop)
        return place_online(*of_piece, query_frames[within] - rows.start, settings)

    each = [placed(queries, rows) for rows in pieces]
    first = PlacedPiece.joined(each)
    sure = queries.frames[first.used & queries.trusted]
    predicted = query_frames[np.isfinite(first.world_from_rig[query_frames]).all(axis=(1, 2))]
    doubtful = np.setdiff1d(predicted, sure).tolist()
    relocalized: dict[int, QueryResult] = {}
    if settings.relocalize and relocalize is not None and doubtful:
        stds = zip(*(values.tolist() for values in stds_of(first.covariances[doubtful])), strict=True)
        rough = [RoughPose(pose, *std) for pose, std in zip(first.world_from_rig[doubtful], stds, strict=True)]
        relocalized = dict(zip(doubtful, relocalize(list(zip(doubtful, rough, strict=True))), strict=True))
    all_queries = with_relocalized(queries, relocalized)
    for number, rows in enumerate(pieces):
        if any(rows.start <= frame < rows.stop for frame in relocalized):
            each[number] = placed(all_queries, rows)
    singles = np.full((len(odometry), 4, 4), np.nan)
    singles[queries.frames] = queries.world_from_rig
    for frame, estimate in relocalized.items():
        if estimate.world_from_rig is not None:
            singles[frame] = estimate.world_from_rig
    steps = (poses[query_frames] for poses in (first.voted, first.world_from_rig, singles))
    of_steps, piece = dict(zip(STEPS, steps, strict=True)), np.repeat(np.arange(len(pieces)), [*map(len, each)])
    return LocalizedPieces(PlacedPiece.joined(each), piece, all_queries, relocalized, of_steps)


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
