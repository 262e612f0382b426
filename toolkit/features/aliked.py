"""ALIKED (Zhao et al., IEEE Transactions on Instrumentation and Measurement, 2023): learned local features."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from toolkit.features.network import NetworkExtractor
from toolkit.manifest import AlikedSettings
from toolkit.models.aliked import Aliked, find_keypoints
from toolkit.models.compute import in_single_threads
from toolkit.models.weights import ALIKED, given_or_resolved

MIN_SCORE = 0.02
"""Smallest score of a keypoint. The authors' 0.2 leaves few keypoints in dark photographs; plain walls stay below
0.02."""
NMS_RADIUS = 2
"""Radius of non-maximum suppression, pixels of the resized image: two maxima are further apart in x or in y."""


class AlikedExtractor(NetworkExtractor):
    """Extracts ALIKED features: keypoints with subpixel positions, unit descriptors (128,), on any device."""

    color = True
    name = "aliked"
    title = "ALIKED"
    min_long_side = 640
    defaults = AlikedSettings()

    def _batch_on_cpu(self) -> int:
        return torch.get_num_threads()

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> Aliked:
        model = self._values.model
        return Aliked.from_checkpoint(given_or_resolved(ALIKED[model], checkpoint), model)

    def _forward(self, batch: Tensor) -> Tensor:
        if batch.device.type == "cpu":
            return torch.cat(in_single_threads(self._run, batch.split(1)))
        return self._run(batch)

    def _run(self, batch: Tensor) -> Tensor:
        settings, model = self._values, self._model
        pixels = batch.permute(0, 3, 1, 2).float() / 255
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            levels = model.encode(pixels)
        packed = torch.zeros(len(batch), settings.max_keypoints, 3 + model.descriptor_length, device=batch.device)
        for number, (row, scores) in enumerate(zip(packed, model.scores(levels), strict=True)):
            if not scores.isfinite().all():
                row[0] = torch.nan
                continue
            keypoints, values = find_keypoints(scores, settings.max_keypoints, MIN_SCORE, NMS_RADIUS)
            descriptors = model.describe(levels, number, keypoints)
            row[: len(keypoints)] = torch.cat([keypoints, values[:, None], descriptors], dim=1)
        return packed
