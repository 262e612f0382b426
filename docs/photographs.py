"""A run of photographs for the documentation's pictures, by the commands that a user types.

The pictures of a street are made from the folder `data/lund/images` of https://github.com/mapillary/OpenSfM, see
docs/images/LICENSE.txt.
"""

import subprocess
import sys
from pathlib import Path

from toolkit.results.localized import LocalizedPair
from toolkit.scene import Run

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "build" / "photographs"
NAME = "street"
HOLD_OUT = 8
"""Every 8th photograph is not in the map, but a query."""


def run_of(photographs: str | Path) -> Path:
    """Return the run folder of a map of the photographs in a folder, which is made if it is missing."""
    run = WORK / "runs" / NAME
    if not (run / "report.html").is_file():
        WORK.mkdir(parents=True, exist_ok=True)
        source = str(Path(photographs).resolve())
        command = ["reconstruct", source, NAME, "--hold-out", str(HOLD_OUT)]
        subprocess.run([sys.executable, "-m", "toolkit", *command], cwd=WORK, check=True)
    return run


def pair_of(run: Path) -> LocalizedPair:
    """Return the localized queries of such a run."""
    scene_map, files = Run.open(run).map("ios"), run / NAME
    return LocalizedPair.open(scene_map.capture, "ios", "ios", files / "poses", files / "map")
