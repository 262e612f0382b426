"""The evaluate stage: measure how accurate the poses of a scene are, and where accuracy was lost."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.names import in_order
from toolkit.capture.tables import ALIGNED, POSES_UNIT
from toolkit.errors import ArtifactError, CaptureError, ToolkitError
from toolkit.figures.evaluation import Evaluation, SequencePair, draw_evaluation, warn_of_older
from toolkit.figures.style import save_figure
from toolkit.files import (
    map_record_path,
    pair_name,
    read_map_record,
    read_references,
    require_whole,
    why_older,
    write_csv,
    write_sidecar,
)
from toolkit.geometry import Floats
from toolkit.manifest import EvaluateSettings
from toolkit.pose.base import Status, status_counts
from toolkit.results import metrics
from toolkit.results.metrics import is_posed, pose_errors
from toolkit.results.metrics import recall as recall  # for callers
from toolkit.results.pair import PairResults, load_maps, map_files
from toolkit.runs.pairs import LEFT_OUT, left_out

if TYPE_CHECKING:
    from toolkit.mapping.local_map import LocalMap

logger = logging.getLogger(__name__)

TABLES = {"recall": "recall", "errors": "errors", "retrieval": "retrieval", "losses": "losses", "overlap": "overlap",
          "sequence": "sequences", "changes": "changes"}  # fmt: skip
"""Names of the tables, `<name>.csv`, and attributes of an evaluation."""
FIGURES = ("recall", "median_errors", "error_curves", "losses", "reliability", "deviations", "retrieval", "sequence")
ERROR_COLUMNS = ["map_device", "query_device", "timestamp", "device_id", "image", "status", "num_inliers",
                 "p_correct", "position_std_m", "rotation_error_deg", "translation_error_m"]  # fmt: skip
DETAILS = ("num_inliers", "p_correct", "position_std_m")
"""Columns copied from a pair's table to the table of errors."""
RETRIEVAL_KS = (1, 5, 10)
"""Retrieval recall is reported for these numbers of references."""
RETRIEVAL_RADIUS_M = 8.0
"""Largest distance of a correct reference from the query: meters, or half of the median depth where that is above
16 m."""
RETRIEVAL_ANGLE_DEG = 45.0
"""Largest angle between the viewing directions of a correct reference and the query, degrees; roll is ignored."""
_PAIR, _KEY = ["map_device", "query_device"], ["timestamp", "device_id"]


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

    A pair without poses, without queries or without ground truth gets a row that says so. If the unit of the poses is
    unknown, lengths are in `metrics.UNKNOWN_UNIT` instead of meters; their columns end in `_L`, not `_m`.

    Args:
        sessions_root: folder `sessions/` of the capture.
        poses_dir: folder of `SCENE_map_<M>_query_<Q>.txt` and, if they exist, `.csv`.
        retrieval_dir: folder of `SCENE_map_<M>_query_<Q>.jsonl`; None skips retrieval recall.
        out_dir: output folder of `{recall,errors,retrieval,losses,overlap}.csv` and the figures; None writes nothing.
        settings: see `EvaluateSettings`; a dict holds the settings that differ from the defaults.
        map_device: `all` or one device key; likewise `query_device`.
        queries: keyframe list of the queries; recall is a share of all of them.
        at: `device` computes one error per query device; `camera` one per camera image, as the benchmark's own code
            evaluates rigs.
        pairs: only these [map device, query device]; None: all.
        reranked_dir: folder of the reranked references, if queries were localized with them: retrieval recall is
            computed from them, and overlap for the references before and after.
        map_dir: folder of the triangulated maps, which tell the points that a reference sees.

    Raises:
        ToolkitError: unknown device or `at`, or there is no pair to evaluate.
        CaptureError: none of the pairs can be evaluated.
    """
    if at not in ("device", "camera"):
        raise ToolkitError(f"Unknown at={at!r}. Known: device, camera.")
    settings = EvaluateSettings.of(settings)
    limits = tuple((float(degrees), float(meters)) for degrees, meters in settings.thresholds)
    capture = Capture.from_sessions_root(sessions_root)
    devices = capture.devices_with("map", map_device), capture.devices_with("query", query_device)
    rows: dict[str, list[dict[str, Any]]] = {"recall": [], "retrieval": [], "losses": []}
    errors, messages, sources, truths = list[pd.DataFrame](), list[str](), list[Path](), list[Path]()
    references_dir = retrieval_dir and (reranked_dir or retrieval_dir)
    for query in devices[1]:
        maps = [mapped for mapped, _ in _chosen((devices[0], [query]), pairs)]
        if not maps:
            continue
        reason = ""
        try:
            session = capture[f"{query}_query"]
            truths += filter(Path.is_file, [session.path / ALIGNED])
            keys, truth = _queries_with_truth(session, queries, messages)
            tables = list[pd.DataFrame]()
            for mapped in maps:
                with suppress(ArtifactError):  # `_read_results` reports it
                    tables.append(PairResults.of(poses_dir, capture.name, mapped, query).table)
            messages += metrics.camera_messages(session, tables)
        except CaptureError as error:
            reason = str(error)
        for mapped in maps:
            pair, name = {"map_device": mapped, "query_device": query}, pair_name(capture.name, mapped, query)
            poses = Path(poses_dir) / f"{name}.txt"
            if cause := reason or left_out(poses_dir, name) or _unreadable(capture, f"{mapped}_map"):
                messages.append(f"{name} was left out: {cause}")
                for kind in ("recall", "losses"):
                    rows[kind].append({**pair, "state": f"{LEFT_OUT}{cause}"})
                continue
            if not len(keys):
                no_queries = truth is not None and session.keyframes(queries).empty
                for kind in rows:
                    rows[kind].append({**pair, "state": "no queries" if no_queries else "no ground truth"})
                continue
            record = read_map_record(map_record_path(poses_dir, capture.name, mapped))
            unit, length = metrics.length_unit(record)
            read = [poses, poses.with_suffix(".csv"), poses.with_name(f"{name}_sequence.txt")]
            read += [Path(folder) / f"{name}.jsonl" for folder in (retrieval_dir, reranked_dir) if folder is not None]
            sources += filter(Path.is_file, read)
            good = None
            if older := why_older(poses, "localize", (".jsonl",), missing=False):
                messages.append(f"{older} Retrieval is not judged.")
                rows["retrieval"].append({**pair, "state": f"{LEFT_OUT}{older}"})
            elif references_dir is not None:
                lengths = length, record["length"] or length
                path = Path(references_dir) / f"{name}.jsonl"
                row, good = _retrieval_recall(path, keys, truth, capture[f"{mapped}_map"], unit, *lengths)
                rows["retrieval"].append({**pair, **row})
                if good is None:
                    messages.append(f"{name}: {row['state']}, so no miss is attributed to retrieval.")
            results, state = _read_results(poses, keys)
            if results is None:
                messages.append(f"{name}: {state}; its queries are not counted.")
                for kind in ("recall", "losses"):
                    rows[kind].append({**pair, "state": state, "queries": len(keys)})
                continue
            if state != "evaluated":
                messages.append(f"{name}: {state}.")
            frame = _errors_of(results, keys, truth, session, good, limits, at, unit, length)
            as_stored = frame.assign(status=frame["status_text"]).drop(columns="status_text")
            errors.append(metrics.named_by_unit(as_stored.assign(**pair), unit))
            rows["recall"].append({**pair, "state": state, **_summary(frame, limits, unit)})
            rows["losses"] += [{**pair, "state": state, **row} for row in _losses(frame, limits, unit)]
    if not rows["recall"]:
        among = f"map_device={map_device!r} and query_device={query_device!r} in {capture.path}"
        raise ToolkitError(f"Found pairs={pairs!r}, expected [map device, query device] among {among}.")
    if all(row["state"].startswith(LEFT_OUT) for row in rows["recall"]):
        raise CaptureError(messages[0])
    folders = {"retrieved": retrieval_dir, "reranked": reranked_dir}
    references = {name: folder for name, folder in folders.items() if folder is not None}
    evaluation = Evaluation(
        _table(pd.DataFrame(rows["recall"]), "queries"),
        _table(pd.concat(errors)) if errors else pd.DataFrame(columns=ERROR_COLUMNS),
        _table(pd.DataFrame(rows["retrieval"])),
        _table(pd.DataFrame(rows["losses"]), "threshold", *metrics.REASONS, "queries", "missed"),
        overlap_table(sessions_root, references, map_dir, map_device, query_device, pairs, poses_dir),
        limits,
        list(dict.fromkeys(messages)),
        metrics.unit_of(*(name for row in rows["recall"] for name in row)),
        *evaluate_sequences(capture, poses_dir, limits, *devices, queries, pairs),
    )
    for message in evaluation.messages:
        logger.warning(message)
    if out_dir is not None:
        record = {"poses": str(poses_dir), "queries": queries, "at": at, **settings.model_dump()}
        write_evaluation(evaluation, out_dir, record | {"messages": evaluation.messages}, sources, truths)
    return evaluation


def _chosen(
    devices: tuple[Sequence[str], Sequence[str]], pairs: Sequence[Sequence[str]] | None
) -> list[tuple[str, str]]:
    """Return the pairs of map devices and query devices that are among `pairs`; None: all."""
    return [pair for pair in product(*devices) if pairs is None or list(pair) in map(list, pairs)]


def evaluate_sequences(
    capture: Capture,
    poses_dir: str | Path,
    limits: Sequence[metrics.Threshold],
    map_devices: Sequence[str],
    query_devices: Sequence[str],
    queries: str = "keyframes_pruned_subsampled",
    pairs: Sequence[Sequence[str]] | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Compare the poses of single queries with the poses after each step of the sequence stage.

    Args:
        limits: thresholds (degrees, length); `rescued` and `broken` count at the last one.
        poses_dir, queries, pairs: as for `evaluate_scene`.

    Returns:
        A table with one row per pair and step, see `SequencePair.recalls`; and a table with one row per query that the
        sequence stage rescued or broke, see `SequencePair.changes`, with its `image`. Both are empty without sequences
        or ground truth.
    """
    steps, changes = [pd.DataFrame()], [pd.DataFrame()]
    warn_of_older(poses_dir)
    for mapped, query in _chosen((map_devices, query_devices), pairs):
        sequence = SequencePair.find(poses_dir, capture.name, mapped, query)
        if sequence is None:
            continue
        try:
            keys, truth = _queries_with_truth(capture[f"{query}_query"], queries, [])
            if truth is None or not len(keys):
                continue
            unit, length = metrics.length_unit(read_map_record(map_record_path(poses_dir, capture.name, mapped)))
            pair = {"map_device": mapped, "query_device": query}
            steps.append(pd.DataFrame(sequence.recalls(keys, truth, limits, unit, length)).assign(**pair))
            changed = metrics.named_by_unit(sequence.changes(keys, truth, limits[-1], length).assign(**pair), unit)
            single = PairResults.of(poses_dir, capture.name, mapped, query).at(changed[_KEY]).table
            # Results of earlier versions have no names of images.
            changes.append(changed.assign(image=single.reindex(columns=["image"], fill_value="")["image"]))
        except (CaptureError, ArtifactError) as error:
            logger.warning("%s: its sequences are not evaluated. %s", sequence.stem.name, error)
    tables = (pd.concat(parts, ignore_index=True) for parts in (steps, changes))
    first, second = (table[[*_PAIR, *table.columns.drop(_PAIR)]] if len(table) else table for table in tables)
    return first, second


