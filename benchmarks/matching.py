"""Pairs of images matched a second: LightGlue in batches beside one at a time, and ours beside OpenCV's matcher.

    python benchmarks/matching.py [--checkpoint FILE] [--keypoints 1024] [--pairs 16] [--device auto] [--out FILE]

Everything runs on the same features in one process, in turns, and the fastest of `--repeat` counts. `LightGlue, one at
a time` and `LightGlue, batches of ...` are the same matcher with another `batch_size`; how many of their matches are
the same is counted. `SIFT mutual` is `features.matching`, pair after pair; OpenCV's brute-force matcher does the same
work (two nearest neighbors, ratio test, and mutual) on the same descriptors. Without a checkpoint LightGlue's weights
are random: its time does not depend on them, as every layer runs for every pair.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from common import add_out, check_out, limit_cores, markdown_table, write_out
from numpy.typing import NDArray

BATCHES = (2, 8, 32)
_SIZE = (1024, 768)
_RATIO = 0.8


def make_pairs(count: int, keypoints: int, kind: str, seed: int = 0) -> list[tuple[Any, Any]]:
    """Return pairs of made-up features, of which half are alike but for some noise."""
    from toolkit.features.features import DESCRIPTOR_SCALE, LocalFeatures

    random = np.random.default_rng(seed)

    def features(vectors: NDArray[np.float64]) -> Any:
        vectors = np.abs(vectors) if kind == "sift" else vectors
        vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        stored = np.round(vectors * DESCRIPTOR_SCALE).clip(0, 255).astype(np.uint8)
        return LocalFeatures(
            (random.uniform(0, 1, (keypoints, 2)) * _SIZE).astype(np.float32),
            np.ones(keypoints, np.float32),
            np.ones(keypoints, np.float32),
            stored if kind == "sift" else vectors.astype(np.float16),
            _SIZE,
        )

    made = []
    for _ in range(count):
        first, second = random.normal(size=(2, keypoints, 128 if kind == "sift" else 256))
        second[: keypoints // 2] = first[: keypoints // 2] + 0.2 * second[: keypoints // 2]
        made.append((features(first), features(second)))
    return made


def random_weights(seed: int = 0) -> dict[str, Any]:
    """Return weights of the official names and shapes that keep activations finite and match alike descriptors."""
    import torch

    from toolkit.features.superpoint import import_transformers

    transformers = import_transformers("LightGlue")
    with torch.device("meta"):
        config = transformers.LightGlueConfig(keypoint_detector_config=transformers.SuperPointConfig())
        shapes = transformers.LightGlueForKeypointMatching(config).state_dict()
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, value in shapes.items():
        scale = (0.3 / value[0].numel()) ** 0.5 if value.ndim > 1 else 0.1
        state[name] = scale * torch.randn(value.shape, generator=generator)
        if name.endswith("layer_norm.weight"):
            state[name] = torch.ones(value.shape)
        if name.endswith("final_projection.weight"):
            state[name] = 10 * torch.eye(len(value))
        if name.endswith("matchability.bias"):
            state[name] = state[name] + 4
    return state


def match_with_opencv(pairs: list[tuple[Any, Any]]) -> list[NDArray[np.int64]]:
    """Return mutual nearest neighbors that pass the ratio test, by OpenCV."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    found = []
    for a, b in pairs:
        forth = matcher.knnMatch(a.descriptors.astype(np.float32), b.descriptors.astype(np.float32), k=2)
        back = matcher.match(b.descriptors.astype(np.float32), a.descriptors.astype(np.float32))
        nearest = {match.queryIdx: match.trainIdx for match in back}
        kept = [
            (best.queryIdx, best.trainIdx)
            for best, second in forth
            if best.distance < _RATIO * second.distance and nearest[best.trainIdx] == best.queryIdx
        ]
        found.append(np.array(kept, np.int64).reshape(-1, 2))
    return found


