"""Candidates among more global descriptors than are to be compared one by one, by FAISS's indexes.

An index holds vectors in fewer bytes, and looks at a part of them. What it finds is compared again by the vectors on
disk, see `search`.
"""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import faiss as typed_faiss
import numpy as np
from numpy.typing import NDArray

from toolkit.embedders.stored import JoinedVectors, StoredVectors, Vectors, blocks, made_of, require_finite
from toolkit.errors import ArtifactError, ManifestError, ToolkitError, first_line
from toolkit.files import (
    fingerprint,
    is_current,
    read_json,
    require_whole,
    sidecar_path,
    write_atomic,
    write_sidecar,
)  # fmt: skip
from toolkit.geometry import Ints
from toolkit.manifest import RetrieveSettings

log = logging.getLogger(__name__)
faiss: Any = typed_faiss  # its stubs lack much of it

EXACT = "Flat"
"""Factory string of the exact search, which needs no index."""
_BLOCK_BYTES = 128 << 20
_TRAIN_BYTES = 1 << 30
"""Of vectors, in float32, that are in memory: those that are added at a time, those that an index is trained with."""
_PER_PART = 64
"""Vectors that each dimension of PCA and each cell of an inverted file is trained with, if there are so many."""
_OF_CODES = 1 << 16
"""Vectors that codes are trained with at least, however few cells there are; a PQ cannot do with less than 256."""


