"""Runs of one manifest with other values of some settings: their names, and what they take over from each other."""

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
"""A sweep of more runs is a mistake, or wants a script of its own."""


@dataclass(frozen=True)
class SweptRun:
    """One run of a sweep."""

    name: str
    """`<manifest>-<key>-<value>`: its folder."""
    overrides: tuple[str, ...]
    """`key=value`, as `--set` has them."""


def swept_runs(name: str, sweeps: Sequence[str]) -> list[SweptRun]:
    """Return the runs of a sweep: one a value or, of several keys, one a combination.

    Args:
        name: of the manifest.
        sweeps: `key=a,b,c` each, the values in YAML: `embed.model=vlad,[megaloc, vlad]` has two.

    Raises:
        ManifestError: a sweep is not of this form, names a key twice, or is of too many runs.
    """
    keys, values = [], []
    for sweep in sweeps:
        key, equals, text = sweep.partition("=")
        try:
            found = yaml.safe_load(f"[{text}]") if equals and key.strip() else None
        except yaml.YAMLError:
            found = None
        if not found:
            raise ManifestError(
                f"--sweep {sweep}: expected key=value,value,..., for example localize.pnp.min_inliers=10,20,40."
            )
        texts = [yaml.safe_dump(value, default_flow_style=True, width=10**6).split("\n")[0] for value in found]
        keys.append(key.strip())
        values.append(list(dict.fromkeys(texts)))
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ManifestError(f"--sweep {twice[0]}: found it twice, expected one list of values a key.")
    combinations = list(product(*values))
    if len(combinations) > MOST_RUNS:
        raise ManifestError(f"--sweep: found {len(combinations)} runs, expected {MOST_RUNS} at most. Take fewer values.")
    short = [key.rpartition(".")[2] for key in keys]
    labels = short if len(set(short)) == len(short) else keys
    runs = []
    for chosen in combinations:
        parts = [f"{label}-{_plain(value)}" for label, value in zip(labels, chosen, strict=True)]
        overrides = tuple(f"{key}={value}" for key, value in zip(keys, chosen, strict=True))
        runs.append(SweptRun("-".join([name, *parts]), overrides))
    if len({run.name for run in runs}) < len(runs):
        raise ManifestError(f"--sweep {' '.join(sweeps)}: two values would have one folder. Sweep them one by one.")
    return runs


def _plain(value: str) -> str:
    """Return a value as a part of a folder's name."""
    return re.sub(r"[^\w.+-]+", "-", value).strip("-") or "none"


def take_over(donor: Path, run_dir: Path, scenes: Iterable[str], keys: Sequence[str]) -> None:
    """Give a run that is not there yet what another run has made before the stages that the swept keys belong to.

    Features and maps are taken over always. A stage reuses of all this what fits its own settings, and makes the rest
    again, so that too much does no harm. Files are hard links where they are replaced as a whole, and copies where
    they are written to (HDF5) or links cannot be made.

    Args:
        donor: run folder to take from.
        run_dir: the run folder to fill; one with results is left as it is.
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
        names = {"features", "maps", "index"} | {name for stage, name in of_stage.items() if STAGES.index(stage) < first}
        for name in sorted(names):
            source: Path = getattr(theirs, name)
            if source.is_dir():
                shutil.copytree(source, getattr(mine, name), copy_function=_link, ignore=shutil.ignore_patterns(".*"))


def _link(source: str, target: str) -> None:
    if not source.endswith(".h5"):
        try:
            os.link(source, target)
            return
        except OSError:  # another disk, or one without links
            pass
    shutil.copy2(source, target)
