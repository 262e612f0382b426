"""A run in the hand: what a manifest made; and the stored results of one of its queries in words, numbers and figures.

Nothing here localizes, except `what_if` of the results.
"""

import logging
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from toolkit.capture import Capture, Session
from toolkit.capture.names import in_order
from toolkit.errors import COMMAND, OF_THE_DATA, ArtifactError, ToolkitError
from toolkit.features.stores import FeatureStore, MatchStore, features_path
from toolkit.files import (
    SceneFiles,
    image_name,
    read_json,
    read_references,
    relative_url,
    require_current,
    sources_of,
    why_older,
)
from toolkit.geometry import Ints
from toolkit.manifest import nearest
from toolkit.pose.base import NetworkMatches, Query, QueryInput, QueryResult, References, Status
from toolkit.results.localized import LocalizedPair
from toolkit.results.metrics import is_posed, worst_first
from toolkit.results.pair import (
    RETRIEVAL,
    SESSIONS_ROOT,
    PairResults,
    find_query,
    how_localized,
    localized_scenes,
    no_such_run,
    opened_by,
    pairs_of,
)
from toolkit.runs.folder import RECORD
from toolkit.runs.kernel import TEXT_BARS
from toolkit.scene.map import WITHOUT_FEATURES, Located, Map
from toolkit.scene.query import best_ranks

if TYPE_CHECKING:
    from toolkit.figures.answers import Answer

log = logging.getLogger(__name__)

WORST = "worst"
"""Alias for the number of the worst query."""


class StoredQueries:
    """The queries of a session with what a run stored of them."""

    def __init__(self, session: Session, retrieval: str | Path) -> None:
        """Take the query session, and read the references of its images from `retrieval/<pair>.jsonl`."""
        self.session = session
        self.references = {
            (int(row["timestamp"]), str(row["sensor_id"])): [
                (image_name(hit["path"]), float(hit.get("score", np.nan))) for hit in row["topk"]
            ]
            for row in read_references(retrieval)
        }
        """Names and scores of the references of each query image, by timestamp and sensor id."""
        self.stores: list[FeatureStore] = []
        """Features of the session, one store per kind."""
        self.matches: list[MatchStore | None] = []
        """Per kind, the stored network matches, or None."""

    def open_features(self, scene_map: Map) -> None:
        """Open the features of the queries that a map's run has stored; raise ArtifactError if they are missing."""
        if scene_map.features_dir is None:
            return
        folder, session = scene_map.features_dir, self.session.id
        paths = [features_path(folder, session, kind.extractor.settings) for kind in scene_map.kinds]
        if missing := [path for path in paths if not path.exists()]:
            do = f"To change its method: {COMMAND} run MANIFEST --set localize.method=hybrid"
            fault = "no features of the queries. A run with the method `feed_forward` extracts none"
            raise ArtifactError(f"{missing[0]}: {fault}. {do}")
        self.stores = [FeatureStore.open(path) for path in paths]

    def query(self, scene_map: Map, rows: Ints) -> QueryInput:
        """Return the query in rows of `session.images`, which one device took at one instant, and the references of
        each of its images in the map; an image without an entry has none.
        """
        query = scene_map.query_of_session(self.session, rows)
        names = [view.name for view in query.views]
        stores = [] if scene_map.settings.method in WITHOUT_FEATURES else self.stores
        query = replace(
            query,
            features=[_features(stores, name) for name in names] if stores else [],
            network_matches=[_network_matches(self.matches, name) for name in names] if any(self.matches) else [],
        )
        return query, self.references_of(scene_map, rows)

    def references_of(self, scene_map: Map, rows: Ints) -> list[References]:
        """Return the references in the map of the images in rows of `session.images`; none of one without an entry."""
        images, index_of, references = self.session.images.iloc[rows], scene_map.index_of, []
        for key in zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True):
            found = [(index_of[name], score) for name, score in self.references.get(key, []) if name in index_of]
            references.append(References.of([index for index, _ in found], [score for _, score in found]))
        return references


def _features(stores: Sequence[FeatureStore], name: str) -> Any:
    missing = [store for store in stores if name not in store]
    if missing:
        return next((store.failed[name] for store in missing if name in store.failed), "no features")
    return [store[name] for store in stores]


