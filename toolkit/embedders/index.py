"""Approximate nearest neighbors with FAISS indexes, for maps too large to compare every vector.

An index compresses the vectors and compares a query with some of them only. `search` computes the exact scores of its
candidates from the vectors on disk.
"""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import faiss as typed_faiss
import numpy as np
from numpy.typing import NDArray

from toolkit.embedders.stored import JoinedVectors, StoredVectors, Vectors, blocks, matrix_fingerprints, require_finite
from toolkit.errors import ArtifactError, ManifestError, ToolkitError, first_line
from toolkit.files import fingerprint, is_current, read_json, require_whole, sidecar_path, write_atomic, write_sidecar
from toolkit.geometry import Ints
from toolkit.manifest import RetrieveSettings

log = logging.getLogger(__name__)
faiss: Any = typed_faiss  # its type stubs are incomplete

EXACT = "Flat"
"""Factory string of the exact search, which needs no index."""
_BLOCK_BYTES = 128 << 20
"""Vectors added to an index at a time, bytes of float32: bounds the memory."""
_TRAIN_BYTES = 1 << 30
"""Training vectors of an index, at most, bytes of float32."""
_TRAIN_PER_UNIT = 64
"""Training vectors per PCA dimension and per cell of an inverted file, if the map has as many."""
_TRAIN_CODES = 1 << 16
"""Training vectors of the codes, at least, however few cells there are; PQ needs 256 or more."""


@dataclass(frozen=True)
class VectorIndex:
    """A FAISS index of N vectors."""

    index: Any
    candidates: int
    """Candidates per query."""
    nprobe: int | None = None
    """Cells of an inverted file searched per query; None: 1/32 of them, at least 16."""

    def find(self, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None) -> Ints:
        """Return the candidate rows (Q, C) int64 of each query (Q, D); -1 pads missing candidates.

        Args:
            allowed: (N,) rows that may be returned; None: all.
        """
        count = min(self.candidates, self.index.ntotal)
        selector = None if allowed is None else faiss.IDSelectorBitmap(np.packbits(allowed, bitorder="little"))
        _, rows = self.index.search(query, count, params=self._parameters(self.index, selector))
        return np.asarray(rows, np.int64)

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
            return faiss.SearchParametersHNSW(efSearch=max(self.candidates, index.hnsw.efSearch), **selection)
        return faiss.SearchParameters(**selection) if selection else None


@dataclass(frozen=True)
class JoinedIndex:
    """One index per descriptor of the same images. Every index contributes candidates."""

    indexes: tuple[VectorIndex, ...]
    dims: tuple[int, ...]

    @property
    def candidates(self) -> int:
        return sum(index.candidates for index in self.indexes)

    def find(self, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None) -> Ints:
        """Return the candidate rows (Q, C) of all indexes for each query (Q, sum of D); rows may repeat."""
        queries = np.split(query, np.cumsum(self.dims)[:-1], axis=1)
        pairs = zip(self.indexes, queries, strict=True)
        return np.hstack([index.find(np.ascontiguousarray(columns), allowed) for index, columns in pairs])


def make_index(
    embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings, skip_existing: bool = True
) -> VectorIndex | JoinedIndex | None:
    """Build the index of a map, or read the current one; None if none is needed, see `load_index`.

    Needs memory for the index and for 1 GB of vectors.

    Args:
        embeddings: folder of the embeddings. The index is a file in the folder `index` beside it; with several
            descriptors, each has a subfolder with its name.
        map_id: the map session.
        vectors: (N, D) of the map.
        skip_existing: reuse the file if it was made from these vectors.

    Raises:
        ManifestError: FAISS has no such index, or cannot build it from N vectors.
        ValueError: a value is not finite.
    """
    if isinstance(vectors, JoinedVectors):
        return _join(vectors, lambda name, part: make_index(embeddings, name, part, settings, skip_existing), map_id)
    if not _is_needed(settings, vectors):
        return None
    path, record = _index_path(embeddings, map_id), _record(vectors, settings)
    if not (skip_existing and is_current(path, record)):
        _write(path, _build(vectors, settings.index))
        write_sidecar(path, record)
    return _open(path, record, vectors, settings)


def _join(
    vectors: JoinedVectors, open_one: Callable[[str, StoredVectors], VectorIndex | JoinedIndex | None], map_id: str
) -> JoinedIndex | None:
    """Return the indexes of all descriptors, or None if one of them needs none."""
    opened = [open_one(f"{name}/{map_id}", part) for name, part in vectors.parts.items()]
    indexes = tuple(index for index in opened if isinstance(index, VectorIndex))
    return JoinedIndex(indexes, vectors.dims) if len(indexes) == len(opened) else None


def is_index_current(embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings) -> bool:
    """Tell whether the map's index is current, or none is needed."""
    if isinstance(vectors, JoinedVectors):
        parts = vectors.parts.items()
        return all(is_index_current(embeddings, f"{name}/{map_id}", part, settings) for name, part in parts)
    needed = _is_needed(settings, vectors)
    return not needed or is_current(_index_path(embeddings, map_id), _record(vectors, settings))


def load_index(
    embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings
) -> VectorIndex | JoinedIndex | None:
    """Read the index that the retrieve stage built for a map; None for an exact search.

    The search is exact if the settings say so, or if the map has no more vectors than the index has candidates, cells
    or PCA dimensions.

    Raises:
        ArtifactError: the file is missing or damaged, or was made from other vectors.
    """
    if isinstance(vectors, JoinedVectors):
        return _join(vectors, lambda name, part: load_index(embeddings, name, part, settings), map_id)
    if not _is_needed(settings, vectors):
        return None
    return _open(_index_path(embeddings, map_id), _record(vectors, settings), vectors, settings)


