"""The README's accuracy on real photographs, from the public photographs by the user's commands: with intervals.

    python -m benchmarks paper Benchmarking_Camera_Calibration_2008 [--features sift] [--out FILE.md]

The photographs are those of openMVG's SfM_quality_evaluation. Each capture is imported, run from nothing and counted
over all of its pairs; intervals are Wilson's, 95 %. Data sets that are absent keep a row with the command and blanks.
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.common import add_out, check_out, markdown_table, write_out
from toolkit.figures.evaluation import wilson_interval
from toolkit.results.metrics import is_below, recall
from toolkit.synthetic.photographs import THRESHOLDS

CAPTURES = {
    "STRECHA": ["strecha"],
    "STRECHA_HARD": ["strecha-hard"],
    "CASTLE_HARD": ["strecha-hard", "--scene", "castle-P30"],
}
ABSENT = {
    "7-Scenes": "import dataset 7scenes 7-scenes/redkitchen KITCHEN",
    "Cambridge Landmarks": "import dataset cambridge ShopFacade SHOP",
    "Aachen Day-Night": "import dataset aachen Aachen-Day-Night AACHEN",
    "LaMAR": "run lamar-cab",
    "CroCoDL": "run crocodl-hydro",
}
"""Data sets that the toolkit reads, and that were not there to be measured: the command of each."""


def visloc(folder: Path, *arguments: str) -> None:
    """Run a command of the toolkit in a folder; its output is shown.

    Raises:
        CalledProcessError: it failed.
    """
    subprocess.run([sys.executable, "-m", "toolkit", *arguments], cwd=folder, check=True)


def measured(folder: Path, name: str, photographs: Path, features: str) -> dict[str, Any]:
    """Import and run one capture from nothing; return its numbers."""
    kind, *options = CAPTURES[name]
    if not (folder / name).exists():
        visloc(folder, "import", "dataset", kind, str(photographs.resolve()), name, *options)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    visloc(folder, "run", name, "--name", f"{name}-{features}", "--force", "--set", f"localize.features={features}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = folder / "runs" / f"{name}-{features}"
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    errors = pd.read_csv(run / name / "evaluation" / "errors.csv")
    rotation, position = errors["rotation_error_deg"].to_numpy(), errors["translation_error_m"].to_numpy()
    ok = (errors["status"] == "ok").to_numpy()
    return {
        "capture": name,
        "queries": len(errors),
        "recall": recall(rotation, position, THRESHOLDS).tolist(),
        "ok": int(ok.sum()),
        "ok_wrong": int((ok & ~is_below(rotation, position, THRESHOLDS[-1])).sum()),
        "median_deg": float(np.median(rotation)),
        "median_cm": float(100 * np.median(position)),
        "seconds": record["total_seconds"],
        "cpu_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "peak_memory_mb": record["peak_memory_mb"],
        "run": {key: record[key] for key in ("created", "machine", "versions", "commit")},
    }


def row(numbers: dict[str, Any]) -> list[str]:
    """Return a row of the table."""
    recalls = []
    for share in numbers["recall"]:
        low, high = wilson_interval(share, numbers["queries"])
        recalls.append(f"{100 * share:.1f} ({100 * low:.1f} to {100 * high:.1f})")
    return [
        numbers["capture"],
        str(numbers["queries"]),
        *recalls,
        f"{numbers['ok']}, {numbers['ok_wrong']} wrong",
        f"{numbers['median_deg']:.3f} deg, {numbers['median_cm']:.2f} cm",
        f"{numbers['seconds']:.0f} s, {numbers['cpu_seconds']:.0f} CPU s",
        f"{numbers['peak_memory_mb'] / 1000:.1f} GB",
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path, help="folder of the scenes, Benchmarking_Camera_Calibration_2008")
    parser.add_argument("--folder", type=Path, default=Path("build/paper"), help="of captures and runs")
    parser.add_argument("--captures", nargs="+", choices=CAPTURES, default=list(CAPTURES), help="default: all")
    parser.add_argument("--features", default="auto", help="localize.features of the runs (default: auto)")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    options.folder.mkdir(parents=True, exist_ok=True)
    all_numbers = [measured(options.folder, name, options.photographs, options.features) for name in options.captures]
    recalls = [f"recall at ({degrees:g} deg, {meters:g} m), %" for degrees, meters in THRESHOLDS]
    header = ["capture", "queries", *recalls, "ok", "median error", "time with pictures", "peak memory"]
    blank = [[f"{name}: `visloc {command}`", *[""] * (len(header) - 1)] for name, command in ABSENT.items()]
    run = all_numbers[-1]["run"]
    on = "{cpu}, {cores} cores, GPU: {gpu}".format(**run["machine"])
    text = f"{markdown_table(header, [*map(row, all_numbers), *blank])}\n\n{on}; commit {run['commit']}\n"
    print(text)
    write_out(options.out, text, {"captures": all_numbers})
    return 0


if __name__ == "__main__":
    sys.exit(main())