def _network_matches(matches: Sequence[MatchStore | None], name: str) -> list[NetworkMatches | None]:
    def of(store: MatchStore) -> NetworkMatches:
        return lambda reference: store[name, reference]

    return [None if store is None else of(store) for store in matches]


# The queries of finished pairs


class InspectedPair:
    """The queries of one pair of a finished run, to inspect one at a time."""

    def __init__(
        self,
        map_device: str,
        query_device: str,
        poses_dir: str | Path,
        features_dir: str | Path | None = None,
        map_dir: str | Path | None = None,
        sessions_root: str | Path | None = None,
    ) -> None:
        """Open a pair; folders are those of the run of `poses_dir`, and the capture's is as when the pair was
        localized, unless given. Raise ArtifactError if the pair does not exist, or its files are missing or torn.
        """
        pairs = pairs_of(poses_dir, ".h5")
        if (map_device, query_device) not in pairs:
            known = [f"{query} in {mapped}" for mapped, query in pairs]
            fault = f"no correspondences of queries of {query_device!r} in the map of {map_device!r}, `<pair>.h5`"
            do = f"{nearest(f'{query_device} in {map_device}', known)} Localize first: {COMMAND} run MANIFEST."
            raise ArtifactError(f"{poses_dir}: {fault}. {do}")
        self.map_device, self.label = map_device, f"{query_device} in the map of {map_device}"
        self._h5 = pairs[map_device, query_device]
        files = self._files = SceneFiles(self._h5.parents[2], self._h5.parents[1].name)
        self._features_dir, self._map_dir = Path(features_dir or files.features), Path(map_dir or files.maps)
        self.settings, paths, _ = how_localized(self._h5)
        stored = (path for path in sources_of(self._h5.with_suffix(".txt")) if path.suffix == ".jsonl")
        self.retrieval = next(stored, Path(paths[RETRIEVAL]) / f"{self._h5.stem}.jsonl")
        capture = Capture.from_sessions_root(sessions_root or paths[SESSIONS_ROOT])
        self.localized = LocalizedPair.open(capture, map_device, query_device, poses_dir, self._map_dir)
        self.names = self.localized.localizations.names
        """Name of the first image of each query."""

    def __len__(self) -> int:
        return len(self.names)

    def look(self, query: int | str = 0) -> "Answer":
        """Return a query with the stored results of the localize stage, by its number, the name of one of its images
        (or a unique end of the name), or `worst`. Raise ArtifactError if no query matches, or several do (the nearest
        is named), or its stored results are damaged.
        """
        if query == WORST and len(self):
            query = int(worst_first(self.localized.localizations.errors)[0])
        names = self.localized.query_session.image_names
        images = {names[row]: number for number, rows in enumerate(self.localized.rows) for row in rows}
        number = find_query(query, images, len(self))
        if older := why_older(self.localized.results.path, "localize", missing=False):
            log.warning("%s", older)
        context = Located(partial(self._answer, number), partial(self._open, number))
        return self._answer(number, replace(self.localized.results[number], context=context))

    def _answer(self, number: int, result: QueryResult) -> "Answer":
        from toolkit.figures.answers import Answer

        pair, true = self.localized, self.localized.true_poses[number]
        return Answer(
            *(result, self.settings, *pair.views(number), pair.map_session, pair.local_map, pair.results.unit),
            true if is_posed(true) else None,
            f"query {number} of {pair.query_session.device}",
            number,
            self._retrieved(number),
        )

    def _open(self, number: int) -> tuple[Map, Query, Sequence[References]]:
        return (self._map, *self._stored.query(self._map, self.localized.rows[number]))

    @cached_property
    def _map(self) -> Map:
        """Cached: opening the map takes time."""
        require_current(self.localized.results.path, "localize", missing=False)
        scene_map = Map.of_pair(self._h5, self.map_device, self._features_dir, self._map_dir)
        if not self._files.embeddings.is_dir():
            return scene_map
        # Other references are then retrieved as in the run.
        reranked = self.retrieval.parent.name == self._files.reranked_dir.name
        return replace(scene_map, files=self._files, reranked=reranked)

    @cached_property
    def _stored(self) -> StoredQueries:
        stored = StoredQueries(self.localized.query_session, self.retrieval)
        if self._map.settings.method not in WITHOUT_FEATURES:
            stored.open_features(self._map)
        return stored

    @cached_property
    def _references(self) -> dict[tuple[int, str], list[tuple[str, float]]]:
        with suppress(ArtifactError):  # poses can be inspected without the retrieval that they were made from
            require_current(self._h5.with_suffix(".txt"), "localize", (".jsonl",))
            return StoredQueries(self.localized.query_session, self.retrieval).references
        return {}

    def _retrieved(self, number: int) -> dict[str, tuple[int, float]]:
        images = self.localized.query_session.images.iloc[self.localized.rows[number]]
        keys = zip(images["timestamp"].tolist(), images["sensor_id"].astype(str).tolist(), strict=True)
        return best_ranks(self._references.get(key, []) for key in keys)


