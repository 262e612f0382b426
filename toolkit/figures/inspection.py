"""Inspect one query of a finished run: the stored results of the localize stage in words, numbers and figures.

Nothing here localizes, except `Inspection.again`.
"""

import json
import os
import textwrap
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from toolkit.capture import Capture
from toolkit.errors import OF_THE_DATA, ArtifactError, ToolkitError
from toolkit.figures.answers import Answer, draw_answers
from toolkit.figures.query_images import shown_name
from toolkit.figures.style import shown
from toolkit.files import SceneFiles, image_name, pair_devices, read_references, require_current
from toolkit.manifest import LocalizeSettings, nearest
from toolkit.pose.result import QueryResult
from toolkit.results.localized import LocalizedPair
from toolkit.results.metrics import worst_first
from toolkit.results.pair import find_query
from toolkit.runs.kernel import TEXT_BARS
from toolkit.scene.map import WITHOUT_FEATURES, Map
from toolkit.scene.opening import RETRIEVAL, SESSIONS_ROOT, how_localized
from toolkit.scene.stored import StoredQueries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORST = "worst"
"""Alias for the number of the worst query."""


@dataclass(frozen=True, repr=False)
class Inspection(Answer):
    """One query of a pair, as it was localized. A notebook displays its figure."""

    of: "InspectedPair" = field(kw_only=True)
    """The pair that it belongs to."""

    def again(self, changes: Mapping[str, Any] | None = None) -> "Comparison":
        """Localize the query again, from the stored features and references, with some settings changed.

        Args:
            changes: settings that differ from those of the run, such as `{"pnp": {"min_inliers": 30}}`.

        Returns:
            This answer and the new one. Nothing is written.

        Raises:
            ManifestError: a setting does not exist, or the features or the map depend on it.
            ToolkitError: features, the map or weights of the run are missing.
        """
        return Comparison(self, self.of.localize(self.number, changes or {}), dict(changes or {}))

    @cached_property
    def figure(self) -> "Figure":
        title = f"{self.headline}\n{shown_name(self.name, 110)}\n{textwrap.fill(self.reason, 130)}"
        return draw_answers([self], title)

    def _repr_mimebundle_(self, **_: Any) -> dict[str, bytes]:
        return shown(self.figure)


