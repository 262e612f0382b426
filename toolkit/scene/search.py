"""Find the references of any image in the map of a finished run, as its stages embed, retrieve and rerank do."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.capture import Session
from toolkit.capture.upright import turn_image
from toolkit.embedders import Embedder, Vectors, create_embedder, embedding_folders, open_descriptors, shows_upright
from toolkit.embedders.index import VectorIndex, load_index
from toolkit.embedders.search import search
from toolkit.embedders.stored import embedder_fingerprint
from toolkit.errors import ArtifactError
from toolkit.features.features import KINDS, usable
from toolkit.features.matching import LocalMethod, create_local_methods
from toolkit.features.sift import SiftExtractor
from toolkit.features.stores import FeatureStore
from toolkit.features.verification import Verifier
from toolkit.files import SceneFiles, image_name
from toolkit.geometry import unit
from toolkit.manifest import EmbedSettings, RerankSettings, RetrieveSettings
from toolkit.pose.base import Query, View
from toolkit.results.opening import read_settings

MAX_IN_MEMORY = 1 << 30
"""Largest size in bytes of global descriptors (float32) that an open map keeps in memory; larger ones stay on disk."""

Ranked = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Rows (k,) of map images in their session, best first, and their scores (k,)."""


class ReferenceSearch:
    """The embedders of a finished run, and the descriptors of its map images."""

    def __init__(self, files: SceneFiles, session: Session, reranked: bool) -> None:
        """Take the files of the run, the map session, and whether the run localized with reranked references."""
        self.files, self.session, self.reranked = files, session, reranked

    def load(self) -> None:
        """Load what all queries share, before several threads find it missing: `cached_property` has no lock."""
        _ = self.embedders, self._descriptors, self._index
        if self.reranked:
            _ = self._verification

    @property
    def shows_upright(self) -> bool:
        """Whether the run turned images upright for an embedder, or for the features that it reranked with."""
        upright = any(shows_upright(embedder, self.embed_settings.upright) for embedder in self.embedders)
        return upright or (self.reranked and KINDS[self._verification[0].name].upright)

    def describe(self, query: Query, kinds: Sequence[LocalMethod]) -> list[NDArray[np.float32]]:
        """Return for each embedder the global descriptors (C, D) of a query's images; `kinds` are its features."""
        return [embedder.embed(self._inputs(embedder, query, kinds)) for embedder in self.embedders]

    def _inputs(self, embedder: Embedder, query: Query, kinds: Sequence[LocalMethod]) -> list[Any]:
        if embedder.inputs != "features":
            turned, side = shows_upright(embedder, self.embed_settings.upright), embedder.least_side
            images = (turn_image(view.read(True, side), view.turns if turned else 0) for view in query.views)
            return [embedder.prepare(image) for image in images]
        sift, settings = SiftExtractor(), [kind.extractor.settings for kind in kinds]
        if query.features and sift.settings in settings:  # the embedder can use the features of the localizer
            at = settings.index(sift.settings)
            return [features[at] for features in query.features if not isinstance(features, str)]
        extracted = sift.extract([view.read(color=False) for view in query.views])
        views = zip(extracted, query.views, strict=True)
        return [usable(features, view.mask, view.camera) for features, view in views]

    def find(
        self, query: Query, k: int | None = None, allowed: Sequence[NDArray[np.bool_] | None] = ()
    ) -> list[Ranked]:
        """Return the references of each image of a query with the descriptors of `describe`, as the run would find
        them.

        By default, there are `k` as in the run; `allowed` has, for each image, a mask over the rows `rows`, or None.
        Raise ArtifactError if the map was embedded by another embedder.
        """
        stored, rows = self._stored
        dims = stored.dims
        for embedder, described, dim in zip(self.embedders, query.descriptors, dims, strict=True):
            if described.shape[1] != dim:
                raise ArtifactError(
                    f"{self.files.embeddings}: found descriptors of {dim} dimensions for the map, expected "
                    f"{described.shape[1]} of {embedder.name}. Run the embed stage again."
                )
        searched = np.hstack([self._as_searched(vectors) for vectors in query.descriptors])
        topk = self.retrieve_settings.topk if k is None or self.reranked else k
        masks = list(allowed) or [None]
        results = [
            search(part, self._descriptors, topk, "torch", "cpu", index=self._index, allowed=mask, dims=dims)
            for part, mask in zip(np.split(searched, len(masks)), masks, strict=True)
        ]
        all_scores, neighbors = (np.concatenate(arrays) for arrays in zip(*results, strict=True))
        ranked = [
            (rows[indices[indices >= 0]], scores[indices >= 0].astype(np.float64))
            for indices, scores in zip(neighbors, all_scores, strict=True)
        ]
        if self.reranked:
            ranked = [self._rerank(of_image, view) for of_image, view in zip(ranked, query.views, strict=True)]
        return [(of_image[:k], scores[:k]) for of_image, scores in ranked]

    def _rerank(self, ranked: Ranked, view: View) -> Ranked:
        """Return rows of map images and their numbers of verified matches, most first, as the rerank stage does."""
        method, verifier = self._verification
        rows = ranked[0][: verifier.settings.topn]
        names = [self.session.image_name(int(row)) for row in rows]
        verified, _ = verifier.verify(view.extract(method), view.camera, names, self.session.cameras(rows))
        order = np.argsort(-np.array(verified), kind="stable")[: verifier.settings.topk]
        return rows[order], np.array(verified, np.float64)[order]

    def _as_searched(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return descriptors normalized and rounded like those of the map, which were written to a file."""
        if self.embed_settings.normalize:
            vectors = unit(vectors)
        vectors = vectors.astype(self.embed_settings.dtype).astype(np.float32)
        return unit(vectors) if self.retrieve_settings.normalize else vectors

    @property
    def rows(self) -> NDArray[np.int64]:
        """Rows (N,) of the map images that are searched, in the session."""
        return self._stored[1]

    @cached_property
    def embed_settings(self) -> EmbedSettings:
        return read_settings(self.files.embeddings / "settings.json", EmbedSettings)

    @cached_property
    def retrieve_settings(self) -> RetrieveSettings:
        return read_settings(self.files.retrieval_dir / "settings.json", RetrieveSettings)

    @cached_property
    def embedders(self) -> list[Embedder]:
        """The embedders that the run used; ArtifactError is raised if the map's vectors are from another one."""
        settings = self.embed_settings
        folders = embedding_folders(self.files.embeddings).values()
        learned = {
            "checkpoint": settings.checkpoint,
            "device": settings.compute_device,
            "dtype_compute": settings.dtype_compute,
            "image_size": settings.image_size,
        }
        embedders = [
            create_embedder(name, **({"vocabulary": folder / "vlad.npz"} if name == "vlad" else learned))
            for name, folder in zip(settings.models, folders, strict=True)
        ]
        for embedder, vectors in zip(embedders, self._stored[0].parts.values(), strict=True):
            if vectors.embedder not in ("", embedder_fingerprint(embedder.settings)):
                raise ArtifactError(
                    f"{vectors.paths[0]} was made by another embedder or vocabulary than the run's {embedder.name} of "
                    "now. Run the embed stage again."
                )
        return embedders

    @cached_property
    def _stored(self) -> tuple[Vectors, NDArray[np.int64]]:
        """Global descriptors (N, D) of the posed map images, on disk, as they are searched; rows of the images (N,)."""
        normalize = self.retrieve_settings.normalize
        vectors, table = open_descriptors(self.files.embeddings, self.session.id, normalize)
        rows = np.array([self.session.row_of_name[image_name(path)] for path in table["abs_path"]], np.int64)
        posed = np.isfinite(self.session.world_from_cam(rows)).reshape(-1, 16).all(axis=1)
        return vectors.choose(np.flatnonzero(posed)), rows[posed]

    @cached_property
    def _descriptors(self) -> NDArray[np.float32] | Vectors:
        """Those of `_stored`, in memory unless the map is large."""
        vectors = self._stored[0]
        return vectors[:] if 4 * vectors.shape[1] * len(vectors) < MAX_IN_MEMORY else vectors

    @cached_property
    def _index(self) -> VectorIndex | None:
        """The index of the descriptors, if the run has one."""
        settings = self.retrieve_settings.model_copy(update={"faiss_gpu": False})  # this machine may have no GPU
        return load_index(self.files.embeddings, self.session.id, self._stored[0], settings)

    @cached_property
    def _verification(self) -> tuple[LocalMethod, Verifier]:
        """Features and verifier of the run's rerank stage."""
        settings = read_settings(self.files.reranked_dir / "settings.json", RerankSettings)
        (method,) = create_local_methods(settings)
        store = FeatureStore.of_session(self.files.features, self.session.id, method.extractor.settings)
        return method, Verifier(settings, method.matcher, store)
