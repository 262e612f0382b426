"""Search among many global descriptors on disk: seconds and memory, beside the bare matrix product.

    python benchmarks/search.py [--images 100000] [--queries 5000] [--dim 8448] [--topk 10] [--threads 2]

The map is one float16 matrix on disk, the queries are float32; all values are random. The bare product multiplies
blocks of the same size, which are in memory already in float32, with all queries, and keeps nothing. Each runs in
a process of its own on the same cores. Peak memory is the process's largest resident set.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, write_out

BLOCK = 4096
"""Rows that are made, or multiplied, at a time."""


def write_map(path: Path, images: int, dim: int) -> None:
    """Write a matrix (images, dim) float16 of random vectors without holding it."""
    rng = np.random.default_rng(0)
    matrix = np.lib.format.open_memmap(path, "w+", np.float16, (images, dim))
    for start in range(0, images, BLOCK):
        stop = min(images, start + BLOCK)
        matrix[start:stop] = rng.standard_normal((stop - start, dim), np.float32)
    matrix.flush()


def make_queries(queries: int, dim: int) -> "np.ndarray":
    vectors = np.random.default_rng(1).standard_normal((queries, dim), np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def search_disk(path: Path, images: int, queries: int, dim: int, topk: int, backend: str) -> list[float]:
    from toolkit.embedders import StoredVectors, Vectors
    from toolkit.embedders.search import search

    query = make_queries(queries, dim)
    stored = StoredVectors((path,), (0, images), dim, np.arange(images), normalize=True)
    vectors = Vectors({"": stored})
    search(query[:2], query[:64], 1, backend)  # libraries are loaded
    started, cpu = time.perf_counter(), time.process_time()
    scores, _ = search(query, vectors, topk, backend)
    assert scores.shape == (queries, topk)
    return [time.perf_counter() - started, time.process_time() - cpu, peak_mb()]


def bare_product(images: int, queries: int, dim: int) -> list[float]:
    query, block = make_queries(queries, dim), make_queries(min(BLOCK, images), dim)
    query[:64] @ block.T
    started, cpu = time.perf_counter(), time.process_time()
    for start in range(0, images, BLOCK):
        query @ block[: images - start].T
    return [time.perf_counter() - started, time.process_time() - cpu, peak_mb()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=100_000)
    parser.add_argument("--queries", type=int, default=5000)
    parser.add_argument("--dim", type=int, default=8448, help="MegaLoc's")
    parser.add_argument("--topk", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where the matrix is written for the time; else a temporary folder")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    limit_cores(options.threads)
    sizes = options.images, options.queries, options.dim
    rows = {"bare product": in_own_process(bare_product, *sizes)}
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / "map.npy"
        in_own_process(write_map, path, options.images, options.dim)
        for backend in ("faiss", "torch"):
            rows[f"search, {backend}"] = in_own_process(search_disk, path, *sizes, options.topk, backend)
    bare = rows["bare product"]
    lines = [
        [name, f"{wall:.1f}", f"{wall / bare[0]:.2f}", f"{cpu:.1f}", f"{cpu / bare[1]:.2f}", f"{peak:.0f}"]
        for name, (wall, cpu, peak) in rows.items()
    ]
    title = f"{options.queries} queries, {options.images} x {options.dim} float16 on disk, top {options.topk}"
    table = markdown_table(["", "s", "ratio", "CPU s", "ratio", "peak MB"], lines)
    text = f"{title}, {options.threads} cores:\n\n{table}\n"
    print(text)
    columns = ("seconds", "cpu_seconds", "peak_mb")
    document = {name: dict(zip(columns, row, strict=True)) for name, row in rows.items()}
    write_out(options.out, text, {"settings": {"title": title, "threads": options.threads}, "rows": document})


if __name__ == "__main__":
    main()
