"""The localize stage: references and local features in, one pose a query device out."""

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch
from toolkit.capture.tables import read_query_table
from toolkit.errors import INTERNAL, ToolkitError, reason_of
from toolkit.features.features import KINDS
from toolkit.features.groups import GroupWriter, heals
from toolkit.features.matching import AnyMethod, MutualMatcher, resolve_auto, weights_files
from toolkit.features.stores import FeatureStore, MatchStore, extract_session, match_sessions
from toolkit.files import (
    Remade,
    file_fingerprint,
    fingerprint,
    is_current,
    map_record_path,
    pair_name,
    read_map_record,
    read_references,
    read_sidecar,
    require_same,
    sidecar_path,
    write_atomic,
    write_sidecar,
    write_text,
)
from toolkit.localizers.base import (
    Localizer,
    PoseEstimate,
    Query,
    References,
    ScaledLocalizer,
)
from toolkit.localizers.correspondences import MAPS, LocalizedQuery, query_group
from toolkit.localizers.escalation import EscalatingLocalizer, can_gain, is_better, is_sure
from toolkit.localizers.feed_forward import FeedForwardAnswer, FeedForwardLocalizer
from toolkit.localizers.map import (
    Map,
    attributes,
    create_localizer,
    create_methods,
    label,
    session_fingerprint,
    update_attributes,
)
from toolkit.localizers.mapping import map_settings
from toolkit.localizers.misfit import LEAST_SIZE, SIGNIFICANCE
from toolkit.localizers.picture import localize_image
from toolkit.localizers.predictors import open_predictor
from toolkit.localizers.queries import localized_query, references_of_images, stored_query
from toolkit.manifest import LocalizeSettings
from toolkit.runs.cluster import current_cluster
from toolkit.runs.pairs import PairRows
from toolkit.show.metrics import camera_messages

__all__ = ["COLUMNS", "PREDICTION_COLUMNS", "Map", "explain_query", "localize_image", "localize_pairs"]

log = logging.getLogger(__name__)

COLUMNS = [
    "timestamp", "device_id", "image", "status", "method", "num_inliers", "num_matches", "inlier_ratio", "num_guided",
    "rmse_px", "rival_support", "coverage", "agreement", "p_correct", "position_std_m", "rotation_std_deg",
    "references", "seconds", "focal_px", "reason",
]  # fmt: skip
PREDICTION_COLUMNS = ["scale_std", "rejected"]
"""Further columns of the methods that predict."""

ESCALATION_COLUMNS = ["first_status", "first_seconds"]
"""Further columns where kinds of features are asked only if the pose is not sure: status and seconds before that;
empty: they were not asked."""


