"""Files of references: a line of JSON for each query image, with the map images that are like it, best first."""

import json
from pathlib import Path
from typing import Any

from toolkit.errors import ArtefactError


def read_references(path: str | Path, *needed: str) -> list[dict[str, Any]]:
    """Return the rows of a file of references, one a query image.

    Each has at least `timestamp` (a whole number), `sensor_id`, and `topk`, a list of map images with a `path` each;
    those that the toolkit writes have the keys that the retrieve stage describes.

    Args:
        path: the file.
        needed: further keys that each row must have.

    Raises:
        ArtefactError: the file is missing, or a line of it is no such row.
    """
    rows: list[dict[str, Any]] = []
    keys, number = {"timestamp", "sensor_id", "topk", *needed}, 0
    try:
        with open(path, encoding="utf-8") as lines:
            for line in lines:
                number += 1
                if line.strip():
                    rows.append(_checked(json.loads(line), keys))
    except FileNotFoundError:
        raise ArtefactError(
            f"No references: {path} is missing. Run the retrieve stage first "
            "(python -m toolkit run MANIFEST --only retrieve)."
        ) from None
    except (ValueError, TypeError, OverflowError) as error:
        raise ArtefactError(f"{path}, line {number}: not a retrieval row ({error}). Retrieve again.") from None
    return rows


def _checked(row: Any, keys: set[str]) -> dict[str, Any]:
    if not isinstance(row, dict) or not keys <= row.keys():
        found = sorted(row) if isinstance(row, dict) else row
        raise ValueError(f"found {found!r}; expected the keys {', '.join(sorted(keys))} and others")
    if not isinstance(row["topk"], list):
        raise TypeError(f"found topk {row['topk']!r}; expected a list of references")
    if not all(isinstance(reference, dict) and "path" in reference for reference in row["topk"]):
        raise ValueError("a reference in topk has no path")
    int(row["timestamp"])
    return row
