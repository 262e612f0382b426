"""Embedded images of a session, and embedders as a run uses them: for the stages and an open map."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Session
from toolkit.capture.images import turn_image
from toolkit.embedders import Embedder, create_embedder, open_descriptors
from toolkit.embedders.masks import Masks
from toolkit.embedders.search import Vectors
from toolkit.errors import ArtifactError, CaptureError
from toolkit.files import image_name
from toolkit.geometry import Ints, unit
from toolkit.manifest import EmbedSettings


@dataclass(frozen=True)
class Embedded:
    """Embedded images of a session."""

    session: Session
    rows: Ints
    """Rows of `session.images`."""
    vectors: Vectors
    table: pd.DataFrame
    """Their lines of the manifests."""
    counts: dict[str, int] = field(default_factory=dict)
    """Columns of a pair's row."""
    masks: Masks | None = None
    """For query images: the map images that each may find."""

    @classmethod
    def open(cls, session: Session, embeddings: Path, normalize: bool) -> Self:
        """Open a session's embeddings; raise ArtifactError as `open_descriptors`, or for images of another capture."""
        vectors, table = open_descriptors(embeddings, session.id, normalize)
        names = table["abs_path"].map(image_name)
        rows = names.map(session.row_of_name).fillna(-1).to_numpy(np.int64)
        if (rows < 0).any():
            first = table["abs_path"][int(np.argmax(rows < 0))]
            fault = f"{(rows < 0).sum()} embedded images are not in {session.path / 'images.txt'}, first {first}"
            raise ArtifactError(f"{embeddings / session.id}: {fault}. They belong to another capture: embed again.")
        return cls(session, rows, vectors, table)

    @classmethod
    def of_map(cls, session: Session, embeddings: Path, normalize: bool) -> Self:
        """Open the images of a map that have a pose; raise CaptureError if there are none."""
        images = cls.open(session, embeddings, normalize)
        posed = np.isfinite(session.world_from_cam(images.rows)).reshape(-1, 16).all(axis=1)
        if not posed.any():
            raise CaptureError(f"No embedded image of {session.id} has a pose ({session.path / 'trajectories.txt'}).")
        counts = {"database": int(posed.sum()), "unposed": int(np.sum(~posed))}
        return replace(images.take(np.flatnonzero(posed)), counts=counts)

    def take(self, positions: Ints) -> Self:
        """Return some of the images."""
        table = self.table.iloc[positions].reset_index(drop=True)
        return replace(self, rows=self.rows[positions], vectors=self.vectors.choose(positions), table=table)


@dataclass(frozen=True)
class Describer:
    """An embedder as a run uses it: its vectors are those in the run's files, before they are rounded there."""

    embedder: Embedder
    settings: EmbedSettings

    @classmethod
    def open(cls, name: str, settings: EmbedSettings, folder: Path) -> "Describer":
        """Open an embedder by its name; `folder` has its embeddings, and its vocabulary if it needs one."""
        options = {"vocabulary": folder / "vlad.npz"} if name == "vlad" else settings.of_network
        return cls(create_embedder(name, **options), settings)

    @property
    def upright(self) -> bool:
        """Whether images are turned upright for the embedder: as the settings say, or else as it needs."""
        upright = self.embedder.upright if self.settings.upright is None else self.settings.upright
        return self.embedder.inputs == "images" and upright

    def prepare(self, image: NDArray[np.uint8], turns: int) -> Any:
        """Return an image, decoded with `min_side`, as an input; the turns count if it is to be `upright`."""
        return self.embedder.prepare(turn_image(image, turns if self.upright else 0))

    def describe(self, inputs: Any) -> NDArray[np.float32]:
        """Return the vectors (B, D) of prepared inputs, or of a batch of them from `Embedder.stack`."""
        vectors, expected = self.embedder.embed(inputs), (len(inputs), self.embedder.dim)
        if vectors.shape != expected:
            raise ValueError(f"{self.embedder.name} gave {vectors.shape}; expected {expected}.")
        return unit(vectors) if self.settings.normalize else vectors
