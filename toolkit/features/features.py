"""Local features of images, and the kinds that can be extracted; SIFT (Lowe, IJCV 2004) with RootSIFT descriptors
(Arandjelovic and Zisserman, CVPR 2012), on whole arrays; and mutual nearest neighbors among them. `stores` keeps
features in files, `matching` has the other ways to match them.

All keypoints of an image are refined, oriented and described together, which takes less than two thirds of the time of
OpenCV's SIFT. Two choices differ from OpenCV, and both give more correct matches:

- A keypoint may be up to 0.6 pixels from its pixel, as in VLFeat, so fewer are lost between two pixels.
- A cell of the descriptor is 4 sigma wide instead of 3.

Matrix products are of integers, or of multiples of a power of two, that float32 sums without rounding. So neither the
number of threads nor the kernel that BLAS has for a processor changes a feature.

A RootSIFT descriptor is a 4 x 4 x 8 array: rows and columns of cells, and directions. Its cosine transform over rows
and columns and Fourier transform over directions decorrelate it nearly as well as principal components, and need no
training. The 64 components with the largest standard deviation are kept. Each is divided by the square root of its
standard deviation, halfway to whitening, so that the few strong components do not outweigh the others. With the same
ratio test, shortened and full descriptors give equally many right matches, and equally many wrong ones (STRECHA and
STRECHA_HARD, 378 pairs of query and reference each).

Components and shortened descriptors are multiples of `STEP`, so that float32 holds their products and sums without
rounding: scores, and so matches, are the same for every number of threads and every kernel of BLAS.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture.images import invertible, read_image, sees_all, turn_image, turn_points
from toolkit.errors import ImageError, ManifestError
from toolkit.files import Remade
from toolkit.geometry import Ints, rounded, unit
from toolkit.manifest import AUTO, FeaturesSettings, SiftSettings, checkpoint_of, nearest
from toolkit.threads import fixed_sums

# Of shorter descriptors
LENGTH = 64  # length of a shortened descriptor
STEP = 2**-11
# Measured on 20 photographs that are not in STRECHA or STRECHA_HARD, whose deviations differ by 5 %.
_DEVIATIONS = np.array([
    [[74, 140, 116, 152, 105, 49, 40, 56], [95, 124, 67, 95, 72, 41, 33, 30],
     [54, 107, 44, 68, 44, 36, 25, 24], [29, 94, 24, 36, 29, 23, 18, 16]],
    [[71, 57, 108, 91, 78, 32, 35, 26], [51, 65, 72, 51, 54, 26, 27, 19],
     [30, 63, 52, 42, 42, 22, 24, 16], [21, 47, 27, 23, 25, 15, 16, 11]],
    [[48, 36, 87, 50, 41, 25, 25, 18], [33, 42, 65, 38, 35, 21, 21, 15],
     [27, 42, 46, 28, 29, 18, 17, 14], [16, 46, 25, 19, 20, 14, 12, 11]],
    [[25, 19, 60, 30, 30, 16, 19, 13], [19, 21, 47, 22, 23, 14, 15, 11],
     [16, 21, 41, 19, 22, 12, 14, 10], [14, 18, 21, 12, 16, 11, 10, 9]],
]) / 1000  # fmt: skip
"""Standard deviations of the components: frequency along the first and the second axis of the cells, and directions
(mean; cosine and sine of one, two and three periods; cosine of four)."""

DESCRIPTOR_SCALE = 512.0  # factor by which RootSIFT vectors of length 1 are stored as uint8, as in COLMAP
Descriptors = NDArray[np.uint8] | NDArray[np.float16] | NDArray[np.float32]
Shorten = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # unit descriptors (N, D) -> shorter unit vectors

# Of SIFT
_Floats = NDArray[np.float32]
_Levels = NDArray[np.int16]
_FORMAT = 6  # Version of the features, part of the settings. Increase when the same settings give other features
MIN_CONTRAST = 0.01  # smallest contrast of a keypoint, after the image's contrast is stretched to the full range
_INTERVALS = 3  # number of levels per octave in which keypoints are detected
_SIGMA = 1.6  # blur of the first level of an octave, pixels of the octave
_BLURS = _SIGMA * 2 ** (np.arange(_INTERVALS + 3) / _INTERVALS)  # blur of each level of an octave, pixels of the octave
_KERNEL_SIGMAS = 3.0  # radius of the blurring kernels, in units of their sigma
_WHITE = 255 * 128  # white in the levels; rounding to integers usually moves a keypoint by less than 0.01 pixels
_MAX_KEPT = 1 << 26  # values that a thread keeps for its next pyramid, 128 MB; 1280 x 960 pixels need 39 million
_CAMERA_SIGMA = 0.5  # assumed blur of the input image, pixels of the image
_BORDER = 5  # smallest distance of a keypoint from the border of an octave, pixels of the octave
_EDGE_RATIO = 10.0  # largest ratio of the principal curvatures; keypoints with a larger one lie on an edge
_MAX_OFFSET = 0.6  # largest distance of a keypoint from its pixel, in x (pixels), y (pixels) and level
_MAX_FITS = 5  # times that the parabola is fitted: a keypoint can move to a neighboring pixel between two fits
_BINS = 36  # number of bins of the orientation histogram
_PEAK = 0.8  # smallest height, relative to the highest, of a peak in the histogram that gives an orientation
_WINDOW_SIGMA = 1.5  # sigma of the Gaussian window of the orientation histogram, in units of the keypoint's sigma
_CELLS = 4  # number of descriptor cells in x and in y
_DIRECTIONS = 8  # number of gradient directions in the histogram of a descriptor cell
_CELL_SIGMAS = 4.0  # width of a descriptor cell, in units of the keypoint's sigma
_MAX_ENTRY = 0.2  # limit of the entries of a descriptor of length 1, before it becomes RootSIFT
_SUBPIXELS = 2048  # steps per pixel of the position of a gradient; with those of 4,096 pixels, it has 23 bits
_WEIGHT_STEPS, _MAGNITUDE_UNIT = 128, 4
"""A gradient's weight in a cell and its magnitude are integers: multiples of 1 / 128 of the largest weight, and of 4 of
the 2**15 gray values. No sum of a cell exceeds 1.1e7, below 2**24, where float32 starts to round."""
_ROWS = 128  # number of rows in which extrema are searched at once, so that they fit into the processor's cache
_CHUNK = 256  # number of keypoints whose gradients are processed at once, so that they fit into the processor's cache
_NEIGHBORS = np.ones((3, 3), np.uint8)


def _components() -> NDArray[np.float32]:
    """Return the matrix (128, `LENGTH`) from descriptors to weighted components."""
    along_cells = unit(np.cos(np.pi / 4 * np.outer(np.arange(4), np.arange(4) + 0.5)))
    angles = 2 * np.pi * np.arange(8) / 8
    waves = [wave(periods * angles) for periods in (1, 2, 3) for wave in (np.cos, np.sin)]
    directions = unit(np.stack([np.ones(8), *waves, np.cos(4 * angles)]))
    components = np.einsum("ai,bj,ck->abcijk", along_cells, along_cells, directions).reshape(128, 128)
    kept = np.argsort(-_DEVIATIONS, axis=None, kind="stable")[:LENGTH]
    weighted = components[kept] / np.sqrt(_DEVIATIONS.reshape(-1)[kept, None])
    return rounded(weighted, STEP).T


_COMPONENTS = _components()


def rootsift_64(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return RootSIFT descriptors (N, 128) as unit vectors (N, `LENGTH`).

    Imported features of an unknown kind may have descriptors of another length; they stay as they are. The name of this
    function is part of the fingerprint of matches: rename it if it returns other vectors.
    """
    if descriptors.shape[1] != len(_COMPONENTS):
        return descriptors
    shortened = descriptors @ _COMPONENTS
    # In float64, the squares and their sums are exact, too.
    steps = 1 / (STEP * np.sqrt(np.einsum("nd,nd->n", shortened, shortened, dtype=np.float64)).clip(1e-12))
    return np.asarray(np.rint(shortened * steps[:, None].astype(np.float32)) * STEP)


