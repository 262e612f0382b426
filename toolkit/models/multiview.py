"""What networks for several views share: loading of images, pose encodings, a head for dense predictions, and a base
class with official checkpoints.

The pose encoding of a camera has nine numbers: translation and quaternion (x, y, z, w, of any length) of
`cam_from_world`, then the vertical and horizontal field of view in radians. The principal point is the image's center.
"World" is the network's frame, in an arbitrary unit.

The head is the Dense Prediction Transformer (Ranftl et al., ICCV 2021) of VGGT, VGGT-Omega and Depth Anything 3.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from torch import Tensor, nn

from toolkit.capture.images import HEADER_ERRORS, open_lazily, read_file
from toolkit.errors import ImageError
from toolkit.geometry import Floats, Ints, quaternion_to_rotation
from toolkit.models.compute import without_cudnn
from toolkit.models.vit import PATCH
from toolkit.models.weights import load_checkpoint

FRAMES_AT_A_TIME = 8
"""Images that a dense head processes at a time on a GPU; bounds the memory."""
_EPS = 1e-5
LayerTokens = tuple[Tensor, Tensor]
"""Tokens (B, S, T, C) after a layer's attention within views, and after its attention among views, patches last."""
Source = str | Path | Image.Image | NDArray[np.uint8]
"""A path, a Pillow image, or an array (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) gray, uint8."""
Size = tuple[int, int]
"""Width and height, or (H, W) where it says so, pixels."""
Fit = tuple[Size, ArrayLike, ArrayLike]
"""Size (width, height) of an image that is resized and cropped for a network, and the scale and offset (x, y) that map
original pixels to its pixels."""


# Dense predictions


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


def add_position(x: Tensor, aspect: float) -> Tensor:
    """Add 0.1 times sines and cosines of each pixel's x (first C / 2 channels) and y (others) to maps (N, C, h, w).

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
        waves = (torch.cat([angles.sin(), angles.cos()]).float() * 0.1).to(x.device)
        x[:, channels].add_(waves.unsqueeze(axis))
    return x


def resize(x: Tensor, size: Sequence[int]) -> Tensor:
    """Resize maps to (N, C, *size) by bilinear interpolation; corner pixels keep their values."""
    return F.interpolate(x, list(size), mode="bilinear", align_corners=True)


# Views


@dataclass(frozen=True)
class Layout:
    """Places of the images of a group in the network images, which have one size."""

    mode: str
    """Mode of the loader."""
    size: Size
    """(H, W) of the network images."""
    scale: Floats
    """(S, 2) scale of x and y. The point (x, y) of image i maps to scale[i] * (x, y) + offset[i]; the center of the
    top-left pixel is (0.5, 0.5) in both."""
    offset: Floats
    """(S, 2) in pixels of the network images."""


@dataclass(frozen=True)
class Views(Layout):
    """Images for the network, and how original pixels map to network pixels."""

    images: Tensor
    """(S, 3, H, W) float32, RGB in [0, 1]."""
    sizes: Ints
    """(S, 2): width and height of the original images."""


@dataclass(frozen=True)
class Loader:
    """Loads images as the official loader of a network does, and tells where it places them."""

    modes: tuple[str, ...]
    fit: Callable[[Size, str], Fit]
    """Returns how an image of this (width, height) is resized and cropped in a mode; a side of 0: too elongated."""
    show: Callable[[Image.Image, str], Image.Image]
    """Resizes and crops an RGB image accordingly."""
    least: Callable[[str], Size] = lambda mode: (0, 0)
    """Returns the smallest (width, height) of the network images in a mode."""
    crops: bool = False
    """Whether images of different sizes are cropped at their center to the smallest width and height among them. Else
    they get white borders up to the largest; an odd border is one pixel narrower at the left and top."""

    def lay_out(self, sizes: Sequence[Size], mode: str) -> Layout:
        """Return the layout of images of these sizes (width, height), at least one."""
        fitted, scales, offsets = (
            np.array(values) for values in zip(*(self.fit(size, mode) for size in sizes), strict=True)
        )
        if self.crops:
            width, height = fitted.min(axis=0).tolist()
            borders = -((fitted - [width, height]) // 2)
        else:
            width, height = np.maximum(fitted.max(axis=0), self.least(mode)).tolist()
            borders = ([width, height] - fitted) // 2
        return Layout(mode, (height, width), scales, offsets + borders)

    def load(self, sources: Sequence[Source], mode: str | None = None) -> Views:
        """Load images; None: in the first mode. Blends RGBA with white. Does not apply the EXIF orientation.

        Raise ImageError for a file that cannot be decoded or an elongated image; ValueError for no images or another
        mode.
        """
        mode = self.modes[0] if mode is None else mode
        if mode not in self.modes:
            raise ValueError(f"mode is {mode!r}; expected one of {list(self.modes)}.")
        if not len(sources):
            raise ValueError("found no images; expected at least one.")
        shown, sizes = [], []
        for position, source in enumerate(sources):
            image = _open_image(source)
            if not min(self.fit(image.size, mode)[0]):
                where = source if isinstance(source, str | Path) else f"no. {position}"
                fault = f"Image of {image.width} x {image.height} pixels is too elongated for the network: {where}"
                raise ImageError(f"{fault}. Its shorter side would be less than {PATCH / 2:g} pixels. Crop it.")
            shown.append(self.show(image, mode))
            sizes.append(image.size)
        layout = self.lay_out(sizes, mode)
        height, width = layout.size
        images = torch.ones(len(shown), 3, height, width)
        for canvas, image in zip(images, shown, strict=True):
            canvas[:] = centered(torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255, layout.size)
        return Views(**vars(layout), images=images, sizes=np.array(sizes, np.int64))


def centered(image: Tensor, size: Size) -> Tensor:
    """Return an image (3, h, w) with a white border, or cropped, to this (H, W)."""
    down, right = (all_ - own for all_, own in zip(size, image.shape[1:], strict=True))
    top, left = int(down / 2), int(right / 2)  # negative where the image is cropped
    return F.pad(image, (left, right - left, top, down - top), value=1.0)


def _open_image(source: Source) -> Image.Image:
    """Return an RGB image; blends RGBA with white."""
    if isinstance(source, Image.Image):
        image = source
    elif isinstance(source, np.ndarray):
        image = Image.fromarray(source)
    else:
        try:
            image = open_lazily(BytesIO(read_file(source)))
            image.load()
        except HEADER_ERRORS as error:
            raise ImageError(f"Image cannot be decoded: {source} ({error}); expected a whole image file.") from None
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, (255, 255, 255, 255)), image)
    return image.convert("RGB")


def cameras_from_pose_encoding(pose_enc: ArrayLike, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return `cam_from_world` (..., 3, 4) and intrinsics K (..., 3, 3), pixels, of pose encodings (..., 9), an array or
    a tensor on the CPU, of images of a size (H, W).

    A field of view of 0 gives an infinite focal length; the network returns 0 for negative fields of view. Raise
    ValueError for not 9 numbers, or a quaternion that is zero or not finite.
    """
    encoding = np.asarray(pose_enc, np.float64)
    if encoding.shape[-1:] != (9,):
        raise ValueError(f"pose encodings have shape {encoding.shape}; expected (..., 9).")
    rotation = quaternion_to_rotation(encoding[..., [6, 3, 4, 5]])
    height, width = size
    intrinsics = np.zeros((*encoding.shape[:-1], 3, 3))
    with np.errstate(divide="ignore"):
        intrinsics[..., 0, 0] = width / 2 / np.tan(encoding[..., 8] / 2)
        intrinsics[..., 1, 1] = height / 2 / np.tan(encoding[..., 7] / 2)
    intrinsics[..., 0, 2], intrinsics[..., 1, 2], intrinsics[..., 2, 2] = width / 2, height / 2, 1.0
    return np.concatenate([rotation, encoding[..., :3, None]], axis=-1), intrinsics