def _unreadable(capture: Capture, session_id: str) -> str:
    """Return why a session cannot be read; empty if it can."""
    try:
        capture[session_id]
    except CaptureError as error:
        return str(error)
    return ""


def write_evaluation(
    evaluation: Evaluation, out_dir: str | Path, settings: dict[str, Any], sources: Sequence[Path] = (),
    truths: Sequence[Path] = (),
) -> None:  # fmt: skip
    """Write the tables as CSV, the figures as PNG, and settings, `sources` and `truths` to the record of recall.csv."""
    out = Path(out_dir)
    tables: dict[str, Any] = {name: getattr(evaluation, attribute) for name, attribute in TABLES.items()}
    if not len(evaluation.sequences):
        tables |= {"sequence": None, "changes": None}
    figures, written = draw_evaluation(evaluation), list[Path]()
    for path, content in {
        **{out / f"{name}.csv": table for name, table in tables.items()},
        **{out / f"{name}.png": figures.get(name) for name in FIGURES},
    }.items():
        if content is None:  # a file of an earlier evaluation would mislead
            path.unlink(missing_ok=True)
            continue
        written.append(path)
        if isinstance(content, pd.DataFrame):
            write_csv(path, content)
        else:
            save_figure(content, path)
    write_sidecar(out / "recall.csv", settings, written[1:], made_from=sources, captured=truths)
    logger.info("Evaluated %d of %d pairs: %s", (evaluation.recall["state"] == "evaluated").sum(),
                len(evaluation.recall), out / "recall.csv")  # fmt: skip


