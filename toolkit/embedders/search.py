"""Global descriptors on disk, and the nearest neighbors among them.

The matrices of a session are read as one, in parts, so a map need not fit in memory. Candidates come from FAISS, torch
or, for maps too large to compare every vector, an index, which compresses the vectors and compares a query with some of
them only; then exact scores are computed from the vectors on disk.
"""

import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import faiss as typed_faiss
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.embedders.masks import Masks
from toolkit.errors import ArtifactError, ManifestError, ToolkitError
from toolkit.files import (
    file_fingerprint,
    fingerprint,
    is_current,
    read_json,
    require_whole,
    sidecar_path,
    write_atomic,
    write_sidecar,
)
from toolkit.geometry import Ints, unit
from toolkit.manifest import RetrieveSettings
from toolkit.models.compute import resolve_device

log = logging.getLogger(__name__)
MANIFEST_COLUMNS = ["row_index", "device_id", "sensor_id", "timestamp", "abs_path"]
"""Columns of `manifest.csv`, which names the image of each row of embeddings."""
faiss: Any = typed_faiss  # its type stubs are incomplete
EXACT = "Flat"  # factory string of the exact search, which needs no index
_TRAIN_BYTES = 1 << 30  # training vectors of an index, at most, bytes of float32
_TRAIN_PER_UNIT = 64  # training vectors per PCA dimension and per cell of an inverted file, if the map has as many
_TRAIN_CODES = 1 << 16  # training vectors of the codes, at least, however few cells there are; PQ needs 256 or more
Backend = Literal["faiss", "torch", "numpy"]
_BLOCK_BYTES = 128 << 20  # vectors read or added to an index at a time, bytes of float32: bounds the memory
_QUERY_BYTES = 512 << 20  # queries compared in one pass over the database, bytes of float32
# Database rows read at a time for queries with masks. Masks select parts of recordings, so a small block has no allowed
# rows for most queries, which then skip it.
_MASKED_ROWS = 1 << 12
_EXTRA = 16  # candidates beyond k: rounding in the backend may swap neighbors
# Parameter of the generalized harmonic mean. Similarities of n >= 2 unit vectors are never below its pole, -n / 2.
_GAMMA = 0.5
_Floats = NDArray[np.float32]
Found = tuple[_Floats, Ints]  # scores and rows (Q, K) of the best database vectors of each query, best first
_Best = Callable[[_Floats, int, int], Found]
"""Maps a block of the database, the number of its first row, and n to the n best scores and rows of each query, counted
from the start of the block."""


# Vectors on disk


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

    @cached_property
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
    """Raise ArtifactError if two sets of vectors are known to come from different embedders or vocabularies, or have
    different dimensions.
    """
    for ours, theirs in zip(vectors.parts.values(), others.parts.values(), strict=True):
        if ours.dim != theirs.dim or (ours.embedder and theirs.embedder and ours.embedder != theirs.embedder):
            fault = f"were made by different models or vocabularies ({ours.dim} and {theirs.dim} dimensions)"
            do = "so their vectors cannot be compared. Embed all sessions again."
            raise ArtifactError(f"{ours.paths[0]} and {theirs.paths[0]} {fault}, {do}")


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
    """Raise ValueError if a value of the matrix `name` is not finite; `first`: number of its first row, or of all."""
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
            found = f"{manifest} ({len(table)} rows, {', '.join(table.columns)})"
            fault = f"{found} does not fit {path.name} {matrix.shape}"
            raise ArtifactError(f"{fault}; expected {', '.join(MANIFEST_COLUMNS)}, one row per vector. Embed again.")
        count, dim = matrix.shape
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


# Indexes