class WorstQueries:
    """The queries of several pairs, the worst first, to inspect one at a time."""

    def __init__(
        self,
        poses_dir: str | Path,
        map_dir: str | Path | None = None,
        sessions_root: str | Path | None = None,
        map_device: str = "all",
        query_device: str = "all",
    ) -> None:
        """Take the queries of all pairs, or those of a device, in a folder of poses that have stored correspondences
        and can be read. The folders are as for `InspectedPair`.
        """
        pairs, errors = list[InspectedPair](), list[ToolkitError]()
        for mapped, queried in pairs_of(poses_dir, ".h5"):
            if map_device in ("all", mapped) and query_device in ("all", queried):
                try:
                    pairs.append(InspectedPair(mapped, queried, poses_dir, None, map_dir, sessions_root))
                except OF_THE_DATA as error:  # an unfinished pair has no table, or a session broke after a good run
                    errors.append(error)
        none = ArtifactError.at(poses_dir, "no localized query", do="Run the stage localize first.")
        self.why_none = next(iter(errors), none)
        """The error if there are no queries: the first of a pair, if there are pairs."""
        queries = [(pair, number) for pair in pairs for number in range(len(pair))]
        tables = [pair.localized.localizations.errors for pair in pairs]
        self._queries = [queries[k] for k in worst_first(pd.concat(tables, ignore_index=True))] if queries else []
        from toolkit.figures.query_images import shown_name

        self.names = [f"{pair.label}: {shown_name(pair.names[number])}" for pair, number in self._queries]

    def table(self, most: int = 12) -> pd.DataFrame:
        """Return the worst: devices, status, inliers, errors (NaN without a pose or a true one), names of images."""
        errors = ["rotation_error_deg", "translation_error_m"]
        columns = ["map_device", "query_device", "status", "num_inliers", *errors, "image"]
        rows = []
        for pair, number in self._queries[:most]:
            row = pair.localized.localizations.errors.iloc[number].to_dict()
            rows.append(row | dict(zip(columns, (*pair.localized.results.devices, row["status_text"]), strict=False)))
        return pd.DataFrame(rows).reindex(columns=columns).replace(np.inf, np.nan)

    def look(self, rank: int | str = 0) -> "Answer":
        """Return a query by its rank, 0 for the worst of all, or by the name of one of its images.

        `worst` is the worst one with matches, as those without, such as a torn file, have little to show. A query that
        was localized in several maps is returned where it is worst. Raise ArtifactError if there is none, or the error
        of the first pair if none can be read.
        """
        if not self._queries:
            raise self.why_none
        if rank == WORST:
            rows = (pair.localized.results.table.iloc[number] for pair, number in self._queries)
            rank = next((at for at, row in enumerate(rows) if row.get("num_matches", 1) > 0), 0)
        pair, number = self._queries[find_query(rank, self._worst_of_image, len(self._queries))]
        return pair.look(number)

    @cached_property
    def _worst_of_image(self) -> dict[str, int]:
        """Rank of the worst localization of each image, by its name."""
        ranked = reversed([(rank, pair.localized, number) for rank, (pair, number) in enumerate(self._queries)])
        return {pair.query_session.image_name(row): rank for rank, pair, number in ranked for row in pair.rows[number]}


# One of many queries in a notebook


@dataclass
class Choice:
    """The query that `choose` shows now; None without queries."""

    shown: Any

    def attempt(self, ask: Callable[[Any], Any]) -> None:
        """Display `ask` of the shown query, or print its error, so that a notebook does not fail."""
        from IPython.display import display

        if self.shown is not None:
            try:
                display(ask(self.shown))
            except ToolkitError as error:
                print(error)


