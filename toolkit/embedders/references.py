"""Describe images, find their references in a map, rerank these: the stages for many images, an open map for one."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture, Session
from toolkit.capture.images import turn_image
from toolkit.capture.upright import upright_turns
from toolkit.embedders import Embedder, create_embedder, embedding_folders, open_descriptors
from toolkit.embedders.masks import Masks, Priors
from toolkit.embedders.search import Vectors, embedder_fingerprint, load_index, search
from toolkit.errors import ArtifactError, CaptureError
from toolkit.features.features import KINDS, LocalFeatures, SiftExtractor
from toolkit.features.matching import LocalMethod, MutualMatcher, Verifier, create_local_methods
from toolkit.features.stores import FeatureStore
from toolkit.files import SceneFiles, image_name
from toolkit.geometry import Floats, Ints, unit
from toolkit.manifest import EmbedSettings, RerankSettings, RetrieveSettings

log = logging.getLogger(__name__)

MAX_IN_MEMORY = 1 << 29
"""Largest size in bytes of global descriptors (float32) that an open map keeps in memory; larger ones stay on disk."""
Ranked = tuple[Ints, Floats]
"""Rows (k,) of map images in their session, best first, and their scores (k,)."""


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


class ReferenceSearch:
    """The embedders of a finished run, its map images, and the features that it reranked with: as in the stages.

    Queries are `pose.base.Query`, of images `View`, which stand on this room.
    """

    def __init__(self, files: SceneFiles, capture: Capture, device: str, reranked: bool) -> None:
        """Load what all queries share; `reranked` tells whether the run localized with reranked references.

        Raise ArtifactError if files are missing, or the map was embedded by another embedder.
        """
        self.files, self.capture, self.session, self._told = files, capture, capture[f"{device}_map"], False
        self.embed_settings = EmbedSettings.read(files.embeddings)
        self.retrieve_settings = settings = RetrieveSettings.read(files.retrieval_dir)
        self.images = Embedded.of_map(self.session, files.embeddings, settings.normalize)
        vectors, folders = self.images.vectors, embedding_folders(files.embeddings).values()
        named = zip(self.embed_settings.models, folders, strict=True)
        self.embedders = [Describer.open(name, self.embed_settings, folder).embedder for name, folder in named]
        for embedder, part in zip(self.embedders, vectors.parts.values(), strict=True):
            if part.embedder not in ("", embedder_fingerprint(embedder.settings)):
                fault = f"was made by another embedder or vocabulary than the run's {embedder.name} of now"
                raise ArtifactError(f"{part.paths[0]} {fault}. Run the embed stage again.")
        in_memory = np.dtype(np.float32).itemsize * vectors.shape[1] * len(vectors) < MAX_IN_MEMORY
        self.vectors = vectors[:] if in_memory else vectors
        of_cpu = settings.model_copy(update={"faiss_gpu": False})  # this machine may have no GPU
        self._index = load_index(files.embeddings, self.session.id, vectors, of_cpu)
        self._sift = LocalMethod("sift", SiftExtractor(), MutualMatcher.of(KINDS["sift"]))
        self.verification: tuple[LocalMethod, Verifier] | None = None
        if reranked:
            reranking = RerankSettings.read(files.reranked_dir)
            (method,) = create_local_methods(reranking)
            store = FeatureStore.of_session(files.features, self.session.id, method.extractor.settings)
            self.verification = method, Verifier(reranking, method.matcher, store)

    @property
    def shows_upright(self) -> bool:
        """Whether the run turned images upright for an embedder, or for the features that it reranked with."""
        upright = any(Describer(embedder, self.embed_settings).upright for embedder in self.embedders)
        return upright or (self.verification is not None and KINDS[self.verification[0].name].upright)

    def describe(self, query: Any, kinds: Sequence[LocalMethod]) -> list[NDArray[np.float32]]:
        """Return for each embedder the global descriptors (C, D) of a query's images; `kinds` are its features."""
        described = []
        for describer in (Describer(embedder, self.embed_settings) for embedder in self.embedders):
            if describer.embedder.inputs == "features":
                inputs = self._features(query, kinds)
            else:
                side, up = describer.embedder.min_side, self.embed_settings.world_up
                views = [self._turned(view, up) if describer.upright else view for view in query.views]
                inputs = [describer.prepare(view.read(True, side), view.turns) for view in views]
            described.append(describer.describe(inputs))
        return described

    def _features(self, query: Any, kinds: Sequence[LocalMethod]) -> list[LocalFeatures]:
        """Return the SIFT features of the images: those of the localizer, if it has them."""
        settings = [kind.extractor.settings for kind in kinds]
        if query.features and self._sift.extractor.settings in settings:
            at = settings.index(self._sift.extractor.settings)
            return [features[at] for features in query.features if not isinstance(features, str)]
        return [view.extract(self._sift) for view in query.views]

    def find(self, query: Any, k: int | None = None, near: Masks | None = None) -> list[Ranked]:
        """Return the references of each image of a query that `describe` has described, as the run would find them.

        By default, there are `k` as in the run. With `near`, these of `images` may be found, whatever the run's priors
        say. Raise ArtifactError if the map was embedded by another embedder.
        """
        settings, dims = self.retrieve_settings, self.images.vectors.dims
        for embedder, described, dim in zip(self.embedders, query.descriptors, dims, strict=True):
            if described.shape[1] != dim:
                found, expected = f"map descriptors of {dim} dimensions", f"{described.shape[1]} of {embedder.name}"
                raise ArtifactError.at(self.files.embeddings, found, expected, "Run the embed stage again.")
        topk = settings.topk if k is None or self.verification else k
        # As they are read from a file.
        stored = (one.astype(self.embed_settings.dtype).astype(np.float32) for one in query.descriptors)
        vectors = np.hstack([unit(one) if settings.normalize else one for one in stored])
        masks = self._masks(query, topk) if near is None else near
        scored = search(vectors, self.vectors, topk, "numpy", index=self._index, allowed=masks, dims=dims)
        both = ((scores, best[best >= 0]) for scores, best in zip(*scored, strict=True))
        ranked = [(self.images.rows[best], scores[: len(best)].astype(np.float64)) for scores, best in both]
        if self.verification:
            ranked = [self.rerank(of_image, view) for of_image, view in zip(ranked, query.views, strict=True)]
        return [(rows[:k], scores[:k]) for rows, scores in ranked]

    def rerank(self, ranked: Ranked, view: Any) -> Ranked:
        """Return rows of map images and their numbers of verified matches with an image, most first."""
        assert self.verification is not None
        method, verifier = self.verification
        view = self._turned(view, verifier.settings.world_up) if KINDS[method.name].upright else view
        names = [self.session.image_names[row] for row in ranked[0]]
        best = verifier.rank(view.extract(method), view.camera, names, self.session.cameras(ranked[0]))
        return ranked[0][[at for at, *_ in best]], np.array([verified for _, verified, _ in best], np.float64)

    def _turned(self, view: Any, world_up: Sequence[float] | None) -> Any:
        """Return an image of a session with the turns that a stage found for it; other images as they are."""
        if (found := self.capture.find_image(view.name)) is None:
            return view
        turns = upright_turns(self.capture, world_up).of(found[0], [found[1]])
        return replace(view, turns=int(turns[0]))

    def _masks(self, query: Any, topk: int) -> Masks | None:
        """Return the map images that the run's priors let each image find, None: all, as for images of no session."""
        if not self._priors.names:
            return None
        found = [place for view in query.views if (place := self.capture.find_image(view.name)) is not None]
        if len(found) < len(query.views):
            if not self._told:
                message = "%s: images from outside a session are searched without %s"
                log.warning(message, self.session.id, " and ".join(self._priors.names))
            self._told = True
            return None
        images = found[0][0], np.array([row for _, row in found], np.int64)
        return self._priors.masks((self.session, self.images.rows), images, topk)[0]

    @cached_property
    def _priors(self) -> Priors:
        return Priors(self.retrieve_settings.mask)