@dataclass(frozen=True)
class VectorIndex:
    """A FAISS index of N vectors."""

    index: Any
    candidates: int
    """How many are found for each query."""
    nprobe: int | None = None
    """Cells of an inverted file that are looked at; None: a 32nd of them, at least 16."""

    def find(self, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None) -> Ints:
        """Return for each query (Q, D) the rows of candidates (Q, C) int64, -1 where there are fewer.

        Args:
            allowed: (N,) the rows that may be found; None: all.
        """
        number = min(self.candidates, self.index.ntotal)
        if allowed is None:
            return self._search(query, number)
        try:
            return self._search(query, number, faiss.IDSelectorBitmap(np.packbits(allowed, bitorder="little")))
        except RuntimeError:  # LSH, PQ, NSG, and others know no selection
            return self._selected(query, number, allowed)

    def _search(self, query: NDArray[np.float32], number: int, selector: Any = None) -> Ints:
        _, rows = self.index.search(query, number, params=self._parameters(self.index, selector))
        return np.asarray(rows, np.int64)

    def _selected(self, query: NDArray[np.float32], number: int, allowed: NDArray[np.bool_]) -> Ints:
        """Return what `find` does, of an index that finds allowed rows only among all."""
        found = np.full((len(query), number), -1, np.int64)
        for row, one in zip(found, query[:, None], strict=True):
            wanted = number
            while True:
                rows = self._search(one, wanted)[0]
                rows = rows[(rows >= 0) & allowed[rows]][:number]
                if len(rows) == number or wanted == self.index.ntotal:
                    break
                wanted = min(4 * wanted, self.index.ntotal)
            row[: len(rows)] = rows
        return found

    def _parameters(self, index: Any, selector: Any) -> Any:
        index = faiss.downcast_index(index)
        chosen = {} if selector is None else {"sel": selector}
        if isinstance(index, faiss.IndexPreTransform):
            return faiss.SearchParametersPreTransform(index_params=self._parameters(index.index, selector))
        if isinstance(index, faiss.IndexRefine):
            base = self._parameters(index.base_index, selector)
            return faiss.IndexRefineSearchParameters(k_factor=index.k_factor, base_index_params=base)
        if isinstance(index, faiss.IndexIVF):
            nprobe = self.nprobe or max(16, index.nlist // 32)
            if isinstance(index, faiss.IndexIVFRaBitQ):
                return faiss.IVFRaBitQSearchParameters(nprobe=nprobe, qb=index.qb, **chosen)
            return faiss.SearchParametersIVF(nprobe=nprobe, **chosen)
        if isinstance(index, faiss.IndexHNSW):
            return faiss.SearchParametersHNSW(efSearch=max(self.candidates, index.hnsw.efSearch), **chosen)
        return faiss.SearchParameters(**chosen) if chosen else None


@dataclass(frozen=True)
class JoinedIndex:
    """The indexes of several descriptors of the same images, side by side: each finds candidates."""

    parts: tuple[VectorIndex, ...]
    dims: tuple[int, ...]

    @property
    def candidates(self) -> int:
        return sum(part.candidates for part in self.parts)

    def find(self, query: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None) -> Ints:
        """Return for each query (Q, sum of D) what any of the indexes finds, (Q, C); rows may come twice."""
        queries = np.split(query, np.cumsum(self.dims)[:-1], axis=1)
        found = [part.find(np.ascontiguousarray(of), allowed) for part, of in zip(self.parts, queries, strict=True)]
        return np.hstack(found)


def make_index(
    embeddings: Path,
    map_id: str,
    vectors: Vectors,
    settings: RetrieveSettings,
    skip_existing: bool = True,
) -> VectorIndex | JoinedIndex | None:
    """Return the index of a map, made if it is not there; None where none is needed, see `load_index`.

    Memory is taken for the index and for 1 GB of vectors.

    Args:
        embeddings: folder of the embeddings; the index is a file in `index` beside it, of each of several descriptors
            one in a folder of its name.
        map_id: the map session.
        vectors: (N, D) of the map.
        skip_existing: take the file if it is of these vectors.

    Raises:
        ManifestError: there is no such index, or it cannot be made of so many vectors.
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
    vectors: JoinedVectors, of_one: Callable[[str, StoredVectors], VectorIndex | JoinedIndex | None], map_id: str
) -> JoinedIndex | None:
    """Return the indexes of all descriptors, or None if one of them needs none."""
    parts = [of_one(f"{name}/{map_id}", part) for name, part in vectors.parts.items()]
    single = tuple(part for part in parts if isinstance(part, VectorIndex))
    return JoinedIndex(single, vectors.dims) if len(single) == len(parts) else None


def is_made(embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings) -> bool:
    """Tell whether `load_index` finds what it looks for."""
    if isinstance(vectors, JoinedVectors):
        parts = vectors.parts.items()
        return all(is_made(embeddings, f"{name}/{map_id}", part, settings) for name, part in parts)
    needed = _is_needed(settings, vectors)
    return not needed or is_current(_index_path(embeddings, map_id), _record(vectors, settings))


def load_index(
    embeddings: Path, map_id: str, vectors: Vectors, settings: RetrieveSettings
) -> VectorIndex | JoinedIndex | None:
    """Return the index that the retrieve stage made of the vectors of a map; None if the settings ask for none.

    A map of no more vectors than candidates, cells or dimensions of PCA needs none either.

    Raises:
        ArtifactError: it is missing or damaged, or of other vectors.
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
    wanted = fingerprint(record)
    found = read_json(sidecar_path(path)).get("fingerprint", wanted)
    if found != wanted or (index.ntotal, index.d) != vectors.shape:
        raise ArtifactError(f"{path}: the map's index is of other embeddings, poses or settings. Retrieve again.")
    if settings.faiss_gpu:
        index = _on_gpu(index, settings.index)
    return VectorIndex(index, max(settings.index_candidates, settings.topk), settings.nprobe)


def _is_needed(settings: RetrieveSettings, vectors: StoredVectors) -> bool:
    if settings.index == EXACT:
        return False
    empty = _empty(vectors, settings.index)  # is to live as long as what `downcast_index` returns
    index = faiss.downcast_index(empty)
    trained_with = [settings.index_candidates]
    if isinstance(index, faiss.IndexPreTransform):
        trained_with += [index.chain.at(number).d_out for number in range(index.chain.size())]
        index = faiss.downcast_index(index.index)
    if isinstance(index, faiss.IndexIVF):
        trained_with.append(index.nlist)
    return len(vectors) > max(trained_with)


def check_factory(factory: str) -> None:
    """Refuse a string that FAISS's index factory cannot make an index of for vectors of any usual length.

    Raises:
        ManifestError: naming the string.
    """
    said = []
    for dim in () if factory == EXACT else (8448, 15360, 512):  # MegaLoc, a length that most numbers divide, VLAD
        try:
            faiss.index_factory(dim, factory)
        except RuntimeError as error:
            said.append(_said(error))
        else:
            return
    if said:
        raise ManifestError(
            f"retrieve.index: found {factory!r} ({said[0]}). Expected a string of FAISS's index factory, such as "
            f"PCA512,IVF4096,RaBitQ; {EXACT} needs no index."
        )


def _empty(vectors: StoredVectors, factory: str) -> Any:
    # Of vectors of length 1 the nearest have the largest product, and centering by PCA does not change distances.
    metric = faiss.METRIC_L2 if vectors.normalize else faiss.METRIC_INNER_PRODUCT
    try:
        return faiss.index_factory(vectors.dim, factory, metric)
    except RuntimeError as error:
        raise ManifestError(
            f"retrieve.index: {factory!r} cannot hold vectors of {vectors.dim} dimensions ({_said(error)}). Expected "
            f"a string of FAISS's index factory, such as PCA512,IVF4096,RaBitQ; {EXACT} needs no index."
        ) from error


def _record(vectors: StoredVectors, settings: RetrieveSettings) -> dict[str, Any]:
    rows = fingerprint(vectors.rows.tolist())
    return {"index": settings.index, "vectors": [made_of(vectors.paths), rows], "normalize": vectors.normalize}


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
            f"retrieve.index: {factory!r} cannot be made of {count} vectors of {dim} dimensions ({_said(error)}). "
            f"{EXACT} needs no index, nor does this map with index_candidates: {count}."
        ) from error
    log.info("index %s of %d vectors is made", factory, count)
    return index


