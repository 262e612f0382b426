"""A run in the hand: what a manifest made."""

from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from toolkit.capture import Capture, Session
from toolkit.capture.devices import in_order
from toolkit.errors import COMMAND, ArtifactError
from toolkit.files import SceneFiles, pair_devices, read_json, relative_url, why_older
from toolkit.geometry import Ints
from toolkit.pose.base import Query
from toolkit.pose.result import QueryResult, Status, statuses
from toolkit.results.opening import SESSIONS_ROOT, how_localized, localized_scenes, no_such_run, opened_by
from toolkit.results.pair import PairResults, find_query, pairs_of
from toolkit.runs.folder import RECORD
from toolkit.scene.map import Map


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
        queries, keys = self.queries, ["scene", "map_device", "query_device"]
        of_status = queries.assign(status=statuses(queries["status"])).groupby([*keys, "status"])
        counts = of_status.size().unstack(fill_value=0)
        return f"<p><b>{escape(self.path.name)}</b>: {escape(str(self.path))}</p>{counts.to_html()}"

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
        """One row per query and map: scene, map_device, query_device, and the columns of `poses/<pair>.csv`.

        Raises:
            ArtifactError: a table is damaged.
        """
        keys, tables = ["scene", "map_device", "query_device"], dict[tuple[str, ...], pd.DataFrame]()
        for scene in self.scenes:
            for path in pairs_of(SceneFiles(self.path, scene).poses_dir):
                results = PairResults.open(path)
                tables[scene, *results.devices] = results.table
        if not tables:
            return pd.DataFrame(columns=[*keys, "status"])
        return pd.concat(tables, names=keys).reset_index(keys).reset_index(drop=True)

    def result(self, name: str = "worst", map_device: str | None = None, scene: str | None = None) -> QueryResult:
        """Return how a query was localized, with its stored matches.

        Args:
            name: of one of its images, see `__getitem__`; or `worst`, the worst query with matches.
            map_device: device of the map; None: of the maps that the query was localized in, the one where it is worst.
            scene: name of the capture; None: the only one of the run.

        Raises:
            ArtifactError: no query has this name, or several do; or its stored results are damaged.
        """
        from toolkit.scene.inspection import WorstQueries

        poses = SceneFiles(self.path, self._scene(scene)).poses_dir
        return WorstQueries(poses, map_device=map_device or "all").look(name).result

    def best_query(self, map_device: str, scene: str | None = None) -> Query:
        """Return the query that was localized in a map: an `ok` one if there is any, with the most inliers.

        Raises:
            ArtifactError: no query was localized in the map.
        """
        queries = self.queries
        of_map = queries[(queries["map_device"] == map_device) & (queries["scene"] == self._scene(scene))]
        status = statuses(of_map["status"])
        of_map = of_map.assign(sure=status == str(Status.OK))[status != str(Status.FAILED)]
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
            of_device = {pair_devices(path.stem)[1]: path for path in pairs}  # any pair with these queries
            for device, path in of_device.items():
                attributes = how_localized(path.with_suffix(".h5"))[1]
                session = Capture.from_sessions_root(attributes[SESSIONS_ROOT])[f"{device}_query"]
                map_device = pair_devices(path.stem)[0]
                for rows in session.rows_of_keyframes(session.keyframes("all")):
                    images |= dict.fromkeys((session.image_name(int(row)) for row in rows), len(queries))
                    queries.append((scene, map_device, session, rows))
        scene, map_device, session, rows = queries[find_query(name, images, len(queries))]
        return self.map(map_device, scene).query_of_session(session, rows)
