"""Base class of networks for several views: heads on a trunk, tokens of single images, official checkpoints."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from toolkit.models.vit import Block
from toolkit.models.weights import checkpoint_tensors, load_checkpoint


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
        where, state = checkpoint_tensors(checkpoint)
        with torch.device("meta"):
            model = cls(cls.known_heads if heads is None else heads, compute_dtype, **cls._sizes(state))
        load_checkpoint(model, state, cls.title, ignore=model._ignored_keys, where=where)
        return model

    @classmethod
    def _sizes(cls, state: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the constructor arguments in which the official checkpoints differ."""
        return {}

    @property
    def _ignored_keys(self) -> tuple[str, ...]:
        """Key prefixes of the official checkpoint that the model does not need."""
        return (*self.unused, *(prefix for head, prefix in self.prefixes.items() if head not in self.heads))

    @property
    def channels(self) -> int:
        """Channels of a token."""
        return int(self.aggregator.camera_token.shape[-1])

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As `torch.nn.Module.load_state_dict`, but always ignores keys of heads that this network does not have."""
        needed = {key: value for key, value in state_dict.items() if not key.startswith(self._ignored_keys)}
        return super().load_state_dict(needed, strict=strict, assign=assign)

    def compile_blocks(self) -> None:
        """Compile the blocks with `torch.compile` at their first run, for images of any size."""
        for module in self.modules():
            if isinstance(module, Block):
                module.compile(dynamic=True)

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Return the tokens (N, P, C) float32 of images (N, 3, H, W), P = H / patch * W / patch + `class_tokens`.

        The tokens of an image do not depend on other images: compute those of map images once and pass them to
        `forward`.

        Raises:
            ValueError: wrong shape.
        """
        if images.ndim != 4:
            raise ValueError(f"images have shape {tuple(images.shape)}; expected (N, 3, H, W).")
        self._check_images(images)
        return self._encoded(images.float())

    def _encoded(self, images: Tensor) -> Tensor:
        tokens: Tensor = self.aggregator.patch_embed(images)
        return tokens

    def _checked(
        self, images: Tensor, heads: Sequence[str] | None, patch_tokens: Tensor | None
    ) -> tuple[tuple[int, int], tuple[str, ...], Tensor]:
        """Check the arguments of `forward`; return (H, W), the heads to compute, and the patch tokens (B, S, P, C).

        Raises:
            ValueError: wrong shape, or a head that this network does not have.
        """
        if images.ndim == 4:
            images = images[None]
            patch_tokens = patch_tokens if patch_tokens is None else patch_tokens[None]
        if images.ndim != 5:
            raise ValueError(f"images have shape {tuple(images.shape)}; expected (B, S, 3, H, W) or (S, 3, H, W).")
        self._check_images(images)
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
        return (H, W), heads, patch_tokens

    def _check_images(self, images: Tensor) -> None:
        channels, height, width = images.shape[-3:]
        if channels != 3 or height % self.patch or width % self.patch or not images.numel():
            raise ValueError(
                f"images have shape {tuple(images.shape)}; expected 3 channels, at least one image, and height and "
                f"width that are multiples of {self.patch}. `load_images` makes such images."
            )


def _ordered_heads(heads: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return heads without repetition, in the order of `known`; raise ValueError if there are none, or unknown ones."""
    if isinstance(heads, str) or not heads or not set(heads) <= set(known):
        raise ValueError(f"heads are {heads!r}; expected some of {list(known)}, in a list.")
    return tuple(head for head in known if head in heads)
