"""Write a manifest for a user's capture: the repository's template, filled in with the findings of `check`."""

import json
import os
import re
from collections.abc import Sequence
from itertools import dropwhile
from pathlib import Path

from toolkit.capture import Capture
from toolkit.capture.check import ASKED, check_capture
from toolkit.errors import COMMAND, ManifestError
from toolkit.files import shipped, write_text

TEMPLATE = shipped("data_manifests") / "my-capture.yaml"
MAX_PROBLEMS = 10


def new_manifest(
    name: str, capture: str | Path | None = None, folder: str | Path = "data_manifests",
    thresholds: Sequence[tuple[float, float]] = (),
) -> Path:  # fmt: skip
    """Write `<folder>/<name>.yaml` and return its path. Without a capture, it keeps the template's placeholder; without
    `thresholds`, degrees and meters, those of the template.

    Raises:
        ManifestError: an invalid name, the file exists already, or there is no template.
        CaptureError: the folder is not a capture. Problems inside a capture are listed in its manifest instead.
    """
    path = Path(folder) / f"{name}.yaml"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):  # the rule for `name` in a manifest
        raise ManifestError(f"{name!r}: not a run name. Expected letters, digits, '-', '_', '.', such as my-place.")
    if path.exists():
        raise ManifestError(f"{path} exists already. Give another name, or remove it first.")
    if not TEMPLATE.is_file():
        raise ManifestError(f"{TEMPLATE}: no such file. Install the toolkit again.")
    head = [f"# {name}. `{COMMAND} settings` lists all other settings."]
    template = TEMPLATE.read_text(encoding="utf-8").splitlines()
    lines = list(dropwhile(lambda line: line.startswith("# "), template))  # its first comment explains how to copy it
    if capture is None:
        head.append(f"# Name your capture below, then: {COMMAND} run {path}")
    else:
        report = check_capture(capture).text(MAX_PROBLEMS)
        head += [f"# Run it: {COMMAND} run {path}", "#", f"# Result of `{COMMAND} check`:"]
        head += [f"# {line}".rstrip() for line in report.splitlines()]
        changed = _new_lines(Path(capture), path.parent)
        if thresholds:
            changed["  thresholds: "] = f"  thresholds: {[list(one) for one in thresholds]} # degrees, meters"
        for prefix, new_line in changed.items():
            index = next((index for index, line in enumerate(lines) if line.startswith(prefix)), None)
            if index is None:
                raise ManifestError(f"{TEMPLATE}: no line starts with {prefix!r}. Restore the file.")
            lines[index] = new_line
    write_text(path, "\n".join([*head, *lines]) + "\n")
    return path


def _new_lines(path: Path, folder: Path) -> dict[str, str]:
    """Return lines for a manifest in `folder`, keyed by the prefix of the template's line that each replaces."""
    capture = Capture.open(path)
    lists = {name for session in capture.usable("query") for name in session.keyframe_files}
    outside = not path.resolve().is_relative_to(Path.cwd().resolve())
    where = str(path.resolve()) if outside else os.path.relpath(path.resolve(), folder.resolve())
    lines = {
        "description: ": "description: " + json.dumps(f"{capture.name}: {', '.join(capture.session_ids)}."),
        "  - ": f"  - {json.dumps(where)} # a folder with sessions/ios_map, ... in it",
    }
    if ASKED not in lists:
        choices = ", ".join(f"keyframes_{name}" for name in sorted(lists))
        lines["queries: "] = "queries: all # images of the query sessions" + (f", or {choices}" if choices else "")
    if capture.unit is None:
        lines["unit: "] = "unit: null # unknown according to its import; limits are relative to the depth of the scene"
    return lines
