"""The localize stage: from references and local features to one pose per query device."""

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch
from toolkit.capture.tables import POSES_UNIT, in_unit_of_poses
from toolkit.capture.upright import Turns, upright_turns
from toolkit.errors import ToolkitError, reason_of
from toolkit.features.features import MutualMatcher
from toolkit.features.matching import AnyMethod, create_methods, needs_upright, resolve_auto, weights_files
from toolkit.features.stores import FeatureStore, extract_session, match_sessions
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
    write_csv,
    write_sidecar,
    write_text,
)
from toolkit.geometry import Ints
from toolkit.manifest import LocalizeSettings
from toolkit.mapping.build import map_settings
from toolkit.pose.base import Query, QueryInput, QueryResult, References, status_counts
from toolkit.pose.map_matching import MAX_SHARES, SIGNIFICANCE
from toolkit.pose.pnp import PNP_FORMAT
from toolkit.prediction.feed_forward import FeedForwardAnswer, FeedForwardLocalizer
from toolkit.prediction.hybrid import lifts
from toolkit.prediction.network import open_predictor
from toolkit.results.metrics import camera_messages
from toolkit.results.pair import (
    MAPS,
    PairResults,
    attributes,
    pose_sources,
    query_group,
    session_fingerprint,
    update_attributes,
)
from toolkit.runs.pairs import PairRows
from toolkit.scene.images import localize_image
from toolkit.scene.map import FEW_REFERENCES, WITHOUT_FEATURES, Map
from toolkit.scene.run import StoredQueries
from toolkit.store.hdf5 import write_groups
from toolkit.store.items import Items, retry_damaged
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

FALLBACK_COLUMNS = ["first_status", "first_seconds"]
"""Additional columns if `features.escalation` is set: status and seconds before the escalation features were used;
empty for a query that did not need them."""


