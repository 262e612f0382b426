"""The localize stage: from references and local features to one pose per query device."""

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch
from toolkit.capture.tables import in_unit_of_poses, read_query_table
from toolkit.capture.upright import Turns, upright_turns
from toolkit.errors import INTERNAL, ToolkitError, reason_of
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
from toolkit.manifest import LocalizeSettings
from toolkit.mapping.build import map_settings
from toolkit.pose.base import (
    Localizer,
    PoseEstimate,
    Query,
    References,
    ScaledLocalizer,
)
from toolkit.pose.correspondences import MAPS, LocalizedQuery, query_group
from toolkit.pose.escalation import EscalatingLocalizer, can_gain, is_better, is_sure, known_poses
from toolkit.pose.intrinsics_check import MAX_SHARES, SIGNIFICANCE
from toolkit.pose.pnp import PNP_FORMAT
from toolkit.pose.stored_queries import localized_query, references_of_images, stored_query
from toolkit.prediction.feed_forward import FeedForwardAnswer, FeedForwardLocalizer
from toolkit.prediction.network import open_predictor
from toolkit.runs.pairs import PairRows
from toolkit.scene.locate import localize_image
from toolkit.scene.map import (
    Map,
    attributes,
    create_localizer,
    create_methods,
    label,
    needs_upright,
    session_fingerprint,
    update_attributes,
)
from toolkit.show.metrics import camera_messages
from toolkit.store.hdf5 import write_groups
from toolkit.store.items import Items, heals
from toolkit.threads import fixed_sums

__all__ = ["COLUMNS", "PREDICTION_COLUMNS", "Map", "explain_query", "localize_image", "localize_pairs"]

log = logging.getLogger(__name__)

COLUMNS = [
    "timestamp", "device_id", "image", "status", "method", "num_inliers", "num_matches", "inlier_ratio", "num_guided",
    "rmse_px", "rival_support", "coverage", "agreement", "p_correct", "position_std_m", "rotation_std_deg",
    "references", "seconds", "focal_px", "principal_point_px", "reason",
]  # fmt: skip
PREDICTION_COLUMNS = ["scale_std", "rejected"]
"""Additional columns of `feed_forward` and `hybrid`."""

