"""SIFT: where a keypoint is and what it looks like."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.features import features as sift
from toolkit.features.features import (
    DESCRIPTOR_SCALE,
    KINDS,
    LocalFeatures,
    SiftExtractor,
    SiftSettings,
    mutual_matches,
    stretch_contrast,
    unit_descriptors,
)

Described = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Keypoints (N, 2) and unit descriptors (N, D)."""


def textured(seed: int, width: int = 320, height: int = 240) -> NDArray[np.uint8]:
    """A picture with structure at several scales."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.random((n * 3 // 4, n)), (width, height), interpolation=cv2.INTER_CUBIC) for n in (8, 24, 64)
    ]
    return np.clip(255 * sum(layers) / 3, 0, 255).astype(np.uint8)


def spots(width: int, height: int, xy: NDArray[np.float64], sigma: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Bright Gaussian spots at given places, the center of the top-left pixel being (0.5, 0.5)."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    image = np.full((height, width), 40.0)
    for (cx, cy), s in zip(xy, sigma, strict=True):
        image += 180 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))
    # With black and white present, the stretch of the contrast leaves the tops of the spots round.
    image[: height // 25], image[-(height // 25) :] = 0, 255
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints, b.keypoints)
    np.testing.assert_array_equal(a.scales, b.scales)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)
    assert a.image_size == b.image_size


@pytest.mark.parametrize(
    ("width", "height", "min_side", "max_side"),
    [
        pytest.param(640, 480, 0, 4000, id="as it is"),
        pytest.param(400, 300, 640, 4000, id="enlarged"),
        pytest.param(900, 675, 0, 600, id="reduced"),
        pytest.param(1001, 607, 0, 640, id="reduced to a rounded size"),
    ],
)
def test_keypoints_are_where_the_spots_are_however_the_image_is_turned(
    width: int, height: int, min_side: int, max_side: int
) -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid([0.2, 0.4, 0.6, 0.8], [0.25, 0.5, 0.75]), -1).reshape(-1, 2) * [width, height]
    xy = grid + rng.uniform(-10, 10, grid.shape)
    zoom = np.clip(max(width, height), min_side, max_side) / max(width, height)
    image = spots(width, height, xy, rng.uniform(4, 7, len(xy)) / zoom)
    extractor = SiftExtractor(SiftSettings(min_long_side=min_side, max_long_side=max_side))
    biases = []
    for quarter_turns in range(4):
        errors = []
        found = extractor.extract([np.ascontiguousarray(np.rot90(image, quarter_turns))])[0]
        x, y = xy.T
        expected = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][quarter_turns]
        assert found.image_size == ((width, height) if quarter_turns % 2 == 0 else (height, width))
        for place in np.column_stack(expected):
            apart = found.keypoints - place
            errors.append(apart[np.argmin((apart**2).sum(1))] * zoom)
        close = [error for error in errors if np.abs(error).max() < 2]
        assert len(close) >= 8  # the refinement of one now and then does not settle
        assert np.abs(close).max() < 0.25
        biases.append(np.mean(close, axis=0))
    # A shift by half a pixel, as of another pixel convention, would show as a bias of 0.5 here.
    assert np.abs(biases).max() < 0.05


def test_scale_is_the_size_of_the_spot_in_pixels_of_the_file() -> None:
    image = spots(800, 600, np.array([[400.0, 300.0]]), np.array([12.0]))
    for side in (400, 800):
        found = SiftExtractor(SiftSettings(min_long_side=0, max_long_side=side)).extract([image])[0]
        nearest = np.argmin(((found.keypoints - [400, 300]) ** 2).sum(1))
        # A difference of Gaussians answers strongest a little below the blob's own size.
        assert 0.6 * 12 < found.scales[nearest] < 1.4 * 12


def test_shapes_types_and_order() -> None:
    image = textured(0)
    found = SiftExtractor().extract([image])[0]
    n = len(found)
    assert n > 200
    assert (found.keypoints.shape, found.keypoints.dtype) == ((n, 2), np.float32)
    assert (found.scales.shape, found.scales.dtype) == ((n,), np.float32)
    assert (found.descriptors.shape, found.descriptors.dtype) == ((n, 128), np.uint8)
    assert found.image_size == (320, 240)
    assert found.keypoints.min() > 0
    assert (found.keypoints < [320, 240]).all()
    lengths = np.linalg.norm(found.descriptors / DESCRIPTOR_SCALE, axis=1)
    np.testing.assert_allclose(lengths, 1, atol=0.02)


def test_the_strongest_are_kept_and_come_first() -> None:
    image = textured(1)
    everything = SiftExtractor(SiftSettings(max_keypoints=100_000)).extract([image])[0]
    few = SiftExtractor(SiftSettings(max_keypoints=100)).extract([image])[0]
    assert 90 <= len(few) <= 100  # one keypoint may have several orientations
    strongest = {tuple(xy) for xy in everything.keypoints[:130]}
    assert sum(tuple(xy) in strongest for xy in few.keypoints) >= 0.95 * len(few)
    # Spots of falling contrast, at equal size: the order is the contrast's.
    y, x = np.mgrid[0:480, 0:640] + 0.5
    faint = np.full((480, 640), 20.0)
    for index, cx in enumerate((500.3, 100.3, 300.3)):
        faint += (220, 140, 60)[index] * np.exp(-((x - cx) ** 2 + (y - 240.2) ** 2) / (2 * 5.0**2))
    keypoints = SiftExtractor().extract([faint.astype(np.uint8)])[0].keypoints
    first = [int(np.argmax(np.hypot(*(keypoints - [cx, 240.2]).T) < 1)) for cx in (500.3, 100.3, 300.3)]
    assert first == sorted(first)
    assert len(set(first)) == 3


def test_a_dark_picture_gives_the_same_features() -> None:
    image = textured(2, 640, 480)
    dark = np.round(image * 0.15 + 12).astype(np.uint8)
    bright, found = SiftExtractor().extract([image])[0], SiftExtractor().extract([dark])[0]
    assert len(found) > 0.7 * len(bright)
    matches = mutual_matches(unit_descriptors(bright.descriptors) @ unit_descriptors(found.descriptors).T)
    apart = np.linalg.norm(bright.keypoints[matches[:, 0]] - found.keypoints[matches[:, 1]], axis=1)
    assert (apart < 1).sum() > 0.6 * len(bright)
    assert (apart < 1).mean() > 0.95


def test_stretch_contrast_keeps_a_full_picture_and_limits_the_gain() -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (256, 1))
    assert np.abs(stretch_contrast(ramp).astype(int) - ramp).max() <= 6
    faint = np.where(np.indices((64, 64)).sum(0) // 8 % 2, 101, 100).astype(np.uint8)
    assert np.ptp(stretch_contrast(faint)) <= 8  # noise of one gray value is not blown up to the full range


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(np.zeros((480, 640), np.uint8), id="black"),
        pytest.param(np.full((480, 640), 255, np.uint8), id="white"),
        pytest.param(np.tile(np.linspace(0, 255, 640).astype(np.uint8), (480, 1)), id="ramp"),
        pytest.param(np.full((1, 1), 7, np.uint8), id="one pixel"),
        pytest.param(np.full((2, 900), 7, np.uint8), id="a strip"),
    ],
)
def test_no_structure_no_features(image: NDArray[np.uint8]) -> None:
    found = SiftExtractor().extract([image])[0]
    assert len(found) == 0
    assert found.keypoints.shape == (0, 2)
    assert (found.descriptors.shape, found.descriptors.dtype) == ((0, 128), np.uint8)
    assert found.image_size == (image.shape[1], image.shape[0])


def test_sift_of_a_color_image_is_that_of_its_gray_one() -> None:
    gray = textured(0)
    color = np.repeat(gray[:, :, None], 3, axis=2)
    assert_same(*SiftExtractor().extract([color, gray]))


def test_keypoints_and_directions_are_those_of_opencv() -> None:
    image = textured(3, 640, 480)
    found = SiftExtractor(SiftSettings(max_keypoints=100_000)).extract([image])[0]
    opencv = cv2.SIFT.create(contrastThreshold=0.01, enable_precise_upscale=True)
    expected = opencv.detect(stretch_contrast(image), None)
    strong = sorted(expected, key=lambda keypoint: -keypoint.response)[: len(expected) // 2]
    tree = cKDTree(found.keypoints)
    near = [tree.query_ball_point(np.array(keypoint.pt) + 0.5, 0.5) for keypoint in strong]
    same = [
        any(abs(np.log2(found.scales[index] / (keypoint.size / 2))) < 0.1 for index in indices)
        for keypoint, indices in zip(strong, near, strict=True)
    ]
    assert np.mean(same) > 0.9
    # As many directions for a keypoint: OpenCV repeats the keypoint for each, too.
    directions = [
        len(np.unique(features, axis=0)) / len(features) for features in (found.keypoints, points_of(expected))
    ]
    assert abs(directions[0] - directions[1]) < 0.08


def points_of(keypoints: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    return np.array([keypoint.pt for keypoint in keypoints], np.float32)


@pytest.mark.parametrize("degrees", [90, 180, 270, 30, 45])
def test_a_turned_picture_has_the_same_descriptors(degrees: int) -> None:
    image = textured(4, 480, 480)
    turn = cv2.getRotationMatrix2D((239.5, 239.5), degrees, 1.0)
    turned = np.asarray(cv2.warpAffine(image, turn, (480, 480), borderMode=cv2.BORDER_REFLECT), np.uint8)
    a, b = SiftExtractor().extract([image, turned])
    inside = np.linalg.norm(a.keypoints - 240, axis=1) < 200
    a = a.take(np.flatnonzero(inside))
    matches = mutual_matches(unit_descriptors(a.descriptors) @ unit_descriptors(b.descriptors).T, ratio=0.85)
    expected = (a.keypoints[matches[:, 0]] - 0.5) @ turn[:, :2].T + turn[:, 2] + 0.5
    right = np.linalg.norm(b.keypoints[matches[:, 1]] - expected, axis=1) < 1
    assert right.mean() > 0.97
    assert right.sum() > 0.6 * len(a)


def test_a_picture_of_twice_the_size_has_the_same_descriptors() -> None:
    image = textured(5, 640, 480)
    large = np.asarray(cv2.resize(image, (1280, 960), interpolation=cv2.INTER_CUBIC), np.uint8)
    a, b = SiftExtractor().extract([image, large])
    matches = mutual_matches(unit_descriptors(a.descriptors) @ unit_descriptors(b.descriptors).T, ratio=0.85)
    right = np.linalg.norm(2 * a.keypoints[matches[:, 0]] - b.keypoints[matches[:, 1]], axis=1) < 2
    assert right.mean() > 0.95
    assert right.sum() > 0.5 * len(a)
    ratios = b.scales[matches[right, 1]] / a.scales[matches[right, 0]]
    assert 1.9 < np.median(ratios) < 2.1


def views_from_the_side(seed: int = 6) -> list[NDArray[np.uint8]]:
    """Return a picture, and the same half as wide, each with noise of its own."""
    image = textured(seed, 640, 480)
    rng = np.random.default_rng(0)
    side = cv2.resize(image, (352, 480), interpolation=cv2.INTER_AREA)
    return [np.clip(view + rng.normal(0, 6, view.shape), 0, 255).astype(np.uint8) for view in (image, side)]


def right_and_wrong(a: Described, b: Described) -> tuple[int, int]:
    """Return the numbers of right and wrong matches of `views_from_the_side`, each a pair of keypoints and vectors."""
    matches = mutual_matches(a[1] @ b[1].T, ratio=0.85)
    apart = a[0][matches[:, 0]] * [0.55, 1.0] - b[0][matches[:, 1]]
    right = int((np.linalg.norm(apart, axis=1) < 2).sum())
    return right, len(matches) - right


def test_more_matches_of_two_views_are_right_than_with_opencv() -> None:
    views = views_from_the_side()
    sift = cv2.SIFT.create(nfeatures=3072, contrastThreshold=0.01, enable_precise_upscale=True)
    theirs = []
    for view in views:
        keypoints, descriptors = sift.detectAndCompute(stretch_contrast(view), None)
        root = np.sqrt(descriptors / descriptors.sum(axis=1, keepdims=True))
        theirs.append((points_of(keypoints) + 0.5, root.astype(np.float32)))
    ours = [(found.keypoints, unit_descriptors(found.descriptors)) for found in SiftExtractor().extract(views)]
    assert right_and_wrong(*ours)[0] > right_and_wrong(*theirs)[0] > 50


def test_shortened_descriptors_match_as_well_as_full_ones() -> None:
    counts = np.zeros((2, 2), int)
    for seed in (6, 7, 8):
        found = SiftExtractor().extract(views_from_the_side(seed))
        for row, shorten in enumerate([None, KINDS["sift"].shorten]):
            a, b = [(one.keypoints, unit_descriptors(one.descriptors, shorten)) for one in found]
            counts[row] += right_and_wrong(a, b)
    (right, wrong), (short_right, short_wrong) = counts.tolist()
    assert short_right >= right > 500
    assert short_wrong <= 1.1 * wrong


@pytest.mark.parametrize(("width", "height"), [(13, 700), (700, 13), (31, 33), (5, 5), (641, 479)])
def test_pictures_of_odd_sizes(width: int, height: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (height, width)).astype(np.uint8)
    found = SiftExtractor().extract([noise])[0]
    assert found.image_size == (width, height)
    assert (found.keypoints >= 0).all()
    assert (found.keypoints <= [width, height]).all()
    assert np.isfinite(found.keypoints).all()
    lengths = np.linalg.norm(found.descriptors / DESCRIPTOR_SCALE, axis=1)
    np.testing.assert_allclose(lengths, 1, atol=0.05)


@pytest.mark.parametrize("rows", [1, 7, 10_000])
def test_extrema_do_not_depend_on_the_bands_in_which_they_are_searched(
    monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    expected = SiftExtractor().extract([textured(3)])[0]
    monkeypatch.setattr(sift, "_ROWS", rows)
    found = SiftExtractor().extract([textured(3)])[0]
    np.testing.assert_array_equal(found.keypoints, expected.keypoints)
    np.testing.assert_array_equal(found.descriptors, expected.descriptors)


def test_a_contrast_of_nothing_keeps_every_extremum(monkeypatch: pytest.MonkeyPatch) -> None:
    image, flat = textured(7), np.full((64, 64), 9, np.uint8)
    extractor = SiftExtractor(SiftSettings(min_long_side=0, max_keypoints=100_000))
    monkeypatch.setattr(sift, "MIN_CONTRAST", 0.05)
    (few,) = extractor.extract([image])
    monkeypatch.setattr(sift, "MIN_CONTRAST", 0.0)
    many, none = extractor.extract([image, flat])
    assert 0 < len(few) < len(many)
    assert few.scores.min() * 3 >= 0.05
    assert len(none) == 0


@pytest.mark.parametrize("equal", [(0, 0, 1), (0, 1, 0), (0, 1, -1), (1, 0, 0), (1, 1, 1)])
def test_of_equal_neighbors_only_the_first_is_an_extremum(equal: tuple[int, int, int]) -> None:
    differences = np.zeros((5, 40, 40), np.int16)
    first, second = (2, 20, 20), tuple(np.add((2, 20, 20), equal).tolist())
    differences[first] = differences[second] = 1000
    levels = np.concatenate([np.zeros((1, 40, 40)), np.cumsum(differences, axis=0)]).astype(np.int16)
    (found,) = sift._extrema(levels, 0.01)
    assert np.unravel_index(found, levels.shape) == first


def test_the_memory_of_the_last_image_does_not_show_in_the_next() -> None:
    extractor, images = SiftExtractor(), [textured(3), textured(4)[:200, :300], textured(3), textured(5)[:150]]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda image: extractor.extract([image])[0], images * 3))
    for image, features in zip(images * 3, found, strict=True):
        assert_same(features, SiftExtractor().extract([image])[0])


def test_a_large_image_does_not_stay_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = SiftExtractor().extract([textured(3)])[0]
    monkeypatch.setattr(sift, "_MAX_KEPT", 10_000)
    extractor = SiftExtractor()
    assert_same(extractor.extract([textured(3)])[0], expected)
    assert len(extractor._memory.values) == 0