@heals
def localize_pairs(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    out_dir: str | Path,
    features_dir: str | Path,
    map_dir: str | Path,
    settings: LocalizeSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    queries: str = "keyframes_pruned_subsampled",
    skip_existing: bool = True,
    workers: int = 0,
) -> pd.DataFrame:
    """Localize the queries of every pair of devices.

    Writes for each pair `<pair>.txt`, the poses; `<pair>.csv`, how each came about; and `<pair>.h5`, the
    correspondences that each rests on (`localizers.correspondences`). Of each map, `<scene>_map_<device>.json` says
    whether its poses are those of its images.

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        out_dir: folder of the poses.
        features_dir: folder of local features, shared with the embed stage.
        map_dir: folder of the triangulated maps, `<device>_map.npz`, and of matches.
        settings: see `LocalizeSettings`; a dict holds what differs from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` that the capture has.
        queries: the keyframe list that says which devices are asked for, or `all`.
        skip_existing: reuse what was made from the same inputs and settings, and go on where a run was killed.
        workers: threads; 0 takes the number of cores.

    Returns:
        One row a pair: map_device, query_device, queries = ok + low_confidence + failed, escalated (those that further
        features were asked for), map_poses (`consistent` with the map's images, `inconsistent` or `unknown`), seconds,
        skipped, path, reason. A pair that cannot be done has zeros and the `reason`.

    Raises:
        ManifestError: unknown method, predictor, features or matcher, or a number that is not positive.
        WeightsError: the network has no weights, before any work is done.
        CaptureError: unknown device; or no pair can be done, e.g. for want of the list.
        ArtifactError: no pair can be done; of one, the retrieval is missing.
    """
    settings = resolve_auto(LocalizeSettings.of(settings))
    folders = _Folders(*map(Path, (sessions_root, retrieval_dir, out_dir, features_dir, map_dir)))
    stage = _Stage(folders, settings, queries, skip_existing, workers or default_workers())
    capture = stage.capture
    table = PairRows(capture.name, folders.out, folders.retrieval)
    asked: dict[str, list[pd.DataFrame]] = {}
    devices = capture.devices_with("map", map_device), capture.devices_with("query", query_device)
    next_map = dict(pairwise(devices[0]))
    # Queries are the parallel dimension, and sums stay in one order.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(1) as background:
        for mapped, queried in product(*devices):
            pair = _Pair(stage, mapped, queried)
            with table.row(mapped, queried) as row:
                table.check_upstream()
                started = time.perf_counter()
                record = stage.record(pair)
                about = stage.attributes(pair)
                skipped = stage.is_current(pair)
                unfinished = False
                if not skipped:
                    run = stage.run(mapped, queried)
                    if mapped in next_map:
                        stage.build_ahead(background, next_map[mapped], devices[1])
                    localized = run.localize(record, about)
                    write_text(pair.about_map, json.dumps(run.place.record(), indent=1) + "\n")
                    _write_poses(pair, localized, settings)
                    unfinished = any(map(_is_internal, localized))
                if update_attributes(pair.file("h5"), about) or not skipped:
                    files = pair.file("csv"), pair.file("h5"), pair.about_map
                    write_sidecar(pair.file("txt"), record, files, unfinished=unfinished)
                rows = read_query_table(pair.file("csv"), ["status"])
                asked.setdefault(queried, []).append(rows)
                counts = rows["status"].str.split(":").str[0].value_counts()
                row |= {
                    "queries": int(counts.sum()),
                    **{status: int(counts.get(status, 0)) for status in ("ok", "low_confidence", "failed")},
                    "escalated": int(rows["first_status"].notna().sum()) if settings.features.escalation else 0,
                    "map_poses": read_map_record(pair.about_map)["verdict"],
                    "seconds": round(time.perf_counter() - started, 2),
                    "skipped": skipped,
                    "path": str(pair.file("txt")),
                }
            if row["reason"]:
                pair.remove_poses()
    for queried, tables in asked.items():
        for message in camera_messages(capture[f"{queried}_query"], tables):
            log.warning(message)
    frame = table.frame()
    write_text(Path(out_dir) / "settings.json", settings.model_dump_json(indent=1) + "\n")
    return frame


@dataclass(frozen=True)
class _Pair:
    """One map device x query device: where its files are, and which queries are asked."""

    stage: "_Stage"
    map_device: str
    query_device: str

    @property
    def retrieval(self) -> Path:
        name = pair_name(self.stage.capture.name, self.map_device, self.query_device)
        return self.stage.folders.retrieval / f"{name}.jsonl"

    @property
    def about_map(self) -> Path:
        return map_record_path(self.stage.folders.out, self.stage.capture.name, self.map_device)

    def file(self, suffix: str) -> Path:
        return self.stage.folders.out / f"{self.retrieval.stem}.{suffix}"

    def is_current(self, record: dict[str, Any], maps: Sequence[Path]) -> bool:
        """Tell whether the pair is done; its maps are part of what there is to see of it."""
        there = self.about_map.exists() and None not in map(read_sidecar, maps)
        return there and is_current(self.file("txt"), record)

    def remove_poses(self) -> None:
        """Remove poses that an earlier run found; what they rest on is kept, and gives them again without work."""
        for poses in (self.file("txt"), sidecar_path(self.file("txt")), self.file("csv")):
            poses.unlink(missing_ok=True)

    @property
    def session(self) -> Session:
        return self.stage.capture[f"{self.query_device}_query"]

    @property
    def keyframes(self) -> pd.DataFrame:
        return self.session.keyframes(self.stage.queries)


class _Folders(NamedTuple):
    """As `localize_pairs` is given them."""

    sessions: Path
    retrieval: Path
    out: Path
    features: Path
    map: Path


