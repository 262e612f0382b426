"""A matrix on disk, `.npy`, written row by row: memory does not grow with it, and a killed writer goes on."""

import json
import os
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from toolkit.errors import ArtifactError
from toolkit.files import fingerprint

if sys.platform != "win32":
    import fcntl


class MatrixWriter:
    """Writes (N, D), N not known beforehand, in batches; `finish` moves the whole file into place.

    Until then the rows are in a hidden file beside it, and a second one has a line a batch. A new writer with the
    same record goes on after the last whole line: `notes` has what was said of the batches already written.
    """

    def __init__(self, path: str | Path, dim: int, dtype: DTypeLike, record: dict[str, Any], resume: bool = True):
        """
        Args:
            path: the `.npy` to be.
            dim: D.
            dtype: of the numbers on disk.
            record: what the matrix is made from; rows that were made from something else are dropped.
            resume: go on with what a killed writer left.

        Raises:
            ArtifactError: another process is writing the same matrix.
        """
        self.path = Path(path)
        self._dim, self._dtype = dim, np.dtype(dtype)
        self._rows_path = self.path.with_name(f".{self.path.name}.partial")
        self._lines_path = self.path.with_name(f".{self.path.name}.partial.jsonl")
        self._identity = fingerprint([record, dim, self._dtype.str])
        self.notes: list[Any] = []
        self.count = 0
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # The header keeps room for any number of rows, so its length does not depend on it.
        self._rows = open(self._rows_path, "r+b" if self._rows_path.exists() else "w+b")  # noqa: SIM115
        self._lock()
        self._write_header()
        start = self._rows.tell()
        kept = self._read_lines(start) if resume else []
        self._rows.truncate(start + self.count * self._dim * self._dtype.itemsize)
        self._rows.seek(0, os.SEEK_END)
        self._lines = open(self._lines_path, "w", encoding="utf-8")  # noqa: SIM115
        self._lines.write("".join(line + "\n" for line in [json.dumps({"made_from": self._identity}), *kept]))
        self._lines.flush()

    def append(self, rows: ArrayLike, note: Any = None) -> None:
        """Write a batch of rows (B, D) and a note about it, any JSON.

        Raises:
            ValueError: rows of another length.
        """
        block = np.ascontiguousarray(rows, self._dtype)
        if block.ndim != 2 or block.shape[1] != self._dim:
            raise ValueError(f"rows have shape {block.shape}; expected (B, {self._dim}).")
        self._rows.write(block.tobytes())
        self._rows.flush()  # before the line: it vouches for the rows
        self._lines.write(json.dumps({"rows": len(block), "note": note}) + "\n")
        self._lines.flush()
        self.count += len(block)

    def finish(self) -> None:
        """Put the matrix in its place."""
        self._rows.seek(0)
        self._write_header()
        self._rows.flush()
        # Before the lock goes with the open file: who comes next shall find no rows of this one.
        self._lines_path.unlink(missing_ok=True)
        self._rows_path.replace(self.path)
        self.close()

    def close(self) -> None:
        """Close the files and keep what was written for the next writer."""
        self._rows.close()
        self._lines.close()

    def __enter__(self) -> "MatrixWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _lock(self) -> None:
        if sys.platform == "win32":
            return
        try:
            fcntl.flock(self._rows, fcntl.LOCK_EX | fcntl.LOCK_NB)  # ends with the process, however it ends
        except BlockingIOError:
            self._rows.close()
            raise ArtifactError(
                f"{self.path} is being written by another process. Wait for that run to end, or stop it."
            ) from None

    def _write_header(self) -> None:
        description = {"descr": self._dtype.str, "fortran_order": False, "shape": (self.count, self._dim)}
        np.lib.format.write_array_header_1_0(self._rows, description)

    def _read_lines(self, start: int) -> list[str]:
        """Take over the batches of a writer that made the same; returns their lines."""
        try:
            lines = self._lines_path.read_text(encoding="utf-8").split("\n")
        except OSError:
            return []
        kept: list[str] = []
        held = (self._rows.seek(0, os.SEEK_END) - start) // (self._dim * self._dtype.itemsize)
        for number, line in enumerate(lines):
            try:
                entry = json.loads(line)
                if number == 0 and entry != {"made_from": self._identity}:
                    return []
                count = self.count + entry["rows"] if number else 0
            except (ValueError, KeyError, TypeError):
                break  # the line that was being written
            if count > held:
                break
            if number:
                kept.append(line)
                self.notes.append(entry["note"])
                self.count = count
        return kept
