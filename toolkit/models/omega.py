"""VGGT-Omega (Wang et al., 2026): cameras and depth of the views of a scene, in one forward pass.

The official network is at github.com/facebookresearch/vggt-omega, with its own licenses for code and weights.
"""

import math
from collections.abc import Collection, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn

from toolkit.models.multiview import (
    DenseHead,
    Fit,
    LayerTokens,
    Loader,
    MultiView,
    Size,
    add_position,
    cameras_from_pose_encoding,
    dense_output,
    with_special_tokens,
)
from toolkit.models.vit import Block, PatchEmbed, Rope, normalized, set_matrix_type

__all__ = ["HEADS", "VGGTOmega", "cameras_from_pose_encoding", "load_images"]

HEADS = ("camera", "depth")
SIDE = 512
PATCH = 16
"""Side of a patch, pixels."""
SPECIAL = 17
"""Number of tokens of a view before its patches: one camera token, then the registers."""
_EPS = 1e-5
_STORAGE = 4  # tokens
_POSE = 9
_MIN_FIELD_OF_VIEW = 0.01  # radians


def cropped_size(width: int, height: int) -> tuple[int, int]:
    """Return the width and height of the central crop of an image, with an aspect ratio of at most 2 to 1 or 1 to 2."""
    return min(width, 2 * height), min(height, 2 * width)


