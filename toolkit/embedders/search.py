"""Exact nearest neighbors among global descriptors, by whatever library is quick at it."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import ToolkitError
from toolkit.geometry import Ints
from toolkit.models.compute import resolve_device

Backend = Literal["faiss", "torch"]
_BLOCK_BYTES = 64 << 20


def search(
    query: ArrayLike,
    database: ArrayLike,
    k: int,
    backend: Backend = "faiss",
    compute_device: str = "cpu",
    faiss_gpu: bool = False,
) -> tuple[NDArray[np.float32], Ints]:
    """Return the rows of the database with the largest dot products, best first; equal ones by index.

    The backend finds candidates; their scores are then computed alike for all backends, so that the result
    does not depend on it.

    Args:
        query: (Q, D), any float type.
        database: (N, D).
        k: how many; at most N are returned.
        backend: `faiss` or `torch`.
        compute_device: where torch computes: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        faiss_gpu: let faiss compute on the GPU (needs a faiss built for it).

    Returns:
        Scores (Q, K) float32 and indices (Q, K) int64, K = min(k, N).

    Raises:
        ValueError: shapes do not fit, k is below 1, or a value is not finite.
    """
    query, database = _matrix(query, "query"), _matrix(database, "database")
    if query.shape[1] != database.shape[1]:
        raise ValueError(f"query has {query.shape[1]} dimensions, the database {database.shape[1]}.")
    if k < 1:
        raise ValueError(f"k is {k}; expected at least 1.")
    count = len(database)
    k = min(k, count)
    scores, indices = np.zeros((len(query), k), np.float32), np.zeros((len(query), k), np.int64)
    if not len(query) or not k:
        return scores, indices
    norm = float(np.sqrt((database**2).sum(axis=1).max()))
    tolerance = 1e-5 * norm * np.linalg.norm(query, axis=1)
    pending, width = np.arange(len(query)), min(count, k + 16)
    while len(pending):
        rough, candidates = _candidates(query[pending], database, width, backend, compute_device, faiss_gpu)
        # Rounding in the backend cuts nothing off once the last candidate is clearly below rank k.
        done = (rough[:, -1] < rough[:, k - 1] - tolerance[pending]) | (width == count)
        rows = pending[done]
        step = max(1, _BLOCK_BYTES // (8 * width * query.shape[1]))
        for start in range(0, len(rows), step):
            part, chosen = rows[start : start + step], np.sort(candidates[done][start : start + step], axis=1)
            exact = np.einsum("qd,qkd->qk", query[part].astype(np.float64), database[chosen].astype(np.float64))
            exact = exact.astype(np.float32)
            order = np.argsort(-exact, axis=1, kind="stable")[:, :k]
            scores[part] = np.take_along_axis(exact, order, axis=1)
            indices[part] = np.take_along_axis(chosen, order, axis=1)
        pending, width = pending[~done], min(count, 4 * width)
    return scores, indices


def _matrix(values: ArrayLike, name: str) -> NDArray[np.float32]:
    matrix = np.ascontiguousarray(values, np.float32)
    if matrix.ndim != 2:
        raise ValueError(f"{name} has shape {matrix.shape}; expected two dimensions, one row a vector.")
    bad = ~np.isfinite(matrix).all(axis=1)
    if bad.any():
        raise ValueError(f"{name} has {bad.sum()} rows with NaN or infinite values, first row {int(bad.argmax())}.")
    return matrix


def _candidates(
    query: NDArray[np.float32],
    database: NDArray[np.float32],
    width: int,
    backend: Backend,
    compute_device: str,
    faiss_gpu: bool,
) -> tuple[NDArray[np.float32], Ints]:
    """Return the `width` best (scores, indices) (Q, width) of each query, best first, up to rounding."""
    if backend == "torch":
        return _torch_candidates(query, database, width, compute_device)
    if backend != "faiss":
        raise ValueError(f"Unknown backend {backend!r}; expected faiss or torch.")
    import faiss

    if not faiss_gpu:
        scores, indices = faiss.knn(query, database, width, metric=faiss.METRIC_INNER_PRODUCT)
        return scores, indices
    if not hasattr(faiss, "StandardGpuResources"):
        raise ToolkitError(
            "faiss_gpu is set, but the installed faiss has no GPU support (faiss-cpu). "
            "Set faiss_gpu: false, or use_faiss: false with compute_device: cuda."
        )
    scores, indices = faiss.knn_gpu(
        faiss.StandardGpuResources(), query, database, width, metric=faiss.METRIC_INNER_PRODUCT
    )
    return scores, indices


def _torch_candidates(
    query: NDArray[np.float32], database: NDArray[np.float32], width: int, compute_device: str
) -> tuple[NDArray[np.float32], Ints]:
    """Search the database in blocks, so that the scores of all its rows are never in memory together."""
    import torch

    device = resolve_device(compute_device)
    queries = torch.from_numpy(query).to(device)
    scores = torch.zeros((len(query), 0), device=device)
    indices = torch.zeros((len(query), 0), dtype=torch.int64, device=device)
    step = max(1, _BLOCK_BYTES // (4 * len(query)))
    for start in range(0, len(database), step):
        block = queries @ torch.from_numpy(database[start : start + step]).to(device).T
        numbers = torch.arange(start, start + block.shape[1], device=device).expand(block.shape)
        scores, best = torch.cat([scores, block], 1).topk(min(width, scores.shape[1] + block.shape[1]))
        indices = torch.cat([indices, numbers], 1).gather(1, best)
    return scores.cpu().numpy(), indices.cpu().numpy()