def _write(path: Path, index: Any) -> None:
    with write_atomic(path) as temporary:
        try:
            faiss.write_index(index, str(temporary))
        except RuntimeError as error:
            raise ToolkitError(
                f"{path}: the map's index cannot be written ({_said(error)}). Free some space on the disk."
            ) from error


def _said(error: RuntimeError) -> str:
    """Return what FAISS says, without the name of its function."""
    return re.sub(r"^Error in .* at \S+:\d+: (Error: )?", "", str(error).strip().splitlines()[-1])


def _train(index: Any, vectors: StoredVectors) -> None:
    """Train the parts of an index one after the other: those that see fewer dimensions see more vectors."""
    rng = np.random.default_rng(0)
    index = faiss.downcast_index(index)
    applied = list[Callable[[NDArray[np.float32]], NDArray[np.float32]]]()

    def sample(dim: int, most: int) -> NDArray[np.float32]:
        number = min(len(vectors), most, _TRAIN_BYTES // (4 * dim))
        rows = np.sort(rng.choice(len(vectors), number, replace=False))
        taken = np.empty((number, dim), np.float32)
        for start, block in blocks(vectors.choose(rows), _BLOCK_BYTES):
            require_finite(block, "database", rows[start:])
            for apply in applied:
                block = apply(block)
            taken[start : start + len(block)] = block
        return taken

    if not isinstance(index, faiss.IndexPreTransform):
        _train_last(index, sample)
        return
    for number in range(index.chain.size()):
        transform = faiss.downcast_VectorTransform(index.chain.at(number))
        if not transform.is_trained:
            train = partial(_train_pca, transform) if isinstance(transform, faiss.PCAMatrix) else transform.train
            train(sample(transform.d_in, _PER_PART * transform.d_out))
        applied.append(transform.apply)
    _train_last(faiss.downcast_index(index.index), sample)
    index.is_trained = True


def _train_pca(pca: Any, rows: NDArray[np.float32]) -> None:
    """Train PCA by random projections, in half a minute for 8,448 dimensions: FAISS's exact solution takes far longer.

    N. Halko, P. G. Martinsson, J. A. Tropp, "Finding Structure with Randomness", SIAM Review 2011.
    """
    import torch  # a second of start-up, which localizing without networks does not need

    if min(rows.shape) < pca.d_out:
        raise RuntimeError(f"PCA to {pca.d_out} dimensions needs as many, and as many vectors")
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
        most = max(_PER_PART * index.nlist, _OF_CODES) if isinstance(index, faiss.IndexIVF) else 1 << 20
        index.train(sample(index.d, most))


def _on_gpu(index: Any, factory: str) -> Any:
    try:
        return faiss.index_cpu_to_all_gpus(index)
    except (AttributeError, NameError, RuntimeError) as error:  # faiss-cpu lacks what its own functions name
        raise ToolkitError(
            f"faiss_gpu: the installed FAISS cannot have the index {factory} on a GPU ({first_line(error)}). "
            "Set faiss_gpu: false."
        ) from error