ESCALATION_COLUMNS = ["first_status", "first_seconds"]
"""Additional columns if `features.escalation` is set: status and seconds before the escalation features were used;
empty for a query that did not need them."""


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
    """Localize the queries of every pair of map device and query device.

    For each pair, writes the poses (`<pair>.txt`), a table with the status and quality of each (`<pair>.csv`), and the
    correspondences that support each pose (`<pair>.h5`, see `pose.correspondences`). For each map, writes
    `<scene>_map_<device>.json`, which says whether the map's poses agree with its images.

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        out_dir: folder of the poses.
        features_dir: folder of local features, shared with the embed stage.
        map_dir: folder of the triangulated maps, `<device>_map.npz`, and of matches.
        settings: see `LocalizeSettings`; a dict needs only the settings that differ from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` devices of the capture.
        queries: the keyframe list to localize, or `all`.
        skip_existing: reuse results of the same inputs and settings, and resume a killed run.
        workers: threads; 0: the number of cores.

    Returns:
        One row per pair: map_device, query_device, queries = ok + low_confidence + failed, escalated (queries localized
        again with the escalation features), map_poses (`consistent` with the map's images, `inconsistent`, also if its
        intrinsics are wrong, or `unknown`), seconds, skipped, path, reason. A pair that cannot be localized has zeros
        and a `reason`.

    Raises:
        ManifestError: unknown method, predictor, features or matcher, or a number that is not positive.
        WeightsError: the network has no weights; raised before any work is done.
        CaptureError: unknown device; or no pair can be localized, for example because the keyframe list is missing.
        ArtifactError: no pair can be localized, and the retrieval file of one is missing.
    """
    settings = resolve_auto(LocalizeSettings.of(settings))
    folders = _Folders(*map(Path, (sessions_root, retrieval_dir, out_dir, features_dir, map_dir)))
    stage = _Stage(folders, settings, queries, skip_existing, workers or default_workers())
    capture, settings = stage.capture, stage.settings
    table = PairRows(capture.name, folders.out, folders.retrieval)
    query_tables: dict[str, list[pd.DataFrame]] = {}
    devices = product(capture.devices_with("map", map_device), capture.devices_with("query", query_device))
    with fixed_sums:
        for mapped, queried in devices:
            pair = _Pair(stage, mapped, queried)
            with table.row(mapped, queried) as row:
                table.check_upstream()
                started = time.perf_counter()
                record = stage.record(pair)
                h5_attributes = attributes(settings, stage.kinds, capture, mapped, folders.retrieval)
                skipped = stage.is_current(pair, record, h5_attributes)
                unfinished = False
                if not skipped:
                    run = stage.run(mapped, queried)
                    localized = run.localize(record, h5_attributes)
                    write_text(pair.map_record, json.dumps(run.map.record(), indent=1) + "\n")
                    write_sidecar(pair.map_record, stage.made_from(h5_attributes))
                    _write_poses(pair, localized, settings)
                    unfinished = any(map(_is_internal, localized))
                if update_attributes(pair.file("h5"), h5_attributes) or not skipped:
                    maps = [stage.folders.map / name for name in json.loads(h5_attributes[MAPS])]
                    write_sidecar(
                        *(pair.file("txt"), record, [pair.file("csv"), pair.file("h5")]),
                        made_from=[pair.retrieval, *maps],
                        unfinished=unfinished,
                    )
                rows = read_query_table(pair.file("csv"), ["status"])
                query_tables.setdefault(queried, []).append(rows)
                counts = rows["status"].str.split(":").str[0].value_counts()
                of_map = read_map_record(pair.map_record)
                row |= {
                    "queries": int(counts.sum()),
                    **{status: int(counts.get(status, 0)) for status in ("ok", "low_confidence", "failed")},
                    "escalated": int(rows["first_status"].notna().sum()) if settings.features.escalation else 0,
                    "map_poses": "inconsistent" if of_map["camera"] else of_map["verdict"],
                    "seconds": round(time.perf_counter() - started, 2),
                    "skipped": skipped,
                    "path": str(pair.file("txt")),
                }
            if row["reason"]:
                pair.remove_poses()
    for queried, tables in query_tables.items():
        for message in camera_messages(capture[f"{queried}_query"], tables):
            log.warning(message)
    frame = table.frame()
    write_text(Path(out_dir) / "settings.json", settings.model_dump_json(indent=1) + "\n")
    return frame


@dataclass(frozen=True)
class _Pair:
    """One pair of map device and query device: its files and its queries."""

    stage: "_Stage"
    map_device: str
    query_device: str

    @property
    def retrieval(self) -> Path:
        name = pair_name(self.stage.capture.name, self.map_device, self.query_device)
        return self.stage.folders.retrieval / f"{name}.jsonl"

    @property
    def map_record(self) -> Path:
        return map_record_path(self.stage.folders.out, self.stage.capture.name, self.map_device)

    def file(self, suffix: str) -> Path:
        return self.stage.folders.out / f"{self.retrieval.stem}.{suffix}"

    def remove_poses(self) -> None:
        """Remove the poses of an earlier run. The items stay: from them they can be written again quickly."""
        for poses in (self.file("txt"), sidecar_path(self.file("txt")), self.file("csv")):
            poses.unlink(missing_ok=True)

    @property
    def session(self) -> Session:
        return self.stage.capture[f"{self.query_device}_query"]

    @property
    def keyframes(self) -> pd.DataFrame:
        return self.session.keyframes(self.stage.queries)


class _Folders(NamedTuple):
    """The folders given to `localize_pairs`."""

    sessions: Path
    retrieval: Path
    out: Path
    features: Path
    map: Path


