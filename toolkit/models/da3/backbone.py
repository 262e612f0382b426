"""Depth Anything 3's trunk: a DINOv2 whose later blocks alternate attention within each view and among all views."""

from collections.abc import Collection

import torch
from torch import Tensor

from toolkit.models.dpt import LayerTokens
from toolkit.models.vit import Dinov2, normalized, places_of_view, rope_of_places

REFERENCES = ("saddle_balanced", "first")
"""Ways to choose the reference view, whose frame is the world."""
_LEAST_CHOICE = 3  # with fewer views, the first is the reference
_NORM_EPS = 1e-5  # epsilon of the last norm, and of those on queries and keys


class Backbone(Dinov2):
    """The trunk. A camera token replaces each view's class token before the first of the later blocks."""

    def __init__(self, dim: int, depth: int, num_heads: int, grid: int, alternate_from: int) -> None:
        """
        Args:
            dim, depth, num_heads, grid: see `Dinov2`.
            alternate_from: number of the first of the later blocks; those with odd numbers attend among views.
        """
        super().__init__(dim, depth, num_heads, grid, _NORM_EPS, (alternate_from, _NORM_EPS))
        self.alternate_from = alternate_from
        self.head_dim = dim // num_heads
        # One token for the reference view, whose frame is the world, and one for all other views.
        self.camera_token = torch.nn.Parameter(torch.empty(1, 2, dim))

    def encode(self, images: Tensor) -> Tensor:
        """Return tokens (N, 1 + P, C) of images (N, 3, H, W) in [0, 1].

        The P patch tokens are the input of the later blocks. The class token before them is from one block earlier,
        where the network chooses the reference view.
        """
        x = self._embedded(normalized(images))
        class_token = x[:, :1]
        for block in self.blocks[: self.alternate_from]:
            class_token = x[:, :1]
            x = block(x)
        return torch.cat([class_token, x[:, 1:]], dim=1)

    def forward(
        self,
        tokens: Tensor,
        cameras: Tensor,
        rows: int,
        columns: int,
        layers: Collection[int],
        cameras_only: bool = False,
    ) -> tuple[dict[int, LayerTokens], Tensor]:
        """Return the tokens after the given blocks.

        Args:
            tokens: (B, S, 1 + rows * columns, C) from `encode`.
            cameras: (B, S, C) camera tokens.
            rows, columns: rows and columns of patches.
            layers: numbers of the blocks whose tokens to return; these blocks attend among views.
            cameras_only: compute and return only the camera tokens of the last of them.

        Returns:
            By block, the tokens (B, S, T, C) after the preceding block, and the normalized tokens after the block
            itself; and the camera tokens (B, S, 2 C) after the last two blocks, not normalized.
        """
        B, S, T, C = tokens.shape
        x = torch.cat([cameras[:, :, None], tokens[:, :, 1:]], dim=2)
        places = places_of_view(rows, columns, 1, x.device)
        # Among views, all patches have the same place; only the camera tokens have another.
        rope, among = (rope_of_places(grid, self.head_dim) for grid in (places, places.clamp(max=1)))
        rope_of_views = (among[0].repeat(S, 1), among[1].repeat(S, 1))
        kept, last, within = {}, max(layers), x
        for number in range(self.alternate_from, last + 1):
            block = self.blocks[number]
            if number % 2 == 0:
                x = within = block(x.view(B * S, T, C), rope).view(B, S, T, C)
                continue
            indices = torch.arange(0, S * T, T, device=x.device) if cameras_only and number == last else None
            x = block(x.view(B, S * T, C), rope_of_views, indices).view(B, S, -1, C)
            if number in layers and not cameras_only:
                kept[number] = (within, self.norm(x))
        return kept, torch.cat([within[:, :, 0], x[:, :, 0]], dim=-1)


def choose_reference(class_tokens: Tensor, way: str) -> Tensor:
    """Return the index (B,) of the reference view, whose frame is the world, for class tokens (B, S, C).

    "first" chooses the first view. "saddle_balanced" chooses, from three or more views, the one closest to the middle
    in three measures, each scaled to [0, 1] over the views: the mean cosine similarity to the other views, the length
    of the class token, and the variance of the class token normalized to length 1. (Lin et al., Depth Anything 3,
    2025.)

    Raises:
        ValueError: unknown way.
    """
    if way not in REFERENCES:
        raise ValueError(f"reference is {way!r}; expected one of {list(REFERENCES)}.")
    S = class_tokens.shape[1]
    if way == "first" or S < _LEAST_CHOICE:
        return torch.zeros(len(class_tokens), dtype=torch.long, device=class_tokens.device)
    lengths = class_tokens.norm(dim=-1)
    units = class_tokens / lengths[..., None]
    similarity = ((units @ units.transpose(1, 2)).sum(dim=-1) - 1) / (S - 1)
    measures = torch.stack([similarity, lengths, units.var(dim=-1)])  # (3, B, S)
    least, most = measures.amin(dim=-1, keepdim=True), measures.amax(dim=-1, keepdim=True)
    scaled = (measures - least) / (most - least + 1e-8)
    return (scaled - 0.5).abs().sum(dim=0).argmin(dim=-1)
