"""Depth Anything 3 (Lin et al., 2025), Base and Small: cameras and depth of the views of a scene, in one forward pass.

The official network is at github.com/ByteDance-Seed/Depth-Anything-3. Its code and the weights of these two sizes are
under the Apache License 2.0.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

import numpy as np
import torch
from torch import Tensor, nn

from toolkit.models.da3.backbone import Backbone, choose_reference
from toolkit.models.da3.cameras import cameras_from_pose_encoding
from toolkit.models.da3.heads import CameraHead
from toolkit.models.dpt import dense_output
from toolkit.models.multiview import MultiView
from toolkit.models.vggt.heads import DenseHead
from toolkit.models.vit import PATCH, set_matrix_type

HEADS = ("camera", "depth")
_HEAD_DIM = 64
_SIZES = (768, 384)
"""Channels of Base and Small."""


class DepthAnything3(MultiView):
    """The network: predicts cameras and depth of photographs. The defaults are the official sizes of Base.

    It omits the official branch for rays, head for Gaussians and encoder of known cameras. `from_checkpoint` tells Base
    from Small by the shapes of the tensors.
    """

    title = "Depth Anything 3"
    patch = PATCH
    known_heads = HEADS
    prefixes: ClassVar = {"camera": "cam_dec.", "depth": "head."}
    unused = (
        "cam_enc.",
        "gs_head.",
        "gs_adapter.",
        *(f"head.scratch.refinenet{level}_aux." for level in range(1, 5)),
        *(f"head.scratch.output_conv{number}_aux." for number in (1, 2)),
    )
    class_tokens = 1

    def __init__(
        self,
        heads: Sequence[str] = HEADS,
        compute_dtype: torch.dtype = torch.float32,
        dim: int = 768,
        depth: int = 12,
        num_heads: int = 12,
        grid: int = 37,
        alternate_from: int = 4,
        dense_layers: Sequence[int] = (5, 7, 9, 11),
        dense_channels: Sequence[int] = (96, 192, 384, 768),
        dense_features: int = 128,
    ) -> None:
        """
        Args:
            heads: the heads to create, of `HEADS`.
            compute_dtype: float32 or bfloat16, for the trunk's matrix products and attention. Sums, norms and
                heads are float32.
            dim, depth, num_heads, grid, alternate_from: sizes of the trunk, see `Backbone`.
            dense_layers: the four blocks that the depth head reads.
            dense_channels, dense_features: channels of the depth head.

        Raises:
            ValueError: unknown head.
        """
        super().__init__(heads, compute_dtype)
        self.dense_layers = tuple(dense_layers)
        self.backbone = nn.ModuleDict({"pretrained": Backbone(dim, depth, num_heads, grid, alternate_from)})
        set_matrix_type(self.backbone, compute_dtype)
        if "camera" in self.heads:
            self.cam_dec = CameraHead(2 * dim)
        if "depth" in self.heads:
            self.head = DenseHead(2 * dim, 2, dense_channels, dense_features, overwrites=False)

    @classmethod
    def _sizes(cls, state: Mapping[str, Tensor]) -> dict[str, Any]:
        token = state.get("backbone.pretrained.camera_token")
        dim = 0 if token is None else token.shape[-1]
        if dim not in _SIZES:
            return {}  # another network: loading will raise the error
        channels = (dim // 8, dim // 4, dim // 2, dim)
        return {"dim": dim, "num_heads": dim // _HEAD_DIM, "dense_channels": channels, "dense_features": dim // 6}

    @property
    def trunk(self) -> Backbone:
        return cast(Backbone, self.backbone["pretrained"])

    @property
    def channels(self) -> int:
        return self.trunk.camera_token.shape[-1]

    def _encoded(self, images: Tensor) -> Tensor:
        return self.trunk.encode(images)

    @torch.no_grad()
    def forward(
        self,
        images: Tensor,
        heads: Sequence[str] | None = None,
        patch_tokens: Tensor | None = None,
        reference: str = "saddle_balanced",
    ) -> dict[str, Tensor]:
        """Return the predictions of the heads under the official names, float32.

        Args:
            images: (B, S, 3, H, W) or (S, 3, H, W), RGB in [0, 1], sides multiples of 14: S views of each of B
                scenes. `load_images` makes such images.
            heads: the heads to compute, of those that this network has; None: all.
            patch_tokens: (B, S, 1 + P, C), or (S, 1 + P, C) like the images, from `encode`, if already computed. Then
                only the shape of `images` is read: `torch.empty(shape, device="meta")` will do.
            reference: how to choose the view whose frame is the world; see `choose_reference`.

        Returns:
            For "camera": `pose_enc` (B, S, 9), see `cameras_from_pose_encoding`, and the cameras computed from it:
            `extrinsics` (B, S, 3, 4), cam_from_world, and `intrinsics` (B, S, 3, 3), pixels; NaN for an invalid
            encoding. For "depth": `depth` (B, S, H, W), along the camera's z, and `depth_conf` (B, S, H, W), at least
            1. Cameras and depth share one scale, which is not metric. B = 1 for images with four axes.

        Raises:
            ValueError: wrong shape, a head that this network does not have, or an unknown way to choose the reference.
        """
        size, heads, tokens = self._checked(images, heads, patch_tokens)
        cameras = self._camera_tokens(tokens, reference)
        last = len(self.trunk.blocks) - 1
        read = {last, *(self.dense_layers if "depth" in heads else ())}
        rows, columns = size[0] // PATCH, size[1] // PATCH
        layers, camera = self.trunk(tokens, cameras, rows, columns, read, cameras_only="depth" not in heads)
        output = {}
        if "camera" in heads:
            output["pose_enc"] = self.cam_dec(camera.float())
            output["extrinsics"], output["intrinsics"] = _cameras(output["pose_enc"], size)
        if "depth" in heads:
            values, confidence = dense_output(self.head, layers, self.dense_layers, size)
            output["depth"], output["depth_conf"] = values[..., 0].exp(), confidence
        return output

    def _camera_tokens(self, tokens: Tensor, reference: str) -> Tensor:
        """Return the learned camera tokens (B, S, C) for tokens from `encode`.

        The official code also moves the reference view to the front, which changes rounding only.
        """
        chosen = choose_reference(tokens[:, :, 0].float(), reference)
        is_reference = torch.arange(tokens.shape[1], device=tokens.device) == chosen[:, None]
        reference_token, other_token = self.trunk.camera_token[0]
        return torch.where(is_reference[..., None], reference_token, other_token)


def _cameras(pose_enc: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return `cam_from_world` (B, S, 3, 4) and K (B, S, 3, 3) of pose encodings, with their type and device.

    NaN if an encoding is not finite or its quaternion is zero.
    """
    encoding = np.asarray(pose_enc.cpu(), np.float64)
    invalid = ~(np.isfinite(encoding).all(axis=-1) & encoding[..., 3:7].any(axis=-1))
    encoding[invalid] = 1.0
    cameras = cameras_from_pose_encoding(encoding, size)
    for array in cameras:
        array[invalid] = np.nan
    extrinsics, intrinsics = (torch.from_numpy(array).to(pose_enc.dtype).to(pose_enc.device) for array in cameras)
    return extrinsics, intrinsics
