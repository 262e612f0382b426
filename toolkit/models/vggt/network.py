"""VGGT (Wang et al., CVPR 2025): cameras, depth and points of a few views of a scene, in one forward pass.

The official network is at github.com/facebookresearch/vggt, with its own licenses for code and weights.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from toolkit.models.dpt import dense_output
from toolkit.models.multiview import MultiView
from toolkit.models.vggt.aggregator import Aggregator
from toolkit.models.vggt.heads import CameraHead, DenseHead
from toolkit.models.vit import PATCH, set_matrix_type

HEADS = ("camera", "depth", "point")


class VGGT(MultiView):
    """The network: predicts cameras, depth and points of a few photographs. The defaults are the official sizes.

    It omits the official track head.
    """

    title = "VGGT"
    patch = PATCH
    known_heads = HEADS
    prefixes: ClassVar = {head: f"{head}_head." for head in (*HEADS, "track")}

    def __init__(
        self,
        heads: Sequence[str] = HEADS,
        compute_dtype: torch.dtype = torch.float32,
        dim: int = 1024,
        depth: int = 24,
        num_heads: int = 16,
        encoder_depth: int = 24,
        encoder_num_heads: int = 16,
        grid: int = 37,
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
            grid: rows and columns of patches for which the position embedding was trained.
            camera_depth, camera_num_heads: sizes of the camera head.
            dense_layers: the four layers that the dense heads read.
            dense_channels, dense_features: channels of the dense heads.

        Raises:
            ValueError: unknown head.
        """
        super().__init__(heads, compute_dtype)
        self.dense_layers = tuple(dense_layers)
        self.aggregator = Aggregator(dim, depth, num_heads, encoder_depth, encoder_num_heads, grid)
        set_matrix_type(self.aggregator, compute_dtype)
        if "camera" in self.heads:
            self.camera_head = CameraHead(2 * dim, camera_depth, camera_num_heads)
        if "point" in self.heads:
            self.point_head = DenseHead(2 * dim, 4, dense_channels, dense_features)
        if "depth" in self.heads:
            self.depth_head = DenseHead(2 * dim, 2, dense_channels, dense_features)

    @torch.no_grad()
    def forward(
        self, images: Tensor, heads: Sequence[str] | None = None, patch_tokens: Tensor | None = None
    ) -> dict[str, Any]:
        """Return the predictions of the heads under the official names, float32.

        Args:
            images: (B, S, 3, H, W) or (S, 3, H, W), RGB in [0, 1], sides multiples of 14: S views of each of B
                scenes; the frame of the first view is the world. `load_images` makes such images.
            heads: the heads to compute, of those that this network has; None: all.
            patch_tokens: (B, S, P, C), or (S, P, C) like the images, from `encode`, if already computed. Then only
                the shape of `images` is read: `torch.empty(shape, device="meta")` will do.

        Returns:
            For "camera": `pose_enc` (B, S, 9), see `cameras_from_pose_encoding`, and `pose_enc_list`, the encoding
            after each step of the head. For "depth": `depth` (B, S, H, W, 1), along the camera's z, and `depth_conf`
            (B, S, H, W), at least 1. For "point": `world_points` (B, S, H, W, 3) and `world_points_conf` (B, S, H, W).
            Cameras, depth and points share one scale, which is not metric. B = 1 for images with four axes.

        Raises:
            ValueError: wrong shape, or a head that this network does not have.
        """
        size, heads, patch_tokens = self._checked(images, heads, patch_tokens)
        rows, columns = size[0] // PATCH, size[1] // PATCH
        last = len(self.aggregator.frame_blocks) - 1
        cameras_only = heads == ("camera",)
        read = {last} if cameras_only else {*self.dense_layers, *([last] if "camera" in heads else [])}
        layers = self.aggregator(patch_tokens, rows, columns, read, cameras_only)
        output: dict[str, Any] = {}
        if "camera" in heads:
            output["pose_enc_list"] = self.camera_head(layers[last])
            output["pose_enc"] = output["pose_enc_list"][-1]
        if "depth" in heads:
            values, confidence = dense_output(self.depth_head, layers, self.dense_layers, size)
            output["depth"], output["depth_conf"] = values.exp(), confidence
        if "point" in heads:
            values, confidence = dense_output(self.point_head, layers, self.dense_layers, size)
            output["world_points"] = values.sign() * values.abs().expm1()
            output["world_points_conf"] = confidence
        return output