@retry_damaged
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
    pairs: Sequence[Sequence[str]] | None = None,
    queries: str = "keyframes_pruned_subsampled",
    skip_existing: bool = True,
    workers: int = 0,
) -> pd.DataFrame:
    """Localize the queries of every pair of map device and query device.

    For each pair, writes the poses (`<pair>.txt`), a table with the status and quality of each (`<pair>.csv`), and the
    correspondences that support each pose (`<pair>.h5`, see `pose.base.Correspondences`). For each map, writes
    `<scene>_map_<device>.json`, which says whether the map's poses agree with its images.

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        out_dir: folder of the poses.
        features_dir: folder of local features, shared with the embed stage.
        map_dir: folder of the triangulated maps, `<device>_map.npz`, and of matches.
        settings: see `LocalizeSettings`; a dict needs only the settings that differ from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` devices of the capture.
        pairs: only these [map device, query device]; None: all of the chosen devices.
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
    stage = _Stage(folders, settings, queries, skip_existing, workers)
    capture, settings = stage.capture, stage.settings
    table = PairRows(capture.name, folders.out, folders.retrieval)
    query_tables: dict[str, list[pd.DataFrame]] = {}
    with fixed_sums:
        for devices in capture.pairs(map_device, query_device, pairs):
            pair = _Pair(stage, *devices)
            with table.row(*devices) as row:
                table.check_upstream()
                skipped = pair.update()
                rows = PairResults.open(pair.file("csv"), whole=False).table
                query_tables.setdefault(devices[1], []).append(rows)
                of_map = read_map_record(pair.map_record)
                row |= {
                    "queries": len(rows),
                    **status_counts(rows["status"]),
                    "escalated": int(rows["first_status"].notna().sum()) if settings.features.escalation else 0,
                    "map_poses": "inconsistent" if of_map["camera"] else of_map["verdict"],
                    "skipped": skipped,
                    "path": str(pair.file("txt")),
                }
            if row["reason"]:
                pair.remove_poses()
    for queried, tables in query_tables.items():
        for message in camera_messages(capture[f"{queried}_query"], tables):
            log.warning(message)
    return table.frame(settings)


def build_maps(
    sessions_root: str | Path, retrieval_dir: str | Path, out_dir: str | Path, features_dir: str | Path,
    map_dir: str | Path, settings: LocalizeSettings, devices: Sequence[str],
) -> list[Map]:  # fmt: skip
    """Build the maps of `devices` without queries, for `Map.open`; the rest is as for `localize_pairs`."""
    folders = _Folders(*map(Path, (sessions_root, retrieval_dir, out_dir, features_dir, map_dir)))
    stage, maps = _Stage(folders, resolve_auto(settings), "all", skip_existing=True), list[Map]()
    with fixed_sums:
        for device in devices:
            maps.append(stage.open_map(device))
            record = map_record_path(folders.out, stage.capture.name, device)
            made_by = attributes(stage.settings, stage.kinds, stage.capture, device, folders.retrieval)
            write_text(record, json.dumps(maps[-1].record(), indent=1) + "\n")
            write_groups(record.with_suffix(".h5"), (), made_by)
    PairRows(stage.capture.name, folders.out).frame(stage.settings)
    return maps


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
        """Take the arguments of `localize_pairs`. A worker also takes the `networks` of the main process, which its own
        must equal, and when the work was distributed, so that it does not reuse a stage that it opened earlier.
        """
        self.folders, self.queries = folders, queries
        self.skip_existing, self.workers = skip_existing, workers or default_workers()
        self.capture = Capture.from_sessions_root(folders.sessions)
        self.settings = settings = settings.model_copy(update={"unit": self.capture.unit_of(settings.unit)})
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

    def _open_map(self, device: str) -> Map:
        scene_map = Map(
            device, self.capture.path / "sessions", self.folders.map, self.settings, self.kinds, (), self.escalation,
            self.folders.features, predictor=self.predictor,
        )  # fmt: skip
        scene_map.capture = self.capture  # its sessions are read already
        return scene_map.build(self.workers, self.skip_existing)

    @property
    def networks(self) -> dict[str, Any]:
        """Settings of the networks, which depend on the machine, and on which the poses depend."""
        made_by = {kind.name: [kind.extractor.settings, kind.matcher.settings] for kind in self.kinds}
        return made_by if self.predictor is None else made_by | {self.predictor.name: self.predictor.settings}

    @cached_property
    def of_worker(self) -> Any:
        """This stage for a worker, which reuses existing files and has its own number of threads."""
        return _Stage.elsewhere(self.folders, self.settings, self.queries, True, 0, time.time_ns(), self.networks)


_Todo = tuple[str, str, int]
"""Name of a query's item, fingerprint of its sources, and number of the query."""
_Task = tuple[int, QueryInput, Any, float]
"""Number of a query, the query, what is known of it (a prediction, or its first result), and seconds spent on it."""
_FEW, _RETRIED = "/few", "/retried"
"""End the names of a query's items with the fallback features, of few references and of all: an item's name chooses the
references. It has no arrays if earlier correspondences count."""


