"""Runs of a manifest with other values of some settings: their names, and the results that they share."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from toolkit.errors import ManifestError
from toolkit.files import SceneFiles, fingerprint, link_folder
from toolkit.manifest import STAGES, Manifest

MOST_RUNS = 100
"""Limit of runs in a sweep: more are most likely a mistake."""
_NO_RESULT = {"name", "output_root", "tolerate_failed", "description"}
"""Keys of a manifest that change no result."""
_LONGEST = 100
"""Longest name of a run folder, letters; a longer one ends in a fingerprint."""


@dataclass(frozen=True)
class Shared:
    """What a new run takes over from another one."""

    run: str
    """Name of the other run's folder."""
    differing: list[str]
    """Keys whose values differ; results that they change are not taken."""


def changed_keys(plain: Manifest, changed: Manifest, overrides: Iterable[str]) -> dict[str, str]:
    """Return, by key, the values of overrides that change a result.

    Args:
        plain, changed: the manifest without and with all overrides.
        overrides: `key=value` each.
    """
    before, after = (manifest.model_dump(mode="json") for manifest in (plain, changed))
    keys = {}
    for override in overrides:
        key, _, value = override.partition("=")
        if key.partition(".")[0] not in _NO_RESULT and _value(before, key) != _value(after, key):
            keys[key.strip()] = value
    return keys


_ABSENT = object()


def _value(content: Any, key: str) -> Any:
    """Return the value of a key `stage.key` in nested dicts, `_ABSENT` without one."""
    for part in key.strip().split("."):
        content = content.get(part, _ABSENT) if isinstance(content, dict) else _ABSENT
    return content


def variant_name(name: str, keys: Mapping[str, str]) -> str:
    """Return the name of a run that differs from the run `name` in these keys and values: `<name>-<key>-<value>`."""
    short = [key.rpartition(".")[2] for key in keys]
    labels = short if len(set(short)) == len(short) else list(keys)
    parts = [f"{label}-{_plain(value)}" for label, value in zip(labels, keys.values(), strict=True)]
    whole = "-".join([name, *parts])
    return whole if len(whole) <= _LONGEST else f"{whole[: _LONGEST - 9]}-{fingerprint(whole)[:8]}"


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
    runs = []
    for chosen in combinations:
        values_of = dict(zip(keys, chosen, strict=True))
        overrides = tuple(f"{key}={value}" for key, value in values_of.items())
        runs.append(SweptRun(variant_name(name, values_of), overrides))
    if len({run.name for run in runs}) < len(runs):
        raise ManifestError(f"--sweep {' '.join(sweeps)}: two runs have the same folder name. Sweep one key at a time.")
    return runs


def _plain(value: str) -> str:
    """Return a value in a form that fits a folder's name."""
    return re.sub(r"[^\w.+-]+", "-", value).strip("-") or "none"


def take_over(donor: Path, run_dir: Path, scenes: Iterable[str], keys: Sequence[str]) -> None:
    """Fill a new run folder with the results of another run that do not depend on the differing keys.

    These are features, maps, and the results of all stages before the first stage with a differing key. Too much does
    no harm: each stage reuses only what fits its settings. Files become hard links, since the toolkit never changes a
    file but replaces it as a whole; or copies, if the disk does not support links.

    Args:
        donor: run folder to take from.
        run_dir: run folder to fill. Scenes that already have a folder there are skipped.
        scenes: names of the captures.
        keys: the differing keys, `stage.key`.
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
                link_folder(source, getattr(mine, name))
