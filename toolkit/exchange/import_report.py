"""What an import has done: one table for all imports, kept as JSON in each session that it made."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap

from toolkit.capture import Capture
from toolkit.capture.folder import IMPORT_RECORD
from toolkit.files import read_json

_SHOWN = 10
"""Largest number of lines about reasons, and about cameras."""


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
