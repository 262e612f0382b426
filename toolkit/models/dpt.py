"""Dense Prediction Transformer (Ranftl et al., ICCV 2021), as in VGGT, VGGT-Omega and Depth Anything 3."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toolkit.models.compute import without_cudnn
from toolkit.models.vit import PATCH

FRAMES_AT_A_TIME = 8
"""Images that a dense head processes at a time on a GPU; bounds the memory."""
_EPS = 1e-5

LayerTokens = tuple[Tensor, Tensor]
"""Tokens (B, S, T, C) after a layer's attention within views, and after its attention among views, patches last."""


class ResidualUnit(nn.Module):
    """Two 3 x 3 convolutions with a residual connection."""

    def __init__(self, channels: int, overwrites: bool) -> None:
        """`overwrites`: add the rectified input, not the input, because the official code's ReLU works in place."""
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.overwrites = overwrites

    def forward(self, x: Tensor) -> Tensor:
        rectified = F.relu(x)
        return self.conv2(F.relu(self.conv1(rectified))).add_(rectified if self.overwrites else x)


class Fusion(nn.Module):
    """Adds a finer map to a coarser one and enlarges the sum."""

    def __init__(self, channels: int, has_residual: bool, overwrites: bool) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        if has_residual:
            self.resConfUnit1 = ResidualUnit(channels, overwrites)
        self.resConfUnit2 = ResidualUnit(channels, overwrites)

    def forward(self, coarse: Tensor | None, fine: Tensor, size: Sequence[int]) -> Tensor:
        """Return the fused map (N, C, *size) of maps (N, C, h, w)."""
        coarse = fine if coarse is None else self.resConfUnit1(fine).add_(coarse)
        # A 1 x 1 convolution commutes with an interpolation, and is cheaper on the small map.
        return resize(self.out_conv(self.resConfUnit2(coarse)), size)


class Scratch(nn.Module):
    """Fuses the maps of the four layers; named as in the checkpoint."""

    def __init__(self, channels: Sequence[int], features: int, overwrites: bool) -> None:
        """For `overwrites`, see `ResidualUnit`."""
        super().__init__()
        for level, channel in enumerate(channels, start=1):
            self.add_module(f"layer{level}_rn", nn.Conv2d(channel, features, 3, padding=1, bias=False))
            self.add_module(f"refinenet{level}", Fusion(features, level < len(channels), overwrites))

    def forward(self, maps: Sequence[Tensor], size: Sequence[int]) -> Tensor:
        """Return the fused map (N, features, *size) of maps (N, channels[level], h, w), given from fine to coarse."""
        sizes = [size, *(x.shape[2:] for x in maps[:-1])]
        x = None
        for level in range(len(maps), 0, -1):
            fine = self.get_submodule(f"layer{level}_rn")(maps[level - 1])
            x = self.get_submodule(f"refinenet{level}")(x, fine, sizes[level - 1])
        assert x is not None
        return x


class DenseHead(nn.Module):
    """Turns the tokens of four layers into maps. Subclasses implement `decode`, which fuses the maps."""

    def __init__(
        self, dim: int, out: int, channels: Sequence[int], features: int, patch: int, overwrites: bool
    ) -> None:
        """`dim` is that of the concatenated tokens of both blocks of a layer, `out` the channels of the result,
        including the confidence, `channels` those of the maps of the four layers, `features` those of the fused map;
        for `overwrites` see `ResidualUnit`.
        """
        super().__init__()
        self.patch = patch
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
        self.scratch: Any = Scratch(channels, features, overwrites)

    def forward(self, layers: Sequence[LayerTokens], size: tuple[int, int]) -> Tensor:
        """Return (N, out, H, W) before activation, size = (H, W), for tokens (N, T, C) of the four layers."""
        rows, columns = size[0] // self.patch, size[1] // self.patch
        maps = []
        for layer, project, resize_layer in zip(layers, self.projects, self.resize_layers, strict=True):
            patches = torch.cat([tokens[:, -rows * columns :] for tokens in layer], dim=-1)
            x = project(self.norm(patches.float()).transpose(1, 2).unflatten(2, (rows, columns)))
            maps.append(resize_layer(add_position(x, size[1] / size[0])))
        return self.decode(maps, size)

    def decode(self, maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        """Return (N, out, H, W) for maps (N, channels[level], h, w) of 4, 2, 1 and 1/2 times the grid of patches."""
        raise NotImplementedError


class ConvolutionalHead(DenseHead):
    """Enlarges the fused map to the image by convolutions."""

    def __init__(self, dim: int, out: int, channels: Sequence[int], features: int, overwrites: bool = True) -> None:
        super().__init__(dim, out, channels, features, PATCH, overwrites)
        self.scratch.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.scratch.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, 32, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(32, out, 1)
        )

    def decode(self, maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        x = self.scratch(maps, [2 * side for side in maps[0].shape[2:]])
        x = resize(self.scratch.output_conv1(x), size)
        output: Tensor = self.scratch.output_conv2(add_position(x, size[1] / size[0]))
        return output


def dense_output(
    head: DenseHead, layers: Mapping[int, LayerTokens], read: Sequence[int], size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Run a dense head on all views, a few at a time, from the tokens (B, S, T, C) of the four layers that it reads.

    Return the values (B, S, H, W, out - 1) before activation, and the confidence (B, S, H, W), above 1; `size` is (H,
    W).
    """
    B, S = layers[read[0]][0].shape[:2]
    flat = [(layers[layer][0].flatten(0, 1), layers[layer][1].flatten(0, 1)) for layer in read]
    device = flat[0][0].device
    result = torch.empty(B * S, *size, head.out, device=device)
    # The maps of a view take many times the memory of its tokens; on a CPU, one view keeps all cores busy.
    views = 1 if device.type == "cpu" else FRAMES_AT_A_TIME
    with without_cudnn():
        for start in range(0, B * S, views):
            part = slice(start, start + views)
            result[part] = head([(within[part], among[part]) for within, among in flat], size).permute(0, 2, 3, 1)
    result = result.unflatten(0, (B, S))
    return result[..., :-1], 1 + result[..., -1].exp()


def add_position(x: Tensor, aspect: float, factor: float = 0.1) -> Tensor:
    """Add sines and cosines of each pixel's x (first C / 2 channels) and y (other channels) to maps (N, C, h, w).

    Works in place. x and y are coordinates on an image plane with half diagonal 1 and width / height = `aspect`.
    """
    _, C, height, width = x.shape
    diagonal = (1 + aspect**2) ** 0.5
    # On the CPU, because Apple's GPUs have no float64.
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


def resize(x: Tensor, size: Sequence[int]) -> Tensor:
    """Resize maps to (N, C, *size) by bilinear interpolation; corner pixels keep their values."""
    return F.interpolate(x, list(size), mode="bilinear", align_corners=True)