class _Pair:
    """One pair of map device and query device: its files, and the localization of its queries."""

    def __init__(self, stage: _Stage, map_device: str, query_device: str) -> None:
        self.stage, self.devices = stage, (map_device, query_device)
        self.stem = pair_name(stage.capture.name, map_device, query_device)
        self.retrieval = stage.folders.retrieval / f"{self.stem}.jsonl"
        self.map_record = map_record_path(stage.folders.out, stage.capture.name, map_device)
        self.label = f"localize {query_device} in {map_device}"

    def file(self, suffix: str) -> Path:
        return self.stage.folders.out / f"{self.stem}.{suffix}"

    def remove_poses(self) -> None:
        """Remove the poses of an earlier run. The items stay: from them they can be written again quickly."""
        for poses in (self.file("txt"), sidecar_path(self.file("txt")), self.file("csv")):
            poses.unlink(missing_ok=True)

    @cached_property
    def session(self) -> Session:
        return self.stage.capture[f"{self.devices[1]}_query"]

    @cached_property
    def keyframes(self) -> pd.DataFrame:
        return self.session.keyframes(self.stage.queries)

    @cached_property
    def keys(self) -> list[tuple[int, str]]:
        return list(zip(self.keyframes["timestamp"].tolist(), self.keyframes["device_id"].tolist(), strict=True))

    @cached_property
    def rows(self) -> list[Ints]:
        """For each query, the rows of its images."""
        return self.session.rows_of_keyframes(self.keyframes)

    def record(self) -> dict[str, Any]:
        """Return everything that the poses of the pair depend on."""
        stage, map_session = self.stage, self.stage.capture[f"{self.devices[0]}_map"]
        settings, sessions, keyframes = stage.settings, [map_session, self.session], self.keyframes
        if not self.retrieval.exists():
            read_references(self.retrieval)  # raises an error that names the missing file
        record: dict[str, Any] = {
            "method": settings.method,
            "pnp": settings.pnp.model_dump() | {"seed": settings.seed, "format": PNP_FORMAT},
            "misfit": [SIGNIFICANCE, MAX_SHARES],
            "map": settings.map and map_settings(settings.map, settings.seed),
            "features": [kind.extractor.settings for kind in stage.kinds],
            "matchers": [kind.matcher.settings for kind in stage.kinds],
            "unit": settings.unit,
            "retrieval": file_fingerprint(self.retrieval),
            "map_session": session_fingerprint(map_session),
            "query_session": session_fingerprint(self.session),
            "images": [session.files_fingerprint for session in sessions],
            "keyframes": fingerprint([keyframes["timestamp"].astype(str).tolist(), keyframes["device_id"].tolist()]),
        }
        if stage.escalation:
            record["escalation"] = {
                "features": settings.features.model_dump(exclude={"checkpoint"}),
                "matcher": settings.matcher.model_dump(exclude={"checkpoint"}),
                "weights": [file_fingerprint(path) for path in weights_files(settings)],
                "few": FEW_REFERENCES,
            }
        if stage.turns is not None:  # they follow from all maps of the capture, not only from that of this pair
            record["turns"] = stage.turns.fingerprint(sessions)
        if stage.predictor is not None:
            record |= {
                "predictor": {"name": stage.predictor.name} | stage.predictor.settings,
                "references": settings.predictor.num_references,
            }
        if stage.predictor is not None or lifts(settings, map_session):
            record["depths"] = map_session.depths_fingerprint
        return record

    def update(self) -> bool:
        """Localize the queries and write all files, unless they are current: then return True."""
        stage, record = self.stage, self.record()
        h5_attributes = attributes(stage.settings, stage.kinds, stage.capture, self.devices[0], stage.folders.retrieval)
        maps = [stage.folders.map / name for name in json.loads(h5_attributes[MAPS])]
        of_map = self._made_from(maps)
        skipped = stage.skip_existing and None not in of_map["maps"] and is_current(self.map_record, of_map)
        skipped = skipped and is_current(self.file("txt"), record)
        unfinished = False
        if not skipped:
            self.open()
            rows, unfinished = self._localize(record, h5_attributes)
            write_text(self.map_record, json.dumps(self.map.record(), indent=1) + "\n")
            write_sidecar(self.map_record, self._made_from(maps))  # its own: all pairs of the map share it
            _write_poses(self.file("txt"), rows, stage.settings)
        if update_attributes(self.file("h5"), h5_attributes) or not skipped:
            files = self.file("txt"), record, [self.file("csv"), self.file("h5")]
            captured = pose_sources(stage.capture[f"{self.devices[0]}_map"], self.session)
            write_sidecar(*files, made_from=[self.retrieval, *maps], captured=captured, unfinished=unfinished)
        return skipped

    def _made_from(self, maps: Sequence[Path]) -> dict[str, Any]:
        """Return everything that the record of the map depends on."""
        return {"unit": self.stage.settings.unit, "maps": [read_sidecar(path) for path in maps]}

    def open(self) -> Self:
        """Open the map, and the references and features of the queries."""
        self.map = self.stage.open_map(self.devices[0])
        self.stored = StoredQueries(self.session, self.retrieval)
        if self.map.settings.method not in WITHOUT_FEATURES:
            references = partial(self.stored.references_of, self.map)
            self._add_features(self.map.kinds, {number: references(rows) for number, rows in enumerate(self.rows)})
        return self

    def _add_features(self, kinds: Sequence[AnyMethod], asked: Mapping[int, Sequence[References]]) -> None:
        """Extract features of queries, given by number with the references of each image, and match them with these if
        the matcher is a network; also extract those of the references if the map has none of a kind.
        """
        session, scene_map, stage = self.session, self.map, self.stage
        rows = np.unique(np.concatenate([*(self.rows[number] for number in asked), np.zeros(0, np.int64)]))
        map_names = list(scene_map.index_of)
        names = [
            (session.image_name(int(row)), map_names[index])
            for number, references in asked.items()
            for row, found in zip(self.rows[number], references, strict=True)
            for index in found.images
        ]
        for kind in kinds:
            turns = scene_map.turns_of(kind, session)
            store = extract_session(session, stage.folders.features, kind.extractor, rows, stage.workers, turns=turns)
            map_features = next((mapped.features for mapped in scene_map.mapped if mapped.name == kind.name), None)
            if map_features is None:
                references = dict.fromkeys(name for _, name in names)
                map_features = scene_map.on_demand(kind).prepare(references, stage.workers, stage.skip_existing)
            matches = None
            if isinstance(map_features, FeatureStore) and not isinstance(kind.matcher, MutualMatcher):
                sessions, stores = (session.id, f"{scene_map.device}_map"), (store, map_features)
                matches = match_sessions(stores, names, kind.matcher, scene_map.map_dir, sessions, stage.skip_existing)
            self.stored.stores.append(store)
            self.stored.matches.append(matches)

    def query(self, number: int) -> QueryInput:
        return self.stored.query(self.map, self.rows[number])

    def _localize(self, record: dict[str, Any], h5_attributes: Mapping[str, str]) -> tuple[list[dict[str, Any]], bool]:
        """Localize the queries that are not localized yet, and write the `.h5` file. Return the row of each query, with
        world_from_rig (4, 4) and covariance (6, 6), NaN if unknown; and whether a query failed with an internal error.
        """
        names, source = [query_group(*key) for key in self.keys], fingerprint(record)
        numbers = {name: number for number, name in enumerate(names)}  # a keyframe list may repeat a query
        with Items(self.file("items"), skip_existing=self.stage.skip_existing) as items:
            items.drop_damaged()
            todo = items.left((name, source, number) for name, number in numbers.items())
            faulty = self._distribute(items, todo)
            if self.map.fallback is not None:
                for end in (_FEW, _RETRIED):
                    items.flush()
                    # The other queries have no features of the fallback.
                    del self.stored.stores[len(self.map.kinds) :], self.stored.matches[len(self.map.kinds) :]
                    retried = [(name + end, source, number) for name, number in numbers.items() if number not in faulty]
                    todo = [one for one in items.left(retried) if self._is_open(items, one)]
                    if todo:
                        started = time.perf_counter()
                        self.add_fallback(items, todo)
                        faulty |= self._distribute(items, todo, (time.perf_counter() - started) / len(todo))
        # If the run is killed before it writes the new poses, no poses of an earlier run may lie beside this file.
        self.remove_poses()
        rows = dict[str, dict[str, Any]]()

        def groups() -> Iterator[tuple[str, dict[str, Any]]]:
            for name, number in numbers.items():
                if number in faulty:
                    row, arrays = faulty[number].to_row(*self.keys[number]), faulty[number].arrays()
                else:
                    known = [name + end for end in (_RETRIED, _FEW, "") if items.is_current(name + end, source)]
                    row, arrays = items.note(known[0]), next(filter(None, map(items.__getitem__, known)))
                rows[name] = row | {key: arrays[key] for key in ("world_from_rig", "covariance")}
                yield name, arrays

        write_groups(self.file("h5"), groups(), h5_attributes)
        images = self.session.own_names(self.rows)
        return [rows[name] | {"image": image} for name, image in zip(names, images, strict=True)], bool(faulty)

    def _distribute(self, items: Items, todo: Sequence[_Todo], *retry_s: float) -> dict[int, QueryResult]:
        """Localize queries, with the workers of the cluster if there is one; see `localize_into`."""
        arguments, size = (self.stage.of_worker, *self.devices, *retry_s), self.map.localizer.batch_size
        todo = items.distribute(_do_share, todo, arguments, self.label, "query", 1 if retry_s else size)
        return self.localize_into(items, todo, *retry_s)

    def _stored(self, items: Items, todo: _Todo) -> tuple[QueryResult, QueryResult]:
        """Return the stored results of a query: from the features that every query has, and the latest of a retry."""
        name = todo[0].removesuffix(_FEW).removesuffix(_RETRIED)
        first = QueryResult.from_row(items.note(name), items[name])
        if not items.is_current(name + _FEW, todo[1]):
            return first, first
        return first, QueryResult.from_row(items.note(name + _FEW), items[name + _FEW] or items[name])

    def _is_open(self, items: Items, todo: _Todo) -> bool:
        """Tell whether a query should be retried in the round of its item."""
        first, latest = self._stored(items, todo)
        unsure = self.map.is_unsure(first) and self.map.needs_fallback(*self.query(todo[2]), first)
        return unsure and bool(self._asked(todo, first, latest))

    def _asked(self, todo: _Todo, first: QueryResult, latest: QueryResult) -> Sequence[References]:
        """Return the references that a query asks in the round of its item, see `Map.references_of_retry`."""
        references = self.stored.references_of(self.map, self.rows[todo[2]])
        return self.map.references_of_retry(todo[0].endswith(_FEW), references, first, latest)

    def add_fallback(self, items: Items, todo: Sequence[_Todo]) -> None:
        """Extract and match the fallback features of queries."""
        self._add_features(self.map.escalation, {one[2]: self._asked(one, *self._stored(items, one)) for one in todo})

    def localize_into(
        self, items: Items, todo: Sequence[_Todo], retry_s: float | None = None
    ) -> dict[int, QueryResult]:
        """Localize queries and add them as items; return those that failed with an internal error, by number: they get
        no item, so the next run tries them again.

        With `retry_s`, retry unsure queries with the fallback features, whose extraction took these seconds per query;
        an item gets arrays only if the result is better.
        """
        faulty, earlier = dict[int, QueryResult](), dict[int, QueryResult]()
        of_number = {number: (name, source) for name, source, number in todo}

        def retried() -> Iterator[_Task]:
            for one in todo:
                first, latest = self._stored(items, one)
                earlier[one[2]] = latest
                yield one[2], (self.query(one[2])[0], self._asked(one, first, latest)), latest, retry_s or 0.0

        if retry_s is None:
            results = self._run(self._locate, self._predicted(list(of_number)), len(todo))
        else:
            results = self._run(self._retry, retried(), len(todo))
        for number, result in results:
            if result.is_internal:
                faulty[number] = result
                if number in earlier and result.world_from_rig is None:  # what was found before the retry stays
                    remark = "; ".join(filter(None, [earlier[number].remark, result.reason]))
                    faulty[number] = replace(earlier[number], remark=remark)
            else:
                same = number in earlier and result.correspondences is earlier[number].correspondences
                items.add(*of_number[number], None if same else result.arrays(), result.to_row(*self.keys[number]))
        return faulty

    def _run(
        self, locate: Callable[[Query, Any, Any], QueryResult], tasks: Iterator[_Task], count: int
    ) -> Iterator[tuple[int, QueryResult]]:
        """Yield the results of queries; `locate` takes a query, its references, and what else a task has."""

        def run(task: _Task) -> tuple[int, QueryResult]:
            number, (query, references), known, seconds = task
            try:
                if not query.views:
                    method = self.map.settings.method
                    return number, QueryResult.failed("no images of this device at this time", found_by=method)
                result = locate(query, references, known)
            except Exception as error:  # one bad query never ends a run
                reason = reason_of(error, f"localizing {query.views[0].name}")
                result = self.map.finished(query, QueryResult.failed(reason))
            return number, replace(result, seconds=result.seconds + seconds)

        results = prefetch(run, tasks, self.stage.workers)
        return iter(tqdm(results, total=count, desc=self.label, unit="query", disable=not count))

    def _locate(self, query: Query, references: Sequence[References], prediction: Any) -> QueryResult:
        return self.map.locate(query, None, references, prediction, fallback=False)

    def _retry(self, query: Query, references: Sequence[References], first: QueryResult) -> QueryResult:
        started = time.perf_counter()
        result = self.map.retry(query, self.map.match(query, references, self.map.fallback), first)
        return replace(result, seconds=first.seconds + time.perf_counter() - started)

    def _predicted(self, numbers: Sequence[int]) -> Iterator[_Task]:
        """Yield queries with the predictions of a network, which runs on batches of queries."""
        size = self.map.localizer.batch_size
        for start in range(0, len(numbers), size):
            batch = numbers[start : start + size]
            queries, started = [self.query(number) for number in batch], time.perf_counter()
            predictions = self.map.predict(queries)
            seconds = (time.perf_counter() - started) / len(batch)
            for number, query, prediction in zip(batch, queries, predictions, strict=True):
                yield number, query, prediction, seconds


