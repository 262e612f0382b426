"""Local features of images: what they are, and their kinds. `stores` keeps them in files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.turning import turn_image, turn_points
from toolkit.errors import ManifestError
from toolkit.geometry import Ints
from toolkit.manifest import AUTO, FeaturesSettings, checkpoint_of, nearest

DESCRIPTOR_SCALE = 512.0
"""RootSIFT vectors have length 1; times this they fill the range of a byte, as COLMAP stores them."""
Descriptors = NDArray[np.uint8] | NDArray[np.float16] | NDArray[np.float32]


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image, strongest response first, in the pixels of the image as stored."""

    keypoints: NDArray[np.float32]
    """(N, 2) x y, pixels; the center of the top-left pixel is (0.5, 0.5)."""
    scales: NDArray[np.float32]
    """(N,) size of the keypoints, the standard deviation of the blob, pixels; 1 for detectors without one."""
    scores: NDArray[np.float32]
    """(N,) response of the detector, larger is better; comparable only within one kind."""
    descriptors: Descriptors
    """(N, D): unit vectors, or uint8: non-negative unit vectors times `DESCRIPTOR_SCALE` (RootSIFT)."""
    image_size: tuple[int, int]
    """Width, height of the image, pixels."""
    turns: int = 0
    """Counter-clockwise quarter turns that the image was shown after. Keypoints are of the image as it is stored."""

    def __len__(self) -> int:
        return len(self.keypoints)

    @classmethod
    def none(cls, image_size: tuple[int, int], length: int = 128) -> "LocalFeatures":
        """Return the features of an image that has none; `length` is that of descriptors."""
        zeros = np.zeros(0, np.float32)
        return cls(zeros.reshape(0, 2), zeros, zeros, np.zeros((0, length), np.uint8), image_size)

    def take(self, part: slice | Ints) -> "LocalFeatures":
        """Return some of the features, by index."""
        return replace(
            self,
            keypoints=self.keypoints[part],
            scales=self.scales[part],
            scores=self.scores[part],
            descriptors=self.descriptors[part],
        )

    def turned(self, turns: int) -> "LocalFeatures":
        """Return the features of the image after counter-clockwise quarter turns."""
        width, height = self.image_size
        keypoints = turn_points(self.keypoints, width, height, turns).astype(np.float32)
        size = (height, width) if turns % 2 else (width, height)
        return replace(self, keypoints=keypoints, image_size=size, turns=(self.turns - turns) % 4)


class Extractor(Protocol):
    """What extracts local features of one kind."""

    color: bool
    """Whether `extract` takes images (H, W, 3) RGB, else (H, W) gray."""
    batch_size: int
    """The number of images in a call that is quickest."""
    threaded: bool
    """Whether it is quickest to call `extract` with one image at a time from several threads at once."""

    @property
    def settings(self) -> dict[str, Any]:
        """All that the features depend on besides the images, `name` first; part of their fingerprint."""

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, uint8, of any sizes."""


@dataclass(frozen=True)
class FeatureKind:
    """How one kind of local features is extracted and matched. Scores are cosine similarities of descriptors."""

    extractor: str
    """`module:callable` that makes the extractor, imported when it is needed."""
    matchers: tuple[str, ...]
    """Keys of `toolkit.features.matching.MATCHERS` that can match queries with references, the default first."""
    ratio: float
    """Lowe's ratio of `mutual` between a query and a reference; 1: no such test."""
    min_score: float
    """Least score of a match of `mutual` between a query and a reference."""
    epipolar_min_score: float
    """Least score of a match between map images along the epipolar line."""
    guided_min_score: float
    """Least score of a match near where a pose projects a map point."""
    scale_octaves: float
    """A keypoint's size may differ from the size that the map predicts by a factor of two to this power."""
    upright: bool = True
    """Whether it was learned from upright photographs, so that images are turned upright for it."""


KINDS: dict[str, FeatureKind] = {
    # RootSIFT has no negative entries: unrelated patches already score about 0.5, so the ratio test decides. The less
    # the geometry restricts the candidates, the higher is the least score.
    "sift": FeatureKind(
        "toolkit.features.sift:SiftExtractor", ("mutual",), 0.85, -1.0, epipolar_min_score=0.6,
        guided_min_score=0.75, scale_octaves=1.0, upright=False,
    ),
    # Scores of unrelated patches scatter about 0, and look-alikes are common: the usual test is a distance below 0.7
    # (hloc's NN-superpoint), which is a cosine of 1 - 0.7^2 / 2, and no ratio test. All keypoints have one size.
    "superpoint": FeatureKind(
        "toolkit.features.superpoint:SuperPointExtractor", ("lightglue", "mutual"), 1.0, 0.755,
        epipolar_min_score=0.755, guided_min_score=0.755, scale_octaves=float("inf"),
    ),
    # Measured on photographs by day and by simulated night (STRECHA, STRECHA_HARD): of mutual matches above 0.7, 97 %
    # and 93 % are right. Unrelated features score above 0.5 in 0.4 % of the searches within 0.7 degrees, 93 % of the
    # true partners by night do, and with a wrong relative pose 0.1 % of the matches along epipolar lines are left.
    "aliked": FeatureKind(
        "toolkit.features.aliked:AlikedExtractor", ("lightglue", "mutual"), 1.0, 0.7,
        epipolar_min_score=0.5, guided_min_score=0.5, scale_octaves=float("inf"),
    ),
}  # fmt: skip
"""The kinds of local features that a manifest can name."""


def feature_kind(name: str) -> FeatureKind:
    """Return the entry of `KINDS` of a name.

    Raises:
        ManifestError: there is none.
    """
    if name not in KINDS:
        raise ManifestError(f"Unknown local features {name!r}. {nearest(name, [*KINDS, AUTO])}")
    return KINDS[name]


def create_extractor(name: str, settings: FeaturesSettings, device: str = "auto", dtype: str = "auto") -> Extractor:
    """Return a ready extractor.

    Args:
        name: a key of `KINDS`.
        settings: holds those of each kind under its name.
        device: where a network runs: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        dtype: what a network computes in: `auto`, `float32`, `bfloat16`, `float16`.

    Raises:
        ManifestError: unknown features.
        WeightsError: the network has no weights.
    """
    make = resolve_name(feature_kind(name).extractor)
    own = getattr(settings, name, None)
    checkpoint = checkpoint_of(settings.checkpoint, name)
    extractor: Extractor = make(own) if name == "sift" else make(checkpoint, device, dtype, settings=own)
    return extractor


def extract_turned(
    extractor: Extractor, images: Sequence[NDArray[np.uint8]], turns: Sequence[int]
) -> list[LocalFeatures]:
    """Return the features of images as they are stored, extracted after counter-clockwise quarter turns."""
    upright = extractor.extract([turn_image(image, turn) for image, turn in zip(images, turns, strict=True)])
    return [features.turned(-turn) if turn else features for features, turn in zip(upright, turns, strict=True)]
