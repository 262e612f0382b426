"""Pairs of images matched a second: LightGlue in batches, one at a time and kornia's; SIFT beside OpenCV's matcher.

    python benchmarks/matching.py [--features superpoint|aliked] [--checkpoint FILE] [--keypoints 1024] [--pairs 16]
                                  [--device auto] [--out FILE]

Everything runs on the same features in one process, in turns, and the fastest of `--repeat` counts; CPU seconds are of
that run, on all cores. All pairs have the same first image. `LightGlue, one at a time` and `LightGlue, batches of ...`
are the same matcher with another `batch_size`; how many of their matches are the same is counted. Where kornia is
installed, its LightGlue runs one pair at a time, with the authors' early stop and dropping of features as ours, in
float32, beside ours in float32. `SIFT mutual` is `features.matching`, pair after pair; OpenCV's brute-force matcher
does the same work (two nearest neighbors, ratio test, and mutual) on the same descriptors. Without a checkpoint
LightGlue's weights are random: then every layer runs for every pair.
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

    length = 256 if kind == "superpoint" else 128
    first, made = random.normal(size=(keypoints, length)), []
    image = features(first)
    for _ in range(count):
        second = random.normal(size=(keypoints, length))
        second[: keypoints // 2] = first[: keypoints // 2] + 0.2 * second[: keypoints // 2]
        made.append((image, features(second)))
    return made


def random_weights(kind: str, seed: int = 0) -> dict[str, Any]:
    """Return weights of the official names and shapes that keep activations finite and match alike descriptors."""
    import torch

    from toolkit.models.lightglue import LightGlue

    with torch.device("meta"):
        shapes = LightGlue(256 if kind == "superpoint" else 128).state_dict()
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, value in shapes.items():
        scale = (0.3 / value[0].numel()) ** 0.5 if value.ndim > 1 else 0.1
        state[name] = scale * torch.randn(value.shape, generator=generator)
        if name.endswith("ffn.1.weight"):
            state[name] = torch.ones(value.shape)
        if name.endswith("final_proj.weight"):
            state[name] = 10 * torch.eye(len(value))
        if name.endswith("matchability.bias"):
            state[name] = state[name] + 4
    return state


def kornia_matcher(weights: Any, kind: str) -> Callable[[list[tuple[Any, Any]]], list[NDArray[np.int64]]] | None:
    """Return what matches pairs with kornia's LightGlue on the CPU, None where it is not installed."""
    try:
        from kornia.feature import LightGlue
    except ImportError:
        return None
    import torch

    from toolkit.models.lightglue import official_names
    from toolkit.models.weights import read_state_dict

    network = LightGlue(None, input_dim=256 if kind == "superpoint" else 128).eval()
    state = read_state_dict(weights) if isinstance(weights, str) else weights
    network.load_state_dict(official_names(state), strict=False)

    def inputs(features: Any) -> dict[str, torch.Tensor]:
        return {
            "keypoints": torch.from_numpy(features.keypoints - np.float32(0.5))[None].clamp(0),
            "descriptors": torch.from_numpy(features.descriptors.astype(np.float32))[None],
            "image_size": torch.tensor([features.image_size]),
        }

    def match(pairs: list[tuple[Any, Any]]) -> list[NDArray[np.int64]]:
        with torch.inference_mode():
            return [network({"image0": inputs(a), "image1": inputs(b)})["matches"][0].numpy() for a, b in pairs]

    return match


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


Seconds = tuple[float, float]


def measure(runs: dict[str, Callable[[], Any]], repeat: int) -> tuple[dict[str, Seconds], dict[str, Any]]:
    """Return the least seconds of each run with its CPU seconds, taken in turns, and what it returned."""
    seconds = dict.fromkeys(runs, (float("inf"), 0.0))
    results = {}
    for _ in range(repeat):
        for name, run in runs.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            results[name] = run()
            seconds[name] = min(seconds[name], (time.perf_counter() - start, time.process_time() - cpu_start))
    return seconds, results


