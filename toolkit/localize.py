"""The localize stage: from references and local features to one pose per query device."""

import json
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
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
from toolkit.pose.base import Correspondences, Query, QueryInput, QueryResult, References, status_counts
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


class _Task(NamedTuple):
    """A query to localize: at first with the features of the map, then in rounds with the fallback features. The result
    of each round is an item.
    """

    item: str
    """Name of the item."""
    source: str
    """Fingerprint of what all results are made from."""
    number: int
    """Of the query."""
    asked: Sequence[References] = ()
    """What the fallback features are matched with, see `Map.asked_next`; empty at first."""
    seconds: float = 0.0
    """Spent on it before, together with others."""


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
            results, unfinished = self._localize(record, h5_attributes)
            write_text(self.map_record, json.dumps(self.map.record(), indent=1) + "\n")
            write_sidecar(self.map_record, self._made_from(maps))  # its own: all pairs of the map share it
            images = self.session.own_names(self.rows)
            _write_poses(self.file("txt"), self.keys, images, results, stage.settings)
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

    def _localize(self, record: dict[str, Any], h5_attributes: Mapping[str, str]) -> tuple[list[QueryResult], bool]:
        """Localize the queries that are not localized yet, and write the `.h5` file. Return the result of each query,
        without its correspondences; and whether a query failed with an internal error.
        """
        names, source = [query_group(*key) for key in self.keys], fingerprint(record)
        numbers = {name: number for number, name in enumerate(names)}  # a keyframe list may repeat a query
        first = [_Task(name, source, number) for name, number in numbers.items()]
        with Items(self.file("items"), skip_existing=self.stage.skip_existing) as items:
            items.drop_damaged()
            faulty, asking = self._distribute(items, items.left(first)), first
            while asking := self._asking(items, [task for task in asking if task.number not in faulty]):
                faulty |= self._distribute(items, self.with_fallback(asking))
        # If the run is killed before it writes the new poses, no poses of an earlier run may lie beside this file.
        self.remove_poses()
        results, none = dict[str, QueryResult](), Correspondences()

        def groups() -> Iterator[tuple[str, dict[str, Any]]]:
            for task in first:
                result = faulty.get(task.number) or self._results(items, task)[-1]
                yield task.item, result.arrays()
                results[task.item] = replace(result, correspondences=none)  # they fill memory

        write_groups(self.file("h5"), groups(), h5_attributes)
        return [results[name] for name in names], bool(faulty)

    def _distribute(self, items: Items, todo: Sequence[_Task]) -> dict[int, QueryResult]:
        """Localize queries, with the workers of the cluster if there is one; see `localize_into`."""
        multiple = 1 if any(task.asked for task in todo) else self.map.localizer.batch_size
        arguments = self.stage.of_worker, *self.devices
        todo = items.distribute(_do_share, todo, arguments, self.label, "query", multiple)
        faulty = self.localize_into(items, todo)
        items.flush()
        return faulty

    def _results(self, items: Items, task: _Task) -> list[QueryResult]:
        """Return the stored results of a query, one per round."""
        results, arrays = list[QueryResult](), dict[str, Any]()
        while items.is_current(item := self._item(task, len(results)), task.source):
            arrays = items[item] or arrays  # none are stored where the earlier ones count
            results.append(QueryResult.from_row(items.note(item), arrays))
        return results

    def _item(self, task: _Task, number: int) -> str:
        """Return the name of the item of a round, by its number."""
        return query_group(*self.keys[task.number]) + (f"/{number}" if number else "")

    def _asking(self, items: Items, tasks: Sequence[_Task]) -> list[_Task]:
        """Return the next round of those queries that fallback features may help."""
        others = slice(len(self.map.kinds), None)  # features of the last round, which not all queries have
        del self.stored.stores[others], self.stored.matches[others]
        asking = list[_Task]()
        for task in tasks if self.map.fallback is not None else ():
            results = self._results(items, task)
            if not self.map.is_unsure(results[0]):
                continue  # without its features, which take time to read
            if asked := self.map.asked_next(*self.query(task.number), results):
                asking.append(task._replace(item=self._item(task, len(results)), asked=asked))
        return asking

    def with_fallback(self, todo: Sequence[_Task]) -> list[_Task]:
        """Extract and match the fallback features of queries, and return these with the seconds that it took."""
        started = time.perf_counter()
        self._add_features(self.map.escalation, {task.number: task.asked for task in todo})
        seconds = (time.perf_counter() - started) / len(todo)
        return [task._replace(seconds=seconds) for task in todo]

    def localize_into(self, items: Items, todo: Sequence[_Task]) -> dict[int, QueryResult]:
        """Localize queries and add the results as items; return those that failed with an internal error, by number:
        they get no item, so the next run tries them again.
        """
        faulty = dict[int, QueryResult]()
        results = prefetch(partial(self._localized, items), self._opened(todo), self.stage.workers)
        for task, result, arrays in tqdm(results, total=len(todo), desc=self.label, unit="query", disable=not todo):
            if result.is_internal:
                faulty[task.number] = result
            else:
                items.add(task.item, task.source, arrays, result.to_row(*self.keys[task.number]))
        return faulty

    def _localized(
        self, items: Items, given: tuple[_Task, QueryInput, Any]
    ) -> tuple[_Task, QueryResult, dict[str, Any] | None]:
        """Return the task and the result of a query, and its arrays; None if they are those of the last round."""
        task, (query, references), prediction = given
        earlier, started = self._results(items, task)[-1] if task.asked else None, time.perf_counter()
        try:
            if earlier is not None:
                result = self.map.retry(query, self.map.match(query, task.asked, self.map.fallback), earlier)
            elif query.views:
                result = self.map.solve(query, self.map.match(query, references), prediction)
            else:
                method = self.map.settings.method
                result = QueryResult.failed("no images of this device at this time", found_by=method)
        except Exception as error:  # one bad query never ends a run
            reason = reason_of(error, f"localizing {query.views[0].name}")
            if earlier is None:
                result = self.map.finished(query, QueryResult.failed(reason))
            else:  # what was found before stays
                result = replace(earlier, remark="; ".join(filter(None, [earlier.remark, reason])))
        spent = task.seconds + time.perf_counter() - started + (earlier.seconds if earlier else 0.0)
        same = earlier is not None and result.correspondences is earlier.correspondences
        return task, replace(result, seconds=spent), None if same else result.arrays()

    def _opened(self, todo: Sequence[_Task]) -> Iterator[tuple[_Task, QueryInput, Any]]:
        """Yield queries, at first with the predictions of a network, which runs on batches of queries."""
        size = self.map.localizer.batch_size
        for start in range(0, len(todo), size):
            batch = todo[start : start + size]
            queries, started = [self.query(task.number) for task in batch], time.perf_counter()
            predictions = [None] * len(batch) if batch[0].asked else self.map.predict(queries)
            seconds = (time.perf_counter() - started) / len(batch)
            for task, query, prediction in zip(batch, queries, predictions, strict=True):
                yield task._replace(seconds=task.seconds + seconds), query, prediction


