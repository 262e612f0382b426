"""VGGT's heads: one for cameras, and dense ones for depth or points, with a confidence for each pixel."""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models.vggt.aggregator import SPECIAL, LayerTokens
from toolkit.models.vit import PATCH, Block, Mlp

_EPS = 1e-5
_CAMERA_STEPS = 4
_POSE = 9


class CameraHead(nn.Module):
    """Predicts cameras from the camera tokens, in steps that each correct the pose encoding."""

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
        """Return the pose encoding (B, S, 9) after each step, for the tokens of the last layer.

        Each step starts from the camera tokens, shifted, scaled and gated by the encoding so far (Peebles and Xie,
        ICCV 2023). Returned fields of view are clamped to 0; the next step gets the raw ones.
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


class ResidualUnit(nn.Module):
    """Two 3 x 3 convolutions, added to the *rectified* input: the official code's ReLU overwrites the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(x)
        return self.conv2(F.relu(self.conv1(x))).add_(x)


class Fusion(nn.Module):
    """Adds a finer map to a coarser one and enlarges the sum."""

    def __init__(self, channels: int, has_residual: bool) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        if has_residual:
            self.resConfUnit1 = ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(self, coarse: Tensor | None, fine: Tensor, size: Sequence[int]) -> Tensor:
        """Return (N, C, *size) of maps (N, C, h, w)."""
        coarse = fine if coarse is None else self.resConfUnit1(fine).add_(coarse)
        # A 1 x 1 convolution and an interpolation commute: convolving the small map is cheaper.
        return _resize(self.out_conv(self.resConfUnit2(coarse)), size)


class Scratch(nn.Module):
    """Fuses the maps of the four layers. (The name is the checkpoint's.)"""

    def __init__(self, channels: Sequence[int], features: int, out: int) -> None:
        super().__init__()
        for level, channel in enumerate(channels, start=1):
            self.add_module(f"layer{level}_rn", nn.Conv2d(channel, features, 3, padding=1, bias=False))
            self.add_module(f"refinenet{level}", Fusion(features, has_residual=level < len(channels)))
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, 32, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(32, out, 1)
        )

    def forward(self, maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        """Return (N, out, H, W), size = (H, W), of maps from fine to coarse, (N, channels[level], h, w)."""
        sizes = [[2 * side for side in maps[0].shape[2:]], *(x.shape[2:] for x in maps[:-1])]
        x = None
        for level in range(len(maps), 0, -1):
            fine = self.get_submodule(f"layer{level}_rn")(maps[level - 1])
            x = self.get_submodule(f"refinenet{level}")(x, fine, sizes[level - 1])
        x = _resize(self.output_conv1(x), size)
        return self.output_conv2(add_position(x, size[1] / size[0]))


class DenseHead(nn.Module):
    """Dense Prediction Transformer (Ranftl et al., ICCV 2021): maps of four layers, fused from coarse to fine."""

    def __init__(self, dim: int, out: int, channels: Sequence[int], features: int) -> None:
        """
        Args:
            dim: channels of the concatenated tokens of both blocks of a layer.
            out: channels of the result, including the confidence.
            channels: of the maps of the four layers.
            features: channels of the fused maps.
        """
        super().__init__()
        self.out = out
        self.norm = nn.LayerNorm(dim, eps=_EPS)
        self.projects = nn.ModuleList([nn.Conv2d(dim, channel, 1) for channel in channels])
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
            ]
        )
        self.scratch = Scratch(channels, features, out)

    def forward(self, layers: Sequence[LayerTokens], size: tuple[int, int]) -> Tensor:
        """Return (N, out, H, W) before activation, size = (H, W), for tokens (N, T, C) of the four layers."""
        grid = (size[0] // PATCH, size[1] // PATCH)
        maps = []
        for (within, among), project, resize in zip(layers, self.projects, self.resize_layers, strict=True):
            tokens = self.norm(torch.cat([within[:, SPECIAL:], among[:, SPECIAL:]], dim=-1).float())
            x = project(tokens.transpose(1, 2).unflatten(2, grid))
            maps.append(resize(add_position(x, size[1] / size[0])))
        output: Tensor = self.scratch(maps, size)
        return output


def dense_output(
    head: DenseHead, layers: Mapping[int, LayerTokens], read: Sequence[int], size: tuple[int, int], frames: int
) -> tuple[Tensor, Tensor]:
    """Return the values (B, S, H, W, out - 1) before activation, and the confidence (B, S, H, W), above 1.

    Args:
        layers: tokens (B, S, T, C) by layer.
        read: the four layers that the head reads.
        size: (H, W) of the images.
        frames: number of frames to compute at a time. A frame's maps take many times the memory of its tokens.
    """
    B, S = layers[read[0]][0].shape[:2]
    flat = [(layers[layer][0].flatten(0, 1), layers[layer][1].flatten(0, 1)) for layer in read]
    result = torch.empty(B * S, *size, head.out, device=flat[0][0].device)
    for start in range(0, B * S, frames):
        part = slice(start, start + frames)
        result[part] = head([(within[part], among[part]) for within, among in flat], size).permute(0, 2, 3, 1)
    result = result.unflatten(0, (B, S))
    return result[..., :-1], 1 + result[..., -1].exp()


def add_position(x: Tensor, aspect: float, factor: float = 0.1) -> Tensor:
    """Add sines and cosines of each pixel's x (in the first C / 2 channels) and y to maps (N, C, h, w), in place.

    x and y are coordinates on an image plane whose half diagonal is 1, for width / height = `aspect`.
    """
    _, C, height, width = x.shape
    diagonal = (1 + aspect**2) ** 0.5
    # In float64 on the CPU: Apple's GPUs have none.
    frequencies = 1.0 / 100.0 ** (torch.arange(C // 4, dtype=torch.float64) / (C / 4))
    for channels, span, count, axis in (
        (slice(0, C // 2), aspect / diagonal, width, 1),
        (slice(C // 2, C), 1 / diagonal, height, 2),
    ):
        last = span * (count - 1) / count
        angles = frequencies[:, None] * torch.linspace(-last, last, count)
        waves = (torch.cat([angles.sin(), angles.cos()]).float() * factor).to(x.device)
        x[:, channels].add_(waves.unsqueeze(axis))
    return x


def _resize(x: Tensor, size: Sequence[int]) -> Tensor:
    return F.interpolate(x, list(size), mode="bilinear", align_corners=True)
