"""Inspect one query of a finished run: the stored results of the localize stage in words, numbers and pictures.

Nothing here localizes, except `Inspection.again`.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from toolkit.capture import Capture, Trajectory
from toolkit.errors import OF_THE_DATA, ArtifactError
from toolkit.files import SceneFiles, image_name, pair_devices, read_references, require_current
from toolkit.geometry import Floats
from toolkit.localizers.again import LocalizeAgain
from toolkit.localizers.map import RETRIEVAL, SESSIONS_ROOT, Map, how_localized, label
from toolkit.manifest import nearest
from toolkit.show.answers import NUMBERS, Answer, reason_in_words
from toolkit.show.choice import find_query, shown_name
from toolkit.show.figures import shown
from toolkit.show.inspection_view import draw_comparison, draw_inspection
from toolkit.show.localized import LocalizedPair
from toolkit.show.metrics import is_posed, worst_first

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
        return draw_inspection(self)

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
        """Status, method, numbers, errors and seconds; columns before and after; lengths in `pair.unit`."""
        columns = {}
        for name, one in (("before", self.before), ("after", self.after)):
            error = dict(zip(("rotation_error_deg", "translation_error_m"), one.error or (), strict=False))
            columns[name] = {"status": one.status, "method": one.method, **one.numbers, **error, "seconds": one.seconds}
        return pd.DataFrame(columns, dtype=object)

    @cached_property
    def figure(self) -> "Figure":
        """Both answers side by side."""
        return draw_comparison(self.before, self.after, self.changes)

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
        pairs = sorted(Path(poses_dir).glob("*_map_*_query_*.h5"))
        names = [pair_devices(path.stem) for path in pairs]
        if (map_device, query_device) not in names:
            known = [f"{query} in {map_}" for map_, query in names]
            raise ArtifactError(
                f"{poses_dir}: no correspondences of queries of {query_device!r} in the map of {map_device!r}, "
                f"`<pair>.h5`. {nearest(f'{query_device} in {map_device}', known)} Localize first: "
                "python -m toolkit run MANIFEST."
            )
        self.map_device, self.query_device = map_device, query_device
        self._h5 = pairs[names.index((map_device, query_device))]
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

    @property
    def label(self) -> str:
        return f"{self.query_device} in the map of {self.map_device}"

    @cached_property
    def true(self) -> Floats:
        """True world_from_rig (Q, 4, 4); NaN where unknown."""
        truth, table = self.localized.query_session.ground_truth, self.localized.table
        if truth is None:
            return np.full((len(self), 4, 4), np.nan)
        return truth.lookup(table["timestamp"].to_numpy(), table["device_id"])

    def _true(self, number: int) -> Floats | None:
        return self.true[number] if is_posed(self.true[number]) else None

    @cached_property
    def table(self) -> pd.DataFrame:
        """The pair's csv with `rotation_error_deg` and `translation_error_m`, see `Localizations.ranked`."""
        return self.localized.localizations.ranked

    def worst_first(self) -> list[int]:
        """Return the numbers of the queries from worst to best, see `metrics.worst_first`."""
        return self.localized.localizations.worst_first().tolist()

    def number_of(self, query: int | str) -> int:
        """Return the number of a query.

        Args:
            query: its number, the name of one of its images (or a unique end of the name), or `worst`.

        Raises:
            ArtifactError: no query matches, or several do; names the nearest.
        """
        if query == WORST and len(self):
            return self.worst_first()[0]
        names = self.localized.query_session.image_names
        images = {names[row]: number for number, rows in enumerate(self.localized.rows) for row in rows}
        return find_query(query, images, len(self))

    def look(self, query: int | str = 0) -> Inspection:
        """Return a query with the stored results of the localize stage.

        Args:
            query: see `number_of`.

        Raises:
            ArtifactError: the query does not exist, or its stored results are damaged.
        """
        number = self.number_of(query)
        row = self.localized.table.iloc[number]
        pose = self.localized.world_from_rig[number]
        numbers = self._numbers({name: row[name] for name in NUMBERS if name in row})
        status, stated = str(row["status"]), str(row["reason"]) if pd.notna(row.get("reason")) else ""
        method = str(row["method"])
        return Inspection(
            self.localized, number, status, method, reason_in_words(status, stated, numbers, self.settings, method),
            numbers, self.localized.localized(number), pose if is_posed(pose) else None, self._covariance(number),
            self.settings, float(row.get("seconds", np.nan)), self._true(number), self._retrieved(number), of=self,
        )  # fmt: skip

    def localize(self, number: int, changes: Mapping[str, Any]) -> Inspection:
        """Localize a query again; see `Inspection.again`."""
        settings = self._again.settings(changes)
        estimate, localized, seconds = self._again.localize(self.localized.rows[number], settings)
        method = label(settings, "" if estimate.world_from_rig is None else estimate.found_by)
        numbers = self._numbers({name: getattr(estimate, name) for name in NUMBERS})
        return Inspection(
            self.localized, number, estimate.status, method,
            reason_in_words(estimate.status, estimate.reason, numbers, settings, method), numbers, localized,
            estimate.world_from_rig, _if_finite(estimate.covariance), settings, seconds, self._true(number),
            self._retrieved(number), of=self,
        )  # fmt: skip

    @cached_property
    def _again(self) -> LocalizeAgain:
        """Cached: opening the map takes time."""
        require_current(self._h5.with_suffix(".txt"), "localize", missing=False)
        map_ = Map.of_pair(self._h5, self.map_device, self._features_dir, self._map_dir)
        return LocalizeAgain(map_, self.localized.query_session, self.retrieval)

    @cached_property
    def _covariances(self) -> dict[tuple[int, str], Floats]:
        poses = Trajectory.read(self._h5.with_suffix(".txt"))
        keys = zip(poses.timestamps.tolist(), map(str, poses.device_ids), strict=True)
        return {} if poses.covariances is None else dict(zip(keys, poses.covariances, strict=True))

    def _covariance(self, number: int) -> Floats | None:
        row = self.localized.table.iloc[number]
        return _if_finite(self._covariances.get((int(row["timestamp"]), str(row["device_id"]))))

    def _numbers(self, values: Mapping[str, Any]) -> dict[str, float]:
        """Return the known values of `NUMBERS`, lengths converted to the unit that they are shown in."""
        lengths = {"position_std_m": self.localized.unit[1]}
        return {name: float(value) / lengths.get(name, 1.0) for name, value in values.items() if np.isfinite(value)}

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
                name = image_name(hit["path"])
                ranked = rank, float(hit.get("score", np.nan))
                best[name] = min(best.get(name, ranked), ranked, key=lambda one: (one[0], -one[1]))
        return dict(sorted(best.items(), key=lambda item: item[1][0]))