class _Stage(Remade):
    """What all pairs share; a worker opens it once."""

    def __init__(
        self,
        folders: _Folders,
        settings: LocalizeSettings,
        queries: str,
        skip_existing: bool,
        workers: int = 0,
        time_ns: int = 0,
        made_by: Mapping[str, Any] | None = None,
    ) -> None:
        """See `localize_pairs`; `time_ns` tells a worker which maps it opened before others were made, and `made_by`
        the `networks` of who asks."""
        self.folders, self.settings, self.queries = folders, settings, queries
        self.skip_existing, self.workers = skip_existing, workers or default_workers()
        self.capture = Capture.from_sessions_root(folders.sessions)
        self.kinds, self.escalation = create_methods(settings)
        self.predictor = open_predictor(settings, self.capture, folders.map) if settings.predicts else None
        if made_by is not None:
            require_same(made_by, self.networks)
        self._opened: tuple[str, Map, Localizer] | None = None
        self._ahead: dict[str, Future[tuple[Map, Localizer]]] = {}

    def record(self, pair: _Pair) -> dict[str, Any]:
        """Return what the poses of a pair depend on."""
        map_session, keyframes = self.capture[f"{pair.map_device}_map"], pair.keyframes
        settings, predictor = self.settings, self.predictor
        if not pair.retrieval.exists():
            read_references(pair.retrieval)  # says what is missing
        record: dict[str, Any] = {
            "method": settings.method,
            "pnp": settings.pnp.model_dump() | {"seed": settings.seed},
            "misfit": [SIGNIFICANCE, LEAST_SIZE],
            "map": settings.map and map_settings(settings.map, settings.seed),
            "features": [kind.extractor.settings for kind in self.kinds],
            "matchers": [kind.matcher.settings for kind in self.kinds],
            "unit": settings.unit,
            "retrieval": file_fingerprint(pair.retrieval),
            "map_session": session_fingerprint(map_session),
            "query_session": session_fingerprint(pair.session),
            "images": [map_session.files_fingerprint, pair.session.files_fingerprint],
            "keyframes": fingerprint([keyframes["timestamp"].astype(str).tolist(), keyframes["device_id"].tolist()]),
        }
        if self.escalation:
            record["escalation"] = {
                "features": settings.features.model_dump(exclude={"checkpoint"}),
                "matcher": settings.matcher.model_dump(exclude={"checkpoint"}),
                "weights": [file_fingerprint(path) for path in weights_files(settings)],
            }
        if predictor is not None or any(
            KINDS[name].upright for name in (*settings.features.kinds, *settings.features.escalation)
        ):
            record["world_up"] = settings.world_up
        if predictor is not None:
            record |= {
                "predictor": {"name": predictor.name} | predictor.settings,
                "references": settings.predictor.model_dump(
                    exclude={"name", "checkpoint", "batch_size", "compile", "conditioned"}
                ),
                "depths": map_session.depths_fingerprint,
            }
        return record

    def attributes(self, pair: _Pair) -> dict[str, str]:
        """Return the attributes of a pair's file of correspondences."""
        return attributes(self.settings, self.kinds, self.capture, pair.map_device, self.folders.retrieval)

    def is_current(self, pair: _Pair) -> bool:
        """Tell whether a pair is done and may be reused."""
        maps = [self.folders.map / name for name in json.loads(self.attributes(pair)[MAPS])]
        return self.skip_existing and pair.is_current(self.record(pair), maps)

    def open_map(self, device: str) -> tuple[Map, Localizer]:
        """Return the map of a device and its localizer; only the last map is kept."""
        if self._opened is None or self._opened[0] != device:
            self._opened = None
            ahead = self._ahead.pop(device, None)
            self._opened = (device, *(self._open_map(device) if ahead is None else ahead.result()))
        return self._opened[1:]

    def build_ahead(self, background: ThreadPoolExecutor, device: str, query_devices: Sequence[str]) -> None:
        """Build a map in the background, as one thread does most of it and the queries of another map leave cores idle.

        A map in several tiles is not: it takes the memory that there is. Nor is one whose pairs are all done.
        """
        if device in self._ahead or self.settings.map is None or current_cluster() is not None:
            return
        with suppress(ToolkitError):  # told when the turn of this pair comes
            one_tile = len(self.capture[f"{device}_map"].images) <= self.settings.map.tile_images
            if one_tile and not all(self.is_current(_Pair(self, device, query)) for query in query_devices):
                self._ahead[device] = background.submit(self._open_map, device)

    def _open_map(self, device: str) -> tuple[Map, Localizer]:
        folders = self.folders
        place = Map.build(
            self.capture, device, self.settings, self.kinds, folders.features, folders.map, self.workers,
            self.skip_existing, self.escalation,
        )  # fmt: skip
        return place, create_localizer(self.settings, place, self.predictor)

    def run(self, map_device: str, query_device: str) -> "_PairRun":
        """Return the queries of a pair on their way."""
        return _PairRun(_Pair(self, map_device, query_device), *self.open_map(map_device))

    @property
    def networks(self) -> dict[str, Any]:
        """What poses depend on that the machine has a part in."""
        made_by = {kind.name: [kind.extractor.settings, kind.matcher.settings] for kind in self.kinds}
        return made_by if self.predictor is None else made_by | {self.predictor.name: self.predictor.settings}

    @cached_property
    def of_worker(self) -> Any:
        """What a worker is to open: it uses what is there, with its own number of threads."""
        return _Stage.elsewhere(self.folders, self.settings, self.queries, True, 0, time.time_ns(), self.networks)