# Features and their kinds


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image as it is stored, strongest response first."""

    keypoints: NDArray[np.float32]  # (N, 2) x y, pixels; the center of the top-left pixel is (0.5, 0.5)
    scales: NDArray[np.float32]  # (N,) sizes: standard deviation of the blob, pixels; 1 for detectors without scale
    scores: NDArray[np.float32]  # (N,) response of the detector, larger is better; comparable only within one kind
    descriptors: Descriptors  # (N, D) unit vectors; or uint8, such vectors >= 0 times `DESCRIPTOR_SCALE` (RootSIFT)
    image_size: tuple[int, int]  # width and height of the image, pixels
    turns: int = 0  # counter-clockwise quarter turns before extraction; keypoints are in the image as stored

    def __len__(self) -> int:
        return len(self.keypoints)

    @classmethod
    def none(cls, image_size: tuple[int, int]) -> "LocalFeatures":
        """Return an empty set of features."""
        zeros = np.zeros(0, np.float32)
        return cls(zeros.reshape(0, 2), zeros, zeros, np.zeros((0, 128), np.uint8), image_size)

    def take(self, part: slice | Ints) -> "LocalFeatures":
        """Return some of the features, by index."""
        arrays: Any = {name: getattr(self, name)[part] for name in ("keypoints", "scales", "scores", "descriptors")}
        return replace(self, **arrays)

    def turned(self, turns: int) -> "LocalFeatures":
        """Return the features in the image after counter-clockwise quarter turns of it."""
        width, height = self.image_size
        keypoints = turn_points(self.keypoints, width, height, turns).astype(np.float32)
        size = (height, width) if turns % 2 else (width, height)
        return replace(self, keypoints=keypoints, image_size=size, turns=(self.turns - turns) % 4)


class Extractor(Protocol):
    """Extracts local features of one kind."""

    color: bool  # whether `extract` takes RGB images (H, W, 3) or gray ones (H, W)
    batch_size: int  # the fastest number of images per call
    threaded: bool  # whether it is fastest to call `extract` with one image at a time from several threads

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that the features depend on besides the images, `name` first; part of their fingerprint."""

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of uint8 images of any sizes."""


def shorten_settings(shorten: Shorten | None) -> dict[str, str]:
    """Return how descriptors are shortened, for the fingerprint of their matches."""
    return {} if shorten is None else {"shorten": shorten.__name__}


@dataclass(frozen=True)
class FeatureKind:
    """How one kind of local features is extracted and matched. Scores are cosine similarities of descriptors."""

    extractor: str  # `module:callable` that makes the extractor; imported when needed
    matchers: tuple[str, ...]  # keys of `matching.MATCHERS` for queries and references, the default first
    ratio: float  # Lowe's ratio of `mutual` between a query and a reference; 1: no ratio test
    min_score: float  # smallest score of a `mutual` match between a query and a reference
    epipolar_min_score: float  # smallest score of a match between map images along an epipolar line
    guided_min_score: float  # smallest score of a guided match, near the projection of a map point
    scale_octaves: float  # largest difference of a keypoint's size and the size that the map predicts, in octaves
    upright: bool = True  # whether they were learned from upright images, so that images are turned upright for them
    shorten: Shorten | None = None  # makes unit descriptors (N, D) shorter before they are compared; None: as they are


KINDS: dict[str, FeatureKind] = {
    # RootSIFT has no negative entries: unrelated patches already score about 0.7 (shortened, too), so the ratio test
    # decides. The less the geometry restricts the candidates, the higher the minimum score must be.
    "sift": FeatureKind(
        "toolkit.features.features:SiftExtractor", ("mutual",), 0.85, -1.0, epipolar_min_score=0.6,
        guided_min_score=0.75, scale_octaves=1.0, upright=False, shorten=rootsift_64,
    ),
    # Scores of unrelated patches scatter around 0, and similar patches are common: the usual test is a distance below
    # 0.7 (hloc's NN-superpoint), a cosine of 1 - 0.7^2 / 2, without a ratio test. All keypoints have the same size.
    "superpoint": FeatureKind(
        "toolkit.features.network:SuperPointExtractor", ("lightglue", "mutual"), 1.0, 0.755,
        epipolar_min_score=0.755, guided_min_score=0.755, scale_octaves=float("inf"),
    ),
    # Measured on photographs by day and by simulated night (STRECHA, STRECHA_HARD): 97 % and 93 % of the mutual matches
    # above 0.7 are correct. In searches within 0.7 degrees, 0.4 % of unrelated features score above 0.5, and 93 % of
    # the true partners by night. With a wrong relative pose, 0.1 % of the matches along epipolar lines remain.
    "aliked": FeatureKind(
        "toolkit.features.network:AlikedExtractor", ("lightglue", "mutual"), 1.0, 0.7,
        epipolar_min_score=0.5, guided_min_score=0.5, scale_octaves=float("inf"),
    ),
}  # fmt: skip
"""The kinds of local features that a manifest can name."""


def feature_kind(name: str) -> FeatureKind:
    """Return the entry of `KINDS` with a name. Raise ManifestError for an unknown name."""
    if name not in KINDS:
        raise ManifestError(f"Unknown local features {name!r}. {nearest(name, [*KINDS, AUTO])}")
    return KINDS[name]


def create_extractor(name: str, settings: FeaturesSettings, device: str = "auto", dtype: str = "auto") -> Extractor:
    """Return a ready extractor of the kind `name`, a key of `KINDS`; `settings` are those of all kinds, by name.

    Device and precision of a network: see `models.compute`. Raise ManifestError for an unknown kind, WeightsError for a
    network without weights.
    """
    make, own = resolve_name(feature_kind(name).extractor), getattr(settings, name, None)
    network = checkpoint_of(settings.checkpoint, name), device, dtype
    extractor: Extractor = make(own) if name == "sift" else make(*network, settings=own)
    return extractor


def extract_turned(
    extractor: Extractor, images: Sequence[NDArray[np.uint8]], turns: Sequence[int]
) -> list[LocalFeatures]:
    """Extract features after counter-clockwise quarter turns; return them in the images as stored."""
    upright = extractor.extract([turn_image(image, turn) for image, turn in zip(images, turns, strict=True)])
    return [features.turned(-turn) if turn else features for features, turn in zip(upright, turns, strict=True)]


def usable(features: LocalFeatures, mask: Path | None, camera: pycolmap.Camera) -> LocalFeatures:
    """Return the features outside of the black pixels of an image's mask, as COLMAP does, that have a viewing ray.

    Raise ImageError if the mask cannot be read, has another size than the image as stored, or is black everywhere.
    """
    if not sees_all(camera):
        features = features.take(np.flatnonzero(invertible(camera, features.keypoints)))
    if mask is None:
        return features
    pixels, (width, height) = read_image(mask, gray=True), features.image_size
    if pixels.shape != (height, width):
        found = f"Mask of {pixels.shape[1]} x {pixels.shape[0]} pixels"
        raise ImageError(f"{found}, but the image has {width} x {height}: {mask}")
    if not pixels.any():
        raise ImageError(f"No features, as the mask of the image is black everywhere: {mask}")
    x, y = np.clip(features.keypoints.astype(np.int64), 0, [width - 1, height - 1]).T
    return features.take(np.flatnonzero(pixels[y, x]))


# SIFT


def stretch_contrast(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Stretch the 1st to 99th percentile of an image to the full range, with a gain of at most 8.

    A gain does not change SIFT descriptors, but a dark image has no keypoints above a fixed contrast threshold.
    """
    low, high = np.percentile(gray[::4, ::4], (1.0, 99.0))
    gain = min(255.0 / max(high - low, 1.0), 8.0)
    table = np.clip((np.arange(256) - low) * gain, 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(gray, table), np.uint8)


