"""Exact nearest neighbors among global descriptors, by whatever library is quick at it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.masks import Masks
from toolkit.embedders.index import JoinedIndex, VectorIndex
from toolkit.embedders.stored import Vectors, blocks, require_finite
from toolkit.errors import ToolkitError
from toolkit.geometry import Ints
from toolkit.models.compute import resolve_device

Backend = Literal["faiss", "torch"]
_BLOCK_BYTES = 128 << 20
"""Of the rows of the database, in float32, that are in memory at a time."""
_QUERY_BYTES = 512 << 20
"""Of the queries, in float32, that one pass over the database is for."""
_PRODUCTS = 1 << 23
"""Of queries that have masks and rows of the database, that are in memory at a time."""
_MASKED_ROWS = 1 << 12
"""Of the database, in memory at a time where queries have masks: of so few, most queries find none, if masks leave
parts of recordings."""
_MORE = 16
"""Candidates beyond k: the backend's rounding may exchange neighbors in rank."""
_GAMMA = 0.5
"""Of the generalized harmonic mean. With it no similarity of n >= 2 unit vectors is below its pole, -n/2."""

Found = tuple[NDArray[np.float32], Ints]
_Best = Callable[[NDArray[np.float32], int, int], Found]
"""Finds in a block of the database, which begins at a row, for each query so many of the best."""
_Vectors = NDArray[np.float32] | Vectors


