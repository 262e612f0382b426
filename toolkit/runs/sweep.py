"""Runs of a manifest with other values of some settings: their names, and the results that they share."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import product, takewhile
from pathlib import Path
from typing import Any

import yaml

from toolkit.errors import ManifestError
from toolkit.files import SceneFiles, fingerprint, link_folder, read_json
from toolkit.manifest import Manifest
from toolkit.runs.folder import RECORD

MOST_RUNS = 100
"""Limit of runs in a sweep: more are most likely a mistake."""
_NO_RESULT = {"name", "output_root", "tolerate_failed", "description"}
"""Keys of a manifest that change no result."""
_LONGEST = 100
"""Longest name of a run folder, letters; a longer one ends in a fingerprint."""
TAKEN = ("embed", "retrieve", "rerank", "localize", "sequence")
"""Stages whose results a run takes over, in order."""


def changed_keys(plain: Manifest, changed: Manifest, overrides: Iterable[str]) -> dict[str, str]:
    """Return, by key, the values of the overrides, `key=value` each, that make a difference between two manifests."""
    before, after = (manifest.model_dump(mode="json") for manifest in (plain, changed))
    keys = {}
    for override in overrides:
        key, _, value = override.partition("=")
        if key.partition(".")[0] not in _NO_RESULT and _value(before, key) != _value(after, key):
            keys[key.strip()] = value
    return keys


def _value(content: Any, key: str) -> Any:
    """Return the value of a key `stage.key` in nested dicts, None without one."""
    for part in key.strip().split("."):
        content = content.get(part) if isinstance(content, dict) else None
    return content


def variant_name(name: str, keys: Mapping[str, str]) -> str:
    """Return the name of a run that differs from the run `name` in these keys and values: `<name>-<key>-<value>`."""
    short = [key.rpartition(".")[2] for key in keys]
    labels = short if len(set(short)) == len(short) else list(keys)
    values = (re.sub(r"[^\w.+-]+", "-", value).strip("-") or "none" for value in keys.values())
    whole = "-".join([name, *(f"{label}-{value}" for label, value in zip(labels, values, strict=True))])
    return whole if len(whole) <= _LONGEST else f"{whole[: _LONGEST - 9]}-{fingerprint(whole)[:8]}"


def swept_runs(name: str, sweeps: Sequence[str]) -> dict[str, list[str]]:
    """Return the runs of a sweep: one per value or, for several keys, one per combination of values.

    Args:
        name: name of the manifest.
        sweeps: `key=a,b,c` each. Values are YAML: `embed.model=vlad,[megaloc, vlad]` has two values.

    Returns:
        The overrides of each run, `key=value` each as for `--set`, by its name, `<manifest>-<key>-<value>`.
    """
    values: dict[str, list[str]] = {}
    for sweep in sweeps:
        key, equals, text = sweep.partition("=")
        key = key.strip()
        try:
            parsed = yaml.safe_load(f"[{text}]") if equals and key else None
        except yaml.YAMLError:
            parsed = None
        if not parsed:
            example = "localize.pnp.min_inliers=10,20,40"
            raise ManifestError.at(f"--sweep {sweep}", expected=f"key=value,value,..., for example {example}")
        if key in values:
            raise ManifestError.at(f"--sweep {key}", "it twice", "one list of values per key")
        if key.partition(".")[0] in ("captures", "demo_data"):
            do = f"The runs could not be compared: run the manifest once per value, --set {key}=... --set name=..."
            raise ManifestError.at(f"--sweep {key}", expected="the same captures for all runs", do=do)
        texts = [yaml.safe_dump(value, default_flow_style=True, width=10**6).split("\n")[0] for value in parsed]
        values[key] = list(dict.fromkeys(texts))
    combinations = [dict(zip(values, chosen, strict=True)) for chosen in product(*values.values())]
    if len(combinations) > MOST_RUNS:
        raise ManifestError.at("--sweep", f"{len(combinations)} runs", f"at most {MOST_RUNS}", "Use fewer values.")
    runs = {variant_name(name, keys): [f"{key}={value}" for key, value in keys.items()] for keys in combinations}
    if len(runs) < len(combinations):
        found = "two runs with the same folder name"
        raise ManifestError.at(f"--sweep {' '.join(sweeps)}", found, do="Sweep one key at a time.")
    return runs


def take_over(donors: Sequence[Path], own: Manifest) -> None:
    """Fill a new run folder with the results of the donor, a run folder, that shares most with it.

    These are features, maps, and the results of all stages before the first stage with other settings. Too much does no
    harm: each stage reuses only what fits its settings. Files become hard links, since the toolkit never changes a file
    but replaces it as a whole; or copies, if the disk does not support links. Scenes that have a folder are skipped.
    """
    shared = {donor: _shared_stages(donor, own) for donor in donors if donor.is_dir()}
    donor = max(shared, key=lambda donor: shared[donor], default=None)
    for scene in (Path(capture).name for capture in own.captures):
        mine = SceneFiles(Path(own.output_root) / own.name, scene)
        if donor is None or mine.root.exists():
            continue
        theirs = SceneFiles(donor, scene)
        for source in {*theirs.caches, *(theirs.of_stage(stage) for stage in TAKEN[: shared[donor]])}:
            if source is not None and source.is_dir():
                link_folder(source, mine.root / source.name)


def _shared_stages(donor: Path, own: Manifest) -> int:
    """Return how many stages of `TAKEN`, from the first on, have the same settings in the record of a run."""
    try:
        theirs = Manifest.of(read_json(donor / RECORD).get("manifest"))
    except ManifestError:  # without a record, or of an older version
        return 0
    if any(getattr(theirs, key) != getattr(own, key) for key in ("queries", "devices", "pairs", "extra_devices")):
        return 0
    before, after = ([one.stage(stage) if stage in one.stages else None for stage in TAKEN] for one in (theirs, own))
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(before, after, strict=True)))
