"""ALIKED (Zhao et al., 2023): keypoints and descriptors by deformable convolutions; official weights and results.

The authors' code computes a feature map of 128 channels at full image size. This code avoids it. The scores are linear
in the map up to the first activation, so each level passes the head's first convolution before it is enlarged.
Descriptors need the map near keypoints only, where it is computed pixel by pixel. Batch normalization is folded into
the convolutions, and all maps have their channels last.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_weights

from toolkit.models.compute import linear
from toolkit.models.weights import load_checkpoint

MODELS = {
    "aliked-t16": ((8, 16, 32, 64), 16),
    "aliked-n16": ((16, 32, 64, 128), 16),
    "aliked-n16rot": ((16, 32, 64, 128), 16),
    "aliked-n32": ((16, 32, 64, 128), 32),
}
"""The variants of the network: channels of the encoder's four levels, of which the last is also the length of a
descriptor, and the number of positions around a keypoint at which its descriptor samples features."""
_COARSEST = 32  # side of a pixel of the coarsest level, image pixels
_PATCH = 3  # side of the patch around a keypoint from which the sample positions are computed, pixels
_TEMPERATURE = 0.1  # of the soft maximum that gives keypoints subpixel positions
_CPU_ROWS = 8192  # pixels at a time: their activations fit a CPU's cache


class Aliked(nn.Module):
    """Detects and describes keypoints in batches of images of one size.

    Modules have the names of the official checkpoint.
    """

    def __init__(self, model: str = "aliked-n16") -> None:
        super().__init__()
        channels, samples = MODELS[model]
        c1, c2, c3, c4 = channels
        self.block1 = _Block(3, c1, deformable=False, residual=False)
        self.block2 = _Block(c1, c2, deformable=False)
        self.block3 = _Block(c2, c3, deformable=True)
        self.block4 = _Block(c3, c4, deformable=True)
        self.conv1, self.conv2, self.conv3, self.conv4 = (nn.Conv2d(c, c4 // 4, 1, bias=False) for c in channels)
        self.score_head = nn.Sequential(
            nn.Conv2d(c4, 8, 1, bias=False), nn.SELU(inplace=True),
            nn.Conv2d(8, 4, 3, padding=1, bias=False), nn.SELU(inplace=True),
            nn.Conv2d(4, 4, 3, padding=1, bias=False), nn.SELU(inplace=True),
            nn.Conv2d(4, 1, 3, padding=1, bias=False),
        )  # fmt: skip
        self.desc_head = _DescriptorHead(c4, samples)
        self.descriptor_length = c4

    @classmethod
    def from_checkpoint(cls, checkpoint: str | Path | Mapping[str, Tensor], model: str = "aliked-n16") -> "Aliked":
        """Create the network from an official file, or tensors under the official names, else raise WeightsError."""
        with torch.device("meta"):
            network = cls(model)
        load_checkpoint(network, checkpoint, model.replace("aliked", "ALIKED"))
        for block in (network.block1, network.block2, network.block3, network.block4):
            block.fold_norms()
        for parameter in network.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        return network

    def encode(self, images: Tensor) -> "Levels":
        """Compute the feature levels of images (B, 3, H, W), RGB in 0..1. Can run under autocast."""
        height, width = images.shape[2:]
        # As the authors, pad both sides to a multiple of the coarsest level's pixel.
        down, across = -height % _COARSEST, -width % _COARSEST
        left, top = across // 2, down // 2
        padded = F.pad(images, (left, across - left, top, down - top), mode="replicate")
        x1 = self.block1(padded.contiguous(memory_format=torch.channels_last))
        x2 = self.block2(F.avg_pool2d(x1, 2))
        x3 = self.block3(F.avg_pool2d(x2, 4))
        x4 = self.block4(F.avg_pool2d(x3, 4))
        coarse = [F.selu_(conv(x)).float() for conv, x in ((self.conv2, x2), (self.conv3, x3), (self.conv4, x4))]
        return Levels(x1.float(), coarse, (left, top), (width, height))

    def scores(self, levels: "Levels") -> Tensor:
        """Return the score of each pixel, (B, H, W) in 0..1, float32."""
        first: Any
        first, *rest = self.score_head
        heads = first.weight.chunk(4, dim=1)  # one per level
        fine = levels.fine
        batch, _, height, width = fine.shape
        pixels = fine.permute(0, 2, 3, 1).flatten(0, 2)
        parts = pixels.split(_CPU_ROWS if fine.device.type == "cpu" else len(pixels))
        weight, fine_head = self.conv1.weight[:, :, 0, 0], heads[0][:, :, 0, 0].contiguous()
        summed = torch.cat([linear(F.selu_(linear(part, weight)), fine_head) for part in parts])
        summed = summed.view(batch, height, width, -1).permute(0, 3, 1, 2)
        for level, head in zip(levels.coarse, heads[1:], strict=True):
            small = F.conv2d(level, head)
            summed += F.interpolate(small, size=(height, width), mode="bilinear", align_corners=True)
        for layer in rest:
            summed = layer(summed)
        (left, top), (width, height) = levels.corner, levels.size
        return summed[:, 0, top : top + height, left : left + width].sigmoid()

    def describe(self, levels: "Levels", image: int, keypoints: Tensor) -> Tensor:
        """Return unit descriptors (K, D) of keypoints (K, 2) of one image of the batch, float32.

        The center of the image's top-left pixel is at (0, 0).
        """
        if not len(keypoints):
            return keypoints.new_zeros(0, self.descriptor_length)
        head, (width, height) = self.desc_head, levels.size
        size = torch.tensor([width, height], device=keypoints.device)
        # As in the authors' code, patches stay one pixel further from the right and lower border than necessary.
        low = (keypoints.long() - _PATCH // 2).clamp(min=0).minimum(size - 1 - _PATCH)
        patch = low[:, None] + _grid(0, _PATCH, low)
        features, lengths = self._features(levels, image, patch.flatten(0, 1))
        patches = (torch.cat(features, dim=1) / lengths[:, None]).view(len(keypoints), -1)
        offsets = head.offsets(patches).clamp(-max(levels.size) / 4, max(levels.size) / 4)
        positions = keypoints[:, None] + offsets.view(len(keypoints), 2, -1).transpose(1, 2)
        indices, weights = _corners(positions.flatten(0, 1), (height, width))
        # Neighboring positions share pixels: compute the features of each pixel once.
        pixels, rows = indices.unique(return_inverse=True)
        features, lengths = self._features(levels, image, torch.stack([pixels % width, pixels // width], dim=1))
        weights = weights / lengths[rows]
        sampled = torch.cat([_weighted_sum(table, rows, weights) for table in features], dim=1)
        return F.normalize(head(sampled.view(*positions.shape[:2], -1)), dim=1)

    def _features(self, levels: "Levels", image: int, pixels: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return the features of one image at whole pixels (N, 2), one (N, D / 4) per level, and their length (N,), by
        which the authors' map of all levels is divided.
        """
        fine = levels.fine[image].permute(1, 2, 0)
        x, y = (pixels + torch.tensor(levels.corner, device=pixels.device)).unbind(1)
        parts = [F.selu_(linear(fine[y, x], self.conv1.weight[:, :, 0, 0]))]
        for level in levels.coarse:
            # The interpolation aligns the centers of the corner pixels of both maps.
            scale = [(small - 1) / (large - 1) for small, large in zip(level.shape[2:], fine.shape[:2], strict=True)]
            parts.append(sample(level[image, None], torch.stack([x * scale[1], y * scale[0]], dim=1)[None])[0])
        lengths = torch.stack([torch.linalg.vector_norm(part, dim=1) for part in parts]).norm(dim=0)
        return parts, lengths.clamp(min=1e-12)