_Task = tuple[int, Query, list[References], Any, float]
"""A query's number, the query, its references, what a network says of it, and the seconds that took."""
_Done = tuple[str, int, dict[str, Any]]
"""A query's group, its number, and its line of the table."""


class _PairRun:
    """The queries of a pair on their way through a localizer."""

    def __init__(self, pair: _Pair, place: Map, localizer: Localizer) -> None:
        self.pair, self.place, self.localizer, self.stage = pair, place, localizer, pair.stage
        self.first = localizer.first if isinstance(localizer, EscalatingLocalizer) else localizer
        """Of queries that are not escalated."""
        keyframes = pair.keyframes
        self.keys = list(zip(keyframes["timestamp"].tolist(), keyframes["device_id"].tolist(), strict=True))
        self.rows = pair.session.rows_of_keyframes(keyframes)
        """Of each query, the rows of its images."""
        index_of = {name: index for index, name in enumerate(localizer.image_names)}
        self.references = references_of_images(pair.retrieval, index_of)
        """Of each query image, by timestamp and sensor."""
        self.stores: list[FeatureStore] = []
        self.matches: list[MatchStore | None] = []
        if place.settings.method != "feed_forward":
            for kind in place.kinds:
                self._add_kind(kind, range(len(self.keys)))

    def _add_kind(self, kind: AnyMethod, numbers: Sequence[int]) -> None:
        """Extract features of the images of queries, and match them with their references where that takes a network.

        Where the map has no points of the kind, the features of the references are extracted, too.
        """
        session, place, stage = self.pair.session, self.place, self.stage
        rows = np.unique(np.concatenate([*(self.rows[number] for number in numbers), np.zeros(0, np.int64)]))
        turns = place.turns_of(kind, session)
        store = extract_session(session, stage.folders.features, kind.extractor, rows, stage.workers, turns=turns)
        images = session.images.iloc[rows]
        keys = zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True)
        names = [
            (session.image_name(int(row)), self.localizer.image_names[index])
            for row, key in zip(rows, keys, strict=True)
            if key in self.references
            for index in self.references[key].images
        ]
        of_map = next((mapped.features for mapped in place.mapped if mapped.name == kind.name), None)
        if of_map is None:
            references = dict.fromkeys(name for _, name in names)
            of_map = place.on_demand(kind).prepare(references, stage.workers, stage.skip_existing)
        matches = None
        if isinstance(of_map, FeatureStore) and not isinstance(kind.matcher, MutualMatcher):
            sessions = session.id, f"{place.device}_map"
            stores = store, of_map
            matches = match_sessions(stores, names, kind.matcher, place.map_dir, sessions, stage.skip_existing)
        self.stores.append(store)
        self.matches.append(matches)

    def query(self, number: int) -> tuple[Query, list[References]]:
        """Return a query with the references of its images."""
        # Local features were turned when they were extracted: only a network that predicts looks at the views.
        turns = self.place.turns if self.place.settings.predicts else None
        rows = self.rows[number]
        return stored_query(self.pair.session, rows, self.references, self.stores, self.matches, turns)

    def localize(self, record: dict[str, Any], about: Mapping[str, str]) -> list[dict[str, Any]]:
        """Localize the queries that a killed run has not; returns a row for each, in the list's order."""
        path = self.pair.file("h5")
        groups = [query_group(*key) for key in self.keys]
        with GroupWriter(path, record, about) as writer:
            if not self.stage.skip_existing:
                writer.discard()
            writer.drop_damaged()
            numbers = {group: number for number, group in enumerate(groups)}  # a list may name a query twice
            # Queries with a fault of the toolkit in them are left to do, and done again.
            todo = writer.spread(
                _localize_share, _not_localized(writer, list(numbers.items())), (self.stage.of_worker, *self.devices),
                self._label, "query", self.first.batch_size, _not_localized,
            )  # fmt: skip
            again = self.localize_into(writer, todo)  # rows of queries that are not recorded as done
            if isinstance(self.localizer, EscalatingLocalizer):
                rows = writer.notes()
                done = [(group, number, rows[group]) for group, number in numbers.items() if group in rows]
                again |= self._escalate(writer, done)
            # From here until the new poses are there, a kill must not leave poses of one run with a file of another.
            for poses in (self.pair.file("txt"), sidecar_path(self.pair.file("txt"))):
                poses.unlink(missing_ok=True)
            writer.finish()
            rows = writer.notes() | again
        images = self.pair.session.own_names(self.rows)
        return [rows[group] | {"image": image} for group, image in zip(groups, images, strict=True)]

    @property
    def devices(self) -> tuple[str, str]:
        """Of map and queries."""
        return self.pair.map_device, self.pair.query_device

    @property
    def _label(self) -> str:
        return f"localize {self.pair.query_device} in {self.pair.map_device}"

    def localize_into(self, writer: GroupWriter, todo: Sequence[tuple[str, int]]) -> dict[str, dict[str, Any]]:
        """Localize queries, given by group and number, and add them to a file.

        Returns:
            The rows of queries that have a fault of the toolkit in them, by group: they are not recorded as done.
        """
        again: dict[str, dict[str, Any]] = {}
        tasks = self._predicted(self.first, [number for _, number in todo])
        for number, row, localized in self._localized(self.first.localize, tasks, len(todo)):
            self._add(writer, query_group(*self.keys[number]), row, localized, again)
        return again

    def _add(
        self,
        writer: GroupWriter,
        group: str,
        row: dict[str, Any],
        localized: LocalizedQuery,
        again: dict[str, dict[str, Any]],
    ) -> None:
        """Record a query as done, unless a fault of the toolkit is in its row."""
        if _is_internal(row):
            again[group] = row
        writer.add(group, arrays=localized.arrays(), note=None if group in again else row)

    def _escalate(self, writer: GroupWriter, done: Sequence[_Done]) -> dict[str, dict[str, Any]]:
        """Ask with further features where the rows of queries tell that a pose is not sure.

        Returns:
            As `localize_into`.
        """
        limit = self.place.sure_position_std
        todo = [
            (group, number, row)
            for group, number, row in done
            if not (row.get("first_status") or row["misfit"] or is_sure(row["status"], row["position_std_m"], limit))
            and can_gain(*self.query(number))
        ]
        if not todo:
            return {}
        started = time.perf_counter()
        self.add_escalation(todo)
        shared = (time.perf_counter() - started) / len(todo)
        others = self.stage.of_worker, *self.devices, shared
        todo = writer.spread(_escalate_share, todo, others, self._label, "query", left=_not_escalated)
        return self.escalate_into(writer, todo, shared)

    def add_escalation(self, done: Sequence[_Done]) -> None:
        """Extract and match the further kinds of features of queries."""
        for kind in self.place.escalation:
            self._add_kind(kind, [number for _, number, _ in done])

    def escalate_into(self, writer: GroupWriter, done: Sequence[_Done], shared: float) -> dict[str, dict[str, Any]]:
        """Localize queries with further features, which were extracted, and add those to a file that this helps.

        Args:
            done: those without these features.
            shared: seconds that their extraction took for each.

        Returns:
            As `localize_into`.
        """
        assert isinstance(self.localizer, EscalatingLocalizer)
        again: dict[str, dict[str, Any]] = {}
        first = {number: (group, row) for group, number, row in done}
        tasks = ((number, *self.query(number), None, shared) for number in first)
        for number, row, localized in self._localized(self.localizer.escalate, tasks, len(done)):
            group, before = first[number]
            both = {
                "first_status": before["status"],
                "first_seconds": before["seconds"],
                "seconds": round(before["seconds"] + row["seconds"], 4),
            }
            if _is_internal(row) or is_better(row["status"], before["status"]):
                self._add(writer, group, row | both, localized, again)
            else:
                writer.annotate(group, before | both)
        return again

    def _localized(
        self, localize: Callable[..., PoseEstimate], tasks: Iterator[_Task], count: int
    ) -> Iterator[tuple[int, dict[str, Any], LocalizedQuery]]:
        """Yield queries with their rows and correspondences."""
        answers = prefetch(partial(self._localize, localize), tasks, self.stage.workers)
        return iter(tqdm(answers, total=count, desc=self._label, unit="query", disable=not count))

    def _predicted(self, localizer: Localizer, numbers: Sequence[int]) -> Iterator[_Task]:
        """Yield queries with what a network says of them, asked for some at a time, and the seconds that took."""
        size = localizer.batch_size
        parts = [numbers[start : start + size] for start in range(0, len(numbers), size)]
        asked = ([self.query(number) for number in part] for part in [*parts, []])
        for part, (queries, following) in zip(parts, pairwise(asked), strict=True):
            started = time.perf_counter()
            predictions = localizer.predict(queries, following)
            seconds = (time.perf_counter() - started) / len(part)
            for number, query, prediction in zip(part, queries, predictions, strict=True):
                yield number, *query, prediction, seconds

    def _localize(
        self, localize: Callable[..., PoseEstimate], task: _Task
    ) -> tuple[int, dict[str, Any], LocalizedQuery]:
        number, query, references, prediction, seconds = task
        started = time.perf_counter() - seconds
        try:
            if query.views:
                estimate = self.place.judged(localize(query, references, prediction))
            else:
                estimate = PoseEstimate("failed: no images of this device at this time")
        except Exception as error:  # one bad query never ends a run
            estimate = PoseEstimate(f"failed: {reason_of(error, f'localizing {query.views[0].name}')}")
        localized = localized_query(query, estimate, self.localizer.image_names)
        found_by = "" if estimate.world_from_rig is None else estimate.found_by
        row = _row(self.keys[number], estimate, localized, label(self.place.settings, found_by), started)
        return number, row, localized


