"""Global descriptors: one vector an image, for search. A new one is a file here and a line in `EMBEDDERS`."""

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import ToolkitError


class Embedder(Protocol):
    """What the embed stage and others need of a global descriptor."""

    name: str
    inputs: Literal["images", "features"]
    """What `embed` takes: images (H, W, 3) uint8 RGB, or `toolkit.features.LocalFeatures`."""

    @property
    def dim(self) -> int:
        """Length of the vectors, D."""
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """What the vectors depend on besides the images; part of their fingerprint."""
        ...

    def embed(self, inputs: Sequence[Any]) -> NDArray[np.float32]:
        """Return (B, D) float32; an image without any structure may have a zero vector."""
        ...


EMBEDDERS: dict[str, str] = {"vlad": "toolkit.embedders.vlad:Vlad.load"}
"""Name of an embedder -> `module:callable` that makes it, imported when it is asked for."""
PLANNED = ("megaloc",)
"""Names that manifests may hold and that a later version brings."""
PREFERENCE = ("megaloc", "vlad")
"""What `auto` takes: the first that is there."""


def resolve_name(name: str) -> str:
    """Return the embedder that `name` stands for: itself, or for `auto` the best that is there.

    Raises:
        ToolkitError: it is not in this version, or not known at all.
    """
    if name == "auto":
        return next(candidate for candidate in PREFERENCE if candidate in EMBEDDERS)
    if name in EMBEDDERS:
        return name
    known = ", ".join([*sorted(EMBEDDERS), "auto"])
    if name in PLANNED:
        raise ToolkitError(
            f"Embedder {name!r} is not installed in this version; use model `vlad`. Known: {known}."
        )
    raise ToolkitError(f"Unknown embedder {name!r}. Known: {known}.")


def create_embedder(name: str, **options: Any) -> Embedder:
    """Return a ready embedder.

    Args:
        name: a key of `EMBEDDERS`, or `auto`.
        options: the embedder's own, e.g. `vocabulary=<file>` of `vlad`.
    """
    module, _, path = EMBEDDERS[resolve_name(name)].partition(":")
    make: Any = import_module(module)
    for attribute in path.split("."):
        make = getattr(make, attribute)
    factory: Callable[..., Embedder] = make
    return factory(**options)
