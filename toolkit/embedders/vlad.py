"""VLAD of RootSIFT: a global descriptor that needs no weights. It learns its vocabulary from the map images.

For each visual word, the residuals of the whitened local descriptors assigned to it are summed (Jegou et al., CVPR
2010). Residuals and sums are normalized (Delhumeau et al., ACM MM 2013; Arandjelovic and Zisserman, CVPR 2013). The
result is projected to the principal directions of the map images.

Learning would amplify a rounding error to another vocabulary, so it is exact: whitened descriptors and centroids are
multiples of powers of two (`_POINT_STEP`, `_CENTROID_STEP`) whose products and sums float32 holds without rounding, in
any order. The sample and the first centroids are chosen by a hash of each descriptor (`_keys`), not by its index.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.images import default_workers, prefetch
from toolkit.errors import COMMAND, ArtifactError, ToolkitError
from toolkit.features.features import DESCRIPTOR_SCALE, LocalFeatures, unit_descriptors
from toolkit.files import file_fingerprint, require_whole, write_atomic
from toolkit.geometry import rounded, unit
from toolkit.threads import fixed_sums

Floats = NDArray[np.float32]

VLAD_FORMAT = 3  # Version of the vocabulary, part of its record. Increase when the same images give another one
MAX_WORDS = 256  # largest number of visual words; fewer if the map has too few descriptors
LOCAL_DIM = 64  # dimensions of the local descriptors after PCA whitening
MIN_SCALE_PX = 2.25
"""Smallest scale of a keypoint: the standard deviation of its blob, in pixels of the stored image. Finer keypoints are
the first to change with blur, noise and camera resolution."""
MIN_FEATURES = 300  # if fewer keypoints reach `MIN_SCALE_PX`, this many of the coarsest are used instead
MAX_DIM = 512  # largest dimension of the global descriptor; the number of map images limits it too
PRIOR_IMAGES = 2000
"""Shrinkage of the whitening: a prior that all directions vary equally, with the weight of this many images. Whitening
learned from a hundred images describes the places they show, not what repeats between places."""
SAMPLE_DESCRIPTORS = 50_000  # number of local descriptors from which the vocabulary is learned
ITERATIONS = 15  # iterations of k-means
_SHORTEST = 1e-9  # shorter vectors are rounding errors, and are not normalized
_CHUNK = 8192  # number of local descriptors that are assigned at once
_POINT_STEP, _CENTROID_STEP = 2**-11, 2**-8
"""Whitened descriptors and centroids are multiples of these. The centroids' step is coarse, so that one that moves by a
rounding error is the same again."""
_PROJECTION_BITS = 14  # of an entry of the local projection: products with uint8 descriptors stay below 2**24
_KEY_STEPS = 32  # per unit, to hash a descriptor: one entry off by the last bit usually leaves the hash as it is

_ARRAYS = ("local_projection", "local_offset", "local_scale", "centroids", "projection")  # what a vocabulary file holds


class Vlad:
    """A VLAD with its vocabulary: computes global descriptors from local features."""

    name = "vlad"
    inputs: Literal["features"] = "features"
    upright = False
    min_side = None

    def __init__(self, arrays: dict[str, Floats], fingerprint: str = ""):
        self._fingerprint = fingerprint
        self.local_projection = arrays["local_projection"]
        self.local_offset, self.local_scale = arrays["local_offset"], arrays["local_scale"]
        self.centroids, self.projection = arrays["centroids"], arrays["projection"]

    @property
    def dim(self) -> int:
        return int(self.projection.shape[1])

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": self.name, "vocabulary": self._fingerprint}

    @fixed_sums
    def prepare(self, item: LocalFeatures | Floats) -> Floats:
        """Return the VLAD (words * local_dim,) of an image before the projection, of length 1 or 0."""
        if not isinstance(item, LocalFeatures):
            return item
        vector = np.zeros_like(self.centroids)
        descriptors = _select(item)
        if len(descriptors):
            local = self._whitened(descriptors)
            nearest = _assign(local, self.centroids)
            residuals = unit(local - self.centroids[nearest], _SHORTEST)
            order = np.argsort(nearest, kind="stable")
            present, starts = np.unique(nearest[order], return_index=True)
            vector[present] = unit(np.add.reduceat(residuals[order], starts, axis=0).astype(np.float32), _SHORTEST)
        flat = vector.reshape(-1)
        return unit(np.sign(flat) * np.sqrt(np.abs(flat)), _SHORTEST)

    def _whitened(self, descriptors: Floats) -> Floats:
        """Return the whitened local descriptors (N, local_dim), of length about 1."""
        products = (descriptors * np.float32(DESCRIPTOR_SCALE)) @ self.local_projection
        whitened = np.asarray((products - self.local_offset) * self.local_scale, np.float32)
        return rounded(unit(whitened, _SHORTEST), _POINT_STEP)

    def stack(self, inputs: Sequence[LocalFeatures | Floats]) -> Floats:
        """Return the VLADs of images, (B, words * local_dim)."""
        return np.array([self.prepare(item) for item in inputs], np.float32).reshape(-1, self.centroids.size)

    @fixed_sums
    def embed(self, inputs: Sequence[LocalFeatures] | Floats) -> Floats:
        """Return the global descriptors (B, dim) of images, or of a batch from `stack`; zeros without features.

        The rows do not have length 1: compare them by dot products, or normalize them for cosines.
        """
        # One by one: BLAS rounds the products of a batch and of one image differently.
        rows = [self.prepare(item) @ self.projection for item in inputs]
        return np.array(rows, np.float32).reshape(-1, self.dim)

    @classmethod
    @fixed_sums
    def learn(cls, features: Callable[[], Iterable[LocalFeatures]], count: int, seed: int = 0) -> "Vlad":
        """Learn vocabulary and projection from `count` map images; equal inputs give equal bytes.

        `features` yields the features of the images, in the same order at each call. It is called twice, so memory does
        not grow with the number of local features. Raise ToolkitError if the images have no local features.
        """
        share = -(-SAMPLE_DESCRIPTORS // max(count, 1))
        parts, all_keys = [], []
        for image in features():
            descriptors = _select(image)
            keys = _keys(descriptors, seed)
            chosen = np.sort(np.argsort(keys, kind="stable")[:share])
            parts.append(descriptors[chosen])
            all_keys.append(keys[chosen])
        sample = np.concatenate(parts) if parts else np.zeros((0, 1), np.float32)
        if len(sample) < 2:
            fault = f"{count} map images gave {len(sample)} local features"
            advice = f"Check that they can be read and are not blank (`{COMMAND} check CAPTURE`)"
            raise ToolkitError(f"A VLAD vocabulary cannot be learned: {fault}. {advice}.")
        empty = np.zeros((0, 0), np.float32)
        arrays = _whitening(sample, LOCAL_DIM) | {"centroids": empty, "projection": empty}
        local = cls(arrays)._whitened(sample)
        words = max(1, min(MAX_WORDS, len(local) // 8))
        arrays["centroids"] = _kmeans(local, words, ITERATIONS, np.concatenate(all_keys))
        vlad = cls(arrays)
        vectors = np.stack(list(prefetch(vlad.prepare, features(), default_workers())))
        vlad.projection = _principal_projection(vectors)
        return vlad

    @classmethod
    def load(cls, vocabulary: str | Path) -> "Vlad":
        """Read a vocabulary that `save` wrote."""
        require_whole(vocabulary)
        try:
            with np.load(vocabulary) as stored:
                return cls({name: stored[name] for name in _ARRAYS}, file_fingerprint(vocabulary))
        except FileNotFoundError:
            raise ArtifactError(f"No VLAD vocabulary {vocabulary}; run the embed stage first.") from None
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise ArtifactError(f"Not a VLAD vocabulary: {vocabulary} ({error}). Delete it and embed again.") from error

    def save(self, path: str | Path) -> None:
        """Write the vocabulary (.npz) and take the file's fingerprint as its own."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        with write_atomic(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        self._fingerprint = file_fingerprint(path)


