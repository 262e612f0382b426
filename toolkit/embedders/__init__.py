"""Global descriptors: one vector per image, for search. To add one, add a file here and a line in `EMBEDDERS`."""

import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.embedders.search import (
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
    """Interface of a global descriptor, as the embed stage and the localizer of single images use it."""

    name: str
    inputs: Literal["images", "features"]
    """Input of `embed`: images (H, W, 3) uint8 RGB, or `toolkit.features.features.LocalFeatures`."""
    upright: bool
    """Whether it was trained on upright images, so that images should be turned upright for it."""
    min_side: int | None
    """Pixels that the shorter side of an image must keep; larger images may be decoded smaller, see `read_image`. None:
    always decode at full size."""

    @property
    def dim(self) -> int:
        """Length of the vectors, D."""

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the vectors depend on; part of their fingerprint."""

    def prepare(self, item: Any) -> Any:
        """Preprocess one input, for example resize an image. Threads call this while other inputs are embedded."""

    def stack(self, inputs: Sequence[Any]) -> Any:
        """Return at least one input as a batch on the device. A thread calls this while another batch is embedded."""

    def embed(self, inputs: Any) -> NDArray[np.float32]:
        """Return the vectors (B, D) float32 of inputs, or of a batch that `stack` returned.

        An image without structure may have a zero vector.
        """


EMBEDDERS: dict[str, str] = {
    "megaloc": "toolkit.embedders.megaloc:MegaLocEmbedder",
    "vlad": "toolkit.embedders.vlad:Vlad.load",
}
"""Name of an embedder -> `module:callable` that creates it, imported on use. `auto` prefers the first."""
WEIGHTS = {"megaloc": MEGALOC}
"""Weights of the learned embedders, by name."""


def resolve_name(name: str, checkpoint: str | Path | None = None) -> str:
    """Return the name of the embedder; for `auto`, the first whose weights are on this machine, if it needs any.

    Raise ManifestError for an unknown embedder; WeightsError if the file `checkpoint` is missing.
    """
    if name == "auto":
        return next(key for key in EMBEDDERS if key not in WEIGHTS or find_weights(WEIGHTS[key], checkpoint))
    if name not in EMBEDDERS:
        raise ManifestError(f"Unknown embedder {name!r}. {nearest(name, [*EMBEDDERS, 'auto'])}")
    return name


def resolve_model(model: str | list[str], checkpoint: str | Path | None = None) -> str | list[str]:
    """Apply `resolve_name` to a name, or to each of several names."""
    return resolve_name(model, checkpoint) if isinstance(model, str) else [resolve_name(n, checkpoint) for n in model]


def create_embedder(name: str, **options: Any) -> Embedder:
    """Create an embedder.

    Args:
        name: a key of `EMBEDDERS`, or `auto`.
        options: arguments of the embedder: `vocabulary=<file>` for `vlad`; `checkpoint`, `device`, `dtype_compute` and
            `image_size` for `megaloc`.

    Raises:
        ManifestError: unknown embedder.
    """
    embedder: Embedder = pkgutil.resolve_name(EMBEDDERS[resolve_name(name)])(**options)
    return embedder
