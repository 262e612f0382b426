"""VGGT (Wang et al., CVPR 2025): cameras, depth and points of a few views of a scene, in one forward pass.

The official network is at github.com/facebookresearch/vggt, with its own licenses for code and weights.
"""

from collections.abc import Collection, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn

from toolkit.models.multiview import (
    ConvolutionalHead,
    Fit,
    LayerTokens,
    Loader,
    MultiView,
    Size,
    Views,
    cameras_from_pose_encoding,
    dense_output,
    with_special_tokens,
)
from toolkit.models.vit import (
    PATCH,
    Block,
    Dinov2,
    Mlp,
    normalized,
    places_of_view,
    rope_of_places,
    set_matrix_type,
)

__all__ = ["HEADS", "VGGT", "Views", "cameras_from_pose_encoding", "load_images"]

HEADS = ("camera", "depth", "point")
SIDE = 518
REGISTERS = 4
SPECIAL = 1 + REGISTERS
"""Number of tokens of a view before its patches: one camera token, then the registers. (The encoder has the same number
of tokens before its patches: a class token and registers of its own.)"""
_EPS = 1e-5
_CAMERA_STEPS = 4
_POSE = 9


def resized_size(width: int, height: int, mode: str) -> tuple[int, int]:
    """Return the width and height to which `load_images` resizes an image, before it crops or pads."""
    longest = width if mode == "crop" else max(width, height)
    # Keep the official order of operations: near one half, another order rounds differently.
    new_width = SIDE if longest == width else round(width * (SIDE / height) / PATCH) * PATCH
    new_height = SIDE if longest != width else round(height * (SIDE / width) / PATCH) * PATCH
    return new_width, new_height


def _cut(height: int, mode: str) -> int:
    """Return the number of rows that "crop" cuts at the top of a resized image."""
    return max(0, (height - SIDE) // 2) if mode == "crop" else 0


def _fit(size: Size, mode: str) -> Fit:
    width, height = resized_size(*size, mode)
    return (width, min(height, SIDE)), np.divide((width, height), size), (0.0, -_cut(height, mode))


def _show(image: Image.Image, mode: str) -> Image.Image:
    width, height = resized_size(*image.size, mode)
    top = _cut(height, mode)
    resized = image.resize((width, height), Image.Resampling.BICUBIC)
    return resized.crop((0, top, width, min(top + SIDE, height)))


LOADER = Loader(("crop", "pad"), _fit, _show, least=lambda mode: (SIDE, SIDE if mode == "pad" else 0))
load_images = LOADER.load
"""Loads images as the official loader does; see `multiview.Loader.load`.

Resizes images (bicubic, by Pillow) in proportion, to multiples of 14: "crop", the default, makes the width 518 and
keeps at most the 518 middle rows; "pad" makes the longer side 518 and adds white up to 518 x 518."""


class PatchEncoder(Dinov2):
    """DINOv2 with registers (Darcet et al., ICLR 2024). Returns only the patch tokens."""

    def __init__(self, dim: int, depth: int, num_heads: int, grid: int) -> None:
        super().__init__(dim, depth, num_heads, grid)
        self.register_tokens = nn.Parameter(torch.empty(1, REGISTERS, dim))
        self.mask_token = nn.Parameter(torch.empty(1, dim))  # in the checkpoint, but used in training only

    def forward(self, images: Tensor) -> Tensor:
        """Return the patch tokens (N, P, C), row by row, of images (N, 3, H, W) in [0, 1]."""
        return self.norm(self._tokens(normalized(images), self.register_tokens)[:, SPECIAL:])

    def _resize(self, trained: Tensor, rows: int, columns: int) -> Tensor:
        return F.interpolate(trained, (rows, columns), mode="bicubic", antialias=True)


class Aggregator(nn.Module):
    """The patch encoder, then `depth` layers: a block within each view, followed by a block among all views."""

    def __init__(
        self, dim: int, depth: int, num_heads: int, encoder_depth: int, encoder_num_heads: int, grid: int
    ) -> None:
        super().__init__()
        self.head_dim = dim // num_heads
        self.patch_embed = PatchEncoder(dim, encoder_depth, encoder_num_heads, grid)
        self.camera_token = nn.Parameter(torch.empty(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.empty(1, 2, REGISTERS, dim))
        self.frame_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS) for _ in range(depth)])
        self.global_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS) for _ in range(depth)])

    def forward(
        self, patch_tokens: Tensor, rows: int, columns: int, layers: Collection[int], cameras_only: bool = False
    ) -> dict[int, LayerTokens]:
        """Return the tokens after the given layers, from 0, of patch tokens (B, S, rows * columns, C) from
        `patch_embed`.

        With `cameras_only`, compute and return only the camera tokens of the last of them, T = 1.

        Returns:
            By layer, the tokens (B, S, T, C) after each of its two blocks; T = SPECIAL + rows * columns.
        """
        tokens = with_special_tokens(patch_tokens, self.camera_token, self.register_token)
        B, S, T, C = tokens.shape
        rope = rope_of_places(places_of_view(rows, columns, SPECIAL, tokens.device), self.head_dim)
        rope_of_views = (rope[0].repeat(S, 1), rope[1].repeat(S, 1))
        kept = {}
        for layer in range(max(layers) + 1):
            cameras = cameras_only and layer == max(layers)
            within = self.frame_blocks[layer](tokens.view(B * S, T, C), rope).view(B, S * T, C)
            indices = torch.arange(0, S * T, T, device=within.device) if cameras else None
            tokens = self.global_blocks[layer](within, rope_of_views, indices)
            if layer in layers:
                kept[layer] = (within.view(B, S, T, C)[:, :, : 1 if cameras else T], tokens.view(B, S, -1, C))
        return kept