def _queries_with_truth(session: Session, queries: str, messages: list[str]) -> tuple[pd.DataFrame, Trajectory | None]:
    truth = session.ground_truth
    if truth is None or not len(truth):
        messages.append(f"{session.id} has no ground truth; it is not evaluated.")
        return pd.DataFrame({"timestamp": [], "device_id": []}), None
    keys = session.keyframes(queries).reset_index(drop=True)
    has_truth = is_posed(metrics.poses_of(truth, keys))
    if not np.all(has_truth):
        missing = np.sum(~has_truth)
        messages.append(f"{session.id}: {missing} of {len(keys)} queries have no ground truth and are left out.")
    return keys[has_truth].reset_index(drop=True), truth


def _read_results(path: Path, keys: pd.DataFrame) -> tuple[pd.DataFrame | None, str]:
    """Return the pose (4, 4), status and `DETAILS` of each query (None without poses), and the pair's state."""
    if not path.is_file():
        return None, "no poses file"
    try:
        require_whole(path)
        poses = PairResults(path, keys).poses
    except ArtifactError as error:
        return None, str(error)
    except CaptureError as error:
        return None, f"unreadable poses file ({error})"
    located, results, state = is_posed(poses), PairResults(path, keys), "evaluated"
    try:
        results = PairResults.open(path).at(keys)
    except ArtifactError as error:
        state = f"unreadable table of queries ({error})"
    found = results.table.rename(columns=POSES_UNIT).reindex(columns=[*_KEY, "status", "status_text", *DETAILS])
    has_row, status = found["status_text"].notna(), np.where(located, Status.OK, Status.FAILED)
    known = {name: found[name].where(has_row, status) for name in ("status", "status_text")}
    found = found.astype(dict.fromkeys(DETAILS, float)).assign(**known)
    if state == "evaluated" and path.with_suffix(".csv").is_file():  # another tool writes only poses: all are ok
        if not has_row.all():
            state = f"stale: {has_row.sum()} of {len(keys)} queries have a row in {path.stem}.csv"
        elif np.any((found["status"] == Status.FAILED).to_numpy(bool) == located):
            state = f"stale: {path.stem}.csv and {path.name} differ in which queries have a pose"
    return found.assign(pose=list(poses)), state


