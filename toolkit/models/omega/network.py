"""VGGT-Omega (Wang et al., 2026): cameras and depth of the views of a scene, in one forward pass.

The official network is at github.com/facebookresearch/vggt-omega, with its own licenses for code and weights.
"""

from collections.abc import Collection, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from toolkit.models.dpt import dense_output
from toolkit.models.multiview import MultiView
from toolkit.models.omega.aggregator import PATCH, SPECIAL, Aggregator
from toolkit.models.omega.heads import CameraHead, DenseHead
from toolkit.models.vit import set_matrix_type

HEADS = ("camera", "depth")


class VGGTOmega(MultiView):
    """The network: predicts cameras and depth of photographs. The defaults are the official sizes of 1B-512."""

    title = "VGGT-Omega"
    patch = PATCH
    known_heads = HEADS
    prefixes: ClassVar = {"camera": "camera_head.", "depth": "dense_head."}

    def __init__(
        self,
        heads: Sequence[str] = HEADS,
        compute_dtype: torch.dtype = torch.float32,
        dim: int = 1024,
        depth: int = 24,
        num_heads: int = 16,
        encoder_depth: int = 24,
        encoder_num_heads: int = 16,
        register_layers: Collection[int] = (2, 6, 9, 14, 20),
        camera_depth: int = 4,
        camera_num_heads: int = 16,
        dense_layers: Sequence[int] = (4, 11, 17, 23),
        dense_channels: Sequence[int] = (256, 512, 1024, 1024),
        dense_features: int = 256,
    ) -> None:
        """
        Args:
            heads: the heads to create, of `HEADS`.
            compute_dtype: float32 or bfloat16, for the trunk's matrix products and attention. Sums, norms and heads
                are float32.
            dim, depth, num_heads: sizes of the trunk; each of the `depth` layers has two blocks.
            encoder_depth, encoder_num_heads: sizes of the patch encoder, which has the same `dim`.
            register_layers: layers in which only camera and register tokens attend among views.
            camera_depth, camera_num_heads: sizes of the camera head.
            dense_layers: the four layers that the dense head reads.
            dense_channels, dense_features: channels of the dense head.

        Raises:
            ValueError: unknown head.
        """
        super().__init__(heads, compute_dtype)
        self.dense_layers = tuple(dense_layers)
        self.aggregator = Aggregator(dim, depth, num_heads, encoder_depth, encoder_num_heads, register_layers)
        set_matrix_type(self.aggregator, compute_dtype)
        if "camera" in self.heads:
            self.camera_head = CameraHead(2 * dim, camera_depth, camera_num_heads)
        if "depth" in self.heads:
            self.dense_head = DenseHead(2 * dim, dense_channels, dense_features)

    @torch.no_grad()
    def forward(
        self, images: Tensor, heads: Sequence[str] | None = None, patch_tokens: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the predictions of the heads under the official names, float32.

        Args:
            images: (B, S, 3, H, W) or (S, 3, H, W), RGB in [0, 1], sides multiples of 16: S views of each of B
                scenes; the frame of the first view is the world. `load_images` makes such images.
            heads: the heads to compute, of those that this network has; None: all.
            patch_tokens: (B, S, P, C), or (S, P, C) like the images, from `encode`, if already computed. Then only
                the shape of `images` is read: `torch.empty(shape, device="meta")` will do.

        Returns:
            `camera_and_register_tokens` (B, S, 17, 2 C) of the last layer. For "camera": `pose_enc` (B, S, 9), see
            `cameras_from_pose_encoding`. For "depth": `depth` (B, S, H, W, 1), along the camera's z, and `depth_conf`
            (B, S, H, W), at least 1. Cameras and depth share one scale, which is not metric. B = 1 for images with
            four axes.

        Raises:
            ValueError: wrong shape, or a head that this network does not have.
        """
        size, heads, patch_tokens = self._checked(images, heads, patch_tokens)
        last = len(self.aggregator.frame_blocks) - 1
        read = {last, *(self.dense_layers if "depth" in heads else ())}
        rows, columns = size[0] // PATCH, size[1] // PATCH
        layers = self.aggregator(patch_tokens, rows, columns, read, cameras_only="depth" not in heads)
        special = torch.cat([tokens[:, :, :SPECIAL] for tokens in layers[last]], dim=-1).float()
        output = {"camera_and_register_tokens": special}
        if "camera" in heads:
            output["pose_enc"] = self.camera_head(special)
        if "depth" in heads:
            values, confidence = dense_output(self.dense_head, layers, self.dense_layers, size)
            output["depth"], output["depth_conf"] = values.exp(), confidence
        return output
