"""A run in the hand: what a manifest made."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from toolkit.capture.tables import read_query_table
from toolkit.errors import ArtifactError
from toolkit.files import SceneFiles, of_sequence, pair_devices, read_json
from toolkit.manifest import nearest
from toolkit.runs.record import RECORD
from toolkit.scene.map import Map


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
            known = [record.parent.name for record in path.parent.glob(f"*/{RECORD}")]
            raise ArtifactError(f"{path}: no such run. {nearest(path.name, known)}")
        return cls(path)

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
        """Names of the captures that were localized."""
        return sorted(folder.parent.name for folder in self.path.glob("*/poses"))

    def map(self, device: str, scene: str | None = None) -> Map:
        """Open the map of a device, see `Map.open`.

        Args:
            device: `ios`, `hl`, `spot`.
            scene: name of the capture; None: the only one of the run.
        """
        if scene is None and len(self.scenes) != 1:
            found = ", ".join(self.scenes) or "none"
            raise ArtifactError(f"{self.path}: found the scenes {found}. Expected `scene`, the name of one of them.")
        return Map.open(self.path, scene or self.scenes[0], device)

    @cached_property
    def queries(self) -> pd.DataFrame:
        """One row per query and map: scene, map_device, query_device, and the columns of `poses/<pair>.csv`.

        Raises:
            ArtifactError: a table is damaged.
        """
        tables = [pd.DataFrame({"scene": [], "map_device": [], "query_device": [], "status": []})]
        for scene in self.scenes:
            for path in sorted(SceneFiles(self.path, scene).poses_dir.glob("*.csv")):
                if not of_sequence(path.stem):
                    devices = dict(zip(("map_device", "query_device"), pair_devices(path.stem), strict=True))
                    table = read_query_table(path, ["status"])
                    tables.append(table.assign(scene=scene, **devices))
        table = pd.concat(tables, ignore_index=True)
        return table[[*tables[0].columns[:3], *table.columns.difference(tables[0].columns[:3], sort=False)]]
