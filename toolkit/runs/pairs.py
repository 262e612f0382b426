"""Pairs of devices that cannot be done: the others are, and each that is left out has its reason.

The reason stands in the stage's table and in `<pair>.left_out.json` beside the stage's results, where later stages find
it: what an earlier run left of the pair would not be of this capture.
"""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from toolkit.errors import OF_THE_DATA, ArtifactError, DamagedError
from toolkit.files import pair_name, read_json, write_text

log = logging.getLogger(__name__)

LEFT_OUT = "left out: "
"""How the state of a pair that could not be done begins in the tables of an evaluation."""


@dataclass
class PairRows:
    """The rows of a stage's table, one a pair of devices."""

    scene: str
    out_dir: Path
    """Folder of the stage's results."""
    upstream: Path | None = None
    """Folder of the results that the stage builds on."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    errors: list[Exception] = field(default_factory=list)

    @contextmanager
    def row(self, map_device: str, query_device: str) -> Iterator[dict[str, Any]]:
        """Yield the row of a pair, to be filled, or filled further; an error that is of the pair's own data ends there,
        as its reason."""
        name = pair_name(self.scene, map_device, query_device)
        note = _note(self.out_dir, name)
        pair: dict[str, Any] = {"map_device": map_device, "query_device": query_device}
        row = next((row for row in self.rows if pair.items() <= row.items()), None)
        if row is None:
            row = dict(pair)
            self.rows.append(row)
        try:
            yield row
            row["reason"] = ""
            note.unlink(missing_ok=True)
        except DamagedError:
            raise  # what is damaged is made again, see `features.groups.heals`
        except OF_THE_DATA as error:
            log.warning("%s is left out: %s", name, error)
            row.clear()
            row.update(pair, reason=str(error))
            write_text(note, json.dumps({"reason": str(error)}) + "\n")
            self.errors.append(error)

    def check_upstream(self) -> None:
        """Raise the reason for which the stage before left out the pair of the last row."""
        name = pair_name(self.scene, self.rows[-1]["map_device"], self.rows[-1]["query_device"])
        if self.upstream is not None and (reason := left_out(self.upstream, name)):
            raise ArtifactError(reason)

    def frame(self) -> pd.DataFrame:
        """Return the table; a pair that is left out has zeros, and its `reason`, which is empty for the others.

        Raises:
            ToolkitError: that of the first pair, where none could be done.
        """
        done = next((row for row in self.rows if not row["reason"]), None)
        if done is None and self.errors:
            raise self.errors[0]
        empty = {name: type(value)() for name, value in (done or {}).items()}
        return pd.DataFrame([empty | row for row in self.rows])


def left_out(folder: str | Path, name: str) -> str:
    """Return why a stage left a pair out, by its folder of results and the pair's name; "" where it did not."""
    return str(read_json(_note(Path(folder), name)).get("reason", ""))


def left_out_of(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return what was left out by the table of a stage, and why: the rows with a `reason`."""
    if "reason" not in table:
        return []
    pair = ("map_device", "query_device")
    return [
        {"what": pair_text(row), "reason": row["reason"]} | {name: row[name] for name in pair if name in row}
        for row in table.to_dict("records")
        if row["reason"]
    ]


def pair_text(row: Mapping[Any, Any]) -> str:
    """Return what a row is of, for people."""
    if "map_device" not in row:
        return str(row.get("session", ""))
    return f"{row['query_device']} queries in the {row['map_device']} map"


def way_out(pairs: Iterable[tuple[str, str]], devices: Sequence[str]) -> str:
    """Return how to leave out for good what was left out.

    Args:
        pairs: (map device, query device) of what was left out.
        devices: all that take part.
    """
    pairs = list(pairs)
    culprits = [device for device in devices if all(device in pair for pair in pairs)]
    rest = [device for device in devices if device not in culprits]
    keys = f"`devices: [{', '.join(rest)}]`" if len(culprits) == 1 and rest else "`devices:`"
    return f"Mend it, or leave it out for good: {keys} in the manifest, or `pairs:`."


def _note(folder: Path, name: str) -> Path:
    return folder / f"{name}.left_out.json"
