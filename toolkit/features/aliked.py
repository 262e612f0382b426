"""ALIKED (Zhao et al., IEEE Transactions on Instrumentation and Measurement, 2023): learned local features."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from toolkit.features.network import NetworkExtractor
from toolkit.manifest import AlikedSettings
from toolkit.models.aliked import Aliked, find_keypoints
from toolkit.models.compute import in_single_threads, resolve_device
from toolkit.models.weights import ALIKED, given_or_resolved


class AlikedExtractor(NetworkExtractor):
    """Extracts ALIKED features: keypoints between pixels, unit descriptors (128,), on any device."""

    color = True
    name = "aliked"
    title = "ALIKED"

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        settings: AlikedSettings | None = None,
    ) -> None:
        """
        Args:
            checkpoint: the official file of the model in `settings`, or its tensors by name; None: from an installed
                package or a cache, else downloaded.
            device: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
            dtype: of the encoder: `float32`, `bfloat16`, `float16`; `auto`: float32 on a CPU, where others gain little,
                else the fastest on the device. Positions, scores and descriptors are always float32.
            batch_size: most images at a time; None: as suits the device.

        Raises:
            WeightsError: no weights, or other ones.
            ManifestError: no such device, precision or setting.
            ToolkitError: no such device on this machine.
        """
        on_cpu = resolve_device(device).type == "cpu"
        batch_size = batch_size or (torch.get_num_threads() if on_cpu else None)
        super().__init__(checkpoint, device, dtype, batch_size, settings or AlikedSettings())

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
            keypoints, values = find_keypoints(scores, settings.max_keypoints, settings.threshold, settings.nms_radius)
            descriptors = model.describe(levels, number, keypoints)
            row[: len(keypoints)] = torch.cat([keypoints, values[:, None], descriptors], dim=1)
        return packed