class CameraHead(nn.Module):
    """Predicts cameras from the camera tokens. Each of several steps corrects the pose encoding."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.token_norm = nn.LayerNorm(dim, eps=_EPS)
        self.empty_pose_tokens = nn.Parameter(torch.empty(1, 1, _POSE))
        self.embed_pose = nn.Linear(_POSE, dim)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(dim, 3 * dim))
        self.trunk = nn.ModuleList([Block(dim, num_heads, _EPS) for _ in range(depth)])
        self.trunk_norm = nn.LayerNorm(dim, eps=_EPS)
        self.pose_branch = Mlp(dim, dim // 2, _POSE)

    def forward(self, tokens: LayerTokens) -> list[Tensor]:
        """Return the pose encodings (B, S, 9) after each step, for the tokens of the last layer.

        Each step starts from the camera tokens, shifted, scaled and gated by the current encoding (Peebles and Xie,
        ICCV 2023). Negative fields of view are returned as 0, but passed to the next step unchanged.
        """
        within, among = tokens
        camera = self.token_norm(torch.cat([within[:, :, 0], among[:, :, 0]], dim=-1).float())
        normed = F.layer_norm(camera, camera.shape[-1:], eps=1e-6)
        encoding: Tensor | None = None
        returned = []
        for _ in range(_CAMERA_STEPS):
            before = self.empty_pose_tokens if encoding is None else encoding
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(before)).chunk(3, dim=-1)
            x = camera + gate * (normed * (1 + scale) + shift)
            for block in self.trunk:
                x = block(x)
            correction = self.pose_branch(self.trunk_norm(x))
            encoding = correction if encoding is None else encoding + correction
            returned.append(torch.cat([encoding[..., :7], F.relu(encoding[..., 7:])], dim=-1))
        return returned


class VGGT(MultiView):
    """The network: predicts cameras, depth and points of a few images. The defaults are the official sizes.

    It omits the official track head. The frame of the first view is the world. It returns

    - for "camera": `pose_enc` (B, S, 9), see `cameras_from_pose_encoding`, and `pose_enc_list`, the encoding after
      each step of the head;
    - for "depth": `depth` (B, S, H, W, 1), along the camera's z, and `depth_conf` (B, S, H, W), at least 1;
    - for "point": `world_points` (B, S, H, W, 3) and `world_points_conf` (B, S, H, W).
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
        """Take the sizes of the network, see `MultiView.from_checkpoint` for the first two.

        Args:
            dim, depth, num_heads: of the trunk; each of the `depth` layers has two blocks.
            encoder_depth, encoder_num_heads: of the patch encoder, which has the same `dim`.
            grid: rows and columns of patches for which the position embedding was trained.
            camera_depth, camera_num_heads: of the camera head.
            dense_layers, dense_channels, dense_features: the four layers that the dense heads read, and their channels.
        """
        super().__init__(heads, dim, dense_layers)
        self.aggregator = Aggregator(dim, depth, num_heads, encoder_depth, encoder_num_heads, grid)
        set_matrix_type(self.aggregator, compute_dtype)
        if "camera" in self.heads:
            self.camera_head = CameraHead(2 * dim, camera_depth, camera_num_heads)
        if "point" in self.heads:
            self.point_head = ConvolutionalHead(2 * dim, 4, dense_channels, dense_features)
        if "depth" in self.heads:
            self.depth_head = ConvolutionalHead(2 * dim, 2, dense_channels, dense_features)

    def _predictions(self, tokens: Tensor, heads: tuple[str, ...], size: tuple[int, int]) -> dict[str, Any]:
        last = len(self.aggregator.frame_blocks) - 1
        cameras_only = heads == ("camera",)
        read = {last} if cameras_only else {*self.dense_layers, *([last] if "camera" in heads else [])}
        layers = self.aggregator(tokens, size[0] // PATCH, size[1] // PATCH, read, cameras_only)
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