class _Stage(Remade):
    """State shared by all pairs; each worker opens it once."""

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
        """
        Args:
            folders, settings, queries, skip_existing, workers: see `localize_pairs`.
            time_ns: when the work was distributed, so that a worker does not reuse a stage that it opened earlier.
            made_by: the `networks` of the main process; a worker must have the same.
        """
        self.folders, self.queries = folders, queries
        self.skip_existing, self.workers = skip_existing, workers or default_workers()
        self.capture = Capture.from_sessions_root(folders.sessions)
        if settings.unit == "auto":
            settings = LocalizeSettings.of(settings, {"unit": self.capture.unit})
        self.settings = settings
        """With the capture's unit instead of `auto`."""
        self.kinds, self.escalation = create_methods(settings)
        self.predictor = open_predictor(settings, self.capture, folders.map) if settings.predicts else None
        if made_by is not None:
            require_same(made_by, self.networks)
        self.open_map = lru_cache(maxsize=1)(self._open_map)

    @cached_property
    def turns(self) -> Turns | None:
        """The turns that make images upright; None if no network needs upright images."""
        upright = needs_upright(self.settings, [*self.kinds, *self.escalation])
        return upright_turns(self.capture, self.settings.world_up) if upright else None

    def record(self, pair: _Pair) -> dict[str, Any]:
        """Return everything that the poses of a pair depend on."""
        map_session, keyframes = self.capture[f"{pair.map_device}_map"], pair.keyframes
        settings, predictor = self.settings, self.predictor
        if not pair.retrieval.exists():
            read_references(pair.retrieval)  # raises an error that names the missing file
        record: dict[str, Any] = {
            "method": settings.method,
            "pnp": settings.pnp.model_dump() | {"seed": settings.seed, "format": PNP_FORMAT},
            "misfit": [SIGNIFICANCE, MAX_SHARES],
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
        if self.turns is not None:  # they follow from all maps of the capture, not only from that of this pair
            record["turns"] = self.turns.fingerprint([map_session, pair.session])
        if predictor is not None:
            record |= {
                "predictor": {"name": predictor.name} | predictor.settings,
                "references": settings.predictor.num_references,
                "depths": map_session.depths_fingerprint,
            }
        return record

    def is_current(self, pair: _Pair, record: dict[str, Any], h5_attributes: Mapping[str, str]) -> bool:
        """Tell whether to reuse the poses of a pair: they fit its record, and the files of its map still exist."""
        if not self.skip_existing:
            return False
        made_from = self.made_from(h5_attributes)
        maps_exist = None not in made_from["maps"] and is_current(pair.map_record, made_from)
        return maps_exist and is_current(pair.file("txt"), record)

    def made_from(self, h5_attributes: Mapping[str, str]) -> dict[str, Any]:
        """Return everything that the record of a map depends on. All pairs of the map share it, so it has its own."""
        maps = [self.folders.map / name for name in json.loads(h5_attributes[MAPS])]
        return {"unit": self.settings.unit, "maps": [read_sidecar(path) for path in maps]}

    def _open_map(self, device: str) -> tuple[Map, Localizer]:
        folders = self.folders
        map_ = Map.build(
            self.capture, device, self.settings, self.kinds, folders.features, folders.map, self.workers,
            self.skip_existing, self.escalation,
        )  # fmt: skip
        return map_, create_localizer(self.settings, map_, self.predictor)

    def run(self, map_device: str, query_device: str) -> "_PairRun":
        """Open the map of a pair and the features of its queries."""
        return _PairRun(_Pair(self, map_device, query_device), *self.open_map(map_device))

    @property
    def networks(self) -> dict[str, Any]:
        """Settings of the networks, which depend on the machine, and on which the poses depend."""
        made_by = {kind.name: [kind.extractor.settings, kind.matcher.settings] for kind in self.kinds}
        return made_by if self.predictor is None else made_by | {self.predictor.name: self.predictor.settings}

    @cached_property
    def of_worker(self) -> Any:
        """This stage for a worker, which reuses existing files and has its own number of threads."""
        return _Stage.elsewhere(self.folders, self.settings, self.queries, True, 0, time.time_ns(), self.networks)


_Task = tuple[int, Query, list[References], Any, float]
"""Number of a query, the query, its references, the prediction of a network, and the seconds which that took."""
_Todo = tuple[str, str, int]
"""Name of a query's item, fingerprint of its sources, and number of the query."""
_ToEscalate = tuple[str, str, int, dict[str, Any]]
"""Name of the item of an escalated query, fingerprint of its sources, number of the query, and its first table row."""
_Faulty = dict[int, tuple[dict[str, Any], LocalizedQuery]]
"""Number of a query that failed with an internal error -> its row and correspondences. It gets no item, so the next run
tries it again."""
_ESCALATED = "/escalated"
"""Ends the name of a query's item with the escalation features. It has no arrays if the first correspondences count."""


class _PairRun:
    """Localizes the queries of one pair."""

    def __init__(self, pair: _Pair, map_: Map, localizer: Localizer) -> None:
        self.pair, self.map, self.localizer, self.stage = pair, map_, localizer, pair.stage
        self.first = localizer.first if isinstance(localizer, EscalatingLocalizer) else localizer
        """The localizer without escalation features."""
        keyframes = pair.keyframes
        self.keys = list(zip(keyframes["timestamp"].tolist(), keyframes["device_id"].tolist(), strict=True))
        self.rows = pair.session.rows_of_keyframes(keyframes)
        """For each query, the rows of its images."""
        index_of = {name: index for index, name in enumerate(localizer.image_names)}
        self.references = references_of_images(pair.retrieval, index_of)
        """References of each query image, by timestamp and sensor."""
        self.stores: list[FeatureStore] = []
        self.matches: list[MatchStore | None] = []
        if map_.settings.method != "feed_forward":
            for kind in map_.kinds:
                self._add_kind(kind, range(len(self.keys)))

    def _add_kind(self, kind: AnyMethod, numbers: Sequence[int]) -> None:
        """Extract features of query images, and match them with their references if the matcher is a network.

        If the map has no features of this kind, also extract those of the references.
        """
        session, map_, stage = self.pair.session, self.map, self.stage
        rows = np.unique(np.concatenate([*(self.rows[number] for number in numbers), np.zeros(0, np.int64)]))
        turns = map_.turns_of(kind, session)
        store = extract_session(session, stage.folders.features, kind.extractor, rows, stage.workers, turns=turns)
        images = session.images.iloc[rows]
        keys = zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True)
        names = [
            (session.image_name(int(row)), self.localizer.image_names[index])
            for row, key in zip(rows, keys, strict=True)
            if key in self.references
            for index in self.references[key].images
        ]
        map_features = next((mapped.features for mapped in map_.mapped if mapped.name == kind.name), None)
        if map_features is None:
            references = dict.fromkeys(name for _, name in names)
            map_features = map_.on_demand(kind).prepare(references, stage.workers, stage.skip_existing)
        matches = None
        if isinstance(map_features, FeatureStore) and not isinstance(kind.matcher, MutualMatcher):
            sessions = session.id, f"{map_.device}_map"
            stores = store, map_features
            matches = match_sessions(stores, names, kind.matcher, map_.map_dir, sessions, stage.skip_existing)
        self.stores.append(store)
        self.matches.append(matches)

    def query(self, number: int) -> tuple[Query, list[References]]:
        # Local features were extracted from upright images: only a predictor still needs the turns.
        turns = self.map.turns if self.map.settings.predicts else None
        rows = self.rows[number]
        return stored_query(self.pair.session, rows, self.references, self.stores, self.matches, turns)

    def localize(self, record: dict[str, Any], h5_attributes: Mapping[str, str]) -> list[dict[str, Any]]:
        """Localize the queries that are not localized yet, and write the `.h5` file.

        Returns:
            A row per query, in the keyframe list's order.
        """
        names, source = [query_group(*key) for key in self.keys], fingerprint(record)
        numbers = {name: number for number, name in enumerate(names)}  # a keyframe list may repeat a query
        with Items(self.pair.file("items"), again=not self.stage.skip_existing) as items:
            items.drop_damaged()
            todo = items.spread(
                _localize_share, items.left((name, source, number) for name, number in numbers.items()),
                (self.stage.of_worker, *self.devices), self._label, "query", self.first.batch_size,
            )  # fmt: skip
            faulty = self.localize_into(items, todo)
            if isinstance(self.localizer, EscalatingLocalizer):
                items.flush()
                localized = [(name, source, number) for name, number in numbers.items() if number not in faulty]
                faulty |= self._escalate(items, localized)
        last = {name: name + _ESCALATED * items.is_current(name + _ESCALATED, source) for name in numbers}
        # If the run is killed before it writes the new poses, no poses of an earlier run may lie beside this file.
        for poses in (self.pair.file("txt"), sidecar_path(self.pair.file("txt"))):
            poses.unlink(missing_ok=True)
        groups = (
            (name, faulty[number][1].arrays() if number in faulty else items[last[name]] or items[name])
            for name, number in numbers.items()
        )
        write_groups(self.pair.file("h5"), groups, h5_attributes)
        images = self.pair.session.own_names(self.rows)
        rows = {
            name: faulty[number][0] if number in faulty else items.note(last[name]) for name, number in numbers.items()
        }
        return [rows[name] | {"image": image} for name, image in zip(names, images, strict=True)]

    @property
    def devices(self) -> tuple[str, str]:
        """Map device and query device."""
        return self.pair.map_device, self.pair.query_device

    @property
    def _label(self) -> str:
        return f"localize {self.pair.query_device} in {self.pair.map_device}"

    def localize_into(self, items: Items, todo: Sequence[_Todo]) -> _Faulty:
        """Localize queries and add them as items; return those that failed with an internal error."""
        faulty: _Faulty = {}
        of_number = {number: (name, source) for name, source, number in todo}
        tasks = self._predicted(self.first, list(of_number))
        for number, row, localized in self._localized(self.first.localize, tasks, len(todo)):
            if _is_internal(row):
                faulty[number] = row, localized
            else:
                items.add(*of_number[number], localized.arrays(), row)
        return faulty

    def _escalate(self, items: Items, localized: Sequence[_Todo]) -> _Faulty:
        """Localize queries without a sure pose again, with the escalation features; returns as `localize_into`."""
        limit = self.map.sure_position_std
        rows = {number: items.note(name) for name, _, number in localized}
        escalated = [(name + _ESCALATED, source, number) for name, source, number in localized]
        todo = [
            (name, source, number, row)
            for name, source, number in items.left(escalated)
            if not ((row := rows[number])["misfit"] or is_sure(row["status"], row["position_std_m"], limit))
            and can_gain(*self.query(number))
        ]
        if not todo:
            return {}
        started = time.perf_counter()
        self.add_escalation(todo)
        shared = (time.perf_counter() - started) / len(todo)
        todo = items.spread(_escalate_share, todo, (self.stage.of_worker, *self.devices, shared), self._label, "query")
        return self.escalate_into(items, todo, shared)

    def add_escalation(self, todo: Sequence[_ToEscalate]) -> None:
        """Extract and match the escalation features of queries."""
        for kind in self.map.escalation:
            self._add_kind(kind, [number for _, _, number, _ in todo])

    def escalate_into(self, items: Items, todo: Sequence[_ToEscalate], shared: float) -> _Faulty:
        """Localize queries again with the escalation features, which are extracted; add them, if better, as items.

        Args:
            shared: seconds per query that the extraction took.

        Returns:
            As `localize_into`.
        """
        assert isinstance(self.localizer, EscalatingLocalizer)
        faulty: _Faulty = {}
        of_number = {number: (name, source, row) for name, source, number, row in todo}
        # The first poses take the place of a prediction.
        tasks = ((number, *self.query(number), row["known"], shared) for number, (*_, row) in of_number.items())
        for number, row, localized in self._localized(self.localizer.escalate, tasks, len(todo)):
            name, source, first_row = of_number[number]
            history = {
                "first_status": first_row["status"],
                "first_seconds": first_row["seconds"],
                "seconds": round(first_row["seconds"] + row["seconds"], 4),
            }
            if _is_internal(row):
                faulty[number] = row | history, localized
            elif is_better(row["status"], first_row["status"]):
                items.add(name, source, localized.arrays(), row | history)
            else:
                items.add(name, source, note=first_row | history)
        return faulty

    def _localized(
        self, localize: Callable[..., PoseEstimate], tasks: Iterator[_Task], count: int
    ) -> Iterator[tuple[int, dict[str, Any], LocalizedQuery]]:
        """Yield queries with their rows and correspondences."""
        results = prefetch(partial(self._localize, localize), tasks, self.stage.workers)
        return iter(tqdm(results, total=count, desc=self._label, unit="query", disable=not count))

    def _predicted(self, localizer: Localizer, numbers: Sequence[int]) -> Iterator[_Task]:
        """Yield queries with the predictions of a network, which runs on batches of queries."""
        size = localizer.batch_size
        batches = [numbers[start : start + size] for start in range(0, len(numbers), size)]
        loaded = ([self.query(number) for number in batch] for batch in [*batches, []])
        for batch, (queries, following) in zip(batches, pairwise(loaded), strict=True):
            started = time.perf_counter()
            predictions = localizer.predict(queries, following)
            seconds = (time.perf_counter() - started) / len(batch)
            for number, query, prediction in zip(batch, queries, predictions, strict=True):
                yield number, *query, prediction, seconds

    def _localize(
        self, localize: Callable[..., PoseEstimate], task: _Task
    ) -> tuple[int, dict[str, Any], LocalizedQuery]:
        number, query, references, prediction, seconds = task
        started = time.perf_counter() - seconds
        try:
            if query.views:
                estimate = self.map.judged(localize(query, references, prediction))
            else:
                estimate = PoseEstimate("failed: no images of this device at this time")
        except Exception as error:  # one bad query never ends a run
            estimate = PoseEstimate(f"failed: {reason_of(error, f'localizing {query.views[0].name}')}")
        localized = localized_query(query, estimate, self.localizer.image_names)
        found_by = "" if estimate.world_from_rig is None else estimate.found_by
        row = _row(self.keys[number], estimate, localized, label(self.map.settings, found_by), started)
        return number, row, localized


