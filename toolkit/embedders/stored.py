"""Global descriptors on disk: reads the matrices of a session as one, in parts, so a map need not fit in memory."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.errors import ArtifactError
from toolkit.files import file_fingerprint, fingerprint, read_json, require_whole, sidecar_path
from toolkit.geometry import Ints, unit

log = logging.getLogger(__name__)

MANIFEST_COLUMNS = ["row_index", "device_id", "sensor_id", "timestamp", "abs_path"]
"""Columns of `manifest.csv`, which names the image of each row of embeddings."""


@dataclass(frozen=True)
class StoredVectors:
    """One descriptor of images: selected rows of `.npy` matrices that are concatenated along axis 0."""

    paths: tuple[Path, ...]
    starts: tuple[int, ...]  # first row of each file in the concatenation, then the total number of rows
    dim: int
    rows: Ints  # the selected rows of the concatenation, in any order
    normalize: bool = False  # whether to scale vectors to length 1 when reading
    embedder: str = ""  # identifies the embedder, see `embedder_fingerprint`; empty: unknown

    def __getitem__(self, positions: slice | Ints) -> NDArray[np.float32]:
        """Read the rows (n, D) at these positions."""
        rows = self.rows[positions]
        if (np.diff(rows) < 0).any():  # read files from start to end
            order = np.argsort(rows)
            in_order = replace(self, rows=rows[order])[:]
            vectors = np.empty_like(in_order)
            vectors[order] = in_order
            return vectors
        vectors = np.empty((len(rows), self.dim), np.float32)
        cuts = np.searchsorted(rows, self.starts)
        for path, start, first, last in zip(self.paths, self.starts, cuts, cuts[1:], strict=False):
            if first < last:
                inside = rows[first:last] - start
                contiguous = (np.diff(inside) == 1).all()
                # Map the file anew each time: the pages of a lasting mapping would count as this process's memory.
                matrix = np.load(path, mmap_mode="r")
                vectors[first:last] = matrix[inside[0] : inside[-1] + 1] if contiguous else matrix[inside]
        return unit(vectors) if self.normalize else vectors


@dataclass(frozen=True)
class Vectors:
    """One or several descriptors of the same N images; a row holds those of an image side by side."""

    parts: Mapping[str, StoredVectors]  # vectors by the name of the descriptor; the name of a single one is empty

    @classmethod
    def stack(cls, sets: Sequence["Vectors"]) -> "Vectors":
        """Concatenate the rows of several, which have the same descriptors and dimensions."""
        stacked = {}
        for name in sets[0].parts:
            starts, rows, parts = [0], list[Ints](), [vectors.parts[name] for vectors in sets]
            for part in parts:
                rows.append(part.rows + starts[-1])
                starts += [starts[-1] + start for start in part.starts[1:]]
            paths = tuple(path for part in parts for path in part.paths)
            embedder = next((part.embedder for part in parts if part.embedder), "")
            joined: Any = {"paths": paths, "starts": tuple(starts), "rows": np.concatenate(rows), "embedder": embedder}
            stacked[name] = replace(parts[0], **joined)
        return cls(stacked)

    @property
    def dims(self) -> tuple[int, ...]:
        return tuple(part.dim for part in self.parts.values())

    @property
    def shape(self) -> tuple[int, int]:
        return len(self), sum(self.dims)

    def __len__(self) -> int:
        return len(next(iter(self.parts.values())).rows)

    def choose(self, positions: Ints) -> "Vectors":
        """Return the rows at these positions, without reading them."""
        return Vectors({name: replace(part, rows=part.rows[positions]) for name, part in self.parts.items()})

    def __getitem__(self, positions: slice | Ints) -> NDArray[np.float32]:
        """Read the rows (n, sum of D) at these positions."""
        columns = [part[positions] for part in self.parts.values()]
        return np.hstack(columns) if len(columns) > 1 else columns[0]


def embedder_fingerprint(settings: Mapping[Any, Any]) -> str:
    """Return a fingerprint of an embedder's settings, weights and vocabulary.

    The precision is left out: it changes the last digits only, and depends on the device.
    """
    return fingerprint({name: value for name, value in settings.items() if name != "dtype_compute"})


def require_same_embedder(vectors: Vectors, others: Vectors) -> None:
    """Raise ArtifactError if two sets of vectors are known to come from different embedders or vocabularies."""
    for ours, theirs in zip(vectors.parts.values(), others.parts.values(), strict=True):
        if ours.embedder and theirs.embedder and ours.embedder != theirs.embedder:
            files = f"{ours.paths[0]} and {theirs.paths[0]} were made by different embedders or vocabularies"
            raise ArtifactError(f"{files}, so their vectors cannot be compared. Embed all sessions again.")


def matrix_fingerprints(paths: Sequence[Path]) -> list[Any]:
    """Return, as JSON, names and fingerprints that identify the matrices in these files."""
    # The record beside a matrix identifies it, and is quick to read; a foreign matrix may have none.
    return [
        [path.name, file_fingerprint(record if record.exists() else path)]
        for path, record in zip(paths, map(sidecar_path, paths), strict=True)
    ]


def blocks(vectors: NDArray[Any] | Vectors, size: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield blocks of at most `size` bytes, as float32: the number of the first row, and the rows (n, D)."""
    step = max(1, size // (4 * max(1, vectors.shape[1])))
    for start in range(0, len(vectors), step):
        yield start, np.ascontiguousarray(vectors[start : start + step], np.float32)


def require_finite(matrix: NDArray[np.float32], name: str, first: int | Ints = 0) -> None:
    """Raise ValueError if a value of the matrix `name` is not finite; `first` is the number of its first row, or of
    all.
    """
    bad = ~np.isfinite(matrix).all(axis=1)
    if bad.any():
        index = int(bad.argmax())
        row = first + index if isinstance(first, int) else int(first[index])
        raise ValueError(f"{name} has {bad.sum()} rows with NaN or infinite values, first row {row}.")


def open_embeddings(folder: str | Path) -> tuple[Vectors, pd.DataFrame]:
    """Open the embeddings in `<embeddings>/<session>`, or in a subsession's folder there; vectors stay on disk.

    Raise ArtifactError if there are none, a file is damaged, or files do not fit together.

    Returns:
        The vectors (N, D), and a table of their images: row_index, device_id, sensor_id, timestamp, abs_path,
        subsession.
    """
    folder = Path(folder)
    manifests = sorted(folder.rglob("manifest.csv"))
    if not manifests:
        raise ArtifactError(f"No embeddings in {folder}: run the embed stage first (toolkit run ... --only embed).")
    parts, tables = list[Vectors](), []
    for manifest in manifests:
        path = manifest.parent / f"{manifest.parent.name}.npy"
        for file in (path, manifest):
            require_whole(file, of=path)
        try:
            matrix = np.load(path, mmap_mode="r")
            table = pd.read_csv(manifest, dtype={"device_id": str, "sensor_id": str, "abs_path": str})
        except (OSError, ValueError) as error:
            raise ArtifactError(f"Embeddings {path} cannot be read ({error}); embed again.") from error
        if list(table.columns) != MANIFEST_COLUMNS or matrix.ndim != 2 or len(matrix) != len(table):
            found = (
                f"{manifest} ({len(table)} rows, {', '.join(table.columns)}) does not fit {path.name} {matrix.shape}"
            )
            raise ArtifactError(f"{found}; expected {', '.join(MANIFEST_COLUMNS)}, one row per vector. Embed again.")
        count, dim = matrix.shape
        if parts and (dim,) != parts[0].dims:
            raise ArtifactError(f"{path} has {dim} dimensions, {manifests[0].parent} {parts[0].dims[0]}; embed again.")
        match read_json(sidecar_path(path)):
            case {"settings": {"embedder": {**settings}}}:
                embedder = embedder_fingerprint(settings)
            case _:  # a matrix of another tool
                embedder = ""
        part = Vectors({"": StoredVectors((path,), (0, count), dim, np.arange(count), embedder=embedder)})
        for other in parts:
            require_same_embedder(part, other)
        parts.append(part)
        base = folder.parent if manifest.parent == folder else folder
        tables.append(table.assign(subsession=manifest.parent.relative_to(base).as_posix()))
    return Vectors.stack(parts), pd.concat(tables, ignore_index=True)


def embedding_folders(embeddings: str | Path) -> dict[str, Path]:
    """Return the folder of each descriptor in an embeddings folder; a single one has the name "" and no subfolder."""
    model = read_json(Path(embeddings) / "settings.json").get("model")
    return {name: Path(embeddings) / name for name in model} if isinstance(model, list) else {"": Path(embeddings)}


def open_descriptors(embeddings: str | Path, session: str, normalize: bool) -> tuple[Vectors, pd.DataFrame]:
    """Open all descriptors of a session; with several, only the images that have all of them.

    With `normalize`, the vectors of each have length 1. Raise ArtifactError as `open_embeddings`, or without an image.
    """
    opened = {name: open_embeddings(folder / session) for name, folder in embedding_folders(embeddings).items()}
    parts = {name: replace(vectors.parts[""], normalize=normalize) for name, (vectors, _) in opened.items()}
    tables = [table for _, table in opened.values()]
    if len(parts) == 1:
        return Vectors(parts), tables[0]
    in_all = pd.concat([table["abs_path"] for table in tables]).value_counts() == len(tables)
    table = tables[0][tables[0]["abs_path"].map(in_all)].reset_index(drop=True)
    if not len(table):
        raise ArtifactError(f"{embeddings}: no image of {session} has all of {', '.join(parts)}. Embed again.")
    if missing := len(in_all) - len(table):
        lack = f"{missing} of {len(in_all)} images are left out: they lack one of the descriptors {', '.join(parts)}"
        log.warning("%s: %s, see failed.csv", session, lack)
    positions = [pd.Index(own["abs_path"]).get_indexer(table["abs_path"]) for own in tables]
    common = zip(parts.items(), positions, strict=True)
    return Vectors({name: replace(part, rows=part.rows[chosen]) for (name, part), chosen in common}), table


def load_embeddings(folder: str | Path) -> tuple[NDArray[np.float32], pd.DataFrame]:
    """Read the embeddings (N, D) float32 of a session, or of one subsession, into memory; see `open_embeddings`."""
    vectors, table = open_embeddings(folder)
    return vectors[:], table