def choose(queries: Any, chosen: int | str = 0) -> Choice:
    """Show a query of `RetrievedPair`, `InspectedPair` or `WorstQueries`, and a list to choose another in its place.

    The figure is ordinary output, which a saved notebook keeps. There is no list when the pipeline runs the notebook.
    `chosen` is the number or name of the first query, which must exist, unless there are no queries and it is no name.
    """
    from IPython.display import display

    if not len(queries.names) and (isinstance(chosen, int) or chosen == WORST):
        print(getattr(queries, "why_none", "There are no queries to show."))
        return Choice(None)
    try:
        choice = Choice(queries.look(chosen))
    except ArtifactError as error:
        raise ArtifactError(f"inspect: {str(error).removeprefix('query: ')}") from None
    if TEXT_BARS in os.environ:
        display(choice.shown)
        return choice
    import ipywidgets

    from toolkit.figures.query_images import shown_name

    at = chosen if isinstance(chosen, int) else choice.shown.number
    options = [(f"{k}: {shown_name(name)}", k) for k, name in enumerate(queries.names)]
    layout = ipywidgets.Layout(width="95%")
    dropdown = ipywidgets.Dropdown(options=options, value=at, description="query", layout=layout)
    display(dropdown)
    handle = display(choice.shown, display_id=True)

    def show(change: dict[str, Any]) -> None:
        try:
            choice.shown = queries.look(change["new"])
        except ToolkitError as error:
            handle.update({"text/plain": str(error)}, raw=True)
        else:
            handle.update(choice.shown)

    dropdown.observe(show, "value")
    return choice


# A run


@dataclass(frozen=True)
class Page:
    """A page of a run, which a notebook shows as a link."""

    path: Path

    @classmethod
    def of(cls, path: Path) -> "Page":
        if not path.is_file():
            raise ArtifactError.at(path, "no such page", do=f"Finish the run: {COMMAND} run MANIFEST.")
        if older := why_older(path, "report"):
            found = older.partition(":")[0]
            raise ArtifactError.at(path, found, do=f"Write it again: {COMMAND} report {path.parent}.")
        for shown in sources_of(path):
            if older := why_older(shown, "evaluate", missing=False):
                do = f"Run the manifest again: {COMMAND} run MANIFEST."
                raise ArtifactError.at(path, f"its {older.partition(':')[0]}", do=do)
        return cls(path)

    def _repr_html_(self) -> str:
        return f"<a href='{relative_url(self.path.resolve())}' target='_blank'>{escape(str(self.path))}</a>"


