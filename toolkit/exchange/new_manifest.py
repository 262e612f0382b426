"""A manifest for a capture of one's own: the repository's template, filled in with what `check` has found."""

import json
import os
import re
from itertools import dropwhile
from pathlib import Path

from toolkit.capture import Capture
from toolkit.capture.check import ASKED, check_capture
from toolkit.errors import ManifestError
from toolkit.exchange.drafts import IMPORT_RECORD
from toolkit.files import read_json, write_text

TEMPLATE = Path(__file__).resolve().parents[2] / "data_manifests" / "my-capture.yaml"
MOST_PROBLEMS = 10


def new_manifest(name: str, capture: str | Path | None = None, folder: str | Path = "data_manifests") -> Path:
    """Write `<folder>/<name>.yaml` and return its path.

    Args:
        name: of the manifest and so of the run.
        capture: what to run on; None: the template's place-holder, to be filled in.

    Raises:
        ManifestError: a name that no run can have, the file exists already, or there is no template.
        CaptureError: the folder is not a capture at all. One with problems gets its manifest, with them in it.
    """
    path = Path(folder) / f"{name}.yaml"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):  # as `name` of a manifest has it
        raise ManifestError(f"{name!r}: no name of a run. Expected letters, digits, '-', '_', '.', such as my-place.")
    if path.exists():
        raise ManifestError(f"{path} exists already. Give another name, or remove it first.")
    if not TEMPLATE.is_file():
        raise ManifestError(f"{TEMPLATE}: no such file. Manifests are made in a clone of the repository.")
    head = [f"# {name}. `python -m toolkit settings` tells what else can be set."]
    template = TEMPLATE.read_text(encoding="utf-8").splitlines()
    lines = list(dropwhile(lambda line: line.startswith("# "), template))  # the comment at its head is about copying it
    if capture is None:
        head.append(f"# Name your capture below, then: python -m toolkit run {path}")
    else:
        report = check_capture(capture).text(MOST_PROBLEMS)
        head += [f"# Run it: python -m toolkit run {path}", "#", "# What `python -m toolkit check` has found:"]
        head += [f"# {line}".rstrip() for line in report.splitlines()]
        for begin, found in _found_in(Path(capture), path.parent).items():
            place = next((number for number, line in enumerate(lines) if line.startswith(begin)), None)
            if place is None:
                raise ManifestError(f"{TEMPLATE}: no line begins with {begin!r}. Restore the file.")
            lines[place] = found
    write_text(path, "\n".join([*head, *lines]) + "\n")
    return path


def _found_in(path: Path, folder: Path) -> dict[str, str]:
    """Return new lines of the template by how the old ones begin, for a manifest in `folder`."""
    capture = Capture.open(path)
    lists = {name for session in capture.usable("query") for name in session.keyframe_files}
    unit = {read_json(capture.folder(name) / IMPORT_RECORD).get("unit", "m") for name in capture.session_ids}
    outside = not path.resolve().is_relative_to(Path.cwd().resolve())
    where = str(path.resolve()) if outside else os.path.relpath(path.resolve(), folder.resolve())
    found = {
        "description: ": "description: " + json.dumps(f"{capture.name}: {', '.join(capture.session_ids)}."),
        "  - ": f"  - {json.dumps(where)} # a folder with sessions/ios_map, ... in it",
    }
    if ASKED not in lists:
        others = ", ".join(f"keyframes_{name}" for name in sorted(lists))
        found["queries: "] = "queries: all # images of the query sessions" + (f", or {others}" if others else "")
    if None in unit:
        found["unit: "] = "unit: null # not known, as its import said; limits are relative to the depth of the scene"
    return found
