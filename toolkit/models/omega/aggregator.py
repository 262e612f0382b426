"""VGGT-Omega's trunk: DINOv3 encodes the patches of each image; then layers attend within each view and among views."""

import math
from collections.abc import Collection

import torch
from torch import Tensor, nn

from toolkit.models.dpt import LayerTokens
from toolkit.models.vit import Block, PatchEmbed, Rope, normalized

PATCH = 16
"""Side of a patch, pixels."""
SPECIAL = 17
"""Number of tokens of a view before its patches: one camera token, then the registers."""
EPS = 1e-5
_STORAGE = 4


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
        self.blocks = nn.ModuleList([Block(dim, num_heads, EPS, dinov3=True) for _ in range(depth)])
        self.norm = nn.LayerNorm(dim, eps=EPS)

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
        # One token for the first view, whose frame is the world, and one for all other views.
        self.camera_token = nn.Parameter(torch.empty(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.empty(1, 2, SPECIAL - 1, dim))
        self.frame_blocks = nn.ModuleList([Block(dim, num_heads, EPS, EPS, dinov3=True) for _ in range(depth)])
        self.inter_frame_blocks = nn.ModuleList([Block(dim, num_heads, EPS, EPS, dinov3=True) for _ in range(depth)])

    def forward(
        self, patch_tokens: Tensor, rows: int, columns: int, layers: Collection[int], cameras_only: bool = False
    ) -> dict[int, LayerTokens]:
        """Return the tokens after the given layers.

        Args:
            patch_tokens: (B, S, rows * columns, C) from `patch_embed`.
            rows, columns: rows and columns of patches.
            layers: numbers of the layers whose tokens to return, from 0.
            cameras_only: compute and return only the camera and register tokens of the last of them, T = SPECIAL.

        Returns:
            By layer, the tokens (B, S, T, C) after each of its two blocks; T = SPECIAL + rows * columns.
        """
        B, S, P, C = patch_tokens.shape
        special = torch.cat([self.camera_token, self.register_token], dim=2)  # (1, 2, SPECIAL, C)
        special = torch.cat([special[:, :1], special[:, 1:].expand(-1, S - 1, -1, -1)], dim=1)
        tokens = torch.cat([special.expand(B, -1, -1, -1), patch_tokens.to(special.dtype)], dim=2)
        T = SPECIAL + P
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