def measure(runs: dict[str, Callable[[], Any]], repeat: int) -> tuple[dict[str, float], dict[str, Any]]:
    """Return the least seconds of each run, taken in turns, and what it returned."""
    seconds = dict.fromkeys(runs, float("inf"))
    results = {}
    for _ in range(repeat):
        for name, run in runs.items():
            start = time.perf_counter()
            results[name] = run()
            seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds, results


def same_share(found: list[Any], expected: list[Any]) -> float:
    """Return the part of all matches of either that both have."""
    sets = [({*map(tuple, a.tolist())}, {*map(tuple, b.tolist())}) for a, b in zip(found, expected, strict=True)]
    return sum(len(a & b) for a, b in sets) / max(sum(len(a | b) for a, b in sets), 1)


def benchmark_lightglue(args: argparse.Namespace, device: str) -> list[list[str]]:
    """Return rows of the table: name, pairs/s, ratio, part of the matches that are the same."""
    from toolkit.features.lightglue import LightGlueMatcher

    weights = args.checkpoint or random_weights()
    pairs = make_pairs(args.pairs, args.keypoints, "superpoint")
    sizes = [1, *(size for size in BATCHES if size <= args.pairs)]
    matchers = {size: LightGlueMatcher(weights, device=device, dtype=args.dtype, batch_size=size) for size in sizes}
    for matcher in matchers.values():
        matcher.match(pairs[: matcher.batch_size])  # warm
    seconds, results = measure({str(size): lambda m=m: m.match(pairs) for size, m in matchers.items()}, args.repeat)
    precision = matchers[1].settings["dtype_compute"]
    rows = []
    for size in sizes:
        same = same_share([m.indices for m in results[str(size)]], [m.indices for m in results["1"]])
        name = f"LightGlue, {device}, {precision}, " + (f"batches of {size}" if size > 1 else "one at a time")
        ratio = seconds["1"] / seconds[str(size)]
        rows.append([name, f"{args.pairs / seconds[str(size)]:.2f}", f"{ratio:.2f}", f"{same:.4f}"])
    return rows


def benchmark_sift(args: argparse.Namespace) -> list[list[str]]:
    """Return rows of the table, as `benchmark_lightglue`."""
    from toolkit.features.matching import create_matcher

    pairs = make_pairs(args.pairs, args.keypoints, "sift")
    matcher = create_matcher("mutual", ratio=_RATIO)
    runs = {"OpenCV": lambda: match_with_opencv(pairs), "ours": lambda: matcher.match(pairs)}
    seconds, results = measure(runs, args.repeat)
    same = same_share([found.indices for found in results["ours"]], results["OpenCV"])
    return [
        ["SIFT, OpenCV's brute force, one pair at a time", f"{args.pairs / seconds['OpenCV']:.1f}", "1.00", ""],
        [
            "SIFT mutual", f"{args.pairs / seconds['ours']:.1f}", f"{seconds['OpenCV'] / seconds['ours']:.2f}",
            f"{same:.4f}",
        ],
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", help="LightGlue's official file; random weights without")
    parser.add_argument("--keypoints", type=int, default=1024, help="of each image")
    parser.add_argument("--pairs", type=int, default=16)
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:<i>, mps")
    parser.add_argument("--dtype", default="auto", help="auto, float32, bfloat16, float16")
    parser.add_argument("--threads", type=int, default=2, help="CPU cores")
    parser.add_argument("--repeat", type=int, default=3, help="take the fastest of so many")
    add_out(parser)
    args = parser.parse_args()
    check_out(parser, args.out)
    limit_cores(args.threads)
    import torch

    from toolkit.models.compute import resolve_device

    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    device = str(resolve_device(args.device))
    rows = benchmark_lightglue(args, device) + benchmark_sift(args)
    if not torch.cuda.is_available():
        rows.append(["LightGlue on a GPU", "", "", ""])
    text = markdown_table(["", "pairs/s", "ratio", "same matches"], rows) + "\n"
    print(text)
    settings = {name: value for name, value in vars(args).items() if name != "out"}
    write_out(args.out, text, {"settings": settings, "torch": torch.__version__, "rows": rows})


if __name__ == "__main__":
    main()
