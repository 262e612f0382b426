"""Sweeps: run a manifest with several values of some settings; name the runs and share results between them."""

import os
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import yaml

from toolkit.errors import ManifestError
from toolkit.files import SceneFiles
from toolkit.manifest import STAGES

MOST_RUNS = 100
"""Limit of runs in a sweep: more are most likely a mistake."""


@dataclass(frozen=True)
class SweptRun:
    """One run of a sweep."""

    name: str
    """`<manifest>-<key>-<value>`, the name of the run folder."""
    overrides: tuple[str, ...]
    """`key=value` each, in the form of `--set`."""


def swept_runs(name: str, sweeps: Sequence[str]) -> list[SweptRun]:
    """Return the runs of a sweep: one per value or, for several keys, one per combination of values.

    Args:
        name: name of the manifest.
        sweeps: `key=a,b,c` each. Values are YAML: `embed.model=vlad,[megaloc, vlad]` has two values.

    Raises:
        ManifestError: a sweep has another form, repeats a key, changes the captures, or has too many runs.
    """
    keys, values = [], []
    for sweep in sweeps:
        key, equals, text = sweep.partition("=")
        try:
            parsed = yaml.safe_load(f"[{text}]") if equals and key.strip() else None
        except yaml.YAMLError:
            parsed = None
        if not parsed:
            raise ManifestError(
                f"--sweep {sweep}: expected key=value,value,..., for example localize.pnp.min_inliers=10,20,40."
            )
        texts = [yaml.safe_dump(value, default_flow_style=True, width=10**6).split("\n")[0] for value in parsed]
        keys.append(key.strip())
        values.append(list(dict.fromkeys(texts)))
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ManifestError(f"--sweep {twice[0]}: found it twice, expected one list of values per key.")
    if other := [key for key in keys if key.partition(".")[0] in ("captures", "demo_data")]:
        raise ManifestError(
            f"--sweep {other[0]}: all runs of a sweep have the same captures, so that they can be compared. Run the "
            f"manifest once per value instead: --set {other[0]}=... --set name=..."
        )
    combinations = list(product(*values))
    if len(combinations) > MOST_RUNS:
        raise ManifestError(f"--sweep: found {len(combinations)} runs, expected at most {MOST_RUNS}. Use fewer values.")
    short = [key.rpartition(".")[2] for key in keys]
    labels = short if len(set(short)) == len(short) else keys
    runs = []
    for chosen in combinations:
        parts = [f"{label}-{_plain(value)}" for label, value in zip(labels, chosen, strict=True)]
        overrides = tuple(f"{key}={value}" for key, value in zip(keys, chosen, strict=True))
        runs.append(SweptRun("-".join([name, *parts]), overrides))
    if len({run.name for run in runs}) < len(runs):
        raise ManifestError(f"--sweep {' '.join(sweeps)}: two runs have the same folder name. Sweep one key at a time.")
    return runs


def _plain(value: str) -> str:
    """Return a value in a form that fits a folder's name."""
    return re.sub(r"[^\w.+-]+", "-", value).strip("-") or "none"


def take_over(donor: Path, run_dir: Path, scenes: Iterable[str], keys: Sequence[str]) -> None:
    """Fill a new run folder with the results of another run that do not depend on the swept keys.

    These are features, maps, and the results of all stages before the first stage with a swept key. Too much does no
    harm: each stage reuses only what fits its settings. HDF5 files are copied, because stages write to them; all other
    files are replaced as a whole, so they become hard links, or copies if the disk does not support links.

    Args:
        donor: run folder to take from.
        run_dir: run folder to fill. Scenes that already have a folder there are skipped.
        scenes: names of the captures.
        keys: the swept keys, `stage.key`.
    """
    stages = [key.partition(".")[0] for key in keys]
    first = min((STAGES.index(stage) for stage in stages if stage in STAGES), default=0)
    for scene in scenes:
        theirs, mine = SceneFiles(donor, scene), SceneFiles(run_dir, scene)
        if mine.root.exists():
            continue
        of_stage = {"embed": "embeddings", "retrieve": "retrieval_dir", "rerank": "reranked_dir"}
        of_stage |= {"localize": "poses_dir", "sequence": "poses_dir"}
        earlier = {name for stage, name in of_stage.items() if STAGES.index(stage) < first}
        for name in sorted({"features", "maps", "index"} | earlier):
            source: Path = getattr(theirs, name)
            if source.is_dir():
                shutil.copytree(source, getattr(mine, name), copy_function=_link, ignore=shutil.ignore_patterns(".*"))


def _link(source: str, target: str) -> None:
    if not source.endswith(".h5"):
        try:
            os.link(source, target)
            return
        except OSError:  # another disk, or one without hard links
            pass
    shutil.copy2(source, target)