def _do_share(
    items: Items, todo: Sequence[_Todo], stage: _Stage, map_device: str, query_device: str, *retry_s: float
) -> None:
    pair = _Pair(stage, map_device, query_device).open()
    if retry_s:
        pair.add_fallback(items, todo)
    pair.localize_into(items, todo, *retry_s)


def _write_poses(path: Path, rows: Sequence[dict[str, Any]], settings: LocalizeSettings) -> None:
    """Write the table and the poses of a pair; the poses last, because their file marks the pair as finished."""
    columns = [*COLUMNS, *(PREDICTION_COLUMNS if settings.predicts else [])]
    columns += FALLBACK_COLUMNS if settings.features.escalation else []
    table = pd.DataFrame(rows).rename(columns=POSES_UNIT).reindex(columns=columns)
    write_csv(path.with_suffix(".csv"), in_unit_of_poses(table, settings.unit))
    posed = [row for row in rows if np.isfinite(row["world_from_rig"]).all()]
    covariances = np.array([row["covariance"] for row in posed]).reshape(-1, 6, 6)
    Trajectory.from_poses(
        [row["timestamp"] for row in posed],
        [row["device_id"] for row in posed],
        np.array([row["world_from_rig"] for row in posed]).reshape(-1, 4, 4),
        None if np.isnan(covariances).all() else covariances,
    ).write(path)


