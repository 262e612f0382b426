"""Say how good poses are: errors, recall, retrieval recall, and where accuracy was lost."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.devices import color_of, in_order
from toolkit.capture.tables import read_query_table
from toolkit.errors import ArtifactError, CaptureError, ToolkitError
from toolkit.files import image_name, pair_name, read_references, write_atomic, write_sidecar
from toolkit.geometry import invert, pose_error, transform
from toolkit.manifest import EvaluateSettings
from toolkit.show.figures import ORANGE, SKY, VERMILLION, new_figure, save_figure, styled

if TYPE_CHECKING:
    import pycolmap
    from matplotlib.figure import Figure

    from toolkit.localizers.mapping import LocalMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Threshold = tuple[float, float]

THRESHOLDS: tuple[Threshold, ...] = ((1, 0.1), (5, 0.5), (5, 1.0))
# An `ok` pose beyond this is a false promise: the share of those is the number that downstream users ask for.
WRONG: Threshold = (5, 0.5)

FIGURES = ("recall", "median_errors", "error_curves", "losses", "retrieval")
ERROR_COLUMNS = ["map_device", "query_device", "timestamp", "device_id", "status", "num_inliers",
                 "rotation_error_deg", "translation_error_m"]  # fmt: skip

# A first reference overlaps with the query if the query sees at least this share of the map points that it sees.
LEAST_OVERLAP = 0.1

NO_REFERENCE, NO_POSE, WRONG_POSE = REASONS = ("no good reference", "no pose", "wrong pose")


# Errors and recall


def pose_errors(
    estimated: "Trajectory | Array", truth: "Trajectory | Array", keys: pd.DataFrame | None = None
) -> tuple[Array, Array]:
    """Return the rotation error, degrees, and the translation error, meters, of each query, (N,) each.

    As the LaMAR benchmark defines them: angle and length of inverse(estimated) @ true. A query without an
    estimate has infinite errors; one without a true pose, NaN.

    Args:
        estimated: world_from_device of the queries, a trajectory, or (N, 4, 4) with NaN where there is none.
        truth: the same, true.
        keys: the queries, columns `timestamp` and `device_id`; needed where a trajectory is given.
    """
    estimates, truths = _poses_of(estimated, keys), _poses_of(truth, keys)
    if estimates.shape != truths.shape:
        raise ValueError(f"Expected one true pose an estimate, got {truths.shape} for {estimates.shape}.")
    known = np.isfinite(truths).all((-1, -2))
    found = np.isfinite(estimates).all((-1, -2))
    rotation_deg = np.where(known, np.inf, np.nan)
    translation_m = rotation_deg.copy()
    both = known & found
    if both.any():
        rotation_deg[both], translation_m[both] = pose_error(estimates[both], truths[both])
    return rotation_deg, translation_m


def recall(
    rotation_deg: Array, translation_m: Array, thresholds: Sequence[Threshold] = THRESHOLDS
) -> NDArray[np.float64]:
    """Return the share of queries, 0 to 1, with both errors strictly below each (degrees, meters) pair.

    All queries count; one without a pose has infinite errors and is a miss. NaN where there is no query.
    """
    rotation_deg, translation_m = np.asarray(rotation_deg), np.asarray(translation_m)
    if not len(rotation_deg):
        return np.full(len(thresholds), np.nan)
    return np.array([np.mean(_below(rotation_deg, translation_m, threshold)) for threshold in thresholds])


def threshold_name(threshold: Threshold) -> str:
    """Return `(1deg,0.1m)`, the name of a threshold in tables."""
    return f"({threshold[0]:g}deg,{threshold[1]:g}m)"


def _below(rotation_deg: Array, translation_m: Array, threshold: Threshold) -> NDArray[np.bool_]:
    return (rotation_deg < threshold[0]) & (translation_m < threshold[1])


def _poses_of(poses: "Trajectory | Array", keys: pd.DataFrame | None) -> Array:
    if isinstance(poses, np.ndarray):
        return poses
    if keys is None:
        raise ValueError("A trajectory needs `keys`: which queries, columns timestamp and device_id.")
    return poses.lookup(keys["timestamp"].to_numpy(np.int64), keys["device_id"].to_numpy(str))


# A scene


@dataclass
class Evaluation:
    """The tables of a scene; rows for every pair, also those that could not be evaluated (column `state`)."""

    recall: pd.DataFrame
    """One row a pair: counts, recall, medians over all queries (a missing pose is infinite), `ok_wrong`."""
    errors: pd.DataFrame
    """One row a query of a pair: errors, status, inliers, and why it misses each threshold."""
    retrieval: pd.DataFrame
    """One row a pair: share of queries with a good reference among the first K, and in the map at all."""
    losses: pd.DataFrame
    """One row a pair and threshold: queries missed, by reason."""
    overlap: pd.DataFrame
    """One row a pair: query images, and the share of them whose first reference overlaps with them in view."""
    thresholds: tuple[Threshold, ...] = THRESHOLDS
    messages: list[str] = field(default_factory=list)
    """What was not evaluated, and why; empty where all was."""


def evaluate_scene(
    sessions_root: str | Path,
    poses_dir: str | Path,
    retrieval_dir: str | Path | None,
    out_dir: str | Path | None,
    settings: EvaluateSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    queries: str = "keyframes_pruned_subsampled",
    at: str = "device",
    pairs: Sequence[Sequence[str]] | None = None,
    reranked_dir: str | Path | None = None,
    map_dir: str | Path | None = None,
) -> Evaluation:
    """Evaluate the poses of all pairs of a scene and write tables and figures.

    A pair whose poses are missing, or whose query session has no ground truth, gets a row that says so.

    Args:
        sessions_root: folder `sessions/` of the capture.
        poses_dir: folder of `SCENE_map_<M>_query_<Q>.txt`, and `.csv` where there is one.
        retrieval_dir: folder of `SCENE_map_<M>_query_<Q>.jsonl`; None skips retrieval recall.
        out_dir: where `{recall,errors,retrieval,losses,overlap}.csv` and the figures go; None: nowhere.
        settings: see `EvaluateSettings`; a dict holds what differs from the defaults.
        map_device: `all` or one device key; likewise `query_device`.
        queries: the keyframe list that is asked; all of it is the denominator.
        at: `device` has one error a query device; `camera` one a camera image of it, as the benchmark's own
            code evaluates rigs.
        pairs: only these [map device, query device]; None: all.
        reranked_dir: folder of the reranked references, if queries were localized with those: retrieval recall is
            then theirs, and overlap is shown before and after.
        map_dir: folder of the triangulated maps, which say what a reference sees.

    Raises:
        ToolkitError: an unknown device or `at`, or no pair to evaluate.
    """
    if at not in ("device", "camera"):
        raise ToolkitError(f"Unknown at={at!r}. Known: device, camera.")
    settings = EvaluateSettings.of(settings)
    pairs_of_thresholds = tuple((float(degrees), float(meters)) for degrees, meters in settings.thresholds)
    capture = Capture.from_sessions_root(sessions_root)
    map_devices = _devices(capture, "map", map_device)
    rows: dict[str, list[dict[str, Any]]] = {"recall": [], "retrieval": [], "losses": []}
    errors: list[pd.DataFrame] = []
    messages: list[str] = []
    for query in _devices(capture, "query", query_device):
        session = capture[f"{query}_query"]
        keys, truth = _queries_with_truth(session, queries, messages)
        for map_ in map_devices:
            if pairs is not None and [map_, query] not in [list(asked) for asked in pairs]:
                continue
            pair = {"map_device": map_, "query_device": query}
            name = pair_name(capture.name, map_, query)
            if not len(keys):
                for table in rows.values():
                    table.append({**pair, "state": "no ground truth"})
                continue
            good = None
            if retrieval_dir is not None:
                path = Path(retrieval_dir if reranked_dir is None else reranked_dir) / f"{name}.jsonl"
                limits = (settings.retrieval_radius_m, settings.retrieval_angle_deg)
                row, good = _retrieval_recall(path, keys, truth, capture[f"{map_}_map"], settings.retrieval_ks, limits)
                rows["retrieval"].append({**pair, **row})
                if good is None:
                    messages.append(f"{name}: {row['state']}, so a miss is not put down to retrieval.")
            results, state = _read_results(Path(poses_dir) / name, keys)
            if results is None:
                messages.append(f"{name}: {state}; its queries are not counted anywhere.")
                for kind in ("recall", "losses"):
                    rows[kind].append({**pair, "state": state, "queries": len(keys)})
                continue
            if state != "evaluated":
                messages.append(f"{name}: {state}.")
            frame = _errors_of(results, keys, truth, session, good, pairs_of_thresholds, at)
            errors.append(frame.assign(**pair))
            rows["recall"].append({**pair, "state": state, **_summary(frame, pairs_of_thresholds)})
            rows["losses"] += [{**pair, "state": state, **row} for row in _losses(frame, pairs_of_thresholds)]
    references = {"retrieved": retrieval_dir, "reranked": reranked_dir}
    known = {name: folder for name, folder in references.items() if folder is not None}
    evaluation = Evaluation(
        _table(rows["recall"], ["map_device", "query_device", "state", "queries"]),
        _leading(pd.concat(errors), ["map_device", "query_device"])
        if errors
        else pd.DataFrame(columns=ERROR_COLUMNS),
        _table(rows["retrieval"], ["map_device", "query_device", "state"]),
        _table(rows["losses"], ["map_device", "query_device", "state", "threshold", *REASONS]),
        overlap_table(sessions_root, known, map_dir, map_device, query_device, pairs),
        pairs_of_thresholds,
        list(dict.fromkeys(messages)),
    )
    for message in evaluation.messages:
        logger.warning(message)
    if out_dir is not None:
        record = {"poses": str(poses_dir), "queries": queries, "at": at, **settings.model_dump()}
        write_evaluation(evaluation, out_dir, record | {"messages": evaluation.messages})
    return evaluation


def write_evaluation(evaluation: Evaluation, out_dir: str | Path, settings: dict[str, Any]) -> None:
    """Write the tables as CSV, the figures as PNG, and beside recall.csv how they were made."""
    out = Path(out_dir)
    for name in ("recall", "errors", "retrieval", "losses", "overlap"):
        with write_atomic(out / f"{name}.csv") as temporary:
            getattr(evaluation, name).to_csv(temporary, index=False)
    figures = draw_evaluation(evaluation)
    for name in FIGURES:
        if name in figures:
            save_figure(figures[name], out / f"{name}.png")
        else:  # one of an earlier evaluation would mislead
            (out / f"{name}.png").unlink(missing_ok=True)
    write_sidecar(out / "recall.csv", settings)
    logger.info("Evaluated %d of %d pairs: %s", (evaluation.recall["state"] == "evaluated").sum(),
                len(evaluation.recall), out / "recall.csv")  # fmt: skip


def _devices(capture: Capture, split: str, wanted: str) -> list[str]:
    known = [device for device in capture.devices if f"{device}_{split}" in capture]
    if wanted == "all" and known:
        return known
    if wanted in known:
        return [wanted]
    raise ToolkitError(f"{capture.path}: no {split} session of device {wanted!r}. Known: {known or 'none'}.")


def _queries_with_truth(
    session: Session, queries: str, messages: list[str]
) -> tuple[pd.DataFrame, Trajectory | None]:
    truth = session.ground_truth
    if truth is None or not len(truth):
        messages.append(f"{session.id} has no ground truth; it is not evaluated.")
        return pd.DataFrame({"timestamp": [], "device_id": []}), None
    keys = session.keyframes(queries).reset_index(drop=True)
    known = np.isfinite(_poses_of(truth, keys)).all((1, 2))
    if not np.all(known):
        messages.append(
            f"{session.id}: {np.sum(~known)} of {len(keys)} queries have no ground truth and are left out."
        )
    return keys[known].reset_index(drop=True), truth


def _read_results(stem: Path, keys: pd.DataFrame) -> tuple[pd.DataFrame | None, str]:
    """Return `keys` with columns pose (4, 4), status and num_inliers; and the state of the pair."""
    path, table = stem.with_name(stem.name + ".txt"), stem.with_name(stem.name + ".csv")
    if not path.is_file():
        return None, "no poses file"
    try:
        poses = Trajectory.read(path)
    except CaptureError as error:
        return None, f"unreadable poses file ({error})"
    results = keys.copy()
    found = _poses_of(poses, keys)
    results["pose"] = list(found)
    located = np.isfinite(found).all((1, 2))
    # A file of another tool has poses only; then a pose is a pose.
    results["status"] = np.where(located, "ok", "failed: no pose")
    results["num_inliers"] = np.nan
    if not table.is_file():
        return results, "evaluated"
    columns = ["timestamp", "device_id"]
    try:
        details = read_query_table(table, ["status"]).drop_duplicates(columns)
    except ArtifactError as error:
        return results, f"unreadable table of queries ({error})"
    merged = keys.merge(details, how="left", on=columns)
    known = merged["status"].notna().to_numpy()
    if "num_inliers" in merged:
        results["num_inliers"] = merged["num_inliers"].to_numpy(float)
    results.loc[known, "status"] = merged.loc[known, "status"].to_numpy(str)
    failed = results["status"].str.startswith("failed").to_numpy(bool)
    asked = f"{known.sum()} of {len(keys)} queries have a row in {table.name}"
    if not known.all():
        return results, f"stale: {asked}"
    if np.any(failed == located):
        return results, f"stale: {table.name} and {path.name} differ in which queries have a pose"
    return results, "evaluated"


def _errors_of(
    results: pd.DataFrame,
    keys: pd.DataFrame,
    truth: Trajectory | None,
    session: Session,
    good: NDArray[np.bool_] | None,
    thresholds: Sequence[Threshold],
    at: str,
) -> pd.DataFrame:
    estimated, true = np.stack(results["pose"].to_list()), _poses_of(truth, keys)  # type: ignore[arg-type]
    frame = results.drop(columns="pose")
    if good is not None:
        frame["good_reference"] = good
    if at == "camera":
        rows = session.rows_of_keyframes(keys)
        device = np.repeat(np.arange(len(keys)), [len(r) for r in rows])
        images = np.concatenate(rows)
        device_from_cam = session.rig_from_cam(images)
        estimated, true = estimated[device] @ device_from_cam, true[device] @ device_from_cam
        frame = frame.iloc[device].reset_index(drop=True)
        frame.insert(2, "sensor_id", session.images["sensor_id"].to_numpy()[images])
    rotation_deg, translation_m = pose_errors(estimated, true)
    frame["rotation_error_deg"], frame["translation_error_m"] = rotation_deg, translation_m
    no_reference = np.zeros(len(frame), bool) if good is None else ~frame["good_reference"].to_numpy(bool)
    reason = np.select([no_reference, ~np.isfinite(rotation_deg)], [NO_REFERENCE, NO_POSE], WRONG_POSE)
    for threshold in thresholds:
        hit = _below(rotation_deg, translation_m, threshold)
        frame[f"loss@{threshold_name(threshold)}"] = np.where(hit, "", reason)
    return frame


def _summary(frame: pd.DataFrame, thresholds: Sequence[Threshold]) -> dict[str, Any]:
    rotation_deg = frame["rotation_error_deg"].to_numpy(float)
    translation_m = frame["translation_error_m"].to_numpy(float)
    status = frame["status"]
    ok = (status == "ok").to_numpy()
    row: dict[str, Any] = {
        "queries": len(frame),
        "localized": int(np.isfinite(rotation_deg).sum()),
        "ok": int(ok.sum()),
        "low_confidence": int((status == "low_confidence").sum()),
        "failed": int(status.str.startswith("failed").sum()),
    }
    for threshold, share in zip(thresholds, recall(rotation_deg, translation_m, thresholds), strict=True):
        row[f"recall@{threshold_name(threshold)}"] = share
    row["median_rotation_deg"] = float(np.median(rotation_deg))
    row["median_translation_m"] = float(np.median(translation_m))
    row["ok_wrong"] = float(np.mean(ok & ~_below(rotation_deg, translation_m, WRONG)))
    return row


def _losses(frame: pd.DataFrame, thresholds: Sequence[Threshold]) -> list[dict[str, Any]]:
    rows = []
    for name in map(threshold_name, thresholds):
        counts = frame[f"loss@{name}"].value_counts()
        reasons = {reason: int(counts.get(reason, 0)) for reason in REASONS}
        missed = sum(reasons.values())
        rows.append({"threshold": name, "queries": len(frame), "missed": missed, **reasons})
    return rows


def _table(rows: list[dict[str, Any]], leading: list[str]) -> pd.DataFrame:
    return _leading(pd.DataFrame(rows), leading)


def _leading(frame: pd.DataFrame, leading: list[str]) -> pd.DataFrame:
    """Return the table with these columns first; rows sorted so that the pairs of one map stand together."""
    frame = frame.reindex(columns=[*leading, *(c for c in frame.columns if c not in leading)])
    order = {device: rank for rank, device in enumerate(in_order(frame["map_device"]))}
    return frame.sort_values(["map_device"], kind="stable", key=lambda s: s.map(order)).reset_index(drop=True)


# Retrieval


def _retrieval_recall(
    path: Path,
    keys: pd.DataFrame,
    truth: Trajectory | None,
    map_session: Session,
    ks: Sequence[int],
    limits: tuple[float, float],
) -> tuple[dict[str, Any], NDArray[np.bool_] | None]:
    """Return a row of the retrieval table, and for each query whether it has any good reference."""
    if not path.is_file():
        return {"state": "no retrieval file", "queries": len(keys)}, None
    try:
        lines = read_references(path)
        index = pd.DataFrame(
            {"timestamp": [int(x["timestamp"]) for x in lines], "device_id": [x["device_id"] for x in lines]}
        )
        device_from_cam = np.array([x["Trs"] for x in lines], float).reshape(-1, 4, 4)
        depth = max((len(x["topk"]) for x in lines), default=0)
        references = np.full((len(lines), depth, 4, 4), np.nan)
        for i, line in enumerate(lines):
            for rank, reference in enumerate(line["topk"]):
                references[i, rank] = reference["Tws"]
    except (ArtifactError, ValueError, KeyError, TypeError) as error:
        state = f"unreadable retrieval file ({type(error).__name__}: {error})"
        return {"state": state, "queries": len(keys)}, None
    cameras = _poses_of(truth, index) @ device_from_cam  # type: ignore[arg-type]
    near = _is_near(references, cameras[:, None], limits)
    best = np.where(near.any(1), near.argmax(1), np.inf) if depth else np.full(len(lines), np.inf)
    in_map = _near_any(cameras, map_session.world_from_cam(), limits)
    # A query device has a good reference where any of its cameras has one.
    frame = index.assign(rank=best, in_map=in_map).groupby(["timestamp", "device_id"], as_index=False)
    by_device = keys.merge(frame.agg(rank=("rank", "min"), in_map=("in_map", "any")), how="left")
    rank = by_device["rank"].fillna(np.inf).to_numpy(float)
    row: dict[str, Any] = {
        "state": "evaluated",
        "queries": len(keys),
        "radius_m": limits[0],
        "angle_deg": limits[1],
    }
    row |= {f"recall@{k}": float(np.mean(rank < k)) for k in ks}
    in_map = by_device["in_map"].astype("boolean").fillna(False).to_numpy(bool)
    return {**row, "in_map": float(np.mean(in_map))}, np.isfinite(rank)


def _is_near(a: Array, b: Array, limits: tuple[float, float]) -> NDArray[np.bool_]:
    """Return whether cameras a and b, world_from_cam (..., 4, 4), stand and look alike; False for NaN."""
    distance = np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1)
    cosine = np.sum(a[..., :3, 2] * b[..., :3, 2], axis=-1)
    return (distance <= limits[0]) & (cosine >= np.cos(np.radians(limits[1])))


def _near_any(cameras: Array, map_cameras: Array, limits: tuple[float, float]) -> NDArray[np.bool_]:
    from scipy.spatial import cKDTree

    map_cameras = map_cameras[np.isfinite(map_cameras).all((1, 2))]
    known = np.flatnonzero(np.isfinite(cameras).all((1, 2)))
    near = np.zeros(len(cameras), bool)
    if len(map_cameras) and len(known):
        tree = cKDTree(map_cameras[:, :3, 3])
        for row, hits in zip(known, tree.query_ball_point(cameras[known, :3, 3], limits[0]), strict=True):
            near[row] = _is_near(map_cameras[hits], cameras[row], limits).any()
    return near


# Overlap


def overlap_in_view(points: Array, reference: Array, world_from_cam: Array, camera: "pycolmap.Camera") -> float:
    """Return the share, 0 to 1, of the points that a reference sees which lie in the view of another camera.

    The overlap of two images by sparse points, as M. Dusmanu et al., "D2-Net", CVPR 2019, choose training pairs. A
    point that the camera would look at from behind (over 90 degrees from the reference's line of sight) is not seen.

    Args:
        points: (P, 3) triangulated points that the reference observes, world, meters.
        reference: (3,) its center.
        world_from_cam: (4, 4) the other camera's pose.
        camera: its intrinsics.
    """
    from toolkit.capture.cameras import in_view, view_bounds

    if not len(points):
        return 0.0
    in_cam = transform(invert(world_from_cam), points)
    same_side = np.sum((points - reference) * (points - world_from_cam[:3, 3]), axis=1) > 0
    seen = in_view(in_cam[None], view_bounds(camera)[None])[0] & same_side
    return float(seen.mean())


def overlap_table(
    sessions_root: str | Path,
    references: Mapping[str, str | Path],
    map_dir: str | Path | None,
    map_device: str = "all",
    query_device: str = "all",
    pairs: Sequence[Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Return for each pair the share of query images whose first reference overlaps with them in view, by true poses.

    A reference overlaps with a query image if at least `LEAST_OVERLAP` of the triangulated map points that it observes
    lie in the image's view (`overlap_in_view`); where no map is triangulated yet, of points laid at 2, 4, 8 and 16 m
    into the reference's view.

    Args:
        sessions_root: folder `sessions/` of the capture.
        references: folders of references (`SCENE_map_<M>_query_<Q>.jsonl`) by the names of their columns.
        map_dir: folder of the triangulated maps.
        map_device: `all` or one device key; likewise `query_device`.
        pairs: only these [map device, query device]; None: all.

    Returns:
        One row a pair: map_device, query_device, state, images (with references and a true pose), points (`map` or
        `view`), and for each name `<name>` (share) and `<name>_mean` (mean overlap).
    """
    capture = Capture.from_sessions_root(sessions_root)
    rows = []
    for map_ in _devices(capture, "map", map_device):
        scene = _MapView.open(capture[f"{map_}_map"], None if map_dir is None else Path(map_dir))
        for query in _devices(capture, "query", query_device):
            if references and (pairs is None or [map_, query] in [list(asked) for asked in pairs]):
                session, name = capture[f"{query}_query"], pair_name(capture.name, map_, query)
                row: dict[str, Any] = {"map_device": map_, "query_device": query, "state": "evaluated"}
                for column, folder in references.items():
                    row |= _overlap(Path(folder) / f"{name}.jsonl", column, session, scene)
                rows.append(row)
    return _table(rows, ["map_device", "query_device", "state", "images", "points"])


def _overlap(path: Path, name: str, session: Session, scene: "_MapView") -> dict[str, Any]:
    """Return what a file of references adds to a row of the overlap table."""
    if session.ground_truth is None:
        return {"state": "no ground truth"}
    try:
        lines = read_references(path)
        times, devices = [int(line["timestamp"]) for line in lines], [line["device_id"] for line in lines]
        cameras = session.ground_truth.lookup(times, devices) @ np.array([x["Trs"] for x in lines]).reshape(-1, 4, 4)
        shares = []
        for line, camera in zip(lines, cameras, strict=True):
            if np.isfinite(camera).all():
                seen = scene.seen_by(line["topk"][0]) if line["topk"] else np.zeros((0, 3))
                center = np.array(line["topk"][0]["Tws"])[:3, 3] if line["topk"] else np.zeros(3)
                shares.append(overlap_in_view(seen, center, camera, session.camera(line["sensor_id"])))
    except (ArtifactError, OSError, ValueError, KeyError, TypeError) as error:
        return {"state": f"{path.name} of the {name} cannot be read ({type(error).__name__})"}
    row: dict[str, Any] = {"images": len(shares), "points": "view" if scene.local_map is None else "map"}
    if shares:
        row |= {name: float(np.mean(np.array(shares) >= LEAST_OVERLAP)), f"{name}_mean": float(np.mean(shares))}
    return row


@dataclass(frozen=True)
class _MapView:
    """What the images of a map see."""

    session: Session
    local_map: "LocalMap | None"

    @classmethod
    def open(cls, session: Session, map_dir: Path | None) -> "_MapView":
        from toolkit.localizers.mapping import LocalMap

        with suppress(ArtifactError):
            return cls(session, None if map_dir is None else LocalMap.load(map_dir / f"{session.id}.npz"))
        return cls(session, None)

    def seen_by(self, reference: dict[str, Any]) -> Array:
        """Return the points (P, 3) that a reference sees, world, meters."""
        if self.local_map is not None:
            image = self.local_map.index_of.get(image_name(str(reference["path"])))
            if image is None:
                return np.zeros((0, 3))
            return self.local_map.points[np.unique(self.local_map.observations(image)[1])]
        from toolkit.capture.cameras import view_bounds

        left, right, top, bottom = view_bounds(self.session.camera(reference["sensor_id"]))
        x, y = np.meshgrid(np.linspace(left, right, 9), np.linspace(top, bottom, 9))
        rays = np.stack([x, y, np.ones_like(x)], -1).reshape(1, -1, 3)
        points = (rays * np.array([2.0, 4.0, 8.0, 16.0])[:, None, None]).reshape(-1, 3)
        return transform(np.array(reference["Tws"], float), points)


# Figures


@styled
def draw_evaluation(evaluation: Evaluation) -> dict[str, "Figure"]:
    """Return the figures of an evaluation by name; those for which there is nothing to draw are left out."""
    figures: dict[str, Figure] = {}
    done = evaluation.recall[evaluation.recall.get("queries", pd.Series(dtype=float)).notna()]
    done = done.dropna(subset=["localized"]) if "localized" in done else done.iloc[:0]
    if len(done):
        names = [threshold_name(t) for t in evaluation.thresholds]
        titles = [f"recall @ {d:g}°, {m:g} m" for d, m in evaluation.thresholds]
        figures["recall"] = draw_matrices(
            done, [(f"recall@{n}", t, 100.0, "%") for n, t in zip(names, titles, strict=True)],
            "Share of queries localized within the threshold", "higher", (0, 100),
        )  # fmt: skip
        figures["median_errors"] = draw_matrices(
            done,
            [("median_rotation_deg", "median rotation error", 1.0, "°"),
             ("median_translation_m", "median translation error", 100.0, "cm")],
            "Median errors over all queries (∞: half of them have no pose)", "lower",
        )  # fmt: skip
        figures["error_curves"] = draw_error_curves(evaluation.errors, evaluation.thresholds)
        if evaluation.losses["missed"].sum():
            figures["losses"] = draw_losses(evaluation.losses)
    retrieval = evaluation.retrieval
    ks = [c for c in retrieval.columns if c.startswith("recall@")]
    if ks:
        known = retrieval.dropna(subset=ks)
        radius, angle = known["radius_m"].iloc[0], known["angle_deg"].iloc[0]
        figures["retrieval"] = draw_matrices(
            known, [(k, f"in the first {k.removeprefix('recall@')}", 100.0, "%") for k in ks]
            + [("in_map", "anywhere in the map", 100.0, "%")],
            f"Share of queries with a reference within {radius:g} m and {angle:g}°", "higher", (0, 100),
        )  # fmt: skip
    return figures


@styled
def draw_matrices(
    table: pd.DataFrame,
    columns: Sequence[tuple[str, str, float, str]],
    title: str,
    better: str,
    limits: tuple[float, float] | None = None,
) -> "Figure":
    """Draw map device x query device matrices side by side.

    Args:
        table: one row a pair.
        columns: for each panel a column's name, title, factor and unit.
        title: of the figure.
        better: `higher` or `lower`: which values are good, shown light to dark.
        limits: range of the colors after the factor; None: of the values.
    """
    figure = new_figure(3.1 * len(columns) + 0.4, 3.35)
    maps, queries = (in_order(table[c]) for c in ("map_device", "query_device"))
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    for axis, (column, name, factor, unit) in zip(axes, columns, strict=True):
        values = np.full((len(maps), len(queries)), np.nan)
        for row in table.itertuples():
            i, j = maps.index(row.map_device), queries.index(row.query_device)
            values[i, j] = factor * float(table.at[row.Index, column])
        finite = values[np.isfinite(values)]
        # Values that hardly differ stay pale: dark is what stands out among them.
        widest = max(float(finite.max()), 3 * float(np.median(finite)), 1e-9) if len(finite) else 1.0
        low, high = limits or (0.0, widest)
        shade = (np.clip(values, low, high) - low) / (high - low)
        axis.imshow(shade, cmap="Blues" if better == "higher" else "Oranges", vmin=-0.08, vmax=1.25)
        for (i, j), value in np.ndenumerate(values):
            text = "–" if np.isnan(value) else "∞" if np.isinf(value) else _short(value, unit)
            axis.text(j, i, text, ha="center", va="center", fontsize=12,
                      color="white" if shade[i, j] > 0.6 else "black")  # fmt: skip
        axis.set_xticks(range(len(queries)), queries)
        axis.set_yticks(range(len(maps)), maps)
        axis.set_xlabel("query")
        axis.set_title(f"{name} [{unit}]", fontsize=10)
        axis.tick_params(which="both", length=0)
        axis.set_xticks(np.arange(len(queries) - 1) + 0.5, minor=True)
        axis.set_yticks(np.arange(len(maps) - 1) + 0.5, minor=True)
        axis.grid(which="minor", color="white", lw=2)
        axis.spines[:].set_visible(False)
    axes[0].set_ylabel("map")
    figure.suptitle(title)
    return figure


@styled
def draw_error_curves(errors: pd.DataFrame, thresholds: Sequence[Threshold] = THRESHOLDS) -> "Figure":
    """Draw cumulative distributions of the errors: a column a query device, a line a map device.

    A curve ends at the share of queries that have a pose. Dotted lines are the recall thresholds.
    """
    queries, maps = in_order(errors["query_device"]), in_order(errors["map_device"])
    figure = new_figure(3.6 * len(queries) + 0.8, 6.0)
    axes = figure.subplots(2, len(queries), squeeze=False, sharey=True, sharex="row")
    quantities = [
        ("translation_error_m", "translation error [m]", 1),
        ("rotation_error_deg", "rotation error [°]", 0),
    ]
    for row, (column, label, part) in enumerate(quantities):
        finite = errors[column].to_numpy(float)
        finite = np.maximum(finite[np.isfinite(finite)], 1e-4)
        marks = sorted({t[part] for t in thresholds})
        low, high = min([*finite, *marks]), max([*finite, *marks])
        for axis, query in zip(axes[row], queries, strict=True):
            for map_ in maps:
                values = errors.loc[(errors.query_device == query) & (errors.map_device == map_), column]
                if not len(values):
                    continue
                found = np.sort(values[np.isfinite(values)].to_numpy(float).clip(1e-4))
                share = 100 * np.arange(len(found) + 1) / len(values)
                axis.step([low / 2, *found, high * 2], [*share, share[-1]], where="post", lw=1.8,
                          color=color_of(map_), label=f"{map_} map")  # fmt: skip
            for mark in marks:
                axis.axvline(mark, color="0.45", lw=0.9, ls=":")
            axis.set_xscale("log")
            axis.set_xlim(low / 1.5, high * 1.5)
            axis.set_ylim(0, 102)
            axis.set_xlabel(label)
            axis.grid(alpha=0.25)
            if row == 0:
                axis.set_title(f"{query} queries", fontsize=10)
        axes[row, 0].set_ylabel("queries below [%]")
    axes[0, 0].legend(frameon=False, fontsize=9)
    figure.suptitle("How many queries have an error below x")
    return figure


@styled
def draw_losses(losses: pd.DataFrame) -> "Figure":
    """Draw for each pair, a panel a threshold, the share of queries missed, by reason."""
    known = losses.dropna(subset=["threshold"])
    thresholds = list(dict.fromkeys(known["threshold"]))
    pairs = list(dict.fromkeys(zip(known["map_device"], known["query_device"], strict=True)))
    widest = max(10.0, 115 * float((known["missed"] / known["queries"]).max()))
    figure = new_figure(3.3 * len(thresholds) + 1.2, 0.3 * len(pairs) + 1.7)
    axes = figure.subplots(1, len(thresholds), squeeze=False, sharey=True, sharex=True)[0]
    for axis, threshold in zip(axes, thresholds, strict=True):
        rows = known[known["threshold"] == threshold].set_index(["map_device", "query_device"]).loc[pairs]
        left = np.zeros(len(rows))
        for reason, color in zip(REASONS, (SKY, ORANGE, VERMILLION), strict=True):
            share = 100 * (rows[reason] / rows["queries"]).to_numpy(float)
            axis.barh(range(len(rows)), share, left=left, color=color, label=reason, height=0.72)
            left += share
        for y, value in enumerate(left):
            axis.text(value + 0.012 * widest, y, f"{value:.0f}", va="center", fontsize=8, color="0.3")
        axis.set_xlim(0, widest)
        axis.set_title(f"missed @ {_spoken(threshold)}", fontsize=10)
        axis.set_xlabel("queries [%]")
        axis.grid(axis="x", alpha=0.25)
    axes[0].set_yticks(range(len(pairs)), [f"{q} in {m} map" for m, q in pairs])
    axes[0].invert_yaxis()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.suptitle("Where accuracy was lost")
    return figure


def _short(value: float, unit: str) -> str:
    if unit == "%":
        return f"{value:.1f}".removesuffix(".0")
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def _spoken(threshold: str) -> str:
    return threshold.strip("()").replace("deg,", "°, ").replace("m", " m")