@dataclass(frozen=True)
class VectorIndex:
    """FAISS indexes of N vectors, one per descriptor. Each contributes candidates."""

    indexes: tuple[Any, ...]
    count: int  # candidates of each index per query
    nprobe: int | None = None  # cells of an inverted file searched per query; None: 1/32 of them, at least 16

    @property
    def candidates(self) -> int:
        return self.count * len(self.indexes)

    def find(self, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None) -> Ints:
        """Return the candidate rows (Q, C) int64 of each query (Q, sum of D), which may repeat; -1 pads missing ones.

        Only rows that are `allowed`, (N,), are returned; None: all.
        """
        selector = None if allowed is None else faiss.IDSelectorBitmap(np.packbits(allowed, bitorder="little"))
        found, end = [], 0
        for index in self.indexes:
            part, end = np.ascontiguousarray(query[:, end : end + index.d]), end + index.d
            count = min(self.count, index.ntotal)
            found.append(index.search(part, count, params=self._parameters(index, selector))[1])
        return np.hstack(found).astype(np.int64, copy=False)

    def _parameters(self, index: Any, selector: Any) -> Any:
        index = faiss.downcast_index(index)
        selection = {} if selector is None else {"sel": selector}
        if isinstance(index, faiss.IndexPreTransform):
            return faiss.SearchParametersPreTransform(index_params=self._parameters(index.index, selector))
        if isinstance(index, faiss.IndexIVF):
            nprobe = self.nprobe or max(16, index.nlist // 32)
            if isinstance(index, faiss.IndexIVFRaBitQ):
                return faiss.IVFRaBitQSearchParameters(nprobe=nprobe, qb=index.qb, **selection)
            return faiss.SearchParametersIVF(nprobe=nprobe, **selection)
        if isinstance(index, faiss.IndexHNSW):
            return faiss.SearchParametersHNSW(efSearch=max(self.count, index.hnsw.efSearch), **selection)
        return faiss.SearchParameters(**selection) if selection else None


def make_index(
    embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings, skip_existing: bool = True
) -> VectorIndex | None:
    """Build the index of a map, or read the current one; None if none is needed, see `load_index`.

    It is a file in the folder `index` beside that of the embeddings. Needs memory for it and for 1 GB of vectors. Raise
    ManifestError if FAISS has no such index, or cannot build it from N vectors; ValueError if a value is not finite.
    """
    for path, record, part in _files(embeddings, map_id, vectors, settings):
        if not (skip_existing and is_current(path, record)):
            index = _build(part, settings.index)
            fault = f"{path}: the map's index cannot be written"
            with write_atomic(path) as temporary, _faults(ToolkitError, fault, "Free some disk."):
                faiss.write_index(index, str(temporary))
            write_sidecar(path, record)
    return load_index(embeddings, map_id, vectors, settings)


def is_index_current(embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings) -> bool:
    """Tell whether the map's index is current, or none is needed."""
    return all(is_current(path, record) for path, record, _ in _files(embeddings, map_id, vectors, settings))


def load_index(embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings) -> VectorIndex | None:
    """Read the index that the retrieve stage built for a map; None for an exact search: if the settings say so, or if
    the map has no more vectors than the index has candidates, cells or PCA dimensions. Raise ArtifactError if the
    file is missing or damaged, or was made from other vectors.
    """
    indexes = [_open(*file, settings) for file in _files(embeddings, map_id, vectors, settings)]
    count = max(settings.index_candidates, settings.topk)
    return VectorIndex(tuple(indexes), count, settings.nprobe) if indexes else None


def _files(
    embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings
) -> list[tuple[Path, dict[str, Any], StoredVectors]]:
    """Return file, record and vectors of the index of each descriptor; none if the search is exact for one of them."""
    sizes = map(int, re.findall(r"(?:PCA|IVF)(\d+)", settings.index))  # dimensions and cells
    if settings.index == EXACT or len(vectors) <= max([settings.index_candidates, *sizes]):
        return []
    files = []
    for name, part in vectors.parts.items():
        identity = [matrix_fingerprints(part.paths), fingerprint(part.rows.tolist())]
        record = {"index": settings.index, "vectors": identity, "normalize": part.normalize}
        files.append((embeddings.parent / "index" / name / f"{map_id}.faiss", record, part))
    return files


def _open(path: Path, record: dict[str, Any], vectors: StoredVectors, settings: RetrieveSettings) -> Any:
    require_whole(path)
    with _faults(ArtifactError, f"{path}: the map's index cannot be read", "Retrieve again."):
        index = faiss.read_index(str(path))
    expected = fingerprint(record)
    stored = read_json(sidecar_path(path)).get("fingerprint", expected)
    if stored != expected or (index.ntotal, index.d) != (len(vectors.rows), vectors.dim):
        made_from = "the map's index was made from other embeddings, poses or settings"
        raise ArtifactError(f"{path}: {made_from}. Retrieve again.")
    if not settings.faiss_gpu:
        return index
    fault = f"faiss_gpu: the installed FAISS cannot put the index {settings.index} on a GPU"
    # faiss-cpu lacks classes that this function uses.
    with _faults(ToolkitError, fault, "Set faiss_gpu: false.", (AttributeError, NameError, RuntimeError)):
        return faiss.index_cpu_to_all_gpus(index)


@contextmanager
def _faults(
    kind: type[ToolkitError], fault: str, do: str, of: tuple[type[Exception], ...] = (RuntimeError,)
) -> Iterator[None]:
    """Raise errors of FAISS as errors of this kind, without the location in its source code."""
    try:
        yield
    except of as error:
        reason = re.sub(r"^Error in .* at \S+:\d+: (Error: )?", "", str(error).strip().splitlines()[-1])
        raise kind(f"{fault} ({reason}). {do}") from error


def _build(vectors: StoredVectors, factory: str) -> Any:
    count, every = len(vectors.rows), Vectors({"": vectors})
    # L2 ranks unit vectors as the dot product does, and the centering by PCA does not change it.
    metric = faiss.METRIC_L2 if vectors.normalize else faiss.METRIC_INNER_PRODUCT
    fault = f"retrieve.index: {factory!r} cannot hold vectors of {vectors.dim} dimensions"
    with _faults(ManifestError, fault, f"{EXACT} searches without an index."):
        index = faiss.index_factory(vectors.dim, factory, metric)
    fault = f"retrieve.index: {factory!r} cannot be built from {count} vectors of {vectors.dim} dimensions"
    do = f"Set index: {EXACT}, or index_candidates: {count}: neither builds an index."
    with _faults(ManifestError, fault, do):
        _train(index, every)
        for start, block in blocks(every, _BLOCK_BYTES):
            require_finite(block, "database", start)
            index.add(block)
    log.info("built index %s of %d vectors", factory, count)
    return index


def _train(index: Any, vectors: Vectors) -> None:
    """Train PCA, if the index starts with it, then the rest. Behind PCA vectors are shorter, so more fit in memory."""
    rng, pca = np.random.default_rng(0), list[Any]()
    last = index = faiss.downcast_index(index)

    def sample(dim: int, most: int) -> NDArray[np.float32]:
        count = min(len(vectors), most, _TRAIN_BYTES // (4 * dim))
        rows = np.sort(rng.choice(len(vectors), count, replace=False))
        samples = np.empty((count, dim), np.float32)
        for start, block in blocks(vectors.choose(rows), _BLOCK_BYTES):
            require_finite(block, "database", rows[start:])
            samples[start : start + len(block)] = pca[0].apply(block) if pca else block
        return samples

    if isinstance(index, faiss.IndexPreTransform):
        last, first = faiss.downcast_index(index.index), faiss.downcast_VectorTransform(index.chain.at(0))
        _train_pca(first, sample(first.d_in, _TRAIN_PER_UNIT * first.d_out))
        pca.append(first)
    if not last.is_trained:
        most = max(_TRAIN_PER_UNIT * last.nlist, _TRAIN_CODES) if isinstance(last, faiss.IndexIVF) else 1 << 20
        last.train(sample(last.d, most))
    index.is_trained = True


def _train_pca(pca: Any, rows: NDArray[np.float32]) -> None:
    """Train PCA by random projections: half a minute for 8,448 dimensions, far faster than FAISS's exact solution.

    N. Halko, P. G. Martinsson, J. A. Tropp, "Finding Structure with Randomness", SIAM Review 2011.
    """
    import torch  # here, because localizing without networks shall not wait a second for the import

    if min(rows.shape) < pca.d_out:
        raise RuntimeError(f"PCA to {pca.d_out} dimensions needs at least as many dimensions and vectors")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        _, lengths, directions = torch.pca_lowrank(torch.from_numpy(rows), q=pca.d_out, niter=2)
    faiss.copy_array_to_vector(rows.mean(axis=0), pca.mean)
    faiss.copy_array_to_vector((lengths**2 / len(rows)).numpy(), pca.eigenvalues)
    faiss.copy_array_to_vector(directions.T.contiguous().numpy().ravel(), pca.PCAMat)
    pca.prepare_Ab()
    pca.is_trained = True


_Vectors = NDArray[Any] | Vectors


# Search


def search(
    query: ArrayLike | Vectors,
    database: ArrayLike | Vectors,
    k: int,
    backend: Backend = "faiss",
    compute_device: str = "cpu",
    faiss_gpu: bool = False,
    index: VectorIndex | None = None,
    allowed: NDArray[np.bool_] | Masks | None = None,
    dims: Sequence[int] = (),
) -> Found:
    """Return the database rows with the largest dot products, best first; ties in order of the row.

    The database is read in blocks, once per 512 MB of queries. The backend finds candidates; their scores are then
    recomputed in the same way for all backends, so the result does not depend on the backend.

    Args:
        query, database: (Q, D) and (N, D), any float type; `Vectors` and memory-mapped arrays stay on disk.
        k: neighbors per query; at most N are returned.
        backend: `faiss`, `torch` or, for few queries, `numpy`, which loads neither of them.
        compute_device: where torch computes: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        faiss_gpu: let faiss compute on the GPU (needs a faiss built for it).
        index: index of the database; it replaces the backend in finding candidates, and may miss neighbors.
        allowed: (N,) rows of the database that may be returned, or a mask per query; None: all. With a mask per query
            and no index, torch computes in place of faiss.
        dims: number of columns of each descriptor, in order, if a row holds several side by side. Their similarities
            are fused, by torch in place of faiss, see `fuse`. Empty: one descriptor.

    Returns:
        Scores (Q, K) float32 and rows (Q, K) int64, K = min(k, N); -inf and -1 if fewer rows are allowed, or the index
        found fewer.

    Raises:
        ValueError: shapes do not fit, k is below 1, or a value that is compared is not finite.
    """
    query, vectors = _matrix(query, "query"), _matrix(database, "database")
    if query.shape[1] != vectors.shape[1]:
        raise ValueError(f"query has {query.shape[1]} dimensions, the database {vectors.shape[1]}.")
    if dims and sum(dims) != query.shape[1]:
        raise ValueError(f"dims is {list(dims)}; expected a sum of {query.shape[1]}.")
    if k < 1:
        raise ValueError(f"k is {k}; expected at least 1.")
    k = min(k, len(vectors))
    scores, indices = np.full((len(query), k), -np.inf, np.float32), np.full((len(query), k), -1, np.int64)
    masks = allowed if isinstance(allowed, Masks) else None
    if masks is not None and (len(masks), masks.count) != (len(query), len(vectors)):
        raise ValueError(f"{len(masks)} masks of {masks.count} rows for {len(query)} queries and {len(vectors)} rows.")
    if isinstance(allowed, np.ndarray) and allowed.shape != (len(vectors),):
        raise ValueError(f"allowed has shape {allowed.shape}; expected ({len(vectors)},), one value per database row.")
    if masks is not None and k and (index is not None or backend == "numpy"):  # reads no row that a mask excludes
        for numbers, mask in masks.distinct():
            found = search(_choose(query, numbers), vectors, k, backend, compute_device, faiss_gpu, index, mask, dims)
            scores[numbers], indices[numbers] = found
        return scores, indices
    # An index visits cells near the query, whether allowed or not: with few allowed rows it would find almost none.
    if isinstance(allowed, np.ndarray) and (index is None or np.count_nonzero(allowed) <= index.candidates):
        rows = np.flatnonzero(allowed)
        if len(rows):
            found = search(query, _choose(vectors, rows), k, backend, compute_device, faiss_gpu, dims=dims)
            scores[:, : len(rows)], indices[:, : len(rows)] = found[0], rows[found[1]]
        return scores, indices
    for start, block in blocks(query, _QUERY_BYTES) if k else ():
        require_finite(block, "query", start)
        here = slice(start, start + len(block))
        if index is not None:
            mask = allowed if isinstance(allowed, np.ndarray) else None
            _rank_candidates(block, vectors, index.find(block, mask), scores[here], indices[here], dims)
            continue
        make = partial(_backend, backend=backend, compute_device=compute_device, faiss_gpu=faiss_gpu, dims=dims)
        own = None if masks is None else masks.choose(here)
        _search_block(block, vectors, make, own, scores[here], indices[here], dims)
    return scores, indices


def _choose(vectors: _Vectors, rows: Ints) -> _Vectors:
    return vectors.choose(rows) if isinstance(vectors, Vectors) else vectors[rows]


def fuse(similarities: Sequence[Any]) -> Any:
    """Return the generalized harmonic mean of n similarities (arrays or tensors of one shape), in the same shape.

    The mean is 1 / mean(1 / (gamma + s / n)) - gamma with gamma = 0.5, as in kapture-localization and the LaMAR
    benchmark: M. Humenberger et al., "Investigating the Role of Image Retrieval for Visual Localization", IJCV 2022,
    after G. Csurka and S. Clinchant, "An Empirical Study of Fusion Operators for Multimodal Image Retrieval", CBMI
    2012. It increases with each similarity, and is 1 / n if all are 1. If one descriptor has similarity 0 to all rows
    (an image without structure), the other descriptors decide the order. At and below the pole, -n / 2, which only
    vectors longer than 1 reach, the mean is -gamma.
    """
    count = len(similarities)
    with np.errstate(divide="ignore"):
        return count / sum(1 / (_GAMMA + scores / count).clip(min=0) for scores in similarities) - _GAMMA


def fused_products(query: Any, vectors: Any, dims: Sequence[int], product: Callable[[Any, Any], Any]) -> Any:
    """Return the products of queries (..., D) and vectors (..., D), fused if there are several descriptors."""
    if len(dims) < 2:
        return product(query, vectors)
    ends = np.cumsum(dims).tolist()
    cuts = [slice(end - dim, end) for dim, end in zip(dims, ends, strict=True)]
    return fuse([product(query[..., cut], vectors[..., cut]) for cut in cuts])


def _search_block(
    query: _Floats,
    vectors: _Vectors,
    make_backend: Callable[[_Floats, Masks | None], _Best],
    masks: Masks | None,
    scores: _Floats,
    indices: Ints,
    dims: Sequence[int],
) -> None:
    """Fill in scores and indices (Q, K) of queries that fit in memory."""
    count, k = len(vectors), scores.shape[1]
    lengths = np.linalg.norm(query, axis=1)
    # All rows are equally similar to a zero vector, the descriptor of an image without features.
    for number in np.flatnonzero(lengths == 0):
        rows = np.arange(k) if masks is None else np.flatnonzero(masks.choose(slice(number, number + 1)).rows(0, count))
        scores[number, : len(rows)], indices[number, : len(rows)] = 0, rows[:k]
    pending, width = np.flatnonzero(lengths), min(count, k + _EXTRA)
    size = _BLOCK_BYTES if masks is None else min(_BLOCK_BYTES, 4 * query.shape[1] * _MASKED_ROWS)
    while len(pending):
        chosen = query if len(pending) == len(query) else query[pending]
        find = make_backend(chosen, None if masks is None else masks.choose(pending))
        rough, candidates, longest = _candidates(vectors, find, len(pending), width, size)
        tolerance = _tolerance(longest * lengths[pending], dims)
        # If the last candidate scores clearly below rank k, no neighbor was lost to rounding in the backend.
        done = (rough[:, -1] < rough[:, k - 1] - tolerance) | (width == count) | np.isneginf(rough[:, -1])
        near = (rough >= (rough[:, k - 1] - 2 * tolerance)[:, None]) & (rough > -np.inf)
        rows, of_rows = pending[done], candidates[done]
        exact = _rescored(query[rows], vectors, of_rows, near[done], dims)
        best = np.lexsort((of_rows, -exact), axis=1)[:, :k]
        scores[rows], indices[rows] = np.take_along_axis(exact, best, 1), np.take_along_axis(of_rows, best, 1)
        indices[np.isneginf(scores)] = -1
        pending, width = pending[~done], min(count, 4 * width)


def _tolerance(product_of_lengths: Any, dims: Sequence[int]) -> Any:
    """Return the largest rounding error of a score. Fusing adds rounding of its own, but never amplifies."""
    return 1e-5 * (product_of_lengths + (len(dims) > 1))


def _rank_candidates(
    query: _Floats, vectors: _Vectors, candidates: Ints, scores: _Floats, indices: Ints, dims: Sequence[int]
) -> None:
    """Fill in scores and indices (Q, K) of the best candidates (Q, C) of each query; -1 is no candidate."""
    for number, vector in enumerate(query):
        rows = np.unique(candidates[number])  # in the order of the file
        rows = rows[rows >= 0]
        if not len(rows):
            continue
        block, k = np.asarray(vectors[rows], np.float32), min(scores.shape[1], len(rows))
        rough = fused_products(vector, block, dims, lambda a, b: b @ a)
        tolerance = _tolerance(np.linalg.norm(block, axis=1).max() * np.linalg.norm(vector), dims)
        near = rough >= np.partition(rough, -k)[-k] - 2 * tolerance
        exact = _products(np.broadcast_to(vector, (int(near.sum()), len(vector))), block[near], dims)
        best = np.lexsort((rows[near], -exact))[:k]
        scores[number, :k], indices[number, :k] = exact[best], rows[near][best]


def _products(query: _Floats, vectors: _Floats, dims: Sequence[int]) -> _Floats:
    """Return the row by row dot products (n,) of two (n, D) arrays, summed and fused in float64."""
    wide = query.astype(np.float64), vectors.astype(np.float64)
    fused: NDArray[np.float64] = fused_products(*wide, dims, partial(np.einsum, "nd,nd->n"))
    return fused.astype(np.float32)


def _matrix(values: ArrayLike | Vectors, name: str) -> _Vectors:
    if isinstance(values, Vectors):
        return values
    matrix = np.asarray(values)  # stays on disk if it is memory-mapped; converted by the rows that are read
    if matrix.ndim != 2:
        raise ValueError(f"{name} has shape {matrix.shape}; expected two dimensions, one row per vector.")
    return matrix


def _candidates(vectors: _Vectors, best: _Best, queries: int, width: int, size: int) -> tuple[_Floats, Ints, float]:
    """Return the `width` best scores and rows (Q, width), best first up to rounding, and the length of the longest
    vector, by the backend, in blocks of `size` bytes.
    """
    scores, indices = np.zeros((queries, 0), np.float32), np.zeros((queries, 0), np.int64)
    longest = 0.0
    for start, block in blocks(vectors, size):
        length = float(np.sqrt(np.einsum("nd,nd->n", block, block).max()))
        if not np.isfinite(length):
            require_finite(block, "database", start)
        longest = max(longest, length)
        block_scores, block_rows = best(block, start, min(width, len(block)))
        scores, indices = np.hstack([scores, block_scores]), np.hstack([indices, block_rows + start])
        order = np.argsort(-scores, axis=1, kind="stable")[:, :width]
        scores, indices = np.take_along_axis(scores, order, 1), np.take_along_axis(indices, order, 1)
    return scores, indices, longest


def _rescored(
    query: _Floats, vectors: _Vectors, candidates: Ints, near: NDArray[np.bool_], dims: Sequence[int]
) -> _Floats:
    """Return the exact scores (Q, C) of the candidates `near` enough to be among the best; -inf for the others."""
    exact = np.full(candidates.shape, -np.inf, np.float32)
    pending, rank = np.nonzero(near)
    order = np.argsort(candidates[pending, rank], kind="stable")  # in the order of the file
    step = max(1, _BLOCK_BYTES // (16 * query.shape[1]))
    for start in range(0, len(order), step):
        part = order[start : start + step]
        rows, where = np.unique(candidates[pending[part], rank[part]], return_inverse=True)
        read = np.asarray(vectors[rows], np.float32)[where]
        exact[pending[part], rank[part]] = _products(query[pending[part]], read, dims)
    return exact


def _backend(
    query: _Floats, masks: Masks | None, backend: Backend, compute_device: str, faiss_gpu: bool, dims: Sequence[int]
) -> _Best:
    """Return the function that searches a block of the database for the queries."""
    if backend not in get_args(Backend):
        raise ValueError(f"Unknown backend {backend!r}; expected {', '.join(get_args(Backend))}.")
    if backend == "numpy":
        return partial(_best_by_numpy, query, dims)
    if backend == "torch" or len(dims) > 1 or masks is not None:
        return _torch_backend(query, masks, compute_device, dims)
    if not faiss_gpu:
        return lambda block, _, number: faiss.knn(query, block, number, metric=faiss.METRIC_INNER_PRODUCT)
    if not hasattr(faiss, "StandardGpuResources"):
        raise ToolkitError("faiss_gpu is set, but the installed faiss has no GPU support. Set faiss_gpu: false.")
    gpu = faiss.StandardGpuResources()
    return lambda block, _, number: faiss.knn_gpu(gpu, query, block, number, metric=faiss.METRIC_INNER_PRODUCT)


def _best_by_numpy(query: _Floats, dims: Sequence[int], block: _Floats, start: int, number: int) -> Found:
    scores = fused_products(query, block, dims, lambda a, b: a @ b.T)
    rows = np.argsort(-scores, axis=1, kind="stable")[:, :number]
    return np.take_along_axis(scores, rows, 1), rows


def _torch_backend(query: _Floats, masks: Masks | None, compute_device: str, dims: Sequence[int]) -> _Best:
    import torch

    device = resolve_device(compute_device)
    queries = torch.from_numpy(query).to(device)

    def find(block: _Floats, start: int, number: int) -> Found:
        rows = torch.from_numpy(block).to(device)
        scores, indices = np.full((len(query), number), -np.inf, np.float32), np.zeros((len(query), number), np.int64)
        step = max(1, _QUERY_BYTES // (4 * len(block) * (len(dims) + 2)))
        for first in range(0, len(query), step):
            part: slice | Ints = slice(first, min(first + step, len(query)))
            allowed = None if masks is None else masks.choose(part).rows(start, start + len(block))
            if allowed is not None:
                some = allowed.any(axis=1)
                part, allowed = first + np.flatnonzero(some), allowed[some]
                if not len(part):
                    continue
            products = fused_products(queries[part], rows, dims, lambda a, b: a @ b.T)
            if allowed is not None:
                products.masked_fill_(torch.from_numpy(~allowed).to(device), -torch.inf)
            scores[part], indices[part] = (best.cpu().numpy() for best in products.topk(number))
        return scores, indices

    return find
