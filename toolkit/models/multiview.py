"""What networks for several views share: loading of images, pose encodings, and a base class with official checkpoints.

The pose encoding of a camera has nine numbers: translation and quaternion (x, y, z, w, of any length) of
`cam_from_world`, then the vertical and horizontal field of view in radians. The principal point is the image's center.
"World" is the network's frame, in an arbitrary unit.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from torch import Tensor, nn
from torch.nn import functional as F

from toolkit.capture.images import HEADER_ERRORS, open_lazily, read_file
from toolkit.errors import ImageError
from toolkit.geometry import Floats, Ints, quaternion_to_rotation
from toolkit.models.vit import PATCH
from toolkit.models.weights import load_checkpoint

Source = str | Path | Image.Image | NDArray[np.uint8]
"""A path, a Pillow image, or an array (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) gray, uint8."""
Size = tuple[int, int]
"""Width and height, or (H, W) where it says so, pixels."""
Fit = tuple[Size, ArrayLike, ArrayLike]
"""Size (width, height) of an image that is resized and cropped for a network, and the scale and offset (x, y) that map
original pixels to its pixels."""


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
class Views:
    """Images for the network, and how original pixels map to network pixels.

    Image coordinates (x, y) are in pixels; the center of the top-left one is (0.5, 0.5).
    """

    images: Tensor
    """(S, 3, H, W) float32, RGB in [0, 1]."""
    scale: Floats
    """(S, 2) for x and y. Point (x, y) of original image i is at scale[i] * (x, y) + offset[i] in images[i]."""
    offset: Floats
    """(S, 2), network pixels."""
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

    def load(self, sources: Sequence[Source], mode: str) -> Views:
        """Load images. Blends RGBA with white. Does not apply the EXIF orientation.

        Raise ImageError for a file that cannot be decoded or an elongated image; ValueError for no images or another
        mode.
        """
        if mode not in self.modes:
            raise ValueError(f"mode is {mode!r}; expected one of {list(self.modes)}.")
        if not len(sources):
            raise ValueError("found no images; expected at least one.")
        shown, sizes = [], []
        for position, source in enumerate(sources):
            image = _open_image(source)
            if not min(self.fit(image.size, mode)[0]):
                where = source if isinstance(source, str | Path) else f"no. {position}"
                raise ImageError(
                    f"Image of {image.width} x {image.height} pixels is too elongated for the network: {where}. Its "
                    f"shorter side would be less than half a patch of {PATCH} pixels; crop it."
                )
            shown.append(self.show(image, mode))
            sizes.append(image.size)
        layout = self.lay_out(sizes, mode)
        height, width = layout.size
        images = torch.ones(len(shown), 3, height, width)
        for canvas, image in zip(images, shown, strict=True):
            canvas[:] = centered(torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255, layout.size)
        return Views(images, layout.scale, layout.offset, np.array(sizes, np.int64))


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


def unproject_depth(depth: ArrayLike, cam_from_world: ArrayLike, intrinsics: ArrayLike) -> Floats:
    """Return the world point of each pixel of depth maps, (S, H, W, 3).

    As in the official code, the center of the top-left pixel is (0, 0) here. Elsewhere in this toolkit it is (0.5,
    0.5): subtract 0.5 from the principal points of such cameras first.

    Args:
        depth: (S, H, W) or (S, H, W, 1), along the camera's z.
        cam_from_world: (S, 3, 4) or (S, 4, 4).
        intrinsics: K, (S, 3, 3), pixels.
    """
    z = np.asarray(depth, np.float64)
    z = z[..., 0] if z.ndim == 4 else z
    pose, K = np.asarray(cam_from_world, np.float64), np.asarray(intrinsics, np.float64)
    v, u = np.indices(z.shape[1:])
    focal, center = K[:, None, None, [0, 1], [0, 1]], K[:, None, None, :2, 2]
    rays = (np.stack([u, v], axis=-1) - center) / focal
    in_camera = np.concatenate([rays * z[..., None], z[..., None]], axis=-1)
    # Multiplying row vectors by R applies the inverse rotation.
    return np.einsum("shwi,sij->shwj", in_camera - pose[:, None, None, :3, 3], pose[:, :3, :3])


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
    """The trunk: `patch_embed` encodes patches, `camera_token` is a parameter (..., C)."""

    def __init__(self, heads: Sequence[str], compute_dtype: torch.dtype) -> None:
        """The heads are those to create, of `known_heads`, else raise ValueError; `compute_dtype`, float32 or bfloat16,
        is for the trunk's matrix products and attention. Sums, norms and heads are float32.
        """
        super().__init__()
        self.heads = _ordered_heads(heads, self.known_heads)
        self.compute_dtype = compute_dtype

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
            compute_dtype: as for the constructor. bfloat16 halves the memory of the weights.

        Raises:
            WeightsError: no checkpoint, or one of another model; names missing, unexpected, mis-shaped keys.
            ValueError: unknown head.
        """
        with torch.device("meta"):
            model = cls(cls.known_heads if heads is None else heads, compute_dtype, **cls._sizes(checkpoint))
        other_heads = (prefix for head, prefix in cls.prefixes.items() if head not in model.heads)
        load_checkpoint(model, checkpoint, cls.title, ignore=(*cls.unused, *other_heads))
        return model

    @classmethod
    def _sizes(cls, checkpoint: str | Path | Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the constructor arguments in which the official checkpoints differ."""
        return {}

    @property
    def channels(self) -> int:
        """Channels of a token."""
        return int(self.aggregator.camera_token.shape[-1])

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
            raise ValueError(
                f"patch_tokens have shape {tuple(patch_tokens.shape)}; expected {expected} for images of shape "
                f"{tuple(images.shape)}."
            )
        return self._predictions(patch_tokens, heads, (H, W), **options)

    def _predictions(self, tokens: Tensor, heads: tuple[str, ...], size: tuple[int, int]) -> dict[str, Any]:
        """Return the output of `forward` for tokens (B, S, P, C) of images of this (H, W)."""
        raise NotImplementedError

    def _check_images(self, images: Tensor, axes: str) -> None:
        channels, height, width = images.shape[-3:] if images.ndim == len(axes.split(",")) else (0, 0, 0)
        if channels != 3 or height % self.patch or width % self.patch or not images.numel():
            raise ValueError(
                f"images have shape {tuple(images.shape)}; expected {axes}, at least one image, with height and width "
                f"that are multiples of {self.patch}. `load_images` makes such images."
            )


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