@dataclass(frozen=True)
class Run:
    """A run folder: its settings, maps and queries. Nothing in it is changed."""

    path: Path

    @classmethod
    def open(cls, path: str | Path) -> "Run":
        """Open a run folder, `<output_root>/<manifest name>`.

        Raises:
            ArtifactError: there is no run; the message lists runs beside it.
        """
        path = Path(path)
        if not (path / RECORD).is_file():
            raise no_such_run(path)
        return cls(path)

    def _repr_html_(self) -> str:
        of_status = self.queries.groupby(["scene", "map_device", "query_device", "status"])
        counts = of_status.size().unstack(fill_value=0).reindex(columns=list(Status), fill_value=0)
        told = counts.to_html() if len(counts) else "<p>No queries: a map alone.</p>"
        return f"<p><b>{escape(self.path.name)}</b>: {escape(str(self.path))}</p>{told}"

    @cached_property
    def record(self) -> dict[str, Any]:
        """The content of `run.json`: manifest, versions, inputs, counts, seconds of each stage."""
        return dict(read_json(self.path / RECORD))

    @property
    def settings(self) -> dict[str, Any]:
        """The manifest, with all settings of its stages."""
        return dict(self.record["manifest"])

    @cached_property
    def scenes(self) -> list[str]:
        """Names of the captures that were localized, or whose maps were built."""
        return localized_scenes(self.path)

    def map(self, device: str | None = None, scene: str | None = None) -> Map:
        """Open the map of a device, see `Map.open`.

        Args:
            device: `ios`, `hl`, `spot`; None: the first that has a map.
            scene: name of the capture; None: the only one of the run.
        """
        devices = in_order(opened_by(SceneFiles(self.path, self._scene(scene))))
        return Map.open(self.path, self._scene(scene), device or (devices[0] if devices else "none"))

    def _scene(self, scene: str | None) -> str:
        if scene is None and len(self.scenes) != 1:
            found = ", ".join(self.scenes) or "none"
            raise ArtifactError(f"{self.path}: found the scenes {found}. Expected `scene`, the name of one of them.")
        return scene or self.scenes[0]

    @cached_property
    def queries(self) -> pd.DataFrame:
        """One row per query and map: scene, map_device, query_device, and the columns of `PairResults.table`.

        Raises:
            ArtifactError: a table is damaged.
        """
        keys, tables = ["scene", "map_device", "query_device"], dict[tuple[str, ...], pd.DataFrame]()
        for scene in self.scenes:
            for devices, path in pairs_of(SceneFiles(self.path, scene).poses_dir).items():
                tables[scene, *devices] = PairResults.open(path).table
        if not tables:
            return pd.DataFrame(columns=[*keys, "status", "status_text"])
        return pd.concat(tables, names=keys).reset_index(keys).reset_index(drop=True)

    def result(self, name: str = "worst", map_device: str | None = None, scene: str | None = None) -> QueryResult:
        """Return how a query was localized, with its stored matches.

        Args:
            name: of one of its images, see `__getitem__`; or `worst`, the worst query with matches.
            map_device: device of the map; None: of the maps that the query was localized in, the one where it is worst.
            scene: name of the capture; None: the only one of the run.

        Raises:
            ArtifactError: no query has this name, or several do; or its stored results are damaged.
            ToolkitError: no pair of the run can be read: why the first one cannot.
        """
        poses = SceneFiles(self.path, self._scene(scene)).poses_dir
        return WorstQueries(poses, map_device=map_device or "all").look(name).result

    def best_query(self, map_device: str, scene: str | None = None) -> Query:
        """Return the query that was localized in a map: an `ok` one if there is any, with the most inliers. If the run
        is a map alone, return images of the map that one device took at one instant.

        Raises:
            ArtifactError: no query was localized in the map.
        """
        queries = self.queries
        if not len(queries):
            scene_map = self.map(map_device, scene)
            session = scene_map.session
            middle = session.images[["timestamp"]].assign(device_id=session.device_ids).iloc[[len(session) // 2]]
            return scene_map.query_of_session(session, session.rows_of_keyframes(middle)[0])
        of_map = queries[(queries["map_device"] == map_device) & (queries["scene"] == self._scene(scene))]
        of_map = of_map.assign(sure=of_map["status"] == Status.OK)[of_map["status"] != Status.FAILED]
        if not len(of_map):
            raise ArtifactError(f"{self.path}: no query was localized in the map of {map_device!r}.")
        best = of_map.sort_values(["sure", "num_inliers"], ascending=False, kind="stable")  # networks have no inliers
        return self[str(best["image"].iloc[0]).partition(";")[0]]

    def report(self) -> "Page":
        """Return a link to the report, as a notebook shows it.

        Raises:
            ArtifactError: the run has no report, or results have changed since it was written.
        """
        return Page.of(self.path / "report.html")

    def compare(self, *others: "Run | str | Path") -> Any:
        """Compare this run with others on their common queries, see `report.comparison.compare_runs`."""
        from toolkit.report.comparison import compare_runs

        return compare_runs([self.path, *(other.path if isinstance(other, Run) else other for other in others)])

    def __getitem__(self, name: str) -> Query:
        """Return a query of the run: the images of one device at one instant, of which one has this name.

        Args:
            name: `<session>/raw_data/<path>`, or an end of it that no other query image has, such as `0008.jpg`.

        Raises:
            ArtifactError: no query image has this name, or several do; names the nearest.
        """
        queries, images = list[tuple[str, str, Session, Ints]](), dict[str, int]()
        for scene in self.scenes:
            pairs = pairs_of(SceneFiles(self.path, scene).poses_dir)
            of_device = {device: (map_device, path) for (map_device, device), path in pairs.items()}  # any map
            for device, (map_device, path) in of_device.items():
                attributes = how_localized(path.with_suffix(".h5"))[1]
                session = Capture.from_sessions_root(attributes[SESSIONS_ROOT])[f"{device}_query"]
                for rows in session.rows_of_keyframes(session.keyframes("all")):
                    images |= dict.fromkeys((session.image_name(int(row)) for row in rows), len(queries))
                    queries.append((scene, map_device, session, rows))
        scene, map_device, session, rows = queries[find_query(name, images, len(queries))]
        return self.map(map_device, scene).query_of_session(session, rows)