class MultiView(nn.Module):
    """A network for several views of a scene, with a patch encoder that processes each view separately.

    It may have only some of the official heads. A complete official checkpoint still loads strictly, because the keys
    of the other heads are ignored.
    """

    title: ClassVar[str]
    """Name of the network, for messages."""
    patch: ClassVar[int]
    """Side of a patch, pixels."""
    known_heads: ClassVar[tuple[str, ...]]
    """The official heads that are implemented."""
    prefixes: ClassVar[Mapping[str, str]]
    """Key prefix of each official head, implemented or not."""
    unused: ClassVar[tuple[str, ...]] = ()
    """Key prefixes of official modules that are not implemented."""
    class_tokens: ClassVar[int] = 0
    """Number of tokens that `encode` returns before the patches of an image."""
    aggregator: Any
    """The trunk: `patch_embed` encodes patches."""

    def __init__(self, heads: Sequence[str], channels: int, dense_layers: Sequence[int]) -> None:
        """The heads are those to create, of `known_heads`, else raise ValueError; `channels` are those of a token,
        `dense_layers` the four layers that dense heads read.
        """
        super().__init__()
        self.heads, self.channels, self.dense_layers = _ordered_heads(heads, self.known_heads), channels, dense_layers

    @classmethod
    def from_checkpoint(
        cls,
        checkpoint: str | Path | Mapping[str, Tensor],
        heads: Sequence[str] | None = None,
        compute_dtype: torch.dtype = torch.float32,
    ) -> Self:
        """Return the network with official weights, on the CPU, in evaluation mode.

        Args:
            checkpoint: the official file, `.pt` or `.safetensors`, or its tensors by name (shared, not copied, if
                their data type stays).
            heads: the heads to create; None: all.
            compute_dtype: of the trunk's matrix products and attention, float32 or bfloat16, which halves the memory of
                the weights. Sums, norms and heads are float32.

        Raises:
            WeightsError: no checkpoint, or one of another model; names missing, unexpected, mis-shaped keys.
            ValueError: unknown head.
        """
        network: Any = cls  # takes other arguments than this base
        with torch.device("meta"):
            model: Self = network(cls.known_heads if heads is None else heads, compute_dtype, **cls._sizes(checkpoint))
        other_heads = (prefix for head, prefix in cls.prefixes.items() if head not in model.heads)
        load_checkpoint(model, checkpoint, cls.title, ignore=(*cls.unused, *other_heads))
        return model

    @classmethod
    def _sizes(cls, checkpoint: str | Path | Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the constructor arguments in which the official checkpoints differ."""
        return {}

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Return the tokens (N, P, C) float32 of images (N, 3, H, W), P = H / patch * W / patch + `class_tokens`.

        The tokens of an image do not depend on other images: compute those of map images once and pass them to
        `forward`.

        Raises:
            ValueError: wrong shape.
        """
        self._check_images(images, "(N, 3, H, W)")
        return self._encoded(images.float())

    def _encoded(self, images: Tensor) -> Tensor:
        tokens: Tensor = self.aggregator.patch_embed(images)
        return tokens

    @torch.no_grad()
    def forward(
        self,
        images: Tensor,
        heads: Sequence[str] | None = None,
        patch_tokens: Tensor | None = None,
        **options: Any,
    ) -> dict[str, Any]:
        """Return the predictions of the heads under the official names, float32; the class lists them.

        B = 1 for images with four axes. Cameras, depth and points share one scale, which is not metric.

        Args:
            images: (B, S, 3, H, W) or (S, 3, H, W), RGB in [0, 1], sides multiples of the patch: S views of each of B
                scenes. `load_images` makes such images.
            heads: the heads to compute, of those that this network has; None: all.
            patch_tokens: (B, S, P, C), or (S, P, C) like the images, from `encode`, if already computed. Then only
                the shape of `images` is read: `torch.empty(shape, device="meta")` will do.
            options: further options of the network.

        Raises:
            ValueError: wrong shape, a head that this network does not have, or a wrong option.
        """
        if images.ndim == 4:
            images = images[None]
            patch_tokens = patch_tokens if patch_tokens is None else patch_tokens[None]
        self._check_images(images, "(B, S, 3, H, W)")
        B, S, _, H, W = images.shape
        heads = self.heads if heads is None else _ordered_heads(heads, self.heads)
        if patch_tokens is None:
            patch_tokens = self.encode(images.flatten(0, 1)).unflatten(0, (B, S))
        expected = (B, S, self.class_tokens + H // self.patch * (W // self.patch), self.channels)
        if patch_tokens.shape != expected:
            found = f"patch_tokens of shape {tuple(patch_tokens.shape)}, images of shape {tuple(images.shape)}"
            raise ValueError(f"{found}: expected tokens of {expected}.")
        return self._predictions(patch_tokens, heads, (H, W), **options)

    def _predictions(self, tokens: Tensor, heads: tuple[str, ...], size: tuple[int, int]) -> dict[str, Any]:
        """Return the output of `forward` for tokens (B, S, P, C) of images of this (H, W)."""
        raise NotImplementedError

    def _check_images(self, images: Tensor, axes: str) -> None:
        channels, height, width = images.shape[-3:] if images.ndim == len(axes.split(",")) else (0, 0, 0)
        if channels != 3 or height % self.patch or width % self.patch or not images.numel():
            expected = f"{axes}, at least one image, height and width multiples of {self.patch}, as by `load_images`"
            raise ValueError(f"images have shape {tuple(images.shape)}; expected {expected}.")


def _ordered_heads(heads: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return heads without repetition, in the order of `known`; raise ValueError if there are none, or unknown ones."""
    if isinstance(heads, str) or not heads or not set(heads) <= set(known):
        raise ValueError(f"heads are {heads!r}; expected some of {list(known)}, in a list.")
    return tuple(head for head in known if head in heads)


def with_special_tokens(patch_tokens: Tensor, *learned: Tensor) -> Tensor:
    """Return tokens (B, S, R + P, C): patch tokens (B, S, P, C) after the learned tokens of their view.

    `learned` are parameters (1, 2, r, C), R in all: those for the first view, whose frame is the world, and for others.
    """
    B, S = patch_tokens.shape[:2]
    special = torch.cat(learned, dim=2)
    special = torch.cat([special[:, :1], special[:, 1:].expand(-1, S - 1, -1, -1)], dim=1)
    return torch.cat([special.expand(B, -1, -1, -1), patch_tokens.to(special.dtype)], dim=2)