class SiftExtractor(Remade):
    """Extracts RootSIFT features. Safe to use from several threads."""

    color = False
    batch_size = 1
    threaded = True

    def __init__(self, settings: SiftSettings | None = None):
        self._settings = settings or SiftSettings()
        self._memory = _Memory()

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": "sift", **self._settings.model_dump(), "format": _FORMAT}

    @fixed_sums
    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, (H, W) gray or (H, W, 3) RGB, uint8."""
        return [self._extract(image) for image in images]

    def _extract(self, image: NDArray[np.uint8]) -> LocalFeatures:
        settings = self._settings
        gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        height, width = gray.shape
        long_side = max(height, width)
        target = float(np.clip(long_side, settings.min_long_side, settings.max_long_side))
        size = (max(1, round(width * target / long_side)), max(1, round(height * target / long_side)))
        image = stretch_contrast(gray)
        if size != (width, height):
            interpolation = cv2.INTER_AREA if size[0] < width else cv2.INTER_CUBIC
            image = np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)
        pyramid = _Pyramid(image, self._memory)
        keypoints = _detect(pyramid, MIN_CONTRAST)
        if not len(keypoints.x):
            return LocalFeatures.none((width, height))
        keypoints = keypoints.take(np.argsort(-keypoints.response, kind="stable")[: settings.max_keypoints])
        index, angles = _orientations(pyramid, keypoints)
        keypoints, angles = keypoints.take(index[: settings.max_keypoints]), angles[: settings.max_keypoints]
        # The first octave has twice the size of the image, so the center of its first pixel is at 0.25 in the image.
        pixel_size = 2.0 ** (keypoints.octave - 1)
        scale = np.array([width / size[0], height / size[1]])
        xy = (np.stack([keypoints.x, keypoints.y], 1) * pixel_size[:, None] + 0.25) * scale
        return LocalFeatures(
            xy.astype(np.float32),
            (keypoints.sigma * pixel_size * scale.mean()).astype(np.float32),
            keypoints.response,
            _descriptors(pyramid, keypoints, angles),
            (width, height),
        )


class _Memory(threading.local):
    """The memory of a thread's largest pyramid, for its next one: the system takes long to give new memory."""

    values: _Levels = np.empty(0, np.int16)

    def take(self, count: int) -> _Levels:
        """Return an array of this length; it may share its memory with the last one."""
        if count > _MAX_KEPT:
            return np.empty(count, np.int16)
        if len(self.values) < count:
            self.values = np.empty(count, np.int16)
        return self.values[:count]


