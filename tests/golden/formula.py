"""Weights, photographs and cameras by formula: the same bits on every machine, from names and sizes alone."""

import hashlib

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.geometry import Floats

_STEP, _FIRST, _SECOND = (np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def numbers(name: str, count: int) -> NDArray[np.float32]:
    """Return so many numbers of [-1, 1) that depend on a name: 24 bits of SplitMix64 (Steele et al., OOPSLA 2014)."""
    seed = np.frombuffer(hashlib.sha256(name.encode()).digest()[:8], "<u8")
    state = seed + _STEP * np.arange(1, count + 1, dtype=np.uint64)
    for shift, factor in ((30, _FIRST), (27, _SECOND)):
        state ^= state >> np.uint64(shift)
        state *= factor
    state ^= state >> np.uint64(31)
    return (state >> np.uint64(40)).astype(np.float32) * np.float32(2.0**-23) - np.float32(1)


def photograph(name: str, height: int, width: int, view: int = 0) -> NDArray[np.uint8]:
    """Return a picture (height, width, 3) of waves and squares, which move with the view, and grain."""
    phase = np.pi * numbers(f"picture {name}", 12).astype(np.float64).reshape(3, 4)
    y, x = (np.mgrid[:height, :width] + 0.5) / max(height, width)
    x, y = x + 0.31 * view, y - 0.17 * view
    squares = np.floor(7 * x) + np.floor(5 * y)
    channels = [
        0.5 + 0.2 * np.sin(9 * x + a) * np.cos(6 * y + b) + 0.15 * np.sin(23 * (x + y) + c) + 0.12 * np.cos(squares + d)
        for a, b, c, d in phase
    ]
    grain = numbers(f"grain {name} {view}", 3 * height * width).reshape(height, width, 3)
    return np.clip(np.rint(255 * (np.stack(channels, axis=-1) + 0.05 * grain)), 0, 255).astype(np.uint8)


def photographs(name: str, count: int, height: int, width: int) -> torch.Tensor:
    """Return views (count, 3, height, width) in [0, 1]."""
    pictures = np.stack([photograph(name, height, width, view) for view in range(count)])
    return torch.from_numpy(pictures.astype(np.float32) / np.float32(255)).permute(0, 3, 1, 2).contiguous()


def cameras(name: str, count: int, height: int, width: int) -> tuple[Floats, Floats]:
    """Return `cam_from_world` (count, 4, 4), some units apart and turned by up to a radian, and K (count, 3, 3)."""
    values = numbers(f"cameras {name}", 8 * count).astype(np.float64).reshape(count, 8)
    poses, K = np.tile(np.eye(4), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1))
    for pose, (x, y, z) in zip(poses, values[:, :3], strict=True):
        for axis, angle in ((0, x), (1, y), (2, z)):
            turn = np.eye(3)
            i, j = [other for other in range(3) if other != axis]
            turn[i, i] = turn[j, j] = np.cos(angle)
            turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
            pose[:3, :3] = turn @ pose[:3, :3]
    poses[:, :3, 3] = 4 * values[:, 3:6]
    K[:, 0, 0], K[:, 1, 1] = width * (1 + 0.2 * values[:, 6]), width * (1 + 0.2 * values[:, 7])
    K[:, 0, 2], K[:, 1, 2] = width / 2, height / 2
    return poses, K
