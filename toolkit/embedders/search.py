"""Exact nearest neighbors among global descriptors: candidates by FAISS, torch or an index, then exact scores."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.masks import Masks
from toolkit.embedders.index import VectorIndex
from toolkit.embedders.stored import Vectors, blocks, require_finite
from toolkit.errors import ToolkitError
from toolkit.geometry import Ints
from toolkit.models.compute import resolve_device

Backend = Literal["faiss", "torch"]
_BLOCK_BYTES = 128 << 20  # database rows read at a time, bytes of float32
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
_Vectors = NDArray[Any] | Vectors


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
        backend: `faiss` or `torch`.
        compute_device: where torch computes: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        faiss_gpu: let faiss compute on the GPU (needs a faiss built for it).
        index: index of the database; it replaces the backend in finding candidates, and may miss neighbors.
        allowed: (N,) rows of the database that may be returned, or a mask per query; None: all. With a mask per query
            and no index, torch computes in place of faiss.
        dims: number of columns of each descriptor, in order, if a row holds several side by side. Their similarities
            are fused by torch, whatever the backend, see `fuse`. Empty: one descriptor.

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
    if masks is not None and index is not None and k:
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


def _fused(query: Any, vectors: Any, dims: Sequence[int], product: Callable[[Any, Any], Any]) -> Any:
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
        rough = _fused(vector, block, dims, lambda a, b: b @ a)
        tolerance = _tolerance(np.linalg.norm(block, axis=1).max() * np.linalg.norm(vector), dims)
        near = rough >= np.partition(rough, -k)[-k] - 2 * tolerance
        exact = _products(np.broadcast_to(vector, (int(near.sum()), len(vector))), block[near], dims)
        best = np.lexsort((rows[near], -exact))[:k]
        scores[number, :k], indices[number, :k] = exact[best], rows[near][best]


def _products(query: _Floats, vectors: _Floats, dims: Sequence[int]) -> _Floats:
    """Return the row by row dot products (n,) of two (n, D) arrays, summed and fused in float64."""
    wide = query.astype(np.float64), vectors.astype(np.float64)
    fused: NDArray[np.float64] = _fused(*wide, dims, partial(np.einsum, "nd,nd->n"))
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
    if backend not in ("faiss", "torch"):
        raise ValueError(f"Unknown backend {backend!r}; expected faiss or torch.")
    if backend == "torch" or len(dims) > 1 or masks is not None:
        return _torch_backend(query, masks, compute_device, dims)
    import faiss

    if not faiss_gpu:
        return lambda block, _, number: faiss.knn(query, block, number, metric=faiss.METRIC_INNER_PRODUCT)
    if not hasattr(faiss, "StandardGpuResources"):
        raise ToolkitError("faiss_gpu is set, but the installed faiss has no GPU support. Set faiss_gpu: false.")
    gpu = faiss.StandardGpuResources()
    return lambda block, _, number: faiss.knn_gpu(gpu, query, block, number, metric=faiss.METRIC_INNER_PRODUCT)


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
            products = _fused(queries[part], rows, dims, lambda a, b: a @ b.T)
            if allowed is not None:
                products.masked_fill_(torch.from_numpy(~allowed).to(device), -torch.inf)
            scores[part], indices[part] = (best.cpu().numpy() for best in products.topk(number))
        return scores, indices

    return find
