"""Depth Anything 3 (Lin et al., 2025), Base and Small: cameras and depth of the views of a scene, in one forward pass.

The official network is at github.com/ByteDance-Seed/Depth-Anything-3. Its code and the weights of these two sizes are
under the Apache License 2.0.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import ArrayLike
from PIL import Image
from torch import Tensor, nn

from toolkit.geometry import Floats, invert, make_pose
from toolkit.models import multiview
from toolkit.models.multiview import ConvolutionalHead, Fit, LayerTokens, Loader, MultiView, Size, dense_output
from toolkit.models.vit import PATCH, Dinov2, normalized, places_of_view, rope_of_places, set_matrix_type
from toolkit.models.weights import read_state_dict

__all__ = ["HEADS", "DepthAnything3", "cameras_from_pose_encoding", "load_images"]

HEADS = ("camera", "depth")
SIDE = 504
REFERENCES = ("saddle_balanced", "first")
"""Ways to choose the reference view, whose frame is the world."""
_MIN_CHOICE = 3  # with fewer views, the first is the reference
_NORM_EPS = 1e-5  # epsilon of the last norm, and of those on queries and keys
_MIN_TANGENT = 1e-6  # of half the field of view, as in the authors' code
_HEAD_DIM = 64
_SIZES = (768, 384)
"""Channels of Base and Small."""


def resized_sizes(width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the width and height after each of the two steps in which `load_images` resizes an image."""
    scale = SIDE / max(width, height)
    first = (max(1, round(width * scale)), max(1, round(height * scale)))
    # The nearest multiple of the patch; half way, the larger.
    columns, rows = ((side + PATCH // 2) // PATCH for side in first)
    return first, (PATCH * columns, PATCH * rows)


def _show(image: Image.Image, mode: str) -> Image.Image:
    import cv2

    pixels = np.asarray(image)
    for size in resized_sizes(*image.size):
        if pixels.shape[1::-1] != size:
            grows = size[0] > pixels.shape[1] or size[1] > pixels.shape[0]
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA)
    return Image.fromarray(pixels)


def _fit(size: Size, mode: str) -> Fit:
    resized = resized_sizes(*size)[1]
    return resized, np.divide(resized, size), (0.0, 0.0)


LOADER = Loader(("upper_bound_resize",), _fit, _show, crops=True)
load_images = LOADER.load
"""Loads images as the official loader does; see `multiview.Loader.load`.

Resizes the longer side to 504 pixels, then both sides to the nearest multiples of 14 (by OpenCV, with area
interpolation if the image shrinks, else bicubic). Crops images of different sizes at their center to the smallest
width and height among them. Transparent pixels become white; the official loader keeps their hidden color."""


def cameras_from_pose_encoding(pose_enc: ArrayLike, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return `cam_from_world` (..., 3, 4) and K (..., 3, 3) of pose encodings, see `multiview`'s function of this name.

    The encodings of this network hold the inverse pose, `world_from_cam`. As in the official code, the tangent of half
    a field of view is at least 1e-6, so that focal lengths are finite.
    """
    encoding = np.asarray(pose_enc, np.float64).copy()
    half = encoding[..., 7:] / 2
    encoding[..., 7:] = np.where(np.tan(half) < _MIN_TANGENT, 2 * _MIN_TANGENT, 2 * half)
    world_from_cam, intrinsics = multiview.cameras_from_pose_encoding(encoding, size)
    return invert(make_pose(world_from_cam[..., :3], world_from_cam[..., 3]))[..., :3, :], intrinsics


class Backbone(Dinov2):
    """A DINOv2 whose later blocks alternate attention within each view and among all views.

    A camera token replaces each view's class token before the first of the later blocks.
    """

    def __init__(self, dim: int, depth: int, num_heads: int, grid: int, alternate_from: int) -> None:
        """`alternate_from` is the first of the later blocks, of which those with odd numbers attend among views; see
        `Dinov2`.
        """
        super().__init__(dim, depth, num_heads, grid, _NORM_EPS, (alternate_from, _NORM_EPS))
        self.alternate_from = alternate_from
        self.head_dim = dim // num_heads
        # One token for the reference view, whose frame is the world, and one for all other views.
        self.camera_token = nn.Parameter(torch.empty(1, 2, dim))

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
        """Return the tokens after the given blocks, `layers`, which attend among views.

        Args:
            tokens, cameras: (B, S, 1 + rows * columns, C) from `encode`, and (B, S, C) camera tokens.
            cameras_only: compute and return only the camera tokens of the last of the blocks.

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
    """
    if way not in REFERENCES:
        raise ValueError(f"reference is {way!r}; expected one of {list(REFERENCES)}.")
    S = class_tokens.shape[1]
    if way == "first" or S < _MIN_CHOICE:
        return torch.zeros(len(class_tokens), dtype=torch.long, device=class_tokens.device)
    lengths = class_tokens.norm(dim=-1)
    units = class_tokens / lengths[..., None]
    similarity = ((units @ units.transpose(1, 2)).sum(dim=-1) - 1) / (S - 1)
    measures = torch.stack([similarity, lengths, units.var(dim=-1)])  # (3, B, S)
    least, most = measures.amin(dim=-1, keepdim=True), measures.amax(dim=-1, keepdim=True)
    scaled = (measures - least) / (most - least + 1e-8)
    return (scaled - 0.5).abs().sum(dim=0).argmin(dim=-1)


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


class DepthAnything3(MultiView):
    """The network: predicts cameras and depth of images. The defaults are the official sizes of Base.

    It omits the official branch for rays, head for Gaussians and encoder of known cameras. `from_checkpoint` tells Base
    from Small by the shapes of the tensors. `forward` has the option `reference`, how to choose the view whose frame is
    the world, see `choose_reference`. It returns

    - for "camera": `pose_enc` (B, S, 9), see `cameras_from_pose_encoding`, and the cameras computed from it:
      `extrinsics` (B, S, 3, 4), cam_from_world, and `intrinsics` (B, S, 3, 3), pixels; NaN for an invalid encoding;
    - for "depth": `depth` (B, S, H, W), along the camera's z, and `depth_conf` (B, S, H, W), at least 1.
    """

    title = "Depth Anything 3"
    patch = PATCH
    known_heads = HEADS
    prefixes: ClassVar = {"camera": "cam_dec.", "depth": "head."}
    unused = (
        "cam_enc.",
        "gs_head.",
        "gs_adapter.",
        *(f"head.scratch.refinenet{level}_aux." for level in range(1, 5)),
        *(f"head.scratch.output_conv{number}_aux." for number in (1, 2)),
    )
    class_tokens = 1

    def __init__(
        self,
        heads: Sequence[str] = HEADS,
        compute_dtype: torch.dtype = torch.float32,
        dim: int = 768,
        depth: int = 12,
        num_heads: int = 12,
        grid: int = 37,
        alternate_from: int = 4,
        dense_layers: Sequence[int] = (5, 7, 9, 11),
        dense_channels: Sequence[int] = (96, 192, 384, 768),
        dense_features: int = 128,
    ) -> None:
        """
        Args:
            heads, compute_dtype: see `MultiView.from_checkpoint`.
            dim, depth, num_heads, grid, alternate_from: sizes of the trunk, see `Backbone`.
            dense_layers: the four blocks that the depth head reads.
            dense_channels, dense_features: channels of the depth head.
        """
        super().__init__(heads, dim, dense_layers)
        self.backbone = nn.ModuleDict({"pretrained": Backbone(dim, depth, num_heads, grid, alternate_from)})
        set_matrix_type(self.backbone, compute_dtype)
        if "camera" in self.heads:
            self.cam_dec = CameraHead(2 * dim)
        if "depth" in self.heads:
            self.head = ConvolutionalHead(2 * dim, 2, dense_channels, dense_features, overwrites=False)

    @classmethod
    def _sizes(cls, checkpoint: str | Path | Mapping[str, Tensor]) -> dict[str, Any]:
        token = read_state_dict(checkpoint).get("backbone.pretrained.camera_token")
        dim = 0 if token is None else token.shape[-1]
        if dim not in _SIZES:
            return {}  # another network: loading will raise the error
        channels = (dim // 8, dim // 4, dim // 2, dim)
        return {"dim": dim, "num_heads": dim // _HEAD_DIM, "dense_channels": channels, "dense_features": dim // 6}

    @property
    def trunk(self) -> Backbone:
        return cast(Backbone, self.backbone["pretrained"])

    def _encoded(self, images: Tensor) -> Tensor:
        return self.trunk.encode(images)

    def _predictions(
        self, tokens: Tensor, heads: tuple[str, ...], size: tuple[int, int], reference: str = "saddle_balanced"
    ) -> dict[str, Any]:
        chosen = choose_reference(tokens[:, :, 0].float(), reference)
        # The official code also moves the reference view to the front, which changes rounding only.
        is_reference = torch.arange(tokens.shape[1], device=tokens.device) == chosen[:, None]
        cameras = torch.where(is_reference[..., None], *self.trunk.camera_token[0])
        last = len(self.trunk.blocks) - 1
        read = {last, *(self.dense_layers if "depth" in heads else ())}
        rows, columns = size[0] // PATCH, size[1] // PATCH
        layers, camera = self.trunk(tokens, cameras, rows, columns, read, cameras_only="depth" not in heads)
        output = {}
        if "camera" in heads:
            output["pose_enc"] = self.cam_dec(camera.float())
            output["extrinsics"], output["intrinsics"] = _cameras(output["pose_enc"], size)
        if "depth" in heads:
            values, confidence = dense_output(self.head, layers, self.dense_layers, size)
            output["depth"], output["depth_conf"] = values[..., 0].exp(), confidence
        return output


def _cameras(pose_enc: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return `cam_from_world` (B, S, 3, 4) and K (B, S, 3, 3) of pose encodings, with their type and device; NaN if an
    encoding is not finite or its quaternion is zero.
    """
    encoding = np.asarray(pose_enc.cpu(), np.float64)
    invalid = ~(np.isfinite(encoding).all(axis=-1) & encoding[..., 3:7].any(axis=-1))
    encoding[invalid] = 1.0
    cameras = cameras_from_pose_encoding(encoding, size)
    for array in cameras:
        array[invalid] = np.nan
    extrinsics, intrinsics = (torch.from_numpy(array).to(pose_enc.dtype).to(pose_enc.device) for array in cameras)
    return extrinsics, intrinsics
