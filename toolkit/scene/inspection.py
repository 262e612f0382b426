"""Inspect one query of a finished run: the stored results of the localize stage in words, numbers and figures.

Nothing here localizes, except `what_if` of the results.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from toolkit.capture import Capture
from toolkit.errors import COMMAND, OF_THE_DATA, ArtifactError, ToolkitError
from toolkit.figures.answers import Answer
from toolkit.figures.query_images import shown_name
from toolkit.files import SceneFiles, image_name, pair_devices, read_references, require_current
from toolkit.manifest import nearest
from toolkit.pose.base import Query, References
from toolkit.pose.result import QueryResult
from toolkit.results.localized import LocalizedPair
from toolkit.results.metrics import is_posed, worst_first
from toolkit.results.opening import RETRIEVAL, SESSIONS_ROOT, how_localized
from toolkit.results.pair import find_query
from toolkit.runs.kernel import TEXT_BARS
from toolkit.scene.located import Located, best_ranks
from toolkit.scene.map import WITHOUT_FEATURES, Map
from toolkit.scene.stored import StoredQueries

WORST = "worst"
"""Alias for the number of the worst query."""


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
        pairs = {pair_devices(path.stem): path for path in sorted(Path(poses_dir).glob("*_map_*_query_*.h5"))}
        if (map_device, query_device) not in pairs:
            known = [f"{query} in {map_}" for map_, query in pairs]
            raise ArtifactError(
                f"{poses_dir}: no correspondences of queries of {query_device!r} in the map of {map_device!r}, "
                f"`<pair>.h5`. {nearest(f'{query_device} in {map_device}', known)} Localize first: "
                f"{COMMAND} run MANIFEST."
            )
        self.map_device, self.label = map_device, f"{query_device} in the map of {map_device}"
        self._h5 = pairs[map_device, query_device]
        files = self._files = SceneFiles(self._h5.parents[2], self._h5.parents[1].name)
        self._features_dir, self._map_dir = Path(features_dir or files.features), Path(map_dir or files.maps)
        self.settings, paths, _ = how_localized(self._h5)
        self.retrieval = Path(paths[RETRIEVAL]) / f"{self._h5.stem}.jsonl"
        capture = Capture.from_sessions_root(sessions_root or paths[SESSIONS_ROOT])
        self.localized = LocalizedPair.open(capture, map_device, query_device, poses_dir, self._map_dir)
        self.names = self.localized.localizations.names
        """Name of the first image of each query."""

    def __len__(self) -> int:
        return len(self.names)

    def look(self, query: int | str = 0) -> Answer:
        """Return a query with the stored results of the localize stage, by its number, the name of one of its images
        (or a unique end of the name), or `worst`. Raise ArtifactError if no query matches, or several do (the nearest
        is named), or its stored results are damaged.
        """
        if query == WORST and len(self):
            query = int(worst_first(self.localized.localizations.errors)[0])
        names = self.localized.query_session.image_names
        images = {names[row]: number for number, rows in enumerate(self.localized.rows) for row in rows}
        number = find_query(query, images, len(self))
        context = Located(partial(self._answer, number), partial(self._open, number))
        return self._answer(number, replace(self.localized.results[number], context=context))

    def _answer(self, number: int, result: QueryResult) -> Answer:
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
        self.localized.results.require_current()
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
    def _topk(self) -> dict[tuple[int, str], list[dict[str, Any]]]:
        with suppress(ArtifactError):  # poses can be inspected without the retrieval that they were made from
            require_current(self._h5.with_suffix(".txt"), "localize", (".jsonl",))
            rows = read_references(self.retrieval)
            return {(int(row["timestamp"]), str(row["sensor_id"])): row["topk"] for row in rows}
        return {}

    def _retrieved(self, number: int) -> dict[str, tuple[int, float]]:
        images = self.localized.query_session.images.iloc[self.localized.rows[number]]
        keys = zip(images["timestamp"].tolist(), images["sensor_id"].astype(str).tolist(), strict=True)
        return best_ranks(
            [(image_name(hit["path"]), float(hit.get("score", np.nan))) for hit in self._topk.get(key, [])]
            for key in keys
        )


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
        pairs: list[InspectedPair] = []
        for path in sorted(Path(poses_dir).glob("*_map_*_query_*.h5")):
            mapped, queried = pair_devices(path.stem)
            if map_device in ("all", mapped) and query_device in ("all", queried):
                with suppress(*OF_THE_DATA):  # an unfinished pair has no table, or a session broke after a good run
                    pairs.append(InspectedPair(mapped, queried, poses_dir, None, map_dir, sessions_root))
        queries = [(pair, number) for pair in pairs for number in range(len(pair))]
        tables = [pair.localized.localizations.errors for pair in pairs]
        order = worst_first(pd.concat(tables, ignore_index=True)).tolist() if queries else []
        self._queries = [queries[k] for k in order]
        self.names = [f"{pair.label}: {shown_name(pair.names[number])}" for pair, number in self._queries]

    def table(self, most: int = 12) -> pd.DataFrame:
        """Return the worst: devices, status, inliers, errors (NaN without a pose or a true one), names of images."""
        errors = ["rotation_error_deg", "translation_error_m"]
        columns = ["map_device", "query_device", "status", "num_inliers", *errors, "image"]
        rows = []
        for pair, number in self._queries[:most]:
            devices = dict(zip(columns, pair_devices(pair._h5.stem), strict=False))
            rows.append({**pair.localized.localizations.errors.iloc[number].to_dict(), **devices})
        return pd.DataFrame(rows).reindex(columns=columns).replace(np.inf, np.nan)

    def look(self, rank: int | str = 0) -> Answer:
        """Return a query by its rank, 0 for the worst of all, or by the name of one of its images.

        `worst` is the worst one with matches, as those without, such as a torn file, have little to show. A query that
        was localized in several maps is returned where it is worst. Raise ArtifactError if there is none.
        """
        if rank == WORST:
            tables = (pair.localized.results.table for pair, _ in self._queries)
            matched = (table.get("num_matches", table["timestamp"]).iloc[number]
                       for table, (_, number) in zip(tables, self._queries, strict=True))  # fmt: skip
            rank = next((at for at, count in enumerate(matched) if count > 0), 0)
        pair, number = self._queries[find_query(rank, self._worst_of_image, len(self._queries))]
        return pair.look(number)

    @cached_property
    def _worst_of_image(self) -> dict[str, int]:
        """Rank of the worst localization of each image, by its name."""
        worst = dict[str, int]()
        for rank, (pair, number) in enumerate(self._queries):
            session = pair.localized.query_session
            for row in pair.localized.rows[number].tolist():
                worst.setdefault(session.image_name(row), rank)
        return worst


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
    `chosen` is the number or name of the first query, which must exist, unless it is a number and there are no queries.
    """
    from IPython.display import display

    if not len(queries.names) and isinstance(chosen, int):
        print("There are no queries to show.")
        return Choice(None)
    try:
        choice = Choice(queries.look(chosen))
    except ArtifactError as error:
        if not str(error).startswith("query: "):
            raise
        raise ArtifactError(f"inspect: {str(error).removeprefix('query: ')}") from None
    if TEXT_BARS in os.environ:
        display(choice.shown)
        return choice
    import ipywidgets

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