def _errors_of(
    frame: pd.DataFrame,
    keys: pd.DataFrame,
    truth: Trajectory | None,
    session: Session,
    good: NDArray[np.bool_] | None,
    thresholds: Sequence[metrics.Threshold],
    at: str,
    unit: str,
    length: float,
) -> pd.DataFrame:
    """Return a pair's rows of the table `errors`, made from what `_read_results` returns.

    `good`: whether each query has a good reference; None if unknown. `length`: the unit of lengths in the table.
    """
    estimated, true = np.stack(frame.pop("pose").to_list()), metrics.poses_of(truth, keys)  # type: ignore[arg-type]
    rows = session.rows_of_keyframes(keys)
    frame.insert(2, "image", session.own_names(rows))
    if good is not None:
        frame["good_reference"] = good
    if at == "camera":
        device, images = np.repeat(np.arange(len(keys)), [len(r) for r in rows]), np.concatenate(rows)
        device_from_cam = session.rig_from_cam(images)
        estimated, true = estimated[device] @ device_from_cam, true[device] @ device_from_cam
        frame = frame.iloc[device].reset_index(drop=True)
        frame.insert(2, "sensor_id", session.images["sensor_id"].to_numpy()[images])
        frame["image"] = session.own_names(images[:, None])
    rotation_deg, translation = pose_errors(estimated, true)
    translation /= length
    frame["position_std_m"] /= length
    frame["rotation_error_deg"], frame["translation_error_m"] = rotation_deg, translation
    no_reference = np.zeros(len(frame), bool) if good is None else ~frame["good_reference"].to_numpy(bool)
    why_not, wrong = [metrics.NO_REFERENCE, metrics.NO_POSE], metrics.WRONG_POSE
    reason = np.select([no_reference, ~np.isfinite(rotation_deg)], why_not, wrong)
    for threshold in thresholds:
        hit = metrics.is_below(rotation_deg, translation, threshold)
        frame[f"loss@{metrics.threshold_name(threshold, unit)}"] = np.where(hit, "", reason)
    return frame


def _summary(frame: pd.DataFrame, thresholds: Sequence[metrics.Threshold], unit: str) -> dict[str, Any]:
    """Return a pair's row of the table `recall`."""
    rotation_deg, translation = (frame[name].to_numpy(float) for name in ERROR_COLUMNS[-2:])
    wrong = (frame["status"] == Status.OK) & ~metrics.is_below(rotation_deg, translation, metrics.WRONG)
    return {
        "queries": len(frame),
        "localized": int(np.isfinite(rotation_deg).sum()),
        **status_counts(frame["status"]),
        **metrics.summary_of(rotation_deg, translation, thresholds, unit),
        "ok_wrong": float(np.mean(wrong)),
    }


