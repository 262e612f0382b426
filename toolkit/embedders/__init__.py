"""Global descriptors: one vector an image, for search. A new one is a file here and a line in `EMBEDDERS`."""

import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.embedders.stored import (
    MANIFEST_COLUMNS,
    StoredVectors,
    Vectors,
    embedding_folders,
    load_embeddings,
    open_descriptors,
    open_embeddings,
)
from toolkit.errors import ManifestError
from toolkit.manifest import nearest
from toolkit.models.weights import MEGALOC, find_weights


class Embedder(Protocol):
    """What the embed stage and others need of a global descriptor."""

    name: str
    inputs: Literal["images", "features"]
    """What `embed` takes: images (H, W, 3) uint8 RGB, or `toolkit.features.features.LocalFeatures`."""
    upright: bool
    """Whether it was trained with upright photographs, so that images should be turned upright for it."""
    least_side: int | None
    """Pixels that the shorter side of an image must have: larger ones may be decoded smaller, see `read_image`. None:
    images are wanted as they are stored."""

    @property
    def dim(self) -> int:
        """Length of the vectors, D."""

    @property
    def settings(self) -> dict[str, Any]:
        """What the vectors depend on besides the images; part of their fingerprint."""

    def prepare(self, item: Any) -> Any:
        """Return an input as the embedder needs it; threads call this while other inputs are embedded."""

    def stack(self, inputs: Sequence[Any]) -> Any:
        """Return inputs, at least one, as a batch on the device; a thread calls this while another is embedded."""

    def embed(self, inputs: Any) -> NDArray[np.float32]:
        """Return the vectors (B, D) float32 of inputs, or of what `stack` made of them.

        An image without structure may have a zero vector.
        """


EMBEDDERS: dict[str, str] = {
    "megaloc": "toolkit.embedders.megaloc:MegaLocEmbedder",
    "vlad": "toolkit.embedders.vlad:Vlad.load",
}
"""Name of an embedder -> `module:callable` that makes it, imported when it is needed. `auto` prefers the first."""
WEIGHTS = {"megaloc": MEGALOC}
"""The weights of the embedders that need some."""


def resolve_name(name: str, checkpoint: str | Path | None = None) -> str:
    """Return the embedder that `name` stands for: itself; for `auto` the first whose weights are on this machine.

    Raises:
        ManifestError: unknown embedder.
        WeightsError: `checkpoint` is given and is missing.
    """
    if name == "auto":
        return next(key for key in EMBEDDERS if key not in WEIGHTS or find_weights(WEIGHTS[key], checkpoint))
    if name not in EMBEDDERS:
        raise ManifestError(f"Unknown embedder {name!r}. {nearest(name, [*EMBEDDERS, 'auto'])}")
    return name


def resolve_model(model: str | list[str], checkpoint: str | Path | None = None) -> str | list[str]:
    """Return the embedder that a name stands for, or those of several names; see `resolve_name`."""
    if isinstance(model, str):
        return resolve_name(model, checkpoint)
    return [resolve_name(name, checkpoint) for name in model]


def create_embedder(name: str, **options: Any) -> Embedder:
    """Return a ready embedder.

    Args:
        name: a key of `EMBEDDERS`, or `auto`.
        options: the embedder's own: `vocabulary=<file>` of `vlad`; `checkpoint`, `device`, `dtype_compute` and
            `image_size` of `megaloc`.
    """
    checkpoint = options.get("checkpoint")
    place = checkpoint if isinstance(checkpoint, str | Path) else None
    embedder: Embedder = pkgutil.resolve_name(EMBEDDERS[resolve_name(name, place)])(**options)
    return embedder