def _select(image: LocalFeatures) -> Floats:
    """Return the RootSIFT vectors (N, 128) of the coarse keypoints, at least `MIN_FEATURES` if there are, in order."""
    scales = image.scales
    chosen = np.flatnonzero(scales >= MIN_SCALE_PX)
    if len(chosen) < MIN_FEATURES:
        chosen = np.sort(np.argsort(-scales, kind="stable")[:MIN_FEATURES])
    return unit_descriptors(image.descriptors[chosen])


def _keys(descriptors: Floats, seed: int) -> NDArray[np.uint32]:
    """Return a number (N,) for each RootSIFT vector that looks random and depends on nothing but the vector."""
    weights = np.random.default_rng(seed).integers(2**32, size=descriptors.shape[1], dtype=np.uint32)
    return np.asarray((descriptors * np.float32(_KEY_STEPS)).astype(np.uint32) @ weights)


def _whitening(sample: Floats, dim: int) -> dict[str, Floats]:
    """Return the PCA whitening of RootSIFT vectors (N, 128): `(512 * vectors @ projection - offset) * scale`, where the
    projection (128, dim) holds integers, so products with stored RootSIFT vectors, integers / 512, are exact.
    """
    squares, sums = np.zeros((sample.shape[1],) * 2), np.zeros(sample.shape[1])
    for start in range(0, len(sample), _CHUNK):  # exact in float64, as descriptors are integers / 512
        part = sample[start : start + _CHUNK].astype(np.float64)
        squares += part.T @ part
        sums += part.sum(axis=0)
    mean = sums / len(sample)
    variance, directions = np.linalg.eigh((squares - np.outer(sums, mean)) / (len(sample) - 1))
    keep = np.argsort(-variance, kind="stable")[: min(dim, len(sample) - 1)]
    directions = directions[:, keep]
    largest = np.abs(directions).argmax(axis=0)
    directions *= np.sign(directions[largest, np.arange(len(keep))])  # an eigenvector has no sign of its own
    projection = np.rint(directions * 2**_PROJECTION_BITS)
    # Without a lower bound, whitening would amplify the noise of almost constant directions.
    scale = DESCRIPTOR_SCALE * 2**_PROJECTION_BITS * np.sqrt(np.maximum(variance[keep], 1e-4 * variance.max() + 1e-12))
    return {
        "local_projection": projection.astype(np.float32),
        "local_offset": (DESCRIPTOR_SCALE * mean @ projection).astype(np.float32),
        "local_scale": (1 / scale).astype(np.float32),
    }


