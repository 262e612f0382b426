"""LightGlue (Lindenberger, Sarlin and Pollefeys, ICCV 2023): matches the learned features of two images."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from toolkit.errors import ManifestError, ToolkitError
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import MATCHER_WEIGHTS, PairMatches
from toolkit.features.network import NOT_FINITE
from toolkit.files import Remade
from toolkit.models.compute import Fitting, in_single_threads, on_device, resolve_device, resolve_precision
from toolkit.models.lightglue import LightGlue, official_names
from toolkit.models.weights import given_or_resolved, load_checkpoint, weights_digest
from toolkit.threads import release_memory

_DESCRIPTOR_LENGTHS = {"superpoint": 256, "aliked": 128}


class LightGlueMatcher(Remade):
    """Matches pairs of images of any sizes, with any numbers of learned features, in batches, on any device.

    On a CPU, each thread matches one pair at a time, so its matches do not depend on the other pairs. As the authors'
    code by default, it stops early, and drops features when it is confident that they match nothing: this takes half
    the time. On other devices, every pair of a batch goes through all layers with all its features, and rounding
    depends on the batch.
    """

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        min_score: float = 0.1,
        features: str = "superpoint",
    ) -> None:
        """Take the authors' or the hub's file, see `NetworkExtractor`, for features of the kind `superpoint` or
        `aliked`.

        `dtype` is the precision of the attention blocks, `batch_size` the largest number of pairs per batch (None:
        depends on the device), `min_score` the smallest confidence of a match, from 0 to 1.

        Raises:
            WeightsError: the weights are missing, or are those of another network.
            ManifestError: unknown device, precision or kind, or a confidence out of range.
            ToolkitError: this machine does not have the device.
        """
        if not 0 <= min_score <= 1:
            raise ManifestError(f"lightglue: min_score is {min_score}; expected a confidence from 0 to 1.")
        if features not in _DESCRIPTOR_LENGTHS:
            raise ManifestError(f"lightglue: no weights for {features!r}. Known: {', '.join(_DESCRIPTOR_LENGTHS)}.")
        self._kind = features
        self._min_score = min_score
        self._device = resolve_device(device)
        self._dtype = resolve_precision(dtype, self._device)
        self._one_by_one = self._device.type == "cpu"
        self.batch_size = batch_size or (8 if self._one_by_one else 32)
        source = MATCHER_WEIGHTS["lightglue", features]
        with torch.device("meta"):
            model = LightGlue(_DESCRIPTOR_LENGTHS[features])
        # The hub's file contains a copy of SuperPoint; the authors' newer code stores thresholds for early stopping.
        ignore = ("keypoint_detector.", "confidence_thresholds")
        load_checkpoint(model, given_or_resolved(source, checkpoint), source.model, ignore, official_names)
        self._weights = weights_digest(model)
        model.fold_(self._dtype)
        self._model: Any = on_device(model, self._device, "LightGlue")
        self._fitting_images = Fitting(self._encode, "images", self._device)
        self._fitting_pairs = Fitting(self._forward, "pairs of images", self._device)

    @property
    def settings(self) -> dict[str, Any]:
        numbers = {"dtype_compute": str(self._dtype).removeprefix("torch."), "min_score": self._min_score}
        return {"name": "lightglue", "weights": self._weights, **numbers, "adaptive": self._one_by_one}

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images, in the order of the first image's features.

        If several pairs share an image (the same object), it goes through the first half of the first layer only once.
        Raise ToolkitError if features are of another kind, a confidence is not finite, or not even one pair fits the
        device's memory.
        """
        matches = [PairMatches.none() for _ in pairs]
        # Pairs with similar numbers of features form a batch, as all are padded to the largest. The largest come first,
        # so that a batch that does not fit the memory fails at the start.
        sizes = [-max(len(a), len(b)) for a, b in pairs]
        order = [number for number in np.argsort(sizes, kind="stable") if all(map(len, pairs[number]))]
        for features in (features for number in order for features in pairs[number]):
            self._check(features)  # an image without features has no kind of its own
        uses = Counter(id(features) for number in order for features in pairs[number])
        encoded: dict[int, Tensor] = {}
        with torch.inference_mode():
            for start in range(0, len(order), self.batch_size):
                batch = order[start : start + self.batch_size]
                images = [features for number in batch for features in pairs[number]]
                self._encode_new(images, encoded)
                states = [encoded[id(features)] for features in images]
                for number, result in zip(batch, self._match(states), strict=True):
                    matches[number] = _unpack(result.cpu().numpy())
                uses.subtract(map(id, images))
                encoded = {key: value for key, value in encoded.items() if uses[key]}
        return matches

    def _match(self, states: Sequence[Tensor]) -> Iterable[Tensor]:
        """Return the output of `_forward` for consecutive pairs of images, given by their output of `_encode`."""
        if not self._one_by_one:
            return self._fitting_pairs(pad_sequence(list(states), batch_first=True).unflatten(0, (-1, 2)))

        def match_one(pair: tuple[Tensor, Tensor]) -> Tensor:
            matches = self._forward_pairs(pair[0][None], pair[1][None])[0]
            release_memory()  # hundreds of megabytes, as the numbers of features differ after each layer
            return matches

        return in_single_threads(match_one, zip(states[::2], states[1::2], strict=True))

    def _check(self, features: LocalFeatures) -> None:
        dtype, shape, expected = features.descriptors.dtype, features.descriptors.shape, _DESCRIPTOR_LENGTHS[self._kind]
        if dtype == np.uint8 or shape[1:] != (expected,):
            wanted = f"descriptors of {self._kind}, (N, {expected}) unit vectors; found {dtype} {shape}"
            raise ToolkitError(f"These weights of LightGlue expect {wanted}. Use the matcher `mutual`.")

    def _encode_new(self, images: Sequence[LocalFeatures], encoded: dict[int, Tensor]) -> None:
        """Add the missing images to `encoded`: by the id of the object, the input (N, 2 + DIM + 1) of `_forward`."""
        new = list({id(features): features for features in images if id(features) not in encoded}.values())
        if self._one_by_one:
            packed = [torch.from_numpy(_pack(features))[None] for features in new]
            for features, rows in zip(new, in_single_threads(self._encode, packed), strict=True):
                encoded[id(features)] = rows[0]
            return
        for start in range(0, len(new), 2 * self.batch_size):
            part = new[start : start + 2 * self.batch_size]
            batch = pad_sequence([torch.from_numpy(_pack(features)) for features in part], batch_first=True)
            for features, rows in zip(part, self._fitting_images(batch), strict=True):
                encoded[id(features)] = rows[: len(features)]

    def _encode(self, batch: Tensor) -> Tensor:
        """Replace the descriptors of images (B, N, 2 + D + 1), see `_pack`, by the network's initial states."""
        xy, mask = batch[..., :2], _mask(batch)
        states = self._model.encode(xy, batch[..., 2:-1], mask)
        return torch.cat([xy, states, batch[..., -1:]], dim=-1)

    def _forward(self, batch: Tensor) -> Tensor:
        """Return for each feature of the first image its partner (-1: none) and the confidence, (B, N, 2).

        The batch (B, 2, N, 2 + DIM + 1) has, for each image of a pair, the normalized x y, the state of the network,
        and 1; padded with rows of zeros.
        """
        return self._forward_pairs(*batch.unbind(1))

    def _forward_pairs(self, a: Tensor, b: Tensor) -> Tensor:
        masks = _mask(a), _mask(b)
        partners, scores = self._model((a[..., :2], b[..., :2]), (a[..., 2:-1], b[..., 2:-1]), masks, self._one_by_one)
        partners = partners.where(scores > self._min_score, -1)
        return torch.stack([partners.float(), scores], dim=2)  # exact: there are fewer than 2^24 features