@dataclass(frozen=True)
class Levels:
    """Feature maps of a batch of images, float32, from fine to coarse."""

    fine: Tensor
    """(B, C, H', W'), at the size of the padded images."""
    coarse: list[Tensor]
    """Three maps (B, D / 4, H' / n, W' / n), each with a quarter of a descriptor's channels."""
    corner: tuple[int, int]
    """(x, y) of the images' top-left pixel in the padded images."""
    size: tuple[int, int]
    """(width, height) of the images without padding, pixels."""


def find_keypoints(scores: Tensor, most: int, threshold: float = 0.0, radius: int = 2) -> tuple[Tensor, Tensor]:
    """Return the positions x y (K, 2) and scores (K,) of at most `most` maxima of a score map (H, W), highest score
    first.

    Positions have subpixel precision; the center of the top-left pixel is at (0, 0). The score at a keypoint's pixel is
    above the threshold; pixels of two keypoints, and the border, are more than the radius apart.
    """
    height, width = scores.shape
    maxima = _suppress(scores, radius)
    inner = torch.zeros_like(maxima)
    inside = (slice(radius, max(height - radius, 0)), slice(radius, max(width - radius, 0)))
    inner[inside] = maxima[inside]
    best, indices = inner.flatten().topk(min(most, inner.numel()))
    indices = indices[best > threshold]
    pixels = torch.stack([indices % width, indices // width], dim=1)
    grid = _grid(-radius, radius + 1, pixels)
    x, y = (pixels[:, None] + grid).unbind(2)
    patch = scores[y, x]
    share = ((patch - patch.amax(dim=1, keepdim=True)) / _TEMPERATURE).softmax(dim=1)
    keypoints = pixels + share @ grid.to(share)
    values = sample(scores[None, None], keypoints[None])[0, :, 0]
    values, order = values.sort(descending=True, stable=True)
    return keypoints[order], values


def _suppress(scores: Tensor, radius: int) -> Tensor:
    """Return the scores (H, W) with all but the maxima set to zero: of the pixels that are the maximum of their window,
    then twice of those outside of all such windows.
    """
    maxima = scores == _window_max(scores, radius)
    for _ in range(2):
        hidden = _window_max(maxima.to(torch.uint8), radius) > 0
        rest = scores.masked_fill(hidden, 0)
        maxima = maxima | ((rest == _window_max(rest, radius)) & ~hidden)
    return scores.masked_fill(~maxima, 0)


def _window_max(image: Tensor, radius: int) -> Tensor:
    """Return the largest value within `radius` along x and y, at least 0. On CPUs 20 times as fast as `max_pool2d`."""
    for dim in (1, 0):
        length = image.shape[dim]
        wide = F.pad(image, (radius, radius, 0, 0) if dim else (0, 0, radius, radius))
        image = wide.narrow(dim, 0, length)
        for shift in range(1, 2 * radius + 1):
            image = torch.maximum(image, wide.narrow(dim, shift, length))
    return image


def sample(image: Tensor, positions: Tensor) -> Tensor:
    """Interpolate a map (B, C, H, W) bilinearly at positions (B, N, 2), x y; return (B, N, C) float32.

    The center of the top-left pixel is at (0, 0); the map is zero outside. With channels last, this is faster than
    `grid_sample`.
    """
    batch, channels, height, width = image.shape
    indices, weights = _corners(positions, (height, width))
    indices = indices + torch.arange(batch, device=image.device).view(-1, 1, 1) * (height * width)
    table = image.float().permute(0, 2, 3, 1).reshape(-1, channels)
    return _weighted_sum(table, indices.flatten(0, 1), weights.flatten(0, 1)).view(*positions.shape[:2], channels)


def _weighted_sum(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return weighted sums (M, C) of rows of a table (N, C), by row indices and weights (M, 4)."""
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def _corners(positions: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return flat indices and weights, both (..., 4), of the four pixels of a map (H, W) around x, y (..., 2)."""
    axes = []
    for position, length in ((positions[..., 1], shape[0]), (positions[..., 0], shape[1])):
        low = position.floor()
        fraction = position - low
        index = torch.stack([low, low + 1], dim=-1)
        weight = torch.stack([1 - fraction, fraction], dim=-1) * ((index >= 0) & (index < length))
        # A NaN position gets NaN weights; any valid index will do.
        axes.append((index.clamp(0, length - 1).nan_to_num(0).long(), weight))
    (rows, row_weights), (columns, column_weights) = axes
    indices = rows[..., :, None] * shape[1] + columns[..., None, :]
    return indices.flatten(-2), (row_weights[..., :, None] * column_weights[..., None, :]).flatten(-2)


def _grid(start: int, stop: int, like: Tensor) -> Tensor:
    """Return x y (N, 2) of the pixels of a square, row by row, with the type and device of `like`."""
    side = torch.arange(start, stop, dtype=like.dtype, device=like.device)
    y, x = torch.meshgrid(side, side, indexing="ij")
    return torch.stack([x, y], dim=-1).view(-1, 2)


class _DeformableConv(nn.Module):
    """A 3 x 3 convolution at positions that another convolution shifts."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(inputs, 18, 3, padding=1)
        self.regular_conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        batch, _, height, width = x.shape
        most = max(height, width) / 4
        offsets = self.offset_conv(x).float().clamp(-most, most).permute(0, 2, 3, 1).unflatten(-1, (9, 2))
        rows = torch.arange(height, device=x.device).view(-1, 1, 1)
        columns = torch.arange(width, device=x.device).view(-1, 1)
        dx, dy = _grid(-1, 2, offsets).unbind(1)
        positions = torch.stack([offsets[..., 1] + (columns + dx), offsets[..., 0] + (rows + dy)], dim=-1)
        sampled = sample(x, positions.flatten(1, 3)).view(batch, height, width, -1)
        conv = self.regular_conv
        return linear(sampled, conv.weight.permute(0, 2, 3, 1).flatten(1), conv.bias).permute(0, 3, 1, 2)


class _Block(nn.Module):
    """Two convolutions, each followed by a norm and an activation."""

    def __init__(self, inputs: int, outputs: int, deformable: bool, residual: bool = True) -> None:
        super().__init__()
        conv: Any = _DeformableConv if deformable else partial(nn.Conv2d, kernel_size=3, padding=1, bias=False)
        self.conv1, self.bn1 = conv(inputs, outputs), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = conv(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1) if residual else None

    def forward(self, x: Tensor) -> Tensor:
        inner = self.conv2(F.selu_(self.conv1(x)))
        return F.selu_(inner if self.downsample is None else inner.add_(self.downsample(x)))

    def fold_norms(self) -> None:
        """Fold the norms into the convolutions before them, for inference."""
        norm: Any
        for layer, norm in ((self.conv1, self.bn1), (self.conv2, self.bn2)):
            conv = layer.regular_conv if isinstance(layer, _DeformableConv) else layer
            conv.weight, conv.bias = fuse_conv_bn_weights(
                conv.weight, None, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
            )


class _DescriptorHead(nn.Module):
    """Computes sample positions around a keypoint, and a descriptor from the features there."""

    def __init__(self, channels: int, samples: int) -> None:
        super().__init__()
        self.offset_conv = nn.Sequential(
            nn.Conv2d(channels, 2 * samples, _PATCH), nn.SELU(inplace=True), nn.Conv2d(2 * samples, 2 * samples, 1)
        )
        self.sf_conv = nn.Conv2d(channels, channels, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.empty(samples, channels, channels))

    def offsets(self, patches: Tensor) -> Tensor:
        """Return the sample offsets (K, 2 * samples), all x before all y, for patches (K, 9 * C), row by row."""
        first: Any
        last: Any
        first, _, last = self.offset_conv
        inner = F.selu_(linear(patches, first.weight.permute(0, 2, 3, 1).flatten(1), first.bias))
        return linear(inner, last.weight.flatten(1), last.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Return descriptors (K, C), not normalized, of the sampled features (K, samples, C)."""
        inner = F.selu_(linear(features, self.sf_conv.weight.flatten(1)))
        return linear(inner.flatten(1), self.agg_weights.flatten(0, 1).T)