def _localize_share(
    items: Items, todo: Sequence[_Todo], stage: _Stage, map_device: str, query_device: str
) -> None:
    stage.run(map_device, query_device).localize_into(items, todo)


def _escalate_share(
    items: Items, todo: Sequence[_ToEscalate], stage: _Stage, map_device: str, query_device: str, shared: float
) -> None:
    run = stage.run(map_device, query_device)
    run.add_escalation(todo)
    run.escalate_into(items, todo, shared)


def _is_internal(row: Mapping[str, Any]) -> bool:
    return INTERNAL in row["status"] or INTERNAL in row["reason"]


def _row(
    key: tuple[int, str], estimate: PoseEstimate, localized: LocalizedQuery, method: str, started: float
) -> dict[str, Any]:
    """Return the table row of a query, with its pose and covariance as lists for JSON."""
    pose = None if estimate.world_from_rig is None else geometry.qt_from_pose(estimate.world_from_rig).tolist()
    covariance = None if estimate.covariance is None else estimate.covariance.ravel().tolist()
    focals = estimate.focals_px if np.isfinite(estimate.focals_px).any() else ()
    centers = estimate.centers_px if np.isfinite(estimate.centers_px).any() else ()
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
        "principal_point_px": ";".join("" if np.isnan(x) else f"{x:.1f} {y:.1f}" for x, y in centers),
        "scale_std": round(estimate.scale_std, 6),
        "rejected": ";".join(localized.rejected),
        "reason": estimate.reason,
        "misfit": estimate.misfit,
        "first_status": None,
        "first_seconds": None,
        "qt": pose,
        "known": [pose.tolist() for pose in known_poses(estimate)],
        "covariance": covariance,
    }


