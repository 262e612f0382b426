"""Matches that agree with one fundamental matrix, without intrinsics."""

import numpy as np
import pytest

from toolkit.features.matching import epipolar_matches
from toolkit.geometry import Floats


def two_views(rng: np.random.Generator, count: int, flat: bool, zoom: float = 1.0) -> tuple[Floats, Floats]:
    """Pixels of points in two images of 960 x 640, the second one `zoom` times as large."""
    depth = np.full(count, 6.0) if flat else rng.uniform(4, 12, count)
    points = np.column_stack([rng.uniform(-1, 1, count) * depth / 2, rng.uniform(-1, 1, count) * depth / 3, depth])
    cos, sin = np.cos(0.1), np.sin(0.1)
    turned = points @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]).T + [0.8, 0.1, 0.2]
    a, b = (900 * seen[:, :2] / seen[:, 2:] + [480, 320] for seen in (points, turned))
    return a, zoom * b


@pytest.mark.parametrize(("flat", "zoom"), [(False, 1.0), (False, 2.5), (True, 1.0)])
def test_the_matches_of_one_motion_are_found(flat: bool, zoom: float) -> None:
    rng = np.random.default_rng(0)
    a, b = two_views(rng, 200, flat, zoom)
    b[120:] = rng.uniform(0, 1, (80, 2)) * [960 * zoom, 640 * zoom]  # wrong matches
    size_b = (round(960 * zoom), round(640 * zoom))
    found = epipolar_matches((960, 640), a + rng.normal(size=a.shape) * 0.3, size_b, b, rng.random(200))
    assert np.mean(np.isin(np.arange(120), found)) > 0.95
    assert np.mean(found >= 120) < 0.1


def test_random_matches_are_none() -> None:
    rng = np.random.default_rng(1)
    for count in (0, 7, 20, 60, 300):
        a, b = (rng.uniform(0, 1, (count, 2)) * [960, 640] for _ in range(2))
        assert not len(epipolar_matches((960, 640), a, (960, 640), b, rng.random(count), tests=1000))


def test_one_point_matched_many_times_is_no_motion() -> None:
    a, b = np.full((50, 2), 100.0), np.full((50, 2), 200.0)
    assert not len(epipolar_matches((960, 640), a, (960, 640), b, np.ones(50)))


@pytest.mark.parametrize("seed", [51, 145, 304])
def test_few_matches_on_a_small_strip_are_no_motion(seed: int) -> None:
    """OpenCV's estimate ended in an assertion: 11 matches of nine points at the edges of two images, and 3 others."""
    rng = np.random.default_rng(seed)
    strip = np.column_stack([1343 + rng.uniform(0, 120, 9), 843 + rng.uniform(0, 40, 9)])
    moved = strip @ np.array([[1.0, 0.0], [0.3, 1.0]]) - 800 + rng.normal(size=(9, 2)) * 0.5
    mixed = np.r_[:9, :2][rng.permutation(11)]
    a, b = (np.r_[points[mixed], rng.uniform(0, 900, (3, 2))] for points in (strip, moved))
    assert not len(epipolar_matches((1600, 900), a, (1600, 900), b, np.ones(14)))