def same_share(found: list[Any], expected: list[Any]) -> float:
    """Return the part of all matches of either that both have."""
    sets = [({*map(tuple, a.tolist())}, {*map(tuple, b.tolist())}) for a, b in zip(found, expected, strict=True)]
    return sum(len(a & b) for a, b in sets) / max(sum(len(a | b) for a, b in sets), 1)


def row(name: str, pairs: int, seconds: Seconds, beside: Seconds, same: float | None = None) -> list[str]:
    """Return a row of the table: name, pairs/s, CPU s a pair, ratio, part of the matches that are the same."""
    columns = f"{pairs / seconds[0]:.2f}", f"{seconds[1] / pairs:.3f}", f"{beside[0] / seconds[0]:.2f}"
    return [name, *columns, "" if same is None else f"{same:.4f}"]


def benchmark_lightglue(args: argparse.Namespace, device: str) -> list[list[str]]:
    """Return rows of the table."""
    from toolkit.features.network import LightGlueMatcher

    def create(dtype: str, size: int) -> LightGlueMatcher:
        return LightGlueMatcher(weights, device, dtype, batch_size=size, features=args.features)

    weights = args.checkpoint or random_weights(args.features)
    pairs = make_pairs(args.pairs, args.keypoints, args.features)
    sizes = [1, *(size for size in BATCHES if size <= args.pairs)]
    matchers = {str(size): create(args.dtype, size) for size in sizes}
    for matcher in matchers.values():
        matcher.match(pairs[: matcher.batch_size])  # warm
    seconds, results = measure({size: lambda m=m: m.match(pairs) for size, m in matchers.items()}, args.repeat)
    name = f"LightGlue, {device}, {matchers['1'].settings['dtype_compute']}"
    rows = []
    for size, found in results.items():
        same = same_share([m.indices for m in found], [m.indices for m in results["1"]])
        label = f"batches of {size}" if size != "1" else "one at a time"
        rows.append(row(f"{name}, {label}", args.pairs, seconds[size], seconds["1"], same))
    kornia = kornia_matcher(weights, args.features) if device == "cpu" else None
    if kornia is not None:
        ours = create("float32", 1)
        runs = {"kornia": lambda: kornia(pairs), "ours": lambda: [found.indices for found in ours.match(pairs)]}
        seconds, results = measure(runs, args.repeat)
        same = same_share(results["ours"], results["kornia"])
        rows.append(row("LightGlue of kornia, cpu, float32", args.pairs, seconds["kornia"], seconds["kornia"]))
        rows.append(row("LightGlue, cpu, float32", args.pairs, seconds["ours"], seconds["kornia"], same))
    return rows


def benchmark_sift(args: argparse.Namespace) -> list[list[str]]:
    """Return rows of the table."""
    from toolkit.features.matching import create_matcher

    pairs = make_pairs(args.pairs, args.keypoints, "sift")
    matcher = create_matcher("mutual", ratio=_RATIO)
    runs = {"OpenCV": lambda: match_with_opencv(pairs), "ours": lambda: matcher.match(pairs)}
    seconds, results = measure(runs, args.repeat)
    same = same_share([found.indices for found in results["ours"]], results["OpenCV"])
    opencv = "SIFT, OpenCV's brute force, one pair at a time"
    return [
        row(opencv, args.pairs, seconds["OpenCV"], seconds["OpenCV"]),
        row("SIFT mutual", args.pairs, seconds["ours"], seconds["OpenCV"], same),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", help="LightGlue's official file; random weights without")
    parser.add_argument("--features", default="superpoint", choices=["superpoint", "aliked"], help="of LightGlue")
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
        rows.append(["LightGlue on a GPU", "", "", "", ""])
    text = markdown_table(["", "pairs/s", "CPU s a pair", "ratio", "same matches"], rows) + "\n"
    print(text)
    settings = {name: value for name, value in vars(args).items() if name != "out"}
    write_out(args.out, text, {"settings": settings, "torch": torch.__version__, "rows": rows})


if __name__ == "__main__":
    main()