def explain_query(
    sessions_root: str | Path, retrieval_dir: str | Path, features_dir: str | Path, map_dir: str | Path,
    map_device: str, query_device: str, settings: LocalizeSettings, queries: str = "keyframes_pruned_subsampled",
    index: int = 0,
) -> tuple[FeedForwardLocalizer, Query, FeedForwardAnswer]:  # fmt: skip
    """Run the predictor on one query of a pair again, by its index in the keyframe list, with what `localize_pairs` was
    given. Return the localizer, the query, and the localizer's full output for it, as `draw_prediction` takes it.

    Raises:
        ToolkitError: the method does not use a predictor.
        ArtifactError: the retrieval file is missing.
    """
    if not settings.predicts:
        raise ToolkitError(f"The method {settings.method} does not use a predictor. Use feed_forward or hybrid.")
    settings = resolve_auto(settings.model_copy(update={"method": "feed_forward"}))
    folders = _Folders(*map(Path, (sessions_root, retrieval_dir, retrieval_dir, features_dir, map_dir)))
    stage = _Stage(folders, settings, queries, skip_existing=True, workers=1)
    pair = _Pair(stage, map_device, query_device).open()
    localizer = pair.map.localizer
    assert isinstance(localizer, FeedForwardLocalizer)
    query, references = pair.query(index)
    return localizer, query, localizer.answer(query, references)