class _Pyramid:
    """Blurred copies of an image: octaves with 6 levels of increasing blur, each half as large as the one before.

    The first octave has twice the size of the image. The first three levels of every other octave are the last three of
    the octave before, at half their size.
    """

    def __init__(self, image: NDArray[np.uint8], memory: _Memory) -> None:
        heights, widths = [2 * image.shape[0]], [2 * image.shape[1]]
        while min(heights[-1], widths[-1]) > 4 * _BORDER + 4:
            heights.append((heights[-1] + 1) // 2)
            widths.append((widths[-1] + 1) // 2)
        self.heights, self.widths = np.array(heights), np.array(widths)  # (O,) pixels, for each octave
        self.sizes = self.heights * self.widths  # (O,) pixels of a level, for each octave
        ends = np.cumsum(len(_BLURS) * self.sizes)
        self.starts = ends - len(_BLURS) * self.sizes  # (O,) index in `values` at which each octave starts
        # The pixels of all levels, one level after the other, from 0 to `_WHITE`.
        self.values: _Levels = memory.take(ends[-1])
        # For each octave, its levels (6, H, W): views of `values`.
        self.octaves = [
            self.values[start:end].reshape(-1, height, width)
            for start, end, height, width in zip(self.starts, ends, heights, widths, strict=True)
        ]
        scaled = image.astype(np.int16) * np.int16(_WHITE // 255)
        first = np.asarray(cv2.resize(scaled, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR), np.int16)
        _blur(first, 2 * _CAMERA_SIGMA, _BLURS[0], self.octaves[0][0])
        available = 1
        for octave, levels in enumerate(self.octaves):
            if octave:
                available = _INTERVALS
                levels[:available] = self.octaves[octave - 1][-available:, ::2, ::2]
            for level in range(available, len(_BLURS)):
                _blur(levels[level - 1], _BLURS[level - 1], _BLURS[level], levels[level])

    def locate(self, at: Ints) -> tuple[Ints, Ints]:
        """Return the octaves (N,), and levels, y and x (3, N), of N indices into `values`, (N,)."""
        octave = np.searchsorted(self.starts, at, side="right") - 1
        level, in_level = np.divmod(at - self.starts[octave], self.sizes[octave])
        return octave, np.stack([level, *np.divmod(in_level, self.widths[octave])])


def _blur(image: _Levels, sigma: float, wanted_sigma: float, out: _Levels) -> None:
    """Blur an image of blur `sigma` to a blur of `wanted_sigma`."""
    kernel_sigma = float(np.sqrt(wanted_sigma**2 - sigma**2))
    kernel_size = 2 * int(np.ceil(_KERNEL_SIGMAS * kernel_sigma)) + 1
    cv2.GaussianBlur(image, (kernel_size, kernel_size), kernel_sigma, dst=out)


class _Keypoints(NamedTuple):
    """N keypoints, as arrays (N,); x, y and sigma in pixels of the octave, the first pixel's center at 0."""

    octave: Ints
    level: Ints  # level of the octave that has about the blur of the keypoint
    x: _Floats
    y: _Floats
    sigma: _Floats
    response: _Floats  # absolute difference of Gaussians at the keypoint, for gray values from 0 to 1

    def take(self, part: Ints) -> "_Keypoints":
        columns: list[Any] = [column[part] for column in self]
        return _Keypoints(*columns)


def _extrema(levels: _Levels, contrast: float) -> Ints:
    """Return the extrema of the difference of Gaussians (6, H, W) of an octave among all 26 neighbors, as flat indices.

    Absolute values are compared: near the extremum of a smooth function, all values have the same sign. Of equal
    neighbors, the first is the extremum. Of those weaker than `contrast`, some are left out already.
    """
    _, height, width = levels.shape
    # The interpolated peak, which must reach the contrast, is a little higher than the pixel.
    # Flat areas, in which all pixels are equal, have none at any contrast.
    least = max(0.8 * contrast / _INTERVALS * _WHITE, 1)
    around = np.array([y * width + x for y in (-1, 0, 1) for x in (-1, 0, 1)])
    extrema = [np.zeros(0, np.int64)]
    for top in range(_BORDER, height - _BORDER, _ROWS):
        # With a row more above and below. Level i of the differences is that of levels i and i + 1.
        rows = levels[:, top - 1 : min(top + _ROWS, height - _BORDER) + 1]
        differences = np.empty((len(levels) - 1, *rows.shape[1:]), np.int16)
        for below, above, difference in zip(rows[:-1], rows[1:], differences, strict=True):
            cv2.absdiff(below, above, dst=difference)
        flat, size = differences.reshape(-1), differences[0].size
        before, after = np.concatenate([around - size, around[:4]]), around + size
        for level in range(1, _INTERVALS + 1):
            threshold = cv2.max(cv2.dilate(differences[level], _NEIGHBORS), least)  # type: ignore[call-overload]
            at = np.flatnonzero(differences[level, 1:-1] >= threshold[1:-1]) + level * size + width
            x = at % width
            at = at[(x >= _BORDER) & (x < width - _BORDER)]
            at = at[(flat[at] > flat[at - size]) & (flat[at] >= flat[at + size])]  # cheap test first; few pass it
            at = at[(flat[at] >= flat[at + after[:, None]]).all(axis=0)]
            at = at[(flat[at] > flat[at + before[:, None]]).all(axis=0)]
            extrema.append(at + level * (height * width - size) + (top - 1) * width)
    return np.concatenate(extrema)


def _detect(pyramid: _Pyramid, contrast: float) -> _Keypoints:
    """Return the keypoints at the peaks of parabolas fitted to extrema, without those of low contrast or on edges."""
    extrema = [_extrema(levels, contrast) for levels in pyramid.octaves]
    at = np.concatenate([start + indices for start, indices in zip(pyramid.starts, extrema, strict=True)])
    parts = []
    for _ in range(_MAX_FITS):
        octave, position = pyramid.locate(at)
        width, height = pyramid.widths[octave], pyramid.heights[octave]
        offset, peak, on_edge = _parabola(pyramid.values, at, width, pyramid.sizes[octave])
        settled = (np.abs(offset) < _MAX_OFFSET).all(axis=0)
        good = settled & (np.abs(peak) * _INTERVALS >= contrast) & ~on_edge
        parts.append((at[good], offset[:, good], np.abs(peak[good])))
        step = (np.sign(offset) * (np.abs(offset) >= _MAX_OFFSET)).astype(np.int64)
        level, y, x = position + step[::-1]
        inside = (level >= 1) & (level <= _INTERVALS)
        inside &= (y >= _BORDER) & (y < height - _BORDER) & (x >= _BORDER) & (x < width - _BORDER)
        at = (pyramid.starts[octave] + (level * height + y) * width + x)[inside & ~settled]
    at, first = np.unique(np.concatenate([part[0] for part in parts]), return_index=True)  # two may have moved to one
    offset = np.concatenate([part[1] for part in parts], axis=1)[:, first]
    octave, (level, y, x) = pyramid.locate(at)
    return _Keypoints(
        octave,
        level,
        (x + offset[0]).astype(np.float32),
        (y + offset[1]).astype(np.float32),
        (_SIGMA * 2 ** ((level + offset[2]) / _INTERVALS)).astype(np.float32),
        np.concatenate([part[2] for part in parts])[first],
    )


def _parabola(flat: _Levels, at: Ints, width: Ints, size: Ints) -> tuple[_Floats, _Floats, NDArray[np.bool_]]:
    """Fit a parabola at N extrema, flat indices `at` into the levels of all octaves, rows of `width` and levels of
    `size`.

    Return offsets (3, N) of the peaks in x, y and level, their heights (N,), and whether they are on an edge (N,).
    """

    def value(offset: Ints | int) -> _Floats:
        index = at + offset
        return (flat.take(index + size) - flat.take(index)) * np.float32(1 / _WHITE)

    center = value(0)
    steps = (1, width, size)
    below, above = [value(-step) for step in steps], [value(step) for step in steps]
    gx, gy, gs = ((b - a) / 2 for a, b in zip(below, above, strict=True))
    xx, yy, ss = (a + b - 2 * center for a, b in zip(below, above, strict=True))
    xy, xs, ys = (
        (value(a + b) - value(a - b) - value(b - a) + value(-a - b)) / 4
        for a, b in ((1, width), (1, size), (width, size))
    )
    # Invert the Hessian by its adjugate: LAPACK takes ten times as long for 3 x 3 matrices.
    edge_determinant = xx * yy - xy * xy
    a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    d, e, f = xx * ss - xs * xs, xy * xs - xx * ys, edge_determinant
    determinant = xx * a + xy * b + xs * c
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        offset = -np.stack([a * gx + b * gy + c * gs, b * gx + d * gy + e * gs, c * gx + e * gy + f * gs]) / determinant
    offset = np.clip(np.nan_to_num(offset, nan=np.inf), -10, 10)  # a singular Hessian gives an offset out of range
    peak = center + np.float32(0.5) * (gx * offset[0] + gy * offset[1] + gs * offset[2])
    on_edge = (edge_determinant <= 0) | ((xx + yy) ** 2 * _EDGE_RATIO >= (_EDGE_RATIO + 1) ** 2 * edge_determinant)
    return offset.astype(np.float32, copy=False), np.asarray(peak, np.float32), on_edge


class _Grid(NamedTuple):
    """K positions around a keypoint at which gradients are sampled."""

    xy1: _Floats  # (K, 3) x and y in steps, multiples of a half, and ones
    step: float  # distance of two neighbors, in units of the keypoint's sigma

    @classmethod
    def square(cls, side: int, step: float) -> "_Grid":
        along = np.arange(side, dtype=np.float32) - np.float32((side - 1) / 2)
        y, x = np.meshgrid(along, along, indexing="ij")
        return cls(np.stack([x.ravel(), y.ravel(), np.ones(x.size, np.float32)], axis=1), step)

    def gradients(self, pyramid: _Pyramid, keypoints: _Keypoints, angles: _Floats) -> tuple[_Floats, _Floats]:
        """Return magnitude (K, N) and direction (K, N), 0 to 2 pi, of the gradients around N keypoints, on grids that
        are rotated by `angles` (N,), radians.

        Gradients are those of the nearest pixels in the keypoint's level; outside the image, the magnitude is 0.
        """
        height = pyramid.heights[keypoints.octave].astype(np.int32)
        width = pyramid.widths[keypoints.octave].astype(np.int32)
        start = pyramid.starts[keypoints.octave] + keypoints.level * pyramid.sizes[keypoints.octave]
        step = keypoints.sigma * np.float32(self.step)
        # Adding a half makes the conversion to integers round.
        half = np.float32(0.5)
        vectors = np.stack([np.cos(angles) * step, np.sin(angles) * step, keypoints.x + half, keypoints.y + half])
        cos, sin, x, y = rounded(vectors, 1 / _SUBPIXELS)
        column = (self.xy1 @ np.stack([cos, -sin, x])).astype(np.int32)
        row = (self.xy1 @ np.stack([sin, cos, y])).astype(np.int32)
        inside = (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
        row *= width
        row += column
        row *= inside  # outside, any pixel will do
        at = row + start
        flat = pyramid.values
        dx, dy = flat.take(at + 1), flat.take(at + width)
        dx -= flat.take(at - 1)
        dy -= flat.take(at - width)
        magnitude, direction = cv2.cartToPolar(dx.astype(np.float32), dy.astype(np.float32))
        magnitude *= inside
        return magnitude, direction


_WINDOW = _Grid.square(12, 0.75)
_WINDOW_WEIGHTS = np.exp(
    -((_WINDOW.step * _WINDOW.xy1[:, :2]) ** 2).sum(axis=1, keepdims=True) / (2 * _WINDOW_SIGMA**2)
)


def _chunks(keypoints: _Keypoints) -> Iterator[Ints]:
    """Yield the indices of all keypoints in chunks of neighbors, so that their pixels stay in the cache."""
    order = np.lexsort((keypoints.y, keypoints.level, keypoints.octave))
    for start in range(0, len(order), _CHUNK):
        yield order[start : start + _CHUNK]


def _orientations(pyramid: _Pyramid, keypoints: _Keypoints) -> tuple[Ints, _Floats]:
    """Return the index of the keypoint (M,), ascending, and the angle (M,), radians, of M orientations."""
    histograms = np.zeros((len(keypoints.x), _BINS))
    for index in _chunks(keypoints):
        magnitude, direction = _WINDOW.gradients(pyramid, keypoints.take(index), np.zeros(len(index), np.float32))
        magnitude *= _WINDOW_WEIGHTS
        bins = np.rint(direction * np.float32(_BINS / (2 * np.pi))).astype(np.int64)
        bins[bins == _BINS] = 0
        bins += np.arange(len(index)) * _BINS
        histograms[index] = np.bincount(bins.ravel(), magnitude.ravel(), len(index) * _BINS).reshape(-1, _BINS)
    around = np.pad(histograms, ((0, 0), (2, 2)), mode="wrap")
    smooth = (around[:, :-4] + 4 * around[:, 1:-3] + 6 * histograms + 4 * around[:, 3:-1] + around[:, 4:]) / 16
    before, after = np.roll(smooth, 1, axis=1), np.roll(smooth, -1, axis=1)
    peaks = (smooth > before) & (smooth >= after) & (smooth >= _PEAK * smooth.max(axis=1, keepdims=True))
    index, peak = np.nonzero(peaks)
    left, top, right = before[peaks], smooth[peaks], after[peaks]
    bins = peak + 0.5 * (left - right) / (left - 2 * top + right)
    return index, (bins * (2 * np.pi / _BINS)).astype(np.float32)


def _descriptor_grid() -> tuple[_Grid, _Floats]:
    """Return the grid of the descriptor's K gradients, and the weight (16, K) of each in each cell, an integer."""
    along = (np.arange(15) - 7) / 3  # in cells: three gradients per cell, and half a cell more on both sides
    centers = np.arange(_CELLS) - (_CELLS - 1) / 2
    shares = np.maximum(1 - np.abs(along - centers[:, None]), 0) * np.exp(-((along / _CELLS) ** 2) * 2)
    weights = (shares[:, None, :, None] * shares[None, :, None, :]).reshape(_CELLS**2, -1)
    return _Grid.square(len(along), _CELL_SIGMAS / 3), np.rint(weights * _WEIGHT_STEPS).astype(np.float32)


_DESCRIPTOR, _CELL_WEIGHTS = _descriptor_grid()


def _descriptors(pyramid: _Pyramid, keypoints: _Keypoints, angles: _Floats) -> NDArray[np.uint8]:
    """Return RootSIFT descriptors (N, 128)."""
    cells = np.empty((len(angles), _CELLS**2, _DIRECTIONS), np.float32)
    for index in _chunks(keypoints):
        magnitude, direction = _DESCRIPTOR.gradients(pyramid, keypoints.take(index), angles[index])
        direction -= angles[index]
        direction *= np.float32(_DIRECTIONS / (2 * np.pi))
        direction += (direction < 0) * np.float32(_DIRECTIONS)
        magnitude *= np.float32(1 / _MAGNITUDE_UNIT)
        share = np.empty_like(direction)
        for center in range(_DIRECTIONS):  # a gradient is shared by the two directions next to its own
            np.abs(np.subtract(direction, np.float32(center), out=share), out=share)
            if not center:
                np.minimum(share, np.float32(_DIRECTIONS) - share, out=share)
            np.subtract(np.float32(1), share, out=share)
            cv2.threshold(share, 0, 0, cv2.THRESH_TOZERO, dst=share)  # np.maximum takes seven times as long
            share *= magnitude
            np.rint(share, out=share)
            cells[index, :, center] = (_CELL_WEIGHTS @ share).T
    descriptors = cells.reshape(len(angles), -1)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    np.minimum(descriptors, _MAX_ENTRY, out=descriptors)
    descriptors /= np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    root = np.sqrt(descriptors, out=descriptors)
    return np.minimum(root * DESCRIPTOR_SCALE + 0.5, 255).astype(np.uint8)


# Mutual nearest neighbors


@dataclass(frozen=True)
class PairMatches:
    """K matches of the features of two images."""

    indices: Ints  # (K, 2) index of the first image's feature, index of the second's; no feature is matched twice
    scores: NDArray[np.float32]  # (K,) cosine similarity of descriptors, or confidence of a network; larger is better

    @classmethod
    def none(cls) -> "PairMatches":
        return cls(np.zeros((0, 2), np.int64), np.zeros(0, np.float32))

    def __len__(self) -> int:
        return len(self.indices)


class MutualMatcher:
    """Matches mutual nearest neighbors that pass Lowe's ratio test, for any descriptors; see `mutual_matches`."""

    batch_size = 1

    def __init__(self, ratio: float = 0.8, min_score: float = -1.0, shorten: Shorten | None = None):
        """See `FeatureKind` for the arguments."""
        self.ratio, self.min_score, self.shorten = ratio, min_score, shorten

    @classmethod
    def of(cls, kind: FeatureKind) -> "MutualMatcher":
        """Return the matcher of a kind of features."""
        return cls(kind.ratio, kind.min_score, kind.shorten)

    @property
    def settings(self) -> dict[str, Any]:
        limits = {"ratio": self.ratio, "min_score": self.min_score}
        return {"name": "mutual", **limits, **shorten_settings(self.shorten)}

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images; the ratio test applies to the first image's features."""
        matches, previous, unit_a = [], None, np.zeros((0, 0), np.float32)
        for a, b in pairs:
            if a is not previous:  # usually one image is matched with several
                previous, unit_a = a, unit_descriptors(a.descriptors, self.shorten)
            matches.append(self.match_unit(unit_a, unit_descriptors(b.descriptors, self.shorten)))
        return matches

    @fixed_sums
    def match_unit(self, unit_a: NDArray[np.float32], unit_b: NDArray[np.float32]) -> PairMatches:
        """Return the matches of two images, given by their `unit_descriptors`."""
        if not len(unit_a) or not len(unit_b):  # empty descriptors may have another length
            return PairMatches.none()
        scores = unit_a @ unit_b.T
        indices = mutual_matches(scores, self.ratio, self.min_score)
        return PairMatches(indices, scores[indices[:, 0], indices[:, 1]])


def unit_descriptors(descriptors: Descriptors, shorten: Shorten | None = None) -> NDArray[np.float32]:
    """Return descriptors (N, D) as float32 vectors of length about 1; for `shorten` see `FeatureKind`."""
    vectors = descriptors.astype(np.float32, copy=False)
    if descriptors.dtype == np.uint8:
        vectors = vectors * np.float32(1.0 / DESCRIPTOR_SCALE)
    return shorten(vectors) if shorten else vectors


def mutual_matches(scores: NDArray[np.float32], ratio: float = 0.8, min_score: float = -1.0) -> Ints:
    """Return mutual nearest neighbors whose rows pass Lowe's ratio test: indices (K, 2) of rows and columns.

    Args:
        scores: (N, M) cosine similarities; less than -1 for pairs that geometry excludes.
        ratio: the Euclidean distance of the nearest neighbor must be below `ratio` times that of the second nearest.
        min_score: smallest cosine similarity of a match.
    """
    n, m = scores.shape
    if n == 0 or m == 0:
        return np.zeros((0, 2), np.int64)
    best, second = two_best(scores)
    rows = np.arange(n)
    top = scores[rows, best]
    # |a - b|^2 = 2 - 2 a.b for unit vectors
    keep = np.flatnonzero(((1.0 - top) < ratio**2 * (1.0 - second)) & (top > min_score))
    keep = keep[top[keep] == scores.max(axis=0)[best[keep]]]
    # If several rows are equally near to a column, keep the first.
    keep = keep[np.sort(np.unique(best[keep], return_index=True)[1])]
    return np.stack([keep, best[keep]], axis=1)


def two_best(scores: NDArray[np.float32]) -> tuple[Ints, NDArray[np.float32]]:
    """Return the best column (N,) and the second best score (N,) of each row; the score is -1 if there is none."""
    best = np.argmax(scores, axis=1)
    if scores.shape[1] == 1:
        return best, np.full(len(scores), -1.0, np.float32)
    rows = np.arange(len(scores))
    top = scores[rows, best]
    scores[rows, best] = -2.0
    second = np.maximum(scores.max(axis=1), np.float32(-1.0))
    scores[rows, best] = top
    return best, second