@dataclass(frozen=True)
class Comparison:
    """One query localized twice. A notebook displays its figure."""

    before: Inspection
    after: Inspection
    changes: dict[str, Any]
    """Settings that were changed."""

    @cached_property
    def table(self) -> pd.DataFrame:
        """Status, method, numbers, errors and seconds as texts; columns before and after."""
        both = {"before": self.before, "after": self.after}
        texts = {name: {"status": one.result.status_text, **one.texts} for name, one in both.items()}
        return pd.DataFrame(texts, dtype=object)

    @cached_property
    def figure(self) -> "Figure":
        """Both answers side by side."""
        changed = json.dumps(self.changes)[1:-1] if self.changes else "no setting changed"
        first = self.before.headline.rpartition(":")[0]
        return draw_answers([self.before, self.after], f"{first}, localized again\n{textwrap.fill(changed, 120)}")

    def __repr__(self) -> str:
        return f"{self.changes or 'nothing changed'}\nbefore: {self.before!r}\nafter: {self.after!r}"

    def _repr_mimebundle_(self, **_: Any) -> dict[str, bytes]:
        return shown(self.figure)


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
        """
        Args:
            map_device, query_device: the pair.
            poses_dir, features_dir, map_dir: folders of the localize stage; None: the folders of the run that
                `poses_dir` belongs to.
            sessions_root: `<capture>/sessions`; None: its path when the pair was localized.

        Raises:
            ArtifactError: the pair does not exist, or its files are missing or torn.
        """
        pairs = {pair_devices(path.stem): path for path in sorted(Path(poses_dir).glob("*_map_*_query_*.h5"))}
        if (map_device, query_device) not in pairs:
            known = [f"{query} in {map_}" for map_, query in pairs]
            raise ArtifactError(
                f"{poses_dir}: no correspondences of queries of {query_device!r} in the map of {map_device!r}, "
                f"`<pair>.h5`. {nearest(f'{query_device} in {map_device}', known)} Localize first: "
                "python -m toolkit run MANIFEST."
            )
        self.map_device, self.label = map_device, f"{query_device} in the map of {map_device}"
        self._h5 = pairs[map_device, query_device]
        files = SceneFiles(self._h5.parents[2], self._h5.parents[1].name)
        self._features_dir, self._map_dir = Path(features_dir or files.features), Path(map_dir or files.maps)
        self.settings, paths, _ = how_localized(self._h5)
        self.retrieval = Path(paths[RETRIEVAL]) / f"{self._h5.stem}.jsonl"
        capture = Capture.from_sessions_root(sessions_root or paths[SESSIONS_ROOT])
        self.localized = LocalizedPair.open(capture, map_device, query_device, poses_dir, self._map_dir)
        self.names = self.localized.localizations.names
        """Name of the first image of each query."""

    def __len__(self) -> int:
        return len(self.names)

    def look(self, query: int | str = 0) -> Inspection:
        """Return a query with the stored results of the localize stage.

        Args:
            query: its number, the name of one of its images (or a unique end of the name), or `worst`.

        Raises:
            ArtifactError: no query matches, or several do (the nearest is named), or its stored results are damaged.
        """
        if query == WORST and len(self):
            query = int(worst_first(self.localized.localizations.errors)[0])
        names = self.localized.query_session.image_names
        images = {names[row]: number for number, rows in enumerate(self.localized.rows) for row in rows}
        number = find_query(query, images, len(self))
        return self._inspection(number, self.localized.results[number], self.settings)

    def localize(self, number: int, changes: Mapping[str, Any]) -> Inspection:
        """Localize a query again; see `Inspection.again`."""
        scene_map = self._changed(json.dumps(changes))
        query, references = self._stored.query(scene_map, self.localized.rows[number])
        return self._inspection(number, scene_map.locate(query, references=references), scene_map.settings)

    def _inspection(self, number: int, result: QueryResult, settings: LocalizeSettings) -> Inspection:
        return Inspection(self.localized, number, result, settings, self._retrieved(number), of=self)

    @cached_property
    def _map(self) -> Map:
        """Cached: opening the map takes time."""
        self.localized.results.require_current()
        return Map.of_pair(self._h5, self.map_device, self._features_dir, self._map_dir)

    @cached_property
    def _stored(self) -> StoredQueries:
        stored = StoredQueries(self.localized.query_session, self.retrieval)
        if self._map.settings.method not in WITHOUT_FEATURES:
            stored.open_features(self._map)
        return stored

    @lru_cache(maxsize=8)  # noqa: B019 - lives as long as the pair
    def _changed(self, changes: str) -> Map:
        return self._map.changed(json.loads(changes))

    @cached_property
    def _topk(self) -> dict[tuple[int, str], list[dict[str, Any]]]:
        with suppress(ArtifactError):  # poses can be inspected without the retrieval that they were made from
            require_current(self._h5.with_suffix(".txt"), "localize", (".jsonl",))
            rows = read_references(self.retrieval)
            return {(int(row["timestamp"]), str(row["sensor_id"])): row["topk"] for row in rows}
        return {}

    def _retrieved(self, number: int) -> dict[str, tuple[int, float]]:
        images = self.localized.query_session.images.iloc[self.localized.rows[number]]
        best: dict[str, tuple[int, float]] = {}
        for key in zip(images["timestamp"].tolist(), images["sensor_id"].astype(str).tolist(), strict=True):
            for rank, hit in enumerate(self._topk.get(key, []), start=1):
                name, ranked = image_name(hit["path"]), (rank, float(hit.get("score", np.nan)))
                best[name] = min(best.get(name, ranked), ranked, key=lambda one: (one[0], -one[1]))
        return dict(sorted(best.items(), key=lambda item: item[1][0]))


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
        """Take the queries of all pairs in a folder of poses that have stored correspondences and can be read.

        Args:
            poses_dir, map_dir, sessions_root: as for `InspectedPair`.
            map_device, query_device: devices of the pairs, or `all`.
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

    def look(self, rank: int | str = 0) -> Inspection:
        """Return a query by its rank, 0 for the worst of all.

        Raises:
            ArtifactError: the rank is out of range.
        """
        if not isinstance(rank, int | np.integer) or not 0 <= rank < len(self.names):
            raise ArtifactError(f"query: found {rank!r}, expected a rank from 0, the worst, to {len(self.names) - 1}.")
        pair, number = self._queries[int(rank)]
        return pair.look(number)


def inspect_query(run: str | Path, scene: str, map: str, query: str, n: int | str = 0) -> Inspection:  # noqa: A002
    """Return one query of a finished run with the stored results of the localize stage.

    Args:
        run: the run folder, `<output_root>/<manifest name>`.
        scene: the capture's name.
        map, query: devices of the pair, such as `ios` and `hl`.
        n: number of the query, name of one of its images (or a unique end of it), or `worst`.

    Raises:
        ArtifactError: the run, pair or query does not exist (the nearest is named), or files are missing or torn.
    """
    files = SceneFiles(Path(run), scene)
    if not files.poses_dir.is_dir():
        runs = [path.parent.parent.name for path in Path(run).glob("*/poses/settings.json")]
        raise ArtifactError(
            f"{files.poses_dir}: no poses of the scene {scene!r} in the run {run}. {nearest(scene, runs)} "
            "Localize first: python -m toolkit run MANIFEST."
        )
    return InspectedPair(map, query, files.poses_dir, files.features, files.maps).look(n)


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
    """Show a query, and a list to choose another in its place; return the choice.

    The figure is ordinary output, which a saved notebook keeps. There is no list when the pipeline runs the notebook.

    Args:
        queries: `RetrievedPair`, `InspectedPair` or `WorstQueries`: has `names`, and `look`, which takes a number.
        chosen: number or name of the first query; ignored if it is a number and there are no queries.

    Raises:
        ArtifactError: the query does not exist.
    """
    from IPython.display import display

    if not len(queries.names) and isinstance(chosen, int):
        print("There are no queries to show.")
        return Choice(None)
    choice = Choice(queries.look(chosen))
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