def _localize_share(
    writer: GroupWriter, todo: Sequence[tuple[str, int]], stage: _Stage, map_device: str, query_device: str
) -> None:
    stage.run(map_device, query_device).localize_into(writer, todo)


def _not_localized(writer: GroupWriter, todo: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return those of some queries that a file has no row of."""
    rows = writer.notes()
    return [item for item in todo if item[0] not in rows]


def _escalate_share(
    writer: GroupWriter, done: Sequence[_Done], stage: _Stage, map_device: str, query_device: str, shared: float
) -> None:
    run = stage.run(map_device, query_device)
    run.add_escalation(done)
    run.escalate_into(writer, done, shared)


def _not_escalated(writer: GroupWriter, done: Sequence[_Done]) -> list[_Done]:
    """Return those of some queries that a file has no row of that tells of an escalation."""
    rows = writer.notes()
    return [item for item in done if not rows.get(item[0], {}).get("first_status")]


def _is_internal(row: Mapping[str, Any]) -> bool:
    return INTERNAL in row["status"] or INTERNAL in row["reason"]


def _row(
    key: tuple[int, str], estimate: PoseEstimate, localized: LocalizedQuery, method: str, started: float
) -> dict[str, Any]:
    """Return a query's line of the table, with its pose and covariance as JSON."""
    pose = None if estimate.world_from_rig is None else geometry.qt_from_pose(estimate.world_from_rig).tolist()
    covariance = None if estimate.covariance is None else estimate.covariance.ravel().tolist()
    focals = estimate.focals_px if np.isfinite(estimate.focals_px).any() else ()
    return {
        "timestamp": key[0],
        "device_id": key[1],
        "status": estimate.status,
        "method": method,
        "num_inliers": estimate.num_inliers,
        "num_matches": estimate.num_matches,
        "inlier_ratio": round(estimate.inlier_ratio, 4),
        "num_guided": estimate.num_guided,
        "rmse_px": round(estimate.rmse_px, 4),
        "rival_support": round(estimate.rival_support, 4),
        "coverage": round(estimate.coverage, 4),
        "agreement": estimate.agreement,
        "p_correct": round(estimate.p_correct, 4),
        "position_std_m": round(estimate.position_std_m, 6),
        "rotation_std_deg": round(estimate.rotation_std_deg, 6),
        "references": ";".join(localized.references),
        "seconds": round(time.perf_counter() - started, 4),
        "focal_px": ";".join("" if np.isnan(focal) else f"{focal:.1f}" for focal in focals),
        "scale_std": round(estimate.scale_std, 6),
        "rejected": ";".join(localized.rejected),
        "reason": estimate.reason,
        "misfit": estimate.misfit,
        "first_status": None,
        "first_seconds": None,
        "qt": pose,
        "covariance": covariance,
    }


def _write_poses(pair: _Pair, rows: list[dict[str, Any]], settings: LocalizeSettings) -> None:
    """Write the table and the poses of a pair, the poses last: they stand for a finished pair."""
    columns = [*COLUMNS, *(PREDICTION_COLUMNS if settings.predicts else [])]
    columns += ESCALATION_COLUMNS if settings.features.escalation else []
    with write_atomic(pair.file("csv")) as temporary:
        pd.DataFrame(rows, columns=columns).to_csv(temporary, index=False)
    posed = [row for row in rows if row["qt"] is not None]
    unknown = [float("nan")] * 36
    covariances = [row["covariance"] or unknown for row in posed]
    trajectory = Trajectory(
        np.array([row["timestamp"] for row in posed], np.int64),
        [row["device_id"] for row in posed],
        np.array([row["qt"] for row in posed], np.float64).reshape(-1, 7),
        np.array(covariances, np.float64).reshape(-1, 6, 6) if any(row["covariance"] for row in posed) else None,
    )
    trajectory.write(pair.file("txt"))


def explain_query(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    features_dir: str | Path,
    map_dir: str | Path,
    map_device: str,
    query_device: str,
    settings: LocalizeSettings,
    queries: str = "keyframes_pruned_subsampled",
    index: int = 0,
) -> tuple[FeedForwardLocalizer, Query, FeedForwardAnswer]:
    """Ask the predictor about one query again, and return all that it says.

    Args:
        sessions_root, retrieval_dir, features_dir, map_dir, settings, queries: as `localize_pairs` had them.
        map_device, query_device: the pair.
        index: which of the queries.

    Returns:
        The localizer, the query as it was asked, and its answer: what `draw_prediction` takes.

    Raises:
        ToolkitError: the method asks no network.
        ArtifactError: the retrieval is missing.
    """
    if not settings.predicts:
        raise ToolkitError(f"The method {settings.method} asks no network. Use feed_forward or hybrid.")
    settings = resolve_auto(LocalizeSettings.of(settings, {"method": "feed_forward"}))
    folders = _Folders(*map(Path, (sessions_root, retrieval_dir, retrieval_dir, features_dir, map_dir)))
    run = _Stage(folders, settings, queries, skip_existing=True, workers=1).run(map_device, query_device)
    localizer = run.localizer.inner if isinstance(run.localizer, ScaledLocalizer) else run.localizer
    assert isinstance(localizer, FeedForwardLocalizer)
    query, references = run.query(index)
    return localizer, query, localizer.answer(query, references)