def resized_size(width: int, height: int, mode: str) -> tuple[int, int]:
    """Return the width and height to which `load_images` resizes a cropped image, before it pads."""
    # Keep the official order of operations: near one half, another order rounds differently.
    aspect = height / width
    if mode == "balanced":
        patches = (SIDE // PATCH) ** 2
        columns = math.sqrt(patches / aspect)
        return PATCH * round(columns), PATCH * round(patches / columns)
    if aspect >= 1:
        return PATCH * round(SIDE / aspect / PATCH), SIDE
    return SIDE, PATCH * round(SIDE * aspect / PATCH)


def _fit(size: Size, mode: str) -> Fit:
    cropped = cropped_size(*size)
    resized = resized_size(*cropped, mode)
    scale = np.divide(resized, cropped)
    return resized, scale, -scale * (np.subtract(size, cropped) // 2)


def _show(image: Image.Image, mode: str) -> Image.Image:
    width, height = cropped_size(*image.size)
    left, top = (image.width - width) // 2, (image.height - height) // 2
    cropped = image.crop((left, top, left + width, top + height))
    return cropped.resize(resized_size(width, height, mode), Image.Resampling.BICUBIC)


LOADER = Loader(("balanced", "max_size"), _fit, _show)
load_images = LOADER.load
"""Loads images as the official loader does; see `multiview.Loader.load`.

Crops images of more than 2 to 1 at their center. Resizes images (bicubic, by Pillow) in proportion, rounded to
multiples of 16: "balanced", the default, to about the area of 512 x 512 pixels; "max_size" to a longer side of 512."""


class PlaceRope(nn.Module):
    """Rotary position embedding of DINOv3 (Siméoni et al., 2025): image coordinates range from -1 to 1."""

    def __init__(self, head_dim: int) -> None:
        super().__init__()
        self.register_buffer("periods", torch.empty(head_dim // 4))

    def forward(self, rows: int, columns: int, special: int) -> Rope:
        """Return cosines and signed sines (special + rows * columns, head_dim); special tokens are not rotated.

        Along the longer side of the image, the centers of patches are spread evenly between -1 and 1; along the shorter
        side they start from -1 with the same spacing. A pair of channels rotates by 2 pi place / period, where place is
        the row for the first half of the pairs and the column for the second half.
        """
        periods = self.get_buffer("periods")
        indices = torch.arange(max(rows, columns), dtype=periods.dtype, device=periods.device)
        places = 2 * ((0.5 + indices) / max(rows, columns)) - 1
        angles = 2 * math.pi * places[:, None] / periods
        row_angles = angles[:rows, None].expand(-1, columns, -1)
        column_angles = angles[None, :columns].expand(rows, -1, -1)
        pairs = torch.cat([row_angles, column_angles], dim=-1).flatten(0, 1)  # (rows * columns, head_dim / 2)
        pairs = torch.cat([pairs.new_zeros(special, pairs.shape[1]), pairs])
        cosine, sine = pairs.cos(), pairs.sin()
        return torch.cat([cosine, cosine], dim=-1), torch.cat([-sine, sine], dim=-1)


class PatchEncoder(nn.Module):
    """DINOv3 ViT-16 with storage tokens. Returns only the patch tokens."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.patch_embed = PatchEmbed(dim, PATCH)
        self.cls_token = nn.Parameter(torch.empty(1, 1, dim))
        self.storage_tokens = nn.Parameter(torch.empty(1, _STORAGE, dim))
        self.mask_token = nn.Parameter(torch.empty(1, dim))  # in the checkpoint, but used in training only
        self.rope_embed = PlaceRope(dim // num_heads)
        self.blocks = nn.ModuleList([Block(dim, num_heads, _EPS, dinov3=True) for _ in range(depth)])
        self.norm = nn.LayerNorm(dim, eps=_EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Return the patch tokens (N, P, C), row by row, of images (N, 3, H, W) in [0, 1]."""
        patches = self.patch_embed(normalized(images))
        special = torch.cat([self.cls_token, self.storage_tokens], dim=1)
        x = torch.cat([special.expand(len(images), -1, -1), patches], dim=1)
        rope = self.rope_embed(images.shape[2] // PATCH, images.shape[3] // PATCH, special.shape[1])
        for block in self.blocks:
            x = block(x, rope)
        return self.norm(x[:, special.shape[1] :])


class Aggregator(nn.Module):
    """The patch encoder, then `depth` layers: a block within each view, followed by a block among all views.

    In some layers only the camera and register tokens attend among views.
    """

    def __init__(
        self, dim: int, depth: int, num_heads: int, encoder_depth: int, encoder_num_heads: int,
        register_layers: Collection[int],
    ) -> None:  # fmt: skip
        super().__init__()
        self.register_layers = frozenset(register_layers)
        self.patch_embed = PatchEncoder(dim, encoder_depth, encoder_num_heads)
        self.rope_embed = PlaceRope(dim // num_heads)
        self.camera_token = nn.Parameter(torch.empty(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.empty(1, 2, SPECIAL - 1, dim))
        self.frame_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS, dinov3=True) for _ in range(depth)])
        self.inter_frame_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS, dinov3=True) for _ in range(depth)])

    def forward(
        self, patch_tokens: Tensor, rows: int, columns: int, layers: Collection[int], cameras_only: bool = False
    ) -> dict[int, LayerTokens]:
        """Return the tokens after the given layers, as VGGT's; with `cameras_only`, T = SPECIAL in the last of them."""
        tokens = with_special_tokens(patch_tokens, self.camera_token, self.register_token)
        B, S, T, C = tokens.shape
        rope = self.rope_embed(rows, columns, SPECIAL)
        kept = {}
        for layer in range(max(layers) + 1):
            within = self.frame_blocks[layer](tokens.view(B * S, T, C), rope).view(B, S, T, C)
            among = self.inter_frame_blocks[layer]
            if layer in self.register_layers:
                # The assignment below must not change tokens that are returned.
                tokens = within.clone() if layer in layers else within
                tokens[:, :, :SPECIAL] = among(within[:, :, :SPECIAL].flatten(1, 2)).view(B, S, SPECIAL, C)
            else:
                indices = None
                if cameras_only and layer == max(layers):
                    indices = torch.arange(S * T, device=within.device).view(S, T)[:, :SPECIAL].flatten()
                tokens = among(within.flatten(1, 2), None, indices).view(B, S, -1, C)
            if layer in layers:
                count = SPECIAL if cameras_only and layer == max(layers) else T
                kept[layer] = (within[:, :, :count], tokens[:, :, :count])
        return kept


class CameraHead(nn.Module):
    """Predicts cameras from the camera and register tokens of all views, in one pass."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.token_norm = nn.LayerNorm(dim, eps=_EPS)
        self.trunk = nn.ModuleList([Block(dim, num_heads, _EPS, dinov3=True) for _ in range(depth)])
        self.trunk_norm = nn.LayerNorm(dim, eps=_EPS)
        self.camera_branch = nn.Sequential(nn.Linear(dim, dim // 2), nn.GELU(), nn.Linear(dim // 2, _POSE))

    def forward(self, tokens: Tensor) -> Tensor:
        """Return the pose encodings (B, S, 9) for tokens (B, S, SPECIAL, C); fields of view are at least 0.01."""
        S, count = tokens.shape[1:3]
        cameras = torch.arange(0, S * count, count, device=tokens.device)
        x = self.token_norm(tokens).flatten(1, 2)
        for block in self.trunk[:-1]:
            x = block(x)
        encoding = self.camera_branch(self.trunk_norm(self.trunk[-1](x, kept=cameras)))
        return torch.cat([encoding[..., :7], F.relu(encoding[..., 7:]) + _MIN_FIELD_OF_VIEW], dim=-1)


class ShuffleHead(DenseHead):
    """Depth and its confidence. The last layer expands each pixel of the fused map to a square of pixels."""

    def __init__(self, dim: int, channels: Sequence[int], features: int) -> None:
        super().__init__(dim, 2, channels, features, PATCH, overwrites=False)
        self.enlarged = PATCH // 4
        self.proj = nn.Conv2d(features, self.enlarged**2, 1)
        self.proj_conf = nn.Conv2d(features, self.enlarged**2, 1)

    def decode(self, maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        x = add_position(self.scratch(maps, maps[0].shape[2:]), size[1] / size[0])
        return torch.cat([F.pixel_shuffle(conv(x), self.enlarged) for conv in (self.proj, self.proj_conf)], dim=1)


class VGGTOmega(MultiView):
    """The network: predicts cameras and depth of images. The defaults are the official sizes of 1B-512.

    The frame of the first view is the world. It returns `camera_and_register_tokens` (B, S, 17, 2 C) of the last layer;

    - for "camera": `pose_enc` (B, S, 9), see `cameras_from_pose_encoding`;
    - for "depth": `depth` (B, S, H, W, 1), along the camera's z, and `depth_conf` (B, S, H, W), at least 1.
    """

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
        """`register_layers` are those in which only camera and register tokens attend among views; for the rest see
        `VGGT`.
        """
        super().__init__(heads, dim, dense_layers)
        self.aggregator = Aggregator(dim, depth, num_heads, encoder_depth, encoder_num_heads, register_layers)
        set_matrix_type(self.aggregator, compute_dtype)
        if "camera" in self.heads:
            self.camera_head = CameraHead(2 * dim, camera_depth, camera_num_heads)
        if "depth" in self.heads:
            self.dense_head = ShuffleHead(2 * dim, dense_channels, dense_features)

    def _predictions(self, tokens: Tensor, heads: tuple[str, ...], size: tuple[int, int]) -> dict[str, Any]:
        last = len(self.aggregator.frame_blocks) - 1
        read = {last, *(self.dense_layers if "depth" in heads else ())}
        rows, columns = size[0] // PATCH, size[1] // PATCH
        layers = self.aggregator(tokens, rows, columns, read, cameras_only="depth" not in heads)
        special = torch.cat([tokens[:, :, :SPECIAL] for tokens in layers[last]], dim=-1).float()
        output = {"camera_and_register_tokens": special}
        if "camera" in heads:
            output["pose_enc"] = self.camera_head(special)
        if "depth" in heads:
            values, confidence = dense_output(self.dense_head, layers, self.dense_layers, size)
            output["depth"], output["depth_conf"] = values.exp(), confidence
        return output
