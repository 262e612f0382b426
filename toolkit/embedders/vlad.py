"""VLAD of RootSIFT: a global descriptor that needs no weights. It learns its vocabulary from the map images.

For each visual word, the residuals of the whitened local descriptors assigned to it are summed (Jegou et al., CVPR
2010). Residuals and sums are normalized (Delhumeau et al., ACM MM 2013; Arandjelovic and Zisserman, CVPR 2013). The
result is projected to the principal directions of the map images.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from toolkit.capture.images import default_workers, prefetch
from toolkit.errors import ArtifactError, ToolkitError
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import unit_descriptors
from toolkit.files import file_fingerprint, require_whole, write_atomic
from toolkit.geometry import unit
from toolkit.manifest import VladSettings

Floats = NDArray[np.float32]

_SHORTEST = 1e-9  # shorter vectors are rounding errors, and are not normalized
_CHUNK = 8192
"""Number of local descriptors that are assigned at once. Fixed, so that the result does not depend on the threads."""


class Vlad:
    """A VLAD with its vocabulary: computes global descriptors from local features."""

    name = "vlad"
    inputs: Literal["features"] = "features"
    upright = False
    least_side = None

    def __init__(self, settings: VladSettings, arrays: dict[str, Floats], fingerprint: str = ""):
        self._settings = settings
        self._fingerprint = fingerprint
        self.local_mean, self.local_projection = arrays["local_mean"], arrays["local_projection"]
        self.centroids, self.projection = arrays["centroids"], arrays["projection"]

    @property
    def dim(self) -> int:
        return int(self.projection.shape[1])

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": self.name, **self._settings.model_dump(), "vocabulary": self._fingerprint}

    def prepare(self, item: LocalFeatures | Floats) -> Floats:
        """Return the VLAD (words * local_dim,) of an image before the projection, of length 1 or 0."""
        if not isinstance(item, LocalFeatures):
            return item
        vector = np.zeros_like(self.centroids)
        descriptors = _select(item, self._settings)
        if len(descriptors):
            local = unit(((descriptors - self.local_mean) @ self.local_projection).astype(np.float32), _SHORTEST)
            nearest = _assign(local, self.centroids)
            residuals = unit(local - self.centroids[nearest], _SHORTEST)
            order = np.argsort(nearest, kind="stable")
            present, starts = np.unique(nearest[order], return_index=True)
            vector[present] = unit(np.add.reduceat(residuals[order], starts, axis=0).astype(np.float32), _SHORTEST)
        flat = vector.reshape(-1)
        return unit(np.sign(flat) * np.sqrt(np.abs(flat)), _SHORTEST)

    def stack(self, inputs: Sequence[LocalFeatures | Floats]) -> Floats:
        """Return the VLADs of images, (B, words * local_dim)."""
        return np.array([self.prepare(item) for item in inputs], np.float32).reshape(-1, self.centroids.size)

    @threadpool_limits.wrap(limits=1, user_api="blas")  # the products are small: two threads take three times as long
    def embed(self, inputs: Sequence[LocalFeatures] | Floats) -> Floats:
        """Return the global descriptors (B, dim) of images, or of a batch from `stack`; zeros without features.

        The rows do not have length 1: compare them by dot products, or normalize them for cosines.
        """
        batch = inputs if isinstance(inputs, np.ndarray) else self.stack(inputs)
        return batch @ self.projection

    @classmethod
    @threadpool_limits.wrap(limits=1, user_api="blas")
    def learn(
        cls,
        features: Callable[[], Iterable[LocalFeatures]],
        count: int,
        settings: VladSettings | None = None,
        seed: int = 0,
    ) -> "Vlad":
        """Learn vocabulary and projection from `count` map images; equal inputs give equal bytes.

        Args:
            features: yields the features of the images, in the same order at each call. It is called twice, so memory
                does not grow with the number of local features.

        Raises:
            ToolkitError: the images have no local features.
        """
        settings = settings or VladSettings()
        rng = np.random.default_rng(seed)
        share = -(-settings.sample_descriptors // max(count, 1))
        parts = []
        for image in features():
            descriptors = _select(image, settings)
            parts.append(descriptors[np.sort(rng.permutation(len(descriptors))[:share])])
        sample = np.concatenate(parts) if parts else np.zeros((0, 1), np.float32)
        if len(sample) < 2:
            raise ToolkitError(
                f"A VLAD vocabulary cannot be learned: {count} map images gave {len(sample)} local features. "
                f"Check that they can be read and are not blank (`python -m toolkit check CAPTURE`)."
            )
        mean = sample.mean(axis=0)
        variance, directions = np.linalg.eigh(np.cov((sample - mean).T.astype(np.float64)))
        keep = np.argsort(-variance, kind="stable")[: min(settings.local_dim, len(sample) - 1)]
        # Without a lower bound, whitening would amplify the noise of almost constant directions.
        scale = np.sqrt(np.maximum(variance[keep], 1e-4 * variance.max() + 1e-12))
        arrays: dict[str, Floats] = {
            "local_mean": mean.astype(np.float32),
            "local_projection": (directions[:, keep] / scale).astype(np.float32),
            "projection": np.zeros((0, 0), np.float32),
        }
        local = unit(((sample - arrays["local_mean"]) @ arrays["local_projection"]).astype(np.float32), _SHORTEST)
        words = max(1, min(settings.words, len(local) // 8))
        arrays["centroids"] = _kmeans(local, words, settings.iterations, rng)
        vlad = cls(settings, arrays)
        vectors = np.stack(list(prefetch(vlad.prepare, features(), default_workers())))
        vlad.projection = _principal_projection(vectors, settings)
        return vlad

    @classmethod
    def load(cls, vocabulary: str | Path) -> "Vlad":
        """Read a vocabulary that `save` wrote."""
        require_whole(vocabulary)
        try:
            with np.load(vocabulary) as stored:
                arrays = {name: stored[name] for name in stored.files}
            settings = VladSettings(**json.loads(str(arrays.pop("settings"))))
            return cls(settings, arrays, file_fingerprint(vocabulary))
        except FileNotFoundError:
            raise ArtifactError(f"No VLAD vocabulary {vocabulary}; run the embed stage first.") from None
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise ArtifactError(f"Not a VLAD vocabulary: {vocabulary} ({error}). Delete it and embed again.") from error

    def save(self, path: str | Path) -> None:
        """Write the vocabulary (.npz) and take the file's fingerprint as its own."""
        arrays = {name: getattr(self, name) for name in ("local_mean", "local_projection", "centroids", "projection")}
        settings = np.array(json.dumps(self._settings.model_dump()))
        with write_atomic(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, allow_pickle=False, settings=settings, **arrays)
        self._fingerprint = file_fingerprint(path)


