"""Indexes for large maps: recall against the exact search, bytes an image, milliseconds a query, seconds to build.

    python benchmarks/index.py [--embeddings RUN/SCENE/embeddings] [--images 100000] [--index PCA512,IVF1024,RaBitQ ...]

Rows are made of real descriptors, those of a run (without --embeddings, of 500 random ones of 256 dimensions): each is
a mixture of two of them, lifted to --dim dimensions by one random rotation, plus Gaussian noise in all dimensions of
--noise times its length; then of length 1, float16 on disk. A query is made as its row was, with other noise. So rows
vary in as many directions as the real descriptors have dimensions, and PCA loses less than it might of real ones.
Each index is built and asked in a process of its own; peak memory is the process's largest resident set, files that
are mapped included.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, write_out
from search import BLOCK, peak_mb

TOPK = 10


def signals(real: "np.ndarray", dim: int, rng: np.random.Generator, count: int) -> "np.ndarray":
    """Return mixtures (count, D) of two real descriptors each, in `dim` dimensions."""
    lift = np.linalg.qr(np.random.default_rng(7).standard_normal((dim, real.shape[1])))[0].astype(np.float32)
    share = rng.uniform(0, 0.5, (count, 1)).astype(np.float32)
    first, second = rng.integers(len(real), size=(2, count))
    return ((1 - share) * real[first] + share * real[second]) @ lift.T


def with_noise(rows: "np.ndarray", noise: float, rng: np.random.Generator) -> "np.ndarray":
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows + noise / np.sqrt(rows.shape[1]) * rng.standard_normal(rows.shape, np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def read_real(embeddings: Path | None) -> "np.ndarray":
    if embeddings is None:
        return np.random.default_rng(3).standard_normal((500, 256), np.float32) / 16
    files = sorted(embeddings.rglob("*.npy"))
    if not files:
        raise SystemExit(f"{embeddings}: no .npy files. Give the folder `embeddings` of a run.")
    return np.concatenate([np.load(path) for path in files]).astype(np.float32)


def write_rows(folder: Path, embeddings: Path | None, images: int, queries: int, dim: int, noise: float) -> None:
    """Write the map as `map.npy` (images, D) float16 and `queries.npy` (Q, D) float32."""
    real, rng = read_real(embeddings), np.random.default_rng(0)
    matrix = np.lib.format.open_memmap(folder / "map.npy", "w+", np.float16, (images, dim))
    asked = np.sort(rng.choice(images, queries, replace=False))
    of_queries = np.zeros((queries, dim), np.float32)
    for start in range(0, images, BLOCK):
        stop = min(images, start + BLOCK)
        rows = signals(real, dim, rng, stop - start)
        inside = (asked >= start) & (asked < stop)
        of_queries[inside] = rows[asked[inside] - start]
        matrix[start:stop] = with_noise(rows, noise, rng)
    matrix.flush()
    np.save(folder / "queries.npy", with_noise(of_queries, noise, rng))


def ask(folder: Path, images: int, factory: str, candidates: int) -> dict[str, float]:
    """Build an index and ask it; for `Flat` the exact search writes what the others are compared with."""
    from toolkit.embedders import StoredVectors, Vectors
    from toolkit.embedders.search import make_index, search
    from toolkit.manifest import RetrieveSettings

    query = np.load(folder / "queries.npy")
    stored = StoredVectors((folder / "map.npy",), (0, images), query.shape[1], np.arange(images), normalize=True)
    vectors = Vectors({"": stored})
    settings = RetrieveSettings(index=factory, index_candidates=candidates)
    started = time.perf_counter()
    index = make_index(folder / "embeddings", "map", vectors, settings, skip_existing=False)
    built = time.perf_counter()
    found = 0.0
    if index is not None:
        index.find(query)
        found = time.perf_counter() - built
    started, built = built - started, time.perf_counter()
    _, rows = search(query, vectors, TOPK, index=index)
    seconds = time.perf_counter() - built
    if index is None:
        np.save(folder / "exact.npy", rows)
        size = 2.0 * query.shape[1]
        return {"recall": 1.0, "bytes": size, "find": 0, "query": seconds / len(query), "peak": peak_mb()}
    exact = np.load(folder / "exact.npy")
    recall = sum(len(set(a) & set(b)) for a, b in zip(rows.tolist(), exact.tolist(), strict=True)) / exact.size
    size = (folder / "index" / "map.faiss").stat().st_size / images
    return {"recall": recall, "bytes": size, "build": started, "find": found / len(query),
            "query": seconds / len(query), "peak": peak_mb()}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--embeddings", type=Path, help="of a run")
    parser.add_argument("--images", type=int, default=100_000)
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--dim", type=int, default=8448, help="MegaLoc's")
    parser.add_argument("--noise", type=float, default=0.7)
    parser.add_argument("--candidates", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--index", nargs="+", default=["IVF1024,Flat", "PCA512,IVF1024,RaBitQ", "HNSW32"])
    parser.add_argument("--folder", type=Path, help="where the rows are written for the time; else a temporary folder")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    limit_cores(options.threads)
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        in_own_process(
            write_rows, folder, options.embeddings, options.images, options.queries, options.dim, options.noise
        )
        rows = {}
        for factory in ("Flat", *options.index):
            rows[factory] = in_own_process(ask, folder, options.images, factory, options.candidates)
            print(factory, rows[factory], flush=True)
    lines = [
        [name, f"{100 * row['recall']:.1f} %", f"{row['bytes']:.0f}", f"{1000 * row['find']:.1f}",
         f"{1000 * row['query']:.1f}", f"{row['build']:.0f}" if "build" in row else "", f"{row['peak']:.0f}"]
        for name, row in rows.items()
    ]  # fmt: skip
    title = (
        f"{options.queries} queries, {options.images} x {options.dim} float16 on disk, top {TOPK} of "
        f"{options.candidates} candidates, noise {options.noise:g}"
    )
    header = ["index", f"recall@{TOPK}", "bytes an image", "ms, candidates", "ms a query", "s to build", "peak MB"]
    text = f"{title}, {options.threads} cores:\n\n{markdown_table(header, lines)}\n"
    print(text)
    write_out(options.out, text, {"settings": {"title": title, "threads": options.threads}, "rows": rows})


if __name__ == "__main__":
    main()