def _if_finite(covariance: Floats | None) -> Floats | None:
    return covariance if covariance is not None and np.isfinite(covariance).all() else None


class WorstQueries:
    """The queries of several pairs, the worst first, to inspect one at a time."""

    def __init__(self, pairs: Sequence[InspectedPair]) -> None:
        self._pairs = list(pairs)
        tables = [pair.table.assign(pair=k, number=range(len(pair))) for k, pair in enumerate(self._pairs)]
        empty = pd.DataFrame({"status": [], "pair": [], "number": []})
        table = pd.concat(tables, ignore_index=True) if tables else empty
        self.table = table.iloc[worst_first(table)].reset_index(drop=True) if len(table) else table
        """One row per query: the columns of `InspectedPair.table`, pair and number."""
        queries = zip(self.table["pair"], self.table["number"], strict=True)
        self.names = [f"{self._pairs[k].label}: {shown_name(self._pairs[k].names[number])}" for k, number in queries]

    @classmethod
    def of(
        cls,
        poses_dir: str | Path,
        map_dir: str | Path | None = None,
        sessions_root: str | Path | None = None,
        map_device: str = "all",
        query_device: str = "all",
    ) -> "WorstQueries":
        """Return the queries of all pairs in a folder of poses that have stored correspondences and can be read.

        Args:
            poses_dir, map_dir, sessions_root: as for `InspectedPair`.
            map_device, query_device: devices of the pairs, or `all`.
        """
        pairs = []
        for path in sorted(Path(poses_dir).glob("*_map_*_query_*.h5")):
            mapped, queried = pair_devices(path.stem)
            if map_device in ("all", mapped) and query_device in ("all", queried):
                with suppress(*OF_THE_DATA):  # an unfinished pair has no table, or a session broke after a good run
                    pairs.append(InspectedPair(mapped, queried, poses_dir, None, map_dir, sessions_root))
        return cls(pairs)

    def look(self, rank: int | str = 0) -> Inspection:
        """Return a query by its rank, 0 for the worst of all.

        Raises:
            ArtifactError: the rank is out of range.
        """
        if not isinstance(rank, int | np.integer) or not 0 <= rank < len(self.names):
            raise ArtifactError(f"query: found {rank!r}, expected a rank from 0, the worst, to {len(self.names) - 1}.")
        row = self.table.iloc[int(rank)]
        return self._pairs[int(row["pair"])].look(int(row["number"]))


def inspect_query(
    run: str | Path,
    scene: str,
    map: str,  # noqa: A002
    query: str,
    n: int | str = 0,
) -> Inspection:
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
