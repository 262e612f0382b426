"""Depth Anything 3's camera modules: an encoder of known cameras, and a head that predicts cameras."""

import torch
from torch import Tensor, nn

from toolkit.models.vit import Block, Mlp

_EPS = 1e-5
_POSE = 9


class CameraEncoder(nn.Module):
    """Encodes known cameras as camera tokens, with attention among the cameras."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.pose_branch = Mlp(_POSE, dim // 2, dim)
        self.token_norm = nn.LayerNorm(dim, eps=_EPS)
        self.trunk = nn.ModuleList([Block(dim, num_heads, _EPS) for _ in range(depth)])
        self.trunk_norm = nn.LayerNorm(dim, eps=_EPS)

    def forward(self, encoding: Tensor) -> Tensor:
        """Return camera tokens (B, S, C) for pose encodings (B, S, 9)."""
        x = self.token_norm(self.pose_branch(encoding))
        for block in self.trunk:
            x = block(x)
        tokens: Tensor = self.trunk_norm(x)
        return tokens


class CameraHead(nn.Module):
    """Predicts each camera from its token."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim), nn.ReLU())
        self.fc_t = nn.Linear(dim, 3)
        self.fc_qvec = nn.Linear(dim, 4)
        self.fc_fov = nn.Sequential(nn.Linear(dim, 2), nn.ReLU())

    def forward(self, tokens: Tensor) -> Tensor:
        """Return the pose encodings (B, S, 9) for camera tokens (B, S, C); fields of view are not negative."""
        x = self.backbone(tokens)
        return torch.cat([self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)], dim=-1)
