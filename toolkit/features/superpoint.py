"""SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018): learned keypoints and descriptors.

The network comes from the package `transformers`. Only its `encoder`, `keypoint_decoder` and `descriptor_decoder` are
used, because its image processor would squeeze every photograph to 640 x 480.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from toolkit.errors import ToolkitError
from toolkit.features.network import NetworkExtractor
from toolkit.manifest import SuperPointSettings
from toolkit.models.weights import SUPERPOINT, given_or_resolved, load_checkpoint

DESCRIPTOR_LENGTH = 256
_CELL = 8  # side of the cells of the network's coarsest grid, pixels
MIN_RESPONSE = 0.005  # smallest response of a keypoint; responses are at most 1
NMS_RADIUS = 4
"""Radius of non-maximum suppression, pixels of the resized image: two keypoints are further apart in x or in y."""
BORDER = 4  # keypoints closer to the image border than this are dropped, pixels of the resized image


class SuperPointExtractor(NetworkExtractor):
    """Extracts SuperPoint features: keypoints at integer pixels, unit descriptors (256,), on any device."""

    color = False
    name = "superpoint"
    title = "SuperPoint"
    defaults = SuperPointSettings()

    def _load(self, checkpoint: str | Path | Mapping[str, Tensor] | None) -> nn.Module:
        try:
            import transformers
        except ImportError as error:
            fault = f"{SUPERPOINT.model} needs the package transformers, which cannot be imported ({error})"
            install = "python -m pip install --constraint constraints.txt --editable '.[learned]'"
            raise ToolkitError(f"{fault}. In the folder of this project: {install}. Or use `sift` features.") from error
        # `_forward` limits border and number of keypoints, because only it knows the unpadded size of the image.
        config = transformers.SuperPointConfig(
            keypoint_threshold=MIN_RESPONSE, nms_radius=NMS_RADIUS, max_keypoints=-1, border_removal_distance=0
        )
        with torch.device("meta"):
            network: nn.Module = transformers.SuperPointForKeypointDetection(config)
        load_checkpoint(network, given_or_resolved(SUPERPOINT, checkpoint), SUPERPOINT.model)
        return network

    def _forward(self, batch: Tensor) -> Tensor:
        model, limit = self._model, self._values.max_keypoints
        size = batch.shape[1:]
        # Pad to whole cells by repeating the last column and row, so that the border of the image gives no edge.
        pixels = F.pad(batch[:, None].float() / 255, (0, -size[1] % _CELL, 0, -size[0] % _CELL), mode="replicate")
        with torch.autocast(batch.device.type, self._dtype, enabled=self._dtype != torch.float32):
            encoded = model.encoder(pixels).last_hidden_state
        packed = torch.zeros(len(batch), limit, 3 + DESCRIPTOR_LENGTH, device=batch.device)
        last = torch.tensor([size[1], size[0]], device=batch.device) - BORDER
        for row, features in zip(packed, encoded.float().split(1), strict=True):
            keypoints, responses = model.keypoint_decoder(features)
            inside = ((keypoints >= BORDER) & (keypoints < last)).all(dim=1)
            keypoints, responses = keypoints[inside], responses[inside]
            responses, order = responses.sort(descending=True, stable=True)
            keypoints, responses = keypoints[order[:limit]], responses[:limit]
            if len(keypoints):
                descriptors = model.descriptor_decoder(features, keypoints.clone())
                row[: len(keypoints)] = torch.cat([keypoints, responses[:, None], descriptors], dim=1)
            elif not features.isfinite().all():
                row[0] = torch.nan  # no threshold shows that features are not finite, as NaN is above none
        return packed