def _mask(images: Tensor) -> Tensor | None:
    """Return which rows of images (B, N, ... + 1) are features, not padding, (B, N); None: all."""
    real = images[..., -1].bool()
    return None if bool(real.all()) else real


def _pack(features: LocalFeatures) -> NDArray[np.float32]:
    """Return the features of an image as `_encode` takes them, (N, 2 + D + 1): normalized x y, descriptor, and 1."""
    features = features.turned(features.turns)  # the network was trained on upright images
    size = np.array(features.image_size, np.float32)
    # As in training: pixel centers at integers, the longer side from -1 to 1.
    xy = (features.keypoints - 0.5 - size / 2) / (size.max() / 2)
    return np.concatenate([xy, features.descriptors, np.ones((len(xy), 1))], axis=1, dtype=np.float32)


def _unpack(result: NDArray[np.float32]) -> PairMatches:
    """Return the matches of one pair, from its output (N, 2) of `_forward`."""
    if not np.isfinite(result).all():
        raise ToolkitError(f"LightGlue gave a confidence that is not finite. {NOT_FINITE}")
    partners = result[:, 0].astype(np.int64)
    matched = np.flatnonzero(partners >= 0)
    return PairMatches(np.stack([matched, partners[matched]], axis=1), result[matched, 1].copy())
