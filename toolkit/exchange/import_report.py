"""What an import has done: one table for all imports, kept as JSON in each session that it made; and the manifest of
the new capture: the repository's template, filled in with the findings of `check`.
"""

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap

from toolkit.capture import Capture
from toolkit.capture.check import ASKED, check_capture
from toolkit.capture.session import IMPORT_RECORD
from toolkit.errors import COMMAND, ManifestError
from toolkit.files import read_json, shipped, write_text

_SHOWN = 10
"""Largest number of lines about reasons, and about cameras."""
TEMPLATE = shipped("data_manifests") / "my-capture.yaml"
MAX_PROBLEMS = 10  # that the report of an import names


@dataclass
class ImportReport:
    """The result of an import."""

    session: Path
    images: pd.DataFrame  # image, status (`imported` or why not), path, timestamp, sensor_id, device_id, camera
    record: dict[str, Any]  # what is kept in `proc/import.json`
    held_out: "ImportReport | None" = None  # the queries that were made of a part of the images

    @property
    def notes(self) -> list[str]:
        """Anything else that the user should look at."""
        return list(self.record["notes"])

    def records(self) -> dict[str, dict[str, Any]]:
        """Return the records of the session and of its queries, by session."""
        return {self.session.name: self.record} | (self.held_out.records() if self.held_out is not None else {})

    def text(self) -> str:
        """Return the table as text."""
        return table_text(self.session.parent, self.records())

    def as_json(self) -> str:
        """Return the records as JSON."""
        return json.dumps(self.records(), indent=1, ensure_ascii=False)


def imports_text(capture: Capture) -> str:
    """Return the table of the imports that made the sessions of a capture."""
    records = {capture.folder(name).name: read_json(capture.folder(name) / IMPORT_RECORD) for name in capture}
    text = table_text(capture.path / "sessions", {name: one for name, one in records.items() if "used" in one})
    return text or "No session is from an import that keeps its report."


def table_text(root: Path, records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of the records of sessions in a folder: what, how many, and details."""
    parts = []
    for name, record in records.items():
        rows = [(what, f"{count:,}" if count is not None else "", text) for what, count, text in _rows(record)]
        widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
        lines = (f"  {what:<{widths[0]}}  {count:>{widths[1]}}  {text}".rstrip() for what, count, text in rows)
        parts.append("\n".join([str(root / name), *lines]))
    return "\n".join(parts)


def _rows(record: Mapping[str, Any]) -> Iterator[tuple[str, int | None, str]]:
    """Yield the lines of the table: what, how many, and details."""
    before = f"; {record['before']:,} were in the session" if record.get("before") else ""
    yield "images", record["used"], f"used of {record['seen']:,} in {record['source']}{before}"
    for one in record["left out"][:_SHOWN]:
        first = "" if one["first"] in one["reason"] else f" ({'first: ' if one['count'] > 1 else ''}{one['first']})"
        yield "left out", one["count"], one["reason"] + first
    if more := record["left out"][_SHOWN:]:
        yield "left out", sum(one["count"] for one in more), "for other reasons, see proc/import.csv"
    for one in record["cameras"][:_SHOWN]:
        focal = " to ".join(f"{value:.1f}" for value in one["focal_px"])
        size = f"{one['model']}, {one['width']} x {one['height']}, focal length {focal} px"
        yield "cameras", one["cameras"], f"of {one['images']:,} images: {size}: {one['from']}"
    if more := record["cameras"][_SHOWN:]:
        yield "cameras", sum(one["cameras"] for one in more), "others, see sensors.txt"
    if record["poses"]:
        yield "poses", record["poses"], record["convention"]
        known = "m, from" if record["unit"] else "unknown: relative to the depth of the scene."
        yield "unit", None, f"{known} {record['unit from']}"
        yield "up", None, record["up"]
    for what in ("timestamps", "masks", "odometry", "depth maps", "GPS"):
        if record.get(what):
            yield what, *record[what]
    for note in record["notes"]:
        yield "note", None, note
    yield "seconds", None, f"{record['seconds']:.1f}"


def grouped(left_out: Iterable[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return the count, the reason and the first name of images whose reasons differ only in numbers, given both."""
    groups = dict[str, dict[str, Any]]()
    for name, reason in left_out:
        key = re.sub(r"\d[\d.e+-]*", "#", reason.replace(name, ""))
        groups.setdefault(key, {"count": 0, "reason": reason.rstrip("."), "first": name})["count"] += 1
    return sorted(groups.values(), key=lambda group: -group["count"])


def cameras_of(images: Iterable[tuple[str, pycolmap.Camera, str]]) -> list[dict[str, Any]]:
    """Return what a report says of cameras: those of equal model, size and origin together.

    `images` are sensor, camera, and where its intrinsics are from, of each image.
    """
    groups = dict[tuple[Any, ...], list[tuple[str, float]]]()
    for sensor, camera, origin in images:
        key = camera.model.name, camera.width, camera.height, origin
        groups.setdefault(key, []).append((sensor, camera.mean_focal_length()))
    names = ("model", "width", "height", "from")
    return [
        dict(zip(names, key, strict=True)) | {
            "cameras": len({sensor for sensor, _ in found}), "images": len(found),
            "focal_px": np.unique([min(focal for _, focal in found), max(focal for _, focal in found)]).tolist(),
        }
        for key, found in sorted(groups.items(), key=lambda item: -len(item[1]))
    ]  # fmt: skip


# The manifest of a new capture


def new_manifest(
    name: str, capture: str | Path | None = None, folder: str | Path = "data_manifests",
    thresholds: Sequence[tuple[float, float]] = (),
) -> Path:  # fmt: skip
    """Write `<folder>/<name>.yaml` and return its path. Without a capture, it keeps the template's placeholder; without
    `thresholds`, degrees and meters, those of the template.

    Raises:
        ManifestError: an invalid name, or the file exists already.
        CaptureError: the folder is not a capture. Problems inside a capture are listed in its manifest instead.
    """
    path = Path(folder) / f"{name}.yaml"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):  # the rule for `name` in a manifest
        raise ManifestError(f"{name!r}: not a run name. Expected letters, digits, '-', '_', '.', such as my-place.")
    if path.exists():
        raise ManifestError(f"{path} exists already. Give another name, or remove it first.")
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
            lines[next(index for index, line in enumerate(lines) if line.startswith(prefix))] = new_line
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