def _write_poses(pair: _Pair, rows: list[dict[str, Any]], settings: LocalizeSettings) -> None:
    """Write the table and the poses of a pair; the poses last, because their file marks the pair as finished."""
    columns = [*COLUMNS, *(PREDICTION_COLUMNS if settings.predicts else [])]
    columns += ESCALATION_COLUMNS if settings.features.escalation else []
    with write_atomic(pair.file("csv")) as temporary:
        in_unit_of_poses(pd.DataFrame(rows, columns=columns), settings.unit).to_csv(temporary, index=False)
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
    """Run the predictor on one query again, and return its full output, as `draw_prediction` takes it.

    Args:
        sessions_root, retrieval_dir, features_dir, map_dir, settings, queries: as given to `localize_pairs`.
        map_device, query_device: the pair.
        index: index of the query in the keyframe list.

    Returns:
        The localizer, the query, and the localizer's full output for it.

    Raises:
        ToolkitError: the method does not use a predictor.
        ArtifactError: the retrieval file is missing.
    """
    if not settings.predicts:
        raise ToolkitError(f"The method {settings.method} does not use a predictor. Use feed_forward or hybrid.")
    settings = resolve_auto(LocalizeSettings.of(settings, {"method": "feed_forward"}))
    folders = _Folders(*map(Path, (sessions_root, retrieval_dir, retrieval_dir, features_dir, map_dir)))
    run = _Stage(folders, settings, queries, skip_existing=True, workers=1).run(map_device, query_device)
    localizer = run.localizer.inner if isinstance(run.localizer, ScaledLocalizer) else run.localizer
    assert isinstance(localizer, FeedForwardLocalizer)
    query, references = run.query(index)
    return localizer, query, localizer.answer(query, references)
