"""VGGT's trunk: patches of each image by DINOv2, then attention within a view and among all views in turn."""

from collections.abc import Collection

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models.vit import IMAGENET_MEAN, IMAGENET_STD, Block, PatchEmbed, Rope, SharedRoom

PATCH = 14
REGISTERS = 4
SPECIAL = 1 + REGISTERS
"""Tokens of a view before its patches: the camera's, then the registers."""
_ROPE_BASE = 100.0
_EPS = 1e-5

LayerTokens = tuple[Tensor, Tensor]
"""Tokens (B, S, T, C) after a layer's attention within the views, and after that among them."""


class PatchEncoder(nn.Module):
    """DINOv2 ViT with registers (Darcet et al., ICLR 2024), for its patches alone."""

    def __init__(self, dim: int, depth: int, num_heads: int, grid: int) -> None:
        super().__init__()
        self.grid = grid
        self.patch_embed = PatchEmbed(dim, PATCH)
        self.cls_token = nn.Parameter(torch.empty(1, 1, dim))
        self.register_tokens = nn.Parameter(torch.empty(1, REGISTERS, dim))
        self.mask_token = nn.Parameter(torch.empty(1, dim))  # of training: the checkpoint has it
        self.pos_embed = nn.Parameter(torch.empty(1, grid * grid + 1, dim))
        self.blocks = nn.ModuleList([Block(dim, num_heads) for _ in range(depth)])
        self.norm = nn.LayerNorm(dim, eps=1e-6)

    def forward(self, images: Tensor) -> Tensor:
        """Return the patches (N, P, C), row by row, of images (N, 3, H, W) in [0, 1]."""
        mean, std = (images.new_tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
        rows, columns = images.shape[2] // PATCH, images.shape[3] // PATCH
        patches = self.patch_embed((images - mean) / std) + self._position(rows, columns)
        special = torch.cat([self.cls_token + self.pos_embed[:, :1], self.register_tokens], dim=1)
        x = torch.cat([special.expand(len(images), -1, -1), patches], dim=1)
        room = SharedRoom.on(x.device)
        for block in self.blocks:
            x = block(x, room=room)
        return self.norm(x[:, special.shape[1] :])

    def _position(self, rows: int, columns: int) -> Tensor:
        """Return the position embedding of the patches, (1, rows * columns, C), trained for grid x grid of them."""
        patches = self.pos_embed[:, 1:]
        if rows == columns == self.grid:
            return patches
        trained = patches.unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
        resized = F.interpolate(trained, (rows, columns), mode="bicubic", antialias=True)
        return resized.flatten(2).transpose(1, 2)


def rope_of_view(rows: int, columns: int, head_dim: int, device: torch.device) -> Rope:
    """Return the rotary position embedding of one view's tokens: place 0 for special ones, from 1 for patches.

    Of D = head_dim channels, the first half turns with the row, the second with the column; pair i of D / 4 turns
    by place * 100 ** (-4 i / D) radians.
    """
    half = head_dim // 2
    frequencies = 1.0 / _ROPE_BASE ** (torch.arange(0, half, 2, device=device).float() / half)
    places = torch.zeros(SPECIAL + rows * columns, 2, device=device)
    places[SPECIAL:] = 1 + torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).to(places)
    angles = places[:, :, None] * frequencies  # (tokens, y and x, D / 4)
    cosine, sine = angles.cos(), angles.sin()
    cosine = torch.stack([cosine, cosine], dim=2).flatten(1)
    sine = torch.stack([-sine, sine], dim=2).flatten(1)
    return cosine, sine


class Aggregator(nn.Module):
    """Patch encoder, and layers of a block within each view followed by one among all views."""

    def __init__(
        self, dim: int, depth: int, num_heads: int, encoder_depth: int, encoder_num_heads: int, grid: int
    ) -> None:
        super().__init__()
        self.head_dim = dim // num_heads
        self.patch_embed = PatchEncoder(dim, encoder_depth, encoder_num_heads, grid)
        # Of the first view, which is to be the world's frame; and of the others.
        self.camera_token = nn.Parameter(torch.empty(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.empty(1, 2, REGISTERS, dim))
        self.frame_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS) for _ in range(depth)])
        self.global_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS) for _ in range(depth)])

    def forward(
        self, patch_tokens: Tensor, rows: int, columns: int, layers: Collection[int], cameras_only: bool = False
    ) -> dict[int, LayerTokens]:
        """Return the tokens after each layer asked for, and no other.

        Args:
            patch_tokens: (B, S, rows * columns, C) of `patch_embed`.
            rows, columns: of patches.
            layers: numbers of layers, from 0.
            cameras_only: of the last layer return the camera tokens alone, T = 1: the rest is not computed.

        Returns:
            By layer, the tokens (B, S, T, C) after its two blocks; T = SPECIAL + rows * columns.
        """
        B, S, P, C = patch_tokens.shape
        special = torch.cat([self.camera_token, self.register_token], dim=2)  # (1, 2, SPECIAL, C)
        special = torch.cat([special[:, :1], special[:, 1:].expand(-1, S - 1, -1, -1)], dim=1)
        tokens = torch.cat([special.expand(B, -1, -1, -1), patch_tokens.to(special.dtype)], dim=2)
        T = SPECIAL + P
        rope = rope_of_view(rows, columns, self.head_dim, tokens.device)
        rope_of_views = (rope[0].repeat(S, 1), rope[1].repeat(S, 1))
        room = SharedRoom.on(tokens.device)
        kept = {}
        for layer in range(max(layers) + 1):
            every = T if cameras_only and layer == max(layers) else 1
            within = self.frame_blocks[layer](tokens.view(B * S, T, C), rope, room=room).view(B, S * T, C)
            tokens = self.global_blocks[layer](within, rope_of_views, every, room)
            if layer in layers:
                kept[layer] = (within.view(B, S, T, C)[:, :, ::every], tokens.view(B, S, -1, C))
        return kept
