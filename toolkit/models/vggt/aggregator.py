"""VGGT's trunk: DINOv2 encodes the patches of each image; then layers attend within each view and among all views."""

from collections.abc import Collection

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models.dpt import LayerTokens
from toolkit.models.vit import Block, Dinov2, normalized, places_of_view, rope_of_places

REGISTERS = 4
SPECIAL = 1 + REGISTERS
"""Number of tokens of a view before its patches: one camera token, then the registers. (The encoder has the same number
of tokens before its patches: a class token and registers of its own.)"""
_EPS = 1e-5


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
        # One token for the first view, whose frame is the world, and one for all other views.
        self.camera_token = nn.Parameter(torch.empty(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.empty(1, 2, REGISTERS, dim))
        self.frame_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS) for _ in range(depth)])
        self.global_blocks = nn.ModuleList([Block(dim, num_heads, _EPS, _EPS) for _ in range(depth)])

    def forward(
        self, patch_tokens: Tensor, rows: int, columns: int, layers: Collection[int], cameras_only: bool = False
    ) -> dict[int, LayerTokens]:
        """Return the tokens after the given layers.

        Args:
            patch_tokens: (B, S, rows * columns, C) from `patch_embed`.
            rows, columns: rows and columns of patches.
            layers: numbers of the layers whose tokens to return, from 0.
            cameras_only: compute and return only the camera tokens of the last of them, T = 1.

        Returns:
            By layer, the tokens (B, S, T, C) after each of its two blocks; T = SPECIAL + rows * columns.
        """
        B, S, P, C = patch_tokens.shape
        special = torch.cat([self.camera_token, self.register_token], dim=2)  # (1, 2, SPECIAL, C)
        special = torch.cat([special[:, :1], special[:, 1:].expand(-1, S - 1, -1, -1)], dim=1)
        tokens = torch.cat([special.expand(B, -1, -1, -1), patch_tokens.to(special.dtype)], dim=2)
        T = SPECIAL + P
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
