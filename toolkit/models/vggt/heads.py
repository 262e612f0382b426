"""VGGT's heads: one for cameras, and dense ones for depth or points and their confidence."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models import dpt
from toolkit.models.dpt import LayerTokens, add_position, resize
from toolkit.models.vit import PATCH, Block, Mlp

_EPS = 1e-5
_CAMERA_STEPS = 4
_POSE = 9


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


class Scratch(dpt.Scratch):
    """Fuses the maps and enlarges the result to the image."""

    def __init__(self, channels: Sequence[int], features: int, out: int, overwrites: bool) -> None:
        super().__init__(channels, features, overwrites)
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, 32, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(32, out, 1)
        )

    def forward(self, maps: Sequence[Tensor], size: Sequence[int]) -> Tensor:
        """Return (N, out, H, W), size = (H, W), for maps (N, channels[level], h, w), given from fine to coarse."""
        x = super().forward(maps, [2 * side for side in maps[0].shape[2:]])
        x = resize(self.output_conv1(x), size)
        output: Tensor = self.output_conv2(add_position(x, size[1] / size[0]))
        return output


class DenseHead(dpt.DenseHead):
    """Predicts a map of depth or points, and its confidence."""

    def __init__(self, dim: int, out: int, channels: Sequence[int], features: int, overwrites: bool = True) -> None:
        """`features` is the number of channels of the fused map; for `overwrites`, see `dpt.ResidualUnit`; for the
        other arguments, `dpt.DenseHead`."""
        super().__init__(dim, channels, PATCH, out, Scratch(channels, features, out, overwrites))

    def decode(self, maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        output: Tensor = self.scratch(maps, size)
        return output
