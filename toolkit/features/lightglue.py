"""LightGlue (Lindenberger, Sarlin and Pollefeys, ICCV 2023): matches SuperPoint features of two images.

The network is that of the package `transformers`. Its own forward detects keypoints anew, in images of one size, so
its public parts are called one by one here, in `_forward` alone: `input_projection`, `positional_encoder`,
`transformer_layers`, `match_assignment_layers`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import ManifestError, ToolkitError
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import PairMatches
from toolkit.features.superpoint import DESCRIPTOR_LENGTH, load_network
from toolkit.models.compute import Fitting, resolve_device, resolve_precision
from toolkit.models.weights import LIGHTGLUE, weights_digest

# Few pairs keep a CPU busy; more at once take more memory and no less time.
_BATCH = {"cpu": 2}
_BATCH_ELSEWHERE = 32


class LightGlueMatcher:
    """Matches pairs of images of any sizes, with any numbers of SuperPoint features, in batches, on any device.

    Every pair goes through all layers with all its features. The network could stop early or drop features where it
    is confident. Its authors advise against that where accuracy counts, and rounding, which depends on the batch, could
    then change a pair's matches.
    """

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        min_score: float = 0.1,
    ) -> None:
        """
        Args:
            checkpoint, device, dtype: as of `SuperPointExtractor`. The detector in the file is not used; positions and
                the assignment are always float32.
            batch_size: most pairs at a time; None: as suits the device.
            min_score: least confidence of a match, from 0 to 1.

        Raises:
            WeightsError: no weights, or other ones.
            ManifestError: no such device, precision or confidence.
            ToolkitError: the package transformers is missing, or the device.
        """
        if not 0 <= min_score <= 1:
            raise ManifestError(f"lightglue: min_score is {min_score}; expected a confidence from 0 to 1.")
        self._min_score = min_score
        self._device = resolve_device(device)
        self._dtype = resolve_precision(dtype, self._device)
        self.batch_size = batch_size or _BATCH.get(self._device.type, _BATCH_ELSEWHERE)
        # The official file has a copy of SuperPoint. The features come from elsewhere.
        model = load_network(LIGHTGLUE, checkpoint, _build, ignore=("keypoint_detector.",))
        self._weights = weights_digest(model)
        self._model = model.to(self._device)
        self._fitting = Fitting(self._forward, "pairs of images")

    @property
    def settings(self) -> dict[str, Any]:
        precision = str(self._dtype).removeprefix("torch.")
        return {
            "name": "lightglue", "weights": self._weights, "dtype_compute": precision, "min_score": self._min_score
        }  # fmt: skip

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images, in the order of the first image's features.

        Raises:
            ToolkitError: features of another kind; a confidence is not finite; or not even one pair fits the
                device's memory.
        """
        for features in (features for pair in pairs for features in pair):
            _check(features)
        matches = [PairMatches(np.zeros((0, 2), np.int64), np.zeros(0, np.float32)) for _ in pairs]
        # Pairs with similar numbers of features go together, as all are padded to the largest. The largest come first,
        # so that a batch that does not fit the memory shows at once.
        sizes = [max(len(a), len(b)) for a, b in pairs]
        order = [number for number in np.argsort(sizes, kind="stable")[::-1] if all(map(len, pairs[number]))]
        for start in range(0, len(order), self.batch_size):
            part = order[start : start + self.batch_size]
            batch = torch.from_numpy(np.stack([_pack(pairs[number], sizes[part[0]]) for number in part]))
            with torch.inference_mode():
                results = self._fitting(batch.to(self._device)).cpu().numpy()
            for number, result in zip(part, results, strict=True):
                matches[number] = _unpack(result)
        return matches

    def _forward(self, batch: Tensor) -> Tensor:
        """Return for each feature of the first image its partner, -1 for none, and the confidence, (B, N, 2).

        Args:
            batch: (B, 2, N, 2 + 256 + 1), of each image's features the normalized x y, the descriptor, and 1; rows of
                zeros pad it to N.
        """
        model = self._model
        images = batch.flatten(0, 1)
        real = images[:, :, -1]
        # Without a mask, the layers of transformers attend only to earlier features.
        mask = real.bool()[:, None, None, :]
        turns = model.positional_encoder(images[:, :, :2])[0]
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            states = model.input_projection(images[:, :, 2:-1])
            for layer in model.transformer_layers:
                states = layer(states, turns, attention_mask=mask)[0]
        logarithms = model.match_assignment_layers[-1](states.float(), real)[:, :-1, :-1]
        scores, partners = logarithms.max(dim=2)
        scores = scores.exp()
        a, b = real.bool().unflatten(0, (-1, 2)).unbind(1)
        first = torch.arange(a.shape[1], device=batch.device)
        mutual = logarithms.argmax(dim=1).gather(1, partners) == first
        # Rows of zeros find partners among themselves.
        matched = mutual & (scores > self._min_score) & a & b.gather(1, partners)
        partners = partners.float().where(matched, -1.0)  # exact: there are fewer than 2^24 features
        scores = scores.where(matched | scores.isnan() & a, 0.0)
        return torch.stack([partners, scores], dim=2)


def _build(transformers: Any) -> Any:
    config = transformers.LightGlueConfig(keypoint_detector_config=transformers.SuperPointConfig())
    model = transformers.LightGlueForKeypointMatching(config)
    del model.keypoint_detector
    return model


def _check(features: LocalFeatures) -> None:
    kind, shape = features.descriptors.dtype, features.descriptors.shape
    if kind == np.uint8 or shape[1:] != (DESCRIPTOR_LENGTH,):
        raise ToolkitError(
            f"LightGlue was trained with SuperPoint features, (N, {DESCRIPTOR_LENGTH}) unit vectors; found {kind} "
            f"{shape}. Use the matcher `mutual` with other features."
        )


def _pack(pair: tuple[LocalFeatures, LocalFeatures], length: int) -> NDArray[np.float32]:
    """Return the features of a pair as `_forward` takes them, (2, length, 259)."""
    packed = np.zeros((2, length, 2 + DESCRIPTOR_LENGTH + 1), np.float32)
    for rows, features in zip(packed, pair, strict=True):
        size = np.array(features.image_size, np.float32)
        # As in training: pixel centers at whole numbers, the longer side from -1 to 1.
        rows[: len(features), :2] = (features.keypoints - 0.5 - size / 2) / (size.max() / 2)
        rows[: len(features), 2:-1] = features.descriptors
        rows[: len(features), -1] = 1
    return packed


def _unpack(result: NDArray[np.float32]) -> PairMatches:
    """Return the matches in one pair's part of what `_forward` returns."""
    if not np.isfinite(result).all():
        raise ToolkitError(
            "LightGlue gave a confidence that is not finite. Its weights may hold NaN: compare the file with the "
            "official one. With float16, numbers may have been too large: use bfloat16 or float32."
        )
    partners = result[:, 0].astype(np.int64)
    matched = np.flatnonzero(partners >= 0)
    return PairMatches(np.stack([matched, partners[matched]], axis=1), result[matched, 1].copy())