def _open(path: Path, record: dict[str, Any], vectors: StoredVectors, settings: RetrieveSettings) -> VectorIndex:
    try:
        require_whole(path)
        index = faiss.read_index(str(path))
    except RuntimeError as error:
        raise ArtifactError(f"{path}: the map's index cannot be read ({first_line(error)}). Retrieve again.") from error
    expected = fingerprint(record)
    stored = read_json(sidecar_path(path)).get("fingerprint", expected)
    if stored != expected or (index.ntotal, index.d) != vectors.shape:
        raise ArtifactError(
            f"{path}: the map's index was made from other embeddings, poses or settings. Retrieve again."
        )
    if settings.faiss_gpu:
        index = _on_gpu(index, settings.index)
    return VectorIndex(index, max(settings.index_candidates, settings.topk), settings.nprobe)


def _is_needed(settings: RetrieveSettings, vectors: StoredVectors) -> bool:
    if settings.index == EXACT:
        return False
    empty = _empty(vectors, settings.index)  # owns what `downcast_index` returns: keep it alive
    index = faiss.downcast_index(empty)
    least = [settings.index_candidates]
    if isinstance(index, faiss.IndexPreTransform):
        least.append(index.chain.at(0).d_out)
        index = faiss.downcast_index(index.index)
    if isinstance(index, faiss.IndexIVF):
        least.append(index.nlist)
    return len(vectors) > max(least)


def _empty(vectors: StoredVectors, factory: str) -> Any:
    # L2 ranks unit vectors as the dot product does, and the centering by PCA does not change it.
    metric = faiss.METRIC_L2 if vectors.normalize else faiss.METRIC_INNER_PRODUCT
    try:
        return faiss.index_factory(vectors.dim, factory, metric)
    except RuntimeError as error:
        raise ManifestError(
            f"retrieve.index: {factory!r} cannot hold vectors of {vectors.dim} dimensions ({_reason(error)}). "
            f"{EXACT} searches without an index."
        ) from error


def _record(vectors: StoredVectors, settings: RetrieveSettings) -> dict[str, Any]:
    identity = [matrix_fingerprints(vectors.paths), fingerprint(vectors.rows.tolist())]
    return {"index": settings.index, "vectors": identity, "normalize": vectors.normalize}


def _index_path(embeddings: Path, map_id: str) -> Path:
    return embeddings.parent / "index" / f"{map_id}.faiss"


def _build(vectors: StoredVectors, factory: str) -> Any:
    count, dim = vectors.shape
    index = _empty(vectors, factory)
    try:
        _train(index, vectors)
        for start, block in blocks(vectors, _BLOCK_BYTES):
            require_finite(block, "database", start)
            index.add(block)
    except RuntimeError as error:
        raise ManifestError(
            f"retrieve.index: {factory!r} cannot be built from {count} vectors of {dim} dimensions ({_reason(error)}). "
            f"Set index: {EXACT}, or index_candidates: {count}: neither builds an index for this map."
        ) from error
    log.info("built index %s of %d vectors", factory, count)
    return index


def _write(path: Path, index: Any) -> None:
    with write_atomic(path) as temporary:
        try:
            faiss.write_index(index, str(temporary))
        except RuntimeError as error:
            raise ToolkitError(
                f"{path}: the map's index cannot be written ({_reason(error)}). Free some space on the disk."
            ) from error


def _reason(error: RuntimeError) -> str:
    """Return the message of a FAISS error without the location in its source code."""
    return re.sub(r"^Error in .* at \S+:\d+: (Error: )?", "", str(error).strip().splitlines()[-1])


def _train(index: Any, vectors: StoredVectors) -> None:
    """Train PCA, if the index starts with it, then the rest. Behind PCA vectors are shorter, so more fit in memory."""
    rng = np.random.default_rng(0)
    index = faiss.downcast_index(index)
    transforms = list[Callable[[NDArray[np.float32]], NDArray[np.float32]]]()

    def sample(dim: int, most: int) -> NDArray[np.float32]:
        count = min(len(vectors), most, _TRAIN_BYTES // (4 * dim))
        rows = np.sort(rng.choice(len(vectors), count, replace=False))
        samples = np.empty((count, dim), np.float32)
        for start, block in blocks(vectors.choose(rows), _BLOCK_BYTES):
            require_finite(block, "database", rows[start:])
            for apply in transforms:
                block = apply(block)
            samples[start : start + len(block)] = block
        return samples

    if not isinstance(index, faiss.IndexPreTransform):
        _train_last(index, sample)
        return
    pca = faiss.downcast_VectorTransform(index.chain.at(0))
    _train_pca(pca, sample(pca.d_in, _TRAIN_PER_UNIT * pca.d_out))
    transforms.append(pca.apply)
    _train_last(faiss.downcast_index(index.index), sample)
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


def _train_last(index: Any, sample: Callable[[int, int], NDArray[np.float32]]) -> None:
    if not index.is_trained:
        most = max(_TRAIN_PER_UNIT * index.nlist, _TRAIN_CODES) if isinstance(index, faiss.IndexIVF) else 1 << 20
        index.train(sample(index.d, most))


def _on_gpu(index: Any, factory: str) -> Any:
    try:
        return faiss.index_cpu_to_all_gpus(index)
    except (AttributeError, NameError, RuntimeError) as error:  # faiss-cpu lacks classes that this function uses
        raise ToolkitError(
            f"faiss_gpu: the installed FAISS cannot put the index {factory} on a GPU ({first_line(error)}). "
            "Set faiss_gpu: false."
        ) from error
