"""Global descriptors: one vector an image, for search. A new one is a file here and a line in `EMBEDDERS`."""

import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.errors import ArtifactError, ManifestError
from toolkit.files import require_whole
from toolkit.models.weights import MEGALOC, find_weights


class Embedder(Protocol):
    """What the embed stage and others need of a global descriptor."""

    name: str
    inputs: Literal["images", "features"]
    """What `embed` takes: images (H, W, 3) uint8 RGB, or `toolkit.features.features.LocalFeatures`."""
    upright: bool
    """Whether it was trained with upright photographs, so that images should be turned upright for it."""

    @property
    def dim(self) -> int:
        """Length of the vectors, D."""

    @property
    def settings(self) -> dict[str, Any]:
        """What the vectors depend on besides the images; part of their fingerprint."""

    def prepare(self, item: Any) -> Any:
        """Return an input as the embedder needs it; threads call this while other inputs are embedded."""

    def embed(self, inputs: Sequence[Any]) -> NDArray[np.float32]:
        """Return the vectors (B, D) float32; an image without structure may have a zero vector."""


EMBEDDERS: dict[str, str] = {
    "megaloc": "toolkit.embedders.megaloc:MegaLocEmbedder",
    "vlad": "toolkit.embedders.vlad:Vlad.load",
}
"""Name of an embedder -> `module:callable` that makes it, imported when it is needed. `auto` prefers the first."""
WEIGHTS = {"megaloc": MEGALOC}
"""The weights of the embedders that need some."""
MANIFEST_COLUMNS = ["row_index", "device_id", "sensor_id", "timestamp", "abs_path"]
"""Columns of the `manifest.csv` that names the image of each row of embeddings."""


def resolve_name(name: str, checkpoint: str | Path | None = None) -> str:
    """Return the embedder that `name` stands for: itself; for `auto` the first whose weights are on this machine.

    Raises:
        ManifestError: unknown embedder.
        WeightsError: `checkpoint` is given and is missing.
    """
    if name == "auto":
        return next(key for key in EMBEDDERS if key not in WEIGHTS or find_weights(WEIGHTS[key], checkpoint))
    if name not in EMBEDDERS:
        raise ManifestError(f"Unknown embedder {name!r}. Known: {', '.join([*sorted(EMBEDDERS), 'auto'])}.")
    return name


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


def load_embeddings(folder: str | Path) -> tuple[NDArray[np.float32], pd.DataFrame]:
    """Read the embeddings of a session, or of one subsession.

    Args:
        folder: `<embeddings>/<session>` or `<embeddings>/<session>/<subsession>`.

    Returns:
        (N, D) float32; a table of its rows: row_index, device_id, sensor_id, timestamp, abs_path, subsession.

    Raises:
        ArtifactError: there are none, one is damaged, or files do not fit together.
    """
    folder = Path(folder)
    manifests = sorted(folder.rglob("manifest.csv"))
    if not manifests:
        raise ArtifactError(
            f"No embeddings in {folder}: run the embed stage first (python -m toolkit run ... --only embed)."
        )
    matrices: list[NDArray[np.float32]] = []
    tables = []
    for manifest in manifests:
        path = manifest.parent / f"{manifest.parent.name}.npy"
        for part in (path, manifest):
            require_whole(part, of=path)
        try:
            matrix = np.load(path).astype(np.float32, copy=False)
            table = pd.read_csv(manifest, dtype={"device_id": str, "sensor_id": str, "abs_path": str})
        except (OSError, ValueError) as error:
            raise ArtifactError(f"Embeddings {path} cannot be read ({error}); embed again.") from error
        if list(table.columns) != MANIFEST_COLUMNS or matrix.ndim != 2 or len(matrix) != len(table):
            raise ArtifactError(
                f"{manifest} ({len(table)} rows, {', '.join(table.columns)}) does not fit {path.name} "
                f"{matrix.shape}; expected columns {', '.join(MANIFEST_COLUMNS)} and one row a vector. Embed again."
            )
        if matrices and matrix.shape[1] != matrices[0].shape[1]:
            raise ArtifactError(
                f"{path} has {matrix.shape[1]} dimensions, {manifests[0].parent} {matrices[0].shape[1]}; embed again."
            )
        matrices.append(matrix)
        base = folder.parent if manifest.parent == folder else folder
        tables.append(table.assign(subsession=manifest.parent.relative_to(base).as_posix()))
    return np.concatenate(matrices), pd.concat(tables, ignore_index=True)