def _losses(frame: pd.DataFrame, thresholds: Sequence[metrics.Threshold], unit: str) -> list[dict[str, Any]]:
    """Return a pair's rows of the table `losses`, one per threshold."""
    rows = []
    for name in (metrics.threshold_name(threshold, unit) for threshold in thresholds):
        reasons = {reason: int((frame[f"loss@{name}"] == reason).sum()) for reason in metrics.REASONS}
        rows.append({"threshold": name, "queries": len(frame), "missed": sum(reasons.values()), **reasons})
    return rows


def _table(frame: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """Move the columns of the pair, the state and `columns` to the front, and sort rows by map device."""
    state = ["state"] if "device_id" not in frame else []
    leading = ["map_device", "query_device", *state, *columns]
    frame = frame.reindex(columns=[*leading, *(c for c in frame.columns if c not in leading)])
    order = {device: rank for rank, device in enumerate(in_order(frame["map_device"]))}
    return frame.sort_values(["map_device"], kind="stable", key=lambda s: s.map(order)).reset_index(drop=True)


# Retrieval


def _retrieval_recall(
    path: Path,
    keys: pd.DataFrame,
    truth: Trajectory | None,
    map_session: Session,
    unit: str,
    length: float,
    map_length: float,
) -> tuple[dict[str, Any], NDArray[np.bool_] | None]:
    """Return a pair's row of the table `retrieval`, and whether each query has a good reference (None if unreadable).

    `length` is the table's unit of lengths, and `map_length` is `LocalMap.length`, in the unit of the poses: far scenes
    show the same from further apart.
    """
    if not path.is_file():
        return {"state": "no retrieval file", "queries": len(keys)}, None
    try:
        lines = read_references(path, "device_id", "Trs")
        index = pd.DataFrame([(int(x["timestamp"]), str(x["device_id"])) for x in lines], columns=_KEY)
        index = index.astype({"timestamp": np.int64})
        device_from_cam = np.array([x["Trs"] for x in lines], float).reshape(-1, 4, 4)
        references = np.full((len(lines), max([1, *(len(x["topk"]) for x in lines)]), 4, 4), np.nan)
        for i, line in enumerate(lines):
            for rank, reference in enumerate(line["topk"]):
                references[i, rank] = reference["Tws"]
    except (ArtifactError, ValueError, KeyError, TypeError) as error:
        state = f"unreadable retrieval file ({type(error).__name__}: {error})"
        return {"state": state, "queries": len(keys)}, None
    cameras = metrics.poses_of(truth, index) @ device_from_cam  # type: ignore[arg-type]
    reach = RETRIEVAL_RADIUS_M * map_length, RETRIEVAL_ANGLE_DEG
    near = _is_near(references, cameras[:, None], reach)
    best = np.where(near.any(1), near.argmax(1), np.inf)
    in_map = _near_any(cameras, map_session.world_from_cam(), reach)
    # A query device has a good reference if any of its cameras has one.
    frame = index.assign(rank=best, in_map=in_map).groupby(_KEY, as_index=False)
    by_device = keys.merge(frame.agg(rank=("rank", "min"), in_map=("in_map", "any")), how="left")
    rank = by_device["rank"].fillna(np.inf).to_numpy(float)
    row: dict[str, Any] = {"state": "evaluated", "queries": len(keys), "angle_deg": RETRIEVAL_ANGLE_DEG}
    row[f"radius_{unit}"] = round(reach[0] / length, 4)
    row |= {f"recall@{k}": float(np.mean(rank < k)) for k in RETRIEVAL_KS}
    return {**row, "in_map": float(by_device["in_map"].eq(True).mean())}, np.isfinite(rank)


def _is_near(a: Floats, b: Floats, limits: tuple[float, float]) -> NDArray[np.bool_]:
    """Return whether cameras a and b, world_from_cam (..., 4, 4), are within (distance, degrees); False for NaN."""
    distance = np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1)
    cosine = np.sum(a[..., :3, 2] * b[..., :3, 2], axis=-1)
    return (distance <= limits[0]) & (cosine >= np.cos(np.radians(limits[1])))