def _do_share(items: Items, todo: Sequence[_Task], stage: _Stage, map_device: str, query_device: str) -> None:
    pair = _Pair(stage, map_device, query_device).open()
    if any(task.asked for task in todo):
        pair.with_fallback(todo)
    pair.localize_into(items, todo)


def _write_poses(
    path: Path, keys: Sequence[tuple[int, str]], images: Sequence[str], results: Sequence[QueryResult],
    settings: LocalizeSettings,
) -> None:  # fmt: skip
    """Write the table and the poses of a pair; the poses last, because their file marks the pair as finished.

    `keys` are timestamp and device id of each query, `images` the names of its images.
    """
    columns = [*COLUMNS, *(PREDICTION_COLUMNS if settings.predicts else [])]
    columns += FALLBACK_COLUMNS if settings.features.escalation else []
    rows = [result.to_row(*key) | {"image": image} for key, image, result in zip(keys, images, results, strict=True)]
    table = pd.DataFrame(rows).rename(columns=POSES_UNIT).reindex(columns=columns)
    write_csv(path.with_suffix(".csv"), in_unit_of_poses(table, settings.unit))
    posed = [number for number, result in enumerate(results) if result.world_from_rig is not None]
    arrays = [results[number].arrays() for number in posed]
    poses, covariances = (
        np.array([of_result[name] for of_result in arrays]).reshape(-1, size, size)
        for name, size in (("world_from_rig", 4), ("covariance", 6))
    )
    times, devices = ([keys[number][part] for number in posed] for part in (0, 1))
    Trajectory.from_poses(times, devices, poses, None if np.isnan(covariances).all() else covariances).write(path)


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
