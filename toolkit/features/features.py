"""Local features of images, and the kinds that can be extracted. `stores` keeps them in files."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture.cameras import invertible, sees_all
from toolkit.capture.images import read_image
from toolkit.capture.upright import turn_image, turn_points
from toolkit.errors import ImageError, ManifestError
from toolkit.features.rootsift import rootsift_64
from toolkit.geometry import Ints
from toolkit.manifest import AUTO, FeaturesSettings, checkpoint_of, nearest

DESCRIPTOR_SCALE = 512.0  # factor by which RootSIFT vectors of length 1 are stored as uint8, as in COLMAP
Descriptors = NDArray[np.uint8] | NDArray[np.float16] | NDArray[np.float32]


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
    def none(cls, image_size: tuple[int, int], length: int = 128) -> "LocalFeatures":
        """Return an empty set of features; `length` is that of the descriptors."""
        zeros = np.zeros(0, np.float32)
        return cls(zeros.reshape(0, 2), zeros, zeros, np.zeros((0, length), np.uint8), image_size)

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


Shorten = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # unit descriptors (N, D) -> shorter unit vectors


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
        "toolkit.features.sift:SiftExtractor", ("mutual",), 0.85, -1.0, epipolar_min_score=0.6,
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