def _near_any(cameras: Floats, map_cameras: Floats, limits: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which of `cameras`, world_from_cam (N, 4, 4), have a near map camera (`_is_near`)."""
    from scipy.spatial import cKDTree

    map_cameras = map_cameras[is_posed(map_cameras)]
    posed = np.flatnonzero(is_posed(cameras))
    near = np.zeros(len(cameras), bool)
    if len(map_cameras) and len(posed):
        tree = cKDTree(map_cameras[:, :3, 3])
        for row, hits in zip(posed, tree.query_ball_point(cameras[posed, :3, 3], limits[0]), strict=True):
            near[row] = _is_near(map_cameras[hits], cameras[row], limits).any()
    return near


# Overlap


def overlap_table(
    sessions_root: str | Path,
    references: Mapping[str, str | Path],
    map_dir: str | Path | None,
    map_device: str = "all",
    query_device: str = "all",
    pairs: Sequence[Sequence[str]] | None = None,
    poses_dir: str | Path | None = None,
) -> pd.DataFrame:
    """Return for each pair the share of query images that overlap with their first reference, judged by true poses.

    A reference overlaps with a query image if at least `MIN_OVERLAP` of the triangulated map points that it observes
    lie in the image's view (`overlap_in_view`). Without a triangulated map, points at 2, 4, 8 and 16 m in the
    reference's view replace the map points.

    Args:
        sessions_root, map_dir, map_device, query_device, pairs: as for `evaluate_scene`.
        references: folders of references (`SCENE_map_<M>_query_<Q>.jsonl`) by the names of their columns.
        poses_dir: folder of the poses, which record the maps that were used; None: any map of the device.

    Returns:
        One row per pair: map_device, query_device, state, images (with references and a true pose), points (`map` or
        `view`), and for each name `<name>` (share) and `<name>_mean` (mean overlap).
    """
    capture, load, rows = Capture.from_sessions_root(sessions_root), lru_cache(maxsize=1)(load_maps), []
    devices = capture.devices_with("map", map_device), capture.devices_with("query", query_device)
    for mapped, query in _chosen(devices, pairs) if references else ():
        name = pair_name(capture.name, mapped, query)
        h5 = None if poses_dir is None else Path(poses_dir) / f"{name}.h5"
        row: dict[str, Any] = {"map_device": mapped, "query_device": query, "state": "evaluated"}
        rows.append(row)
        # Files of a pair that was left out are those of an earlier run.
        causes = [_unreadable(capture, f"{query}_query") or _unreadable(capture, f"{mapped}_map")]
        causes += [left_out(folder, name) for folder in references.values()]
        if h5 is not None:
            causes.append(why_older(h5.with_suffix(".txt"), "localize", (".npz",), missing=False))
        if cause := next(filter(None, causes), ""):
            row["state"] = f"{LEFT_OUT}{cause}"
            continue
        local_map = load(map_files(map_dir, f"{mapped}_map", h5))
        for column, folder in references.items():
            path = Path(folder) / f"{name}.jsonl"
            row |= _overlap(path, column, capture[f"{query}_query"], capture[f"{mapped}_map"], local_map)
    return _table(pd.DataFrame(rows), "images", "points")


def _overlap(
    path: Path, name: str, session: Session, map_session: Session, local_map: "LocalMap | None"
) -> dict[str, Any]:
    """Return the columns that a file of references adds to a row of the overlap table."""
    if session.ground_truth is None:
        return {"state": "no ground truth"}
    try:
        lines, shares = read_references(path, "device_id", "Trs"), []
        times, devices = [int(line["timestamp"]) for line in lines], [line["device_id"] for line in lines]
        poses = session.ground_truth.lookup(times, devices) @ np.array([x["Trs"] for x in lines]).reshape(-1, 4, 4)
        for line, pose in zip(lines, poses, strict=True):
            if is_posed(pose):
                seen_from = map_session, local_map, pose, session.camera(line["sensor_id"])
                shares.append(metrics.overlap_of(line["topk"][0], *seen_from) if line["topk"] else 0.0)
    except (ArtifactError, CaptureError, OSError, ValueError, KeyError, TypeError) as error:
        return {"state": f"{path.name} of the {name} cannot be read ({type(error).__name__})"}
    row: dict[str, Any] = {"images": len(shares), "points": "view" if local_map is None else "map"}
    if shares:
        row |= {name: float(np.mean(np.array(shares) >= metrics.MIN_OVERLAP)), f"{name}_mean": float(np.mean(shares))}
    return row