def search(
    query: ArrayLike | Vectors,
    database: ArrayLike | Vectors,
    k: int,
    backend: Backend = "faiss",
    compute_device: str = "cpu",
    faiss_gpu: bool = False,
    index: VectorIndex | JoinedIndex | None = None,
    allowed: NDArray[np.bool_] | Masks | None = None,
    dims: Sequence[int] = (),
) -> Found:
    """Return the rows of the database with the largest dot products, best first; equal ones by index.

    The database is read in blocks, once for as many queries as fit in 512 MB. The backend finds candidates; their
    scores are then computed alike for all backends, so that the result does not depend on it.

    Args:
        query, database: (Q, D) and (N, D), any float type; `StoredVectors` and `JoinedVectors` stay on disk.
        k: how many; at most N are returned.
        backend: `faiss` or `torch`.
        compute_device: where torch computes: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        faiss_gpu: let faiss compute on the GPU (needs a faiss built for it).
        index: of the database; finds the candidates instead of the backend. What it misses is missing.
        allowed: (N,) which rows of the database may be found, or masks of each query; None: all. With masks of each,
            faiss without an index leaves the products to NumPy, on the CPU.
        dims: of several descriptors side by side in each row, how many of the D columns each has, in order: their
            products are fused, see `fuse`, by torch whatever the backend. Empty: one.

    Returns:
        Scores (Q, K) float32 and indices (Q, K) int64, K = min(k, N); -inf and -1 where an index found no more, or no
        more are allowed.

    Raises:
        ValueError: shapes do not fit, k is below 1, or a value is not finite.
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
    if isinstance(allowed, Masks) and (len(allowed), allowed.count) != (len(query), len(vectors)):
        raise ValueError(
            f"{len(allowed)} masks of {allowed.count} rows for {len(query)} queries and {len(vectors)} rows."
        )
    if isinstance(allowed, Masks) and index is not None and k:
        for queries, mask in allowed.distinct():
            those = query.choose(queries) if isinstance(query, Vectors) else query[queries]
            found = search(those, vectors, k, backend, compute_device, faiss_gpu, index, mask, dims)
            scores[queries], indices[queries] = found
        return scores, indices
    # Among few allowed rows an index finds next to none: what it looks at is chosen by all rows.
    if isinstance(allowed, np.ndarray) and (index is None or np.count_nonzero(allowed) <= index.candidates):
        rows = np.flatnonzero(allowed)
        chosen = vectors.choose(rows) if isinstance(vectors, Vectors) else vectors[rows]
        if len(rows):
            found = search(query, chosen, k, backend, compute_device, faiss_gpu, dims=dims)
            scores[:, : len(rows)], indices[:, : len(rows)] = found[0], rows[found[1]]
        return scores, indices
    for start, part in blocks(query, _QUERY_BYTES) if k else ():
        require_finite(part, "query", start)
        here = slice(start, start + len(part))
        if index is not None:
            mask = allowed if isinstance(allowed, np.ndarray) else None
            _compare(part, vectors, index.find(part, mask), scores[here], indices[here], dims)
            continue
        make = partial(_backend, backend=backend, compute_device=compute_device, faiss_gpu=faiss_gpu, dims=dims)
        masks = allowed.choose(here) if isinstance(allowed, Masks) else None
        _search_part(part, vectors, make, masks, scores[here], indices[here], dims)
    return scores, indices


def fuse(similarities: Sequence[Any]) -> Any:
    """Return the generalized harmonic mean of n similarities (arrays or tensors of one shape), in the same shape.

    1 / mean(1 / (gamma + s / n)) - gamma with gamma = 0.5, as kapture-localization and the LaMAR benchmark fuse: M.
    Humenberger et al., "Investigating the Role of Image Retrieval for Visual Localization", IJCV 2022, after G. Csurka
    and S. Clinchant, "An Empirical Study of Fusion Operators for Multimodal Image Retrieval", CBMI 2012. It grows with
    each similarity, and is 1 / n where all are 1. A similarity of 0, such as that of an image without structure, leaves
    the order to the others; at the pole, -n / 2, and below, which only vectors longer than 1 have, it is -gamma.
    """
    count = len(similarities)
    with np.errstate(divide="ignore"):
        return count / sum(1 / (_GAMMA + each / count).clip(min=0) for each in similarities) - _GAMMA


def _fused(query: Any, vectors: Any, dims: Sequence[int], product: Callable[[Any, Any], Any]) -> Any:
    """Return the product of queries (..., D) and vectors (..., D); of several descriptors, their fused products."""
    if len(dims) < 2:
        return product(query, vectors)
    ends = np.cumsum(dims).tolist()
    cuts = [slice(end - dim, end) for dim, end in zip(dims, ends, strict=True)]
    return fuse([product(query[..., cut], vectors[..., cut]) for cut in cuts])


def _search_part(
    query: NDArray[np.float32],
    vectors: _Vectors,
    make_backend: Callable[[NDArray[np.float32], Masks | None], _Best],
    masks: Masks | None,
    scores: NDArray[np.float32],
    indices: Ints,
    dims: Sequence[int],
) -> None:
    """Fill in scores and indices (Q, K) of queries that fit in memory."""
    count, k = len(vectors), scores.shape[1]
    lengths = np.linalg.norm(query, axis=1)
    # To a query of zeros, an image without features, all rows are equal.
    for number in np.flatnonzero(lengths == 0):
        rows = np.arange(k) if masks is None else np.flatnonzero(masks.choose(slice(number, number + 1)).rows(0, count))
        scores[number, : len(rows)], indices[number, : len(rows)] = 0, rows[:k]
    pending, width = np.flatnonzero(lengths), min(count, k + _MORE)
    size = _BLOCK_BYTES if masks is None else min(_BLOCK_BYTES, 4 * query.shape[1] * _MASKED_ROWS)
    while len(pending):
        best = make_backend(
            query if len(pending) == len(query) else query[pending], None if masks is None else masks.choose(pending)
        )
        rough, candidates, longest = _candidates(vectors, best, len(pending), width, size)
        tolerance = _tolerance(longest * lengths[pending], dims)
        # Rounding in the backend cuts nothing off once the last candidate is clearly below rank k.
        done = (rough[:, -1] < rough[:, k - 1] - tolerance) | (width == count) | np.isneginf(rough[:, -1])
        near = (rough >= (rough[:, k - 1] - 2 * tolerance)[:, None]) & (rough > -np.inf)
        _rescore(query, vectors, pending[done], candidates[done], near[done], scores, indices, dims)
        pending, width = pending[~done], min(count, 4 * width)


def _tolerance(product_of_lengths: Any, dims: Sequence[int]) -> Any:
    """Return how far rounding may move a score: fused ones no further than any product, but for their own rounding."""
    return 1e-5 * (product_of_lengths + (len(dims) > 1))


def _compare(
    query: NDArray[np.float32],
    vectors: _Vectors,
    candidates: Ints,
    scores: NDArray[np.float32],
    indices: Ints,
    dims: Sequence[int],
) -> None:
    """Fill in scores and indices (Q, K) of the best among the candidates (Q, C) of each query, of which -1 is none."""
    for number, one in enumerate(query):
        rows = np.unique(candidates[number])  # as they lie on disk
        rows = rows[rows >= 0]
        if not len(rows):
            continue
        block, k = vectors[rows], min(scores.shape[1], len(rows))
        rough = _fused(one, block, dims, lambda a, b: b @ a)
        tolerance = _tolerance(np.linalg.norm(block, axis=1).max() * np.linalg.norm(one), dims)
        near = rough >= np.partition(rough, -k)[-k] - 2 * tolerance
        exact = _products(np.broadcast_to(one, (int(near.sum()), len(one))), block[near], dims)
        best = np.lexsort((rows[near], -exact))[:k]
        scores[number, :k], indices[number, :k] = exact[best], rows[near][best]


def _products(query: NDArray[np.float32], vectors: NDArray[np.float32], dims: Sequence[int]) -> NDArray[np.float32]:
    """Return the dot products (n,) of rows (n, D), summed and fused in float64."""
    wide = query.astype(np.float64), vectors.astype(np.float64)
    fused: NDArray[np.float64] = _fused(*wide, dims, partial(np.einsum, "nd,nd->n"))
    return fused.astype(np.float32)


def _matrix(values: ArrayLike | Vectors, name: str) -> _Vectors:
    if isinstance(values, Vectors):
        return values
    matrix = np.ascontiguousarray(values, np.float32)
    if matrix.ndim != 2:
        raise ValueError(f"{name} has shape {matrix.shape}; expected two dimensions, one row a vector.")
    require_finite(matrix, name)
    return matrix


def _candidates(
    vectors: _Vectors, best: _Best, queries: int, width: int, size: int
) -> tuple[NDArray[np.float32], Ints, float]:
    """Return the `width` best scores and indices (Q, width), best first, up to rounding, and the longest length.

    Args:
        size: bytes of a block of the database.
    """
    scores, indices = np.zeros((queries, 0), np.float32), np.zeros((queries, 0), np.int64)
    longest = 0.0
    for start, block in blocks(vectors, size):
        length = float(np.sqrt(np.einsum("nd,nd->n", block, block).max()))
        if not np.isfinite(length):
            require_finite(block, "database", start)
        longest = max(longest, length)
        of_block, inside = best(block, start, min(width, len(block)))
        scores, indices = np.hstack([scores, of_block]), np.hstack([indices, inside + start])
        order = np.argsort(-scores, axis=1, kind="stable")[:, :width]
        scores, indices = np.take_along_axis(scores, order, 1), np.take_along_axis(indices, order, 1)
    return scores, indices, longest


def _rescore(
    query: NDArray[np.float32],
    vectors: _Vectors,
    rows: Ints,
    candidates: Ints,
    near: NDArray[np.bool_],
    scores: NDArray[np.float32],
    indices: Ints,
    dims: Sequence[int],
) -> None:
    """Fill in scores and indices of query rows: of the candidates that are near enough to be among the k best."""
    exact = np.full(candidates.shape, -np.inf, np.float32)
    who, rank = np.nonzero(near)
    order = np.argsort(candidates[who, rank], kind="stable")  # as they lie on disk
    step = max(1, _BLOCK_BYTES // (16 * query.shape[1]))
    for start in range(0, len(order), step):
        part = order[start : start + step]
        numbers, where = np.unique(candidates[who[part], rank[part]], return_inverse=True)
        exact[who[part], rank[part]] = _products(query[rows[who[part]]], vectors[numbers][where], dims)
    best = np.lexsort((candidates, -exact), axis=1)[:, : scores.shape[1]]
    scores[rows], indices[rows] = np.take_along_axis(exact, best, 1), np.take_along_axis(candidates, best, 1)
    indices[np.isneginf(scores)] = -1


def _backend(
    query: NDArray[np.float32],
    masks: Masks | None,
    backend: Backend,
    compute_device: str,
    faiss_gpu: bool,
    dims: Sequence[int],
) -> _Best:
    """Return what finds the best (scores, indices) (Q, n) of a block of the database for the queries."""
    if backend not in ("faiss", "torch"):
        raise ValueError(f"Unknown backend {backend!r}; expected faiss or torch.")
    by_torch = backend == "torch" or len(dims) > 1
    if masks is not None:
        masked = partial(_torch_best, device=compute_device, dims=dims) if by_torch else _numpy_best
        return lambda block, start, number: _masked(query, masks, masked, block, start, number)
    if by_torch:
        return _torch_backend(query, compute_device, dims)
    import faiss

    if not faiss_gpu:
        return lambda block, _, number: faiss.knn(query, block, number, metric=faiss.METRIC_INNER_PRODUCT)
    if not hasattr(faiss, "StandardGpuResources"):
        raise ToolkitError(
            "faiss_gpu is set, but the installed faiss has no GPU support (faiss-cpu). "
            "Set faiss_gpu: false, or use_faiss: false with compute_device: cuda."
        )
    gpu = faiss.StandardGpuResources()
    return lambda block, _, number: faiss.knn_gpu(gpu, query, block, number, metric=faiss.METRIC_INNER_PRODUCT)


def _torch_backend(query: NDArray[np.float32], compute_device: str, dims: Sequence[int]) -> _Best:
    import torch

    device = resolve_device(compute_device)
    queries = torch.from_numpy(query).to(device)

    def best(block: NDArray[np.float32], _: int, number: int) -> Found:
        rows = torch.from_numpy(block).to(device)
        most = max(1, _QUERY_BYTES // (4 * len(block) * (len(dims) + 2)))
        found = [_fused(some, rows, dims, lambda a, b: a @ b.T).topk(number) for some in queries.split(most)]
        scores, indices = (torch.cat(parts).cpu().numpy() for parts in zip(*found, strict=True))
        return scores, indices

    return best


def _masked(
    query: NDArray[np.float32],
    masks: Masks,
    best: Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], int], Found],
    block: NDArray[np.float32],
    start: int,
    number: int,
) -> Found:
    """Return what `_Best` does, of queries that may find some rows alone; -inf where there are fewer.

    Args:
        best: of queries (n, D) the best rows (m, D) that they may find (n, m), so many.
    """
    scores, indices = np.full((len(query), number), -np.inf, np.float32), np.zeros((len(query), number), np.int64)
    step = max(1, _PRODUCTS // len(block))
    for first in range(0, len(query), step):
        allowed = masks.choose(slice(first, first + step)).rows(start, start + len(block))
        finds = np.flatnonzero(allowed.any(axis=1))
        if len(finds):
            found = best(query[first + finds], block, allowed[finds], number)
            scores[first + finds], indices[first + finds] = found
    return scores, indices


def _numpy_best(
    query: NDArray[np.float32], block: NDArray[np.float32], allowed: NDArray[np.bool_], number: int
) -> Found:
    scores = query @ block.T
    scores[~allowed] = -np.inf
    indices = np.argpartition(scores, -number, axis=1)[:, -number:]
    return np.take_along_axis(scores, indices, 1), indices


def _torch_best(
    query: NDArray[np.float32],
    block: NDArray[np.float32],
    allowed: NDArray[np.bool_],
    number: int,
    device: str,
    dims: Sequence[int],
) -> Found:
    import torch

    queries, rows, refused = (torch.from_numpy(part).to(resolve_device(device)) for part in (query, block, ~allowed))
    products = _fused(queries, rows, dims, lambda a, b: a @ b.T)
    scores, indices = products.masked_fill_(refused, -torch.inf).topk(number)
    return scores.cpu().numpy(), indices.cpu().numpy()