def _select(image: LocalFeatures, settings: VladSettings) -> Floats:
    """Return the RootSIFT vectors (N, 128) of the coarse keypoints, at least `min_features` if there are, in order."""
    scales = image.scales
    chosen = np.flatnonzero(scales >= settings.min_scale_px)
    if len(chosen) < settings.min_features:
        chosen = np.sort(np.argsort(-scales, kind="stable")[: settings.min_features])
    return unit_descriptors(image.descriptors[chosen])


def _assign(points: Floats, centroids: Floats) -> NDArray[np.intp]:
    """Return the index (N,) of each point's nearest centroid."""
    return np.asarray((points @ centroids.T - 0.5 * (centroids**2).sum(axis=1)).argmax(axis=1))


def _kmeans(points: Floats, words: int, iterations: int, rng: np.random.Generator) -> Floats:
    """Return centroids (words, D) by Lloyd's algorithm, starting from random points."""
    centroids = points[np.sort(rng.permutation(len(points))[:words])].copy()
    chunks = np.split(points, range(_CHUNK, len(points), _CHUNK))
    for _ in range(iterations):
        nearest = np.concatenate(list(prefetch(partial(_assign, centroids=centroids), chunks, default_workers())))
        order = np.argsort(nearest, kind="stable")
        present, starts, counts = np.unique(nearest[order], return_index=True, return_counts=True)
        centroids[present] = np.add.reduceat(points[order], starts, axis=0) / counts[:, None]
        empty = np.setdiff1d(np.arange(words), present)
        centroids[empty] = points[rng.integers(len(points), size=len(empty))]
    return centroids


def _principal_projection(vectors: Floats, settings: VladSettings) -> Floats:
    """Return the projection (D, dim) to the map's principal directions, with shrunk whitening.

    The vectors are not centered: as long as no direction is dropped, map images rank by similarity to a query as they
    do with whole VLADs, and a query that has nothing in common with the map gets a short vector.
    """
    count = len(vectors)
    energy, weights = np.linalg.eigh((vectors @ vectors.T).astype(np.float64))
    order = np.argsort(-energy, kind="stable")[: settings.dim]
    order = order[energy[order] > 1e-5 * energy.max()]
    energy = energy[order]
    basis = vectors.T @ (weights[:, order] / np.sqrt(energy)).astype(np.float32)
    mean_energy = energy.mean()
    # Posterior of the energies, given a prior worth `prior_images` images with the mean energy in each direction.
    shrunk = (count * energy + settings.prior_images * mean_energy) / (count + settings.prior_images)
    return (basis * np.sqrt(mean_energy / shrunk)).astype(np.float32)
