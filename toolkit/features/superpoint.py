"""SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018): learned keypoints and descriptors.

The network is that of the package `transformers`, of which only `encoder`, `keypoint_decoder` and
`descriptor_decoder` are used: its processor would squeeze every photograph to 640 x 480.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from toolkit.errors import ToolkitError
from toolkit.features.network import NetworkExtractor
from toolkit.manifest import SuperPointSettings
from toolkit.models.weights import SUPERPOINT, WeightsSource, given_or_resolved, load_checkpoint

DESCRIPTOR_LENGTH = 256
# Side of the cells of the network's coarsest grid, pixels.
_CELL = 8


def import_transformers(model: str) -> Any:
    """Return the package `transformers`.

    Raises:
        ToolkitError: it is not installed; says how to install it.
    """
    try:
        import transformers
    except ImportError as error:
        raise ToolkitError(
            f"{model} needs the package transformers, which cannot be imported ({error}). Install it, in the folder "
            "of this project: python -m pip install --constraint constraints.txt --editable '.[learned]'. "
            "Or use `sift` features, which need nothing else."
        ) from error
    return transformers


def load_network(
    source: WeightsSource,
    checkpoint: str | Path | Mapping[str, Tensor] | None,
    build: Callable[[Any], Any],
    ignore: tuple[str, ...] = (),
) -> Any:
    """Return a network of `transformers` with official weights, float32, on the CPU, ready to use.

    Args:
        checkpoint: the official file, or its tensors by name; None: the hub's cache, else a download.
        ignore: prefixes of tensors in the file that the network does not use.

    Raises:
        WeightsError: no weights, or other ones; names missing, unexpected and mis-shaped keys.
        ToolkitError: the package is missing; before a download.
    """
    with torch.device("meta"):
        network = build(import_transformers(source.model))
    load_checkpoint(network, given_or_resolved(source, checkpoint), source.model, ignore)
    return network


class SuperPointExtractor(NetworkExtractor):
    """Extracts SuperPoint features: keypoints at whole pixels, unit descriptors (256,), on any device."""

    color = False
    name = "superpoint"
    title = "SuperPoint"

    def __init__(
        self,
        checkpoint: str | Path | Mapping[str, Tensor] | None = None,
        device: str = "auto",
        dtype: str = "auto",
        batch_size: int | None = None,
        settings: SuperPointSettings | None = None,
    ) -> None:
        """
        Args:
            checkpoint: the official file, or its tensors by name (shared, not copied); None: from the hub's cache,
                else downloaded there.
            device: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
            dtype: of the encoder: `float32`, `bfloat16`, `float16`; `auto`: the fastest on the device. The heads are
                always float32, so that neighboring pixels do not tie.
            batch_size: most images at a time; None: as suits the device.

        Raises:
            WeightsError: no weights, or other ones.
            ManifestError: no such device, precision or setting.
            ToolkitError: the package transformers is missing, or the device.
        """
        super().__init__(checkpoint, device, dtype, batch_size, settings or SuperPointSettings())

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> nn.Module:
        network: nn.Module = load_network(SUPERPOINT, checkpoint, self._build)
        return network

    def _build(self, transformers: Any) -> Any:
        # Borders and the number of keypoints are left to `_forward`, which knows where the photograph ends.
        config = transformers.SuperPointConfig(
            keypoint_threshold=float(self._values.threshold),
            nms_radius=self._values.nms_radius,
            max_keypoints=-1,
            border_removal_distance=0,
        )
        return transformers.SuperPointForKeypointDetection(config)

    def _forward(self, batch: Tensor) -> Tensor:
        settings, model = self._values, self._model
        size = batch.shape[1:]
        # Whole cells: the last column and row are repeated, so that the image's border is no edge.
        pixels = F.pad(batch[:, None].float() / 255, (0, -size[1] % _CELL, 0, -size[0] % _CELL), mode="replicate")
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            encoded = model.encoder(pixels).last_hidden_state
        most = settings.max_keypoints
        packed = torch.zeros(len(batch), most, 3 + DESCRIPTOR_LENGTH, device=batch.device)
        last = torch.tensor([size[1], size[0]], device=batch.device) - settings.border
        for row, features in zip(packed, encoded.float().split(1), strict=True):
            keypoints, responses = model.keypoint_decoder(features)
            inside = ((keypoints >= settings.border) & (keypoints < last)).all(dim=1)
            keypoints, responses = keypoints[inside], responses[inside]
            responses, order = responses.sort(descending=True, stable=True)
            keypoints, responses = keypoints[order[:most]], responses[:most]
            if len(keypoints):
                descriptors = model.descriptor_decoder(features, keypoints.clone())
                row[: len(keypoints)] = torch.cat([keypoints, responses[:, None], descriptors], dim=1)
            elif not features.isfinite().all():
                row[0] = torch.nan  # what is not finite is above no threshold
        return packed
