"""Leave out pairs of devices that fail because of their data, with a reason, and finish the rest.

The reason is in the stage's table and in `<pair>.left_out.json` beside the stage's results. Later stages read that
file, so that they do not use results which an earlier run made of the pair from other data.
"""

import json
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from toolkit.errors import OF_THE_DATA, ArtifactError, DamagedError
from toolkit.files import pair_name, read_json, write_text
from toolkit.manifest import Settings

log = logging.getLogger(__name__)

LEFT_OUT = "left out: "
"""Prefix of the state of a pair that was left out, in the tables of an evaluation."""


@dataclass
class PairRows:
    """The rows of a stage's table, one per pair of devices."""

    scene: str
    out_dir: Path
    """Folder of the stage's results."""
    upstream: Path | None = None
    """Folder of the results of the stage before."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    errors: list[Exception] = field(default_factory=list)

    @contextmanager
    def row(self, map_device: str, query_device: str) -> Iterator[dict[str, Any]]:
        """Yield the row of a pair, new or existing, for the caller to fill; the time until then is in `seconds`.

        If the body raises an error that the pair's data cause, the row gets it as its `reason`, and the run continues.
        """
        started = time.perf_counter()
        name = pair_name(self.scene, map_device, query_device)
        note = _note(self.out_dir, name)
        pair: dict[str, Any] = {"map_device": map_device, "query_device": query_device}
        row = next((row for row in self.rows if pair.items() <= row.items()), None)
        if row is None:
            row = dict(pair)
            self.rows.append(row)
        try:
            yield row
            row["seconds"] = round(row.get("seconds", 0.0) + time.perf_counter() - started, 3)
            # The last columns of every table, in this order.
            row |= {name: row.pop(name) for name in ("seconds", "skipped", "path") if name in row} | {"reason": ""}
            note.unlink(missing_ok=True)
        except DamagedError:
            raise  # damaged files are rebuilt, see `store.items.retry_damaged`
        except OF_THE_DATA as error:
            log.warning("%s is left out: %s", name, error)
            row.clear()
            row.update(pair, reason=str(error))
            write_text(note, json.dumps({"reason": str(error)}) + "\n")
            self.errors.append(error)

    def check_upstream(self) -> None:
        """Raise ArtifactError if the stage before left out the pair of the last row, with its reason."""
        name = pair_name(self.scene, self.rows[-1]["map_device"], self.rows[-1]["query_device"])
        if self.upstream is not None and (reason := left_out(self.upstream, name)):
            raise ArtifactError(reason)

    def frame(self, settings: Settings | None = None) -> pd.DataFrame:
        """Return the table, and write the settings, if given, beside the stage's results; raise the first pair's error
        if no pair could be done. `reason` is empty for finished pairs; the other columns of a left-out pair are zero.
        """
        done = next((row for row in self.rows if not row["reason"]), None)
        if done is None and self.errors:
            raise self.errors[0]
        if settings is not None:
            write_text(self.out_dir / "settings.json", settings.model_dump_json(indent=1) + "\n")
        empty = {name: type(value)() for name, value in (done or {}).items()}
        return pd.DataFrame([empty | row for row in self.rows])


def left_out(folder: str | Path, name: str) -> str:
    """Return why the stage with this folder of results left out the pair of this name; "" if it did not."""
    return str(read_json(_note(Path(folder), name)).get("reason", ""))


def left_out_of(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the pairs or sessions that the table of a stage leaves out: `what`, `reason` and the pair's devices."""
    if "reason" not in table:
        return []
    pair = ("map_device", "query_device")
    return [
        {"what": pair_text(row), "reason": row["reason"]} | {name: row[name] for name in pair if name in row}
        for row in table.to_dict("records")
        if row["reason"]
    ]


def pair_text(row: Mapping[Any, Any]) -> str:
    """Return the pair or session of a row as readable text."""
    if "map_device" not in row:
        return str(row.get("session", ""))
    return f"{row['query_device']} queries in the {row['map_device']} map"


def _note(folder: Path, name: str) -> Path:
    return folder / f"{name}.left_out.json"
