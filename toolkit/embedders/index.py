"""Approximate nearest neighbors with FAISS indexes, for maps too large to compare every vector.

An index compresses the vectors and compares a query with some of them only. `search` computes the exact scores of its
candidates from the vectors on disk.
"""

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import faiss as typed_faiss
import numpy as np
from numpy.typing import NDArray

from toolkit.embedders.stored import StoredVectors, Vectors, blocks, matrix_fingerprints, require_finite
from toolkit.errors import ArtifactError, ManifestError, ToolkitError, first_line
from toolkit.files import fingerprint, is_current, read_json, require_whole, sidecar_path, write_atomic, write_sidecar
from toolkit.geometry import Ints
from toolkit.manifest import RetrieveSettings

log = logging.getLogger(__name__)
faiss: Any = typed_faiss  # its type stubs are incomplete

EXACT = "Flat"  # factory string of the exact search, which needs no index
_BLOCK_BYTES = 128 << 20  # vectors added to an index at a time, bytes of float32: bounds the memory
_TRAIN_BYTES = 1 << 30  # training vectors of an index, at most, bytes of float32
_TRAIN_PER_UNIT = 64  # training vectors per PCA dimension and per cell of an inverted file, if the map has as many
_TRAIN_CODES = 1 << 16  # training vectors of the codes, at least, however few cells there are; PQ needs 256 or more


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
            _write(path, _build(part, settings.index))
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
    return (
        VectorIndex(tuple(indexes), max(settings.index_candidates, settings.topk), settings.nprobe) if indexes else None
    )


def _files(
    embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings
) -> list[tuple[Path, dict[str, Any], StoredVectors]]:
    """Return file, record and vectors of the index of each descriptor; none if the search is exact for one of them."""
    if not all(_is_needed(settings, part) for part in vectors.parts.values()):
        return []
    files = []
    for name, part in vectors.parts.items():
        identity = [matrix_fingerprints(part.paths), fingerprint(part.rows.tolist())]
        record = {"index": settings.index, "vectors": identity, "normalize": part.normalize}
        files.append((embeddings.parent / "index" / name / f"{map_id}.faiss", record, part))
    return files


def _open(path: Path, record: dict[str, Any], vectors: StoredVectors, settings: RetrieveSettings) -> Any:
    try:
        require_whole(path)
        index = faiss.read_index(str(path))
    except RuntimeError as error:
        raise ArtifactError(f"{path}: the map's index cannot be read ({first_line(error)}). Retrieve again.") from error
    expected = fingerprint(record)
    stored = read_json(sidecar_path(path)).get("fingerprint", expected)
    if stored != expected or (index.ntotal, index.d) != (len(vectors.rows), vectors.dim):
        made_from = "the map's index was made from other embeddings, poses or settings"
        raise ArtifactError(f"{path}: {made_from}. Retrieve again.")
    if not settings.faiss_gpu:
        return index
    try:
        return faiss.index_cpu_to_all_gpus(index)
    except (AttributeError, NameError, RuntimeError) as error:  # faiss-cpu lacks classes that this function uses
        fault = f"the installed FAISS cannot put the index {settings.index} on a GPU ({first_line(error)})"
        raise ToolkitError(f"faiss_gpu: {fault}. Set faiss_gpu: false.") from error


def _is_needed(settings: RetrieveSettings, vectors: StoredVectors) -> bool:
    sizes = map(int, re.findall(r"(?:PCA|IVF)(\d+)", settings.index))  # dimensions and cells
    return settings.index != EXACT and len(vectors.rows) > max([settings.index_candidates, *sizes])


def _empty(vectors: StoredVectors, factory: str) -> Any:
    # L2 ranks unit vectors as the dot product does, and the centering by PCA does not change it.
    metric = faiss.METRIC_L2 if vectors.normalize else faiss.METRIC_INNER_PRODUCT
    try:
        return faiss.index_factory(vectors.dim, factory, metric)
    except RuntimeError as error:
        fault = f"{factory!r} cannot hold vectors of {vectors.dim} dimensions ({_reason(error)})"
        raise ManifestError(f"retrieve.index: {fault}. {EXACT} searches without an index.") from error


def _build(vectors: StoredVectors, factory: str) -> Any:
    count, index, every = len(vectors.rows), _empty(vectors, factory), Vectors({"": vectors})
    try:
        _train(index, every)
        for start, block in blocks(every, _BLOCK_BYTES):
            require_finite(block, "database", start)
            index.add(block)
    except RuntimeError as error:
        fault = f"{factory!r} cannot be built from {count} vectors of {vectors.dim} dimensions ({_reason(error)})"
        raise ManifestError(
            f"retrieve.index: {fault}. Set index: {EXACT}, or index_candidates: {count}: neither builds an index."
        ) from error
    log.info("built index %s of %d vectors", factory, count)
    return index


def _write(path: Path, index: Any) -> None:
    with write_atomic(path) as temporary:
        try:
            faiss.write_index(index, str(temporary))
        except RuntimeError as error:
            raise ToolkitError(
                f"{path}: the map's index cannot be written ({_reason(error)}). Free some disk."
            ) from error


def _reason(error: RuntimeError) -> str:
    """Return the message of a FAISS error without the location in its source code."""
    return re.sub(r"^Error in .* at \S+:\d+: (Error: )?", "", str(error).strip().splitlines()[-1])


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
