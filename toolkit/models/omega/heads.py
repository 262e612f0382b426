"""VGGT-Omega's heads: one for cameras, and a dense one for depth and its confidence."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models import dpt
from toolkit.models.omega.aggregator import EPS, PATCH
from toolkit.models.vit import Block

_POSE = 9
_LEAST_FIELD_OF_VIEW = 0.01  # radians


class CameraHead(nn.Module):
    """Predicts cameras from the camera and register tokens of all views, in one pass."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.token_norm = nn.LayerNorm(dim, eps=EPS)
        self.trunk = nn.ModuleList([Block(dim, num_heads, EPS, dinov3=True) for _ in range(depth)])
        self.trunk_norm = nn.LayerNorm(dim, eps=EPS)
        self.camera_branch = nn.Sequential(nn.Linear(dim, dim // 2), nn.GELU(), nn.Linear(dim // 2, _POSE))

    def forward(self, tokens: Tensor) -> Tensor:
        """Return the pose encodings (B, S, 9) for tokens (B, S, SPECIAL, C); fields of view are at least 0.01."""
        S, count = tokens.shape[1:3]
        cameras = torch.arange(0, S * count, count, device=tokens.device)
        x = self.token_norm(tokens).flatten(1, 2)
        for block in self.trunk[:-1]:
            x = block(x)
        encoding = self.camera_branch(self.trunk_norm(self.trunk[-1](x, kept=cameras)))
        return torch.cat([encoding[..., :7], F.relu(encoding[..., 7:]) + _LEAST_FIELD_OF_VIEW], dim=-1)


class DenseHead(dpt.DenseHead):
    """Depth and its confidence. The last layer expands each pixel of the fused map to a square of pixels."""

    def __init__(self, dim: int, channels: Sequence[int], features: int) -> None:
        """`features` is the number of channels of the fused map; for the other arguments, see `dpt.DenseHead`."""
        super().__init__(dim, channels, PATCH, 2, dpt.Scratch(channels, features, overwrites=False))
        self.enlarged = PATCH // 4
        self.proj = nn.Conv2d(features, self.enlarged**2, 1)
        self.proj_conf = nn.Conv2d(features, self.enlarged**2, 1)

    def decode(self, maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        x = dpt.add_position(self.scratch(maps, maps[0].shape[2:]), size[1] / size[0])
        return torch.cat([F.pixel_shuffle(conv(x), self.enlarged) for conv in (self.proj, self.proj_conf)], dim=1)