def _assign(points: Floats, centroids: Floats) -> NDArray[np.intp]:
    """Return the index (N,) of each point's nearest centroid."""
    return np.asarray((points @ centroids.T - 0.5 * (centroids**2).sum(axis=1)).argmax(axis=1))


def _kmeans(points: Floats, words: int, iterations: int, keys: NDArray[np.uint32]) -> Floats:
    """Return centroids (words, D) by Lloyd's algorithm, from the points with the smallest `keys` (N,)."""
    order = np.unique(keys, return_index=True)[1]  # equal points, as of equal images, are one choice
    order = np.concatenate([order, np.setdiff1d(np.arange(len(points)), order)])
    seeds = points[order]
    centroids, used = rounded(seeds[:words], _CENTROID_STEP), words
    chunks = np.split(points, range(_CHUNK, len(points), _CHUNK))
    for _ in range(iterations):
        nearest = np.concatenate(list(prefetch(partial(_assign, centroids=centroids), chunks, default_workers())))
        by_word = np.argsort(nearest, kind="stable")
        present, starts, counts = np.unique(nearest[by_word], return_index=True, return_counts=True)
        sums = np.add.reduceat(points[by_word], starts, axis=0, dtype=np.float64)
        centroids[present] = rounded((sums / counts[:, None]).astype(np.float32), _CENTROID_STEP)
        empty = np.setdiff1d(np.arange(words), present)
        centroids[empty] = rounded(seeds[np.arange(used, used + len(empty)) % len(seeds)], _CENTROID_STEP)
        used += len(empty)
    return centroids


def _principal_projection(vectors: Floats) -> Floats:
    """Return the projection (D, dim) to the map's principal directions, with shrunk whitening.

    The vectors are not centered: as long as no direction is dropped, map images rank by similarity to a query as they
    do with whole VLADs, and a query that has nothing in common with the map gets a short vector.
    """
    count = len(vectors)
    energy, weights = np.linalg.eigh((vectors @ vectors.T).astype(np.float64))
    order = np.argsort(-energy, kind="stable")[:MAX_DIM]
    order = order[energy[order] > 1e-5 * energy.max()]
    energy = energy[order]
    basis = vectors.T @ (weights[:, order] / np.sqrt(energy)).astype(np.float32)
    mean_energy = energy.mean()
    # Posterior of the energies, given a prior worth `PRIOR_IMAGES` images with the mean energy in each direction.
    shrunk = (count * energy + PRIOR_IMAGES * mean_energy) / (count + PRIOR_IMAGES)
    return (basis * np.sqrt(mean_energy / shrunk)).astype(np.float32)
