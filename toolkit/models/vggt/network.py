"""VGGT (Wang et al., CVPR 2025): cameras, depth and points of a few views of a scene, in one forward pass.

The official network is at github.com/facebookresearch/vggt, with its own licenses for code and weights.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from toolkit.models.dpt import dense_output
from toolkit.models.vggt.aggregator import Aggregator
from toolkit.models.vggt.heads import CameraHead, DenseHead
from toolkit.models.vit import PATCH, set_matrix_type
from toolkit.models.weights import load_checkpoint

HEADS = ("camera", "depth", "point")
_CHECKPOINT_HEADS = (*HEADS, "track")
_FRAMES_AT_A_TIME = 8  # of the dense heads, on a GPU; on a CPU, one frame keeps all cores busy


class VGGT(nn.Module):
    """The network: a few photographs in, their cameras and depth out. The defaults are the official sizes.

    It may hold only some of the official heads, and never the track head. A whole official checkpoint loads strictly
    all the same: the keys of other heads are ignored.
    """

    def __init__(
        self,
        heads: Sequence[str] = HEADS,
        compute_dtype: torch.dtype = torch.float32,
        dim: int = 1024,
        depth: int = 24,
        num_heads: int = 16,
        encoder_depth: int = 24,
        encoder_num_heads: int = 16,
        grid: int = 37,
        camera_depth: int = 4,
        camera_num_heads: int = 16,
        dense_layers: Sequence[int] = (4, 11, 17, 23),
        dense_channels: Sequence[int] = (256, 512, 1024, 1024),
        dense_features: int = 256,
    ) -> None:
        """
        Args:
            heads: the heads to hold, of `HEADS`.
            compute_dtype: float32 or bfloat16, of the trunk's matrix products and attention. Sums, norms and heads
                are float32.
            dim, depth, num_heads: of the trunk; each of `depth` layers has two blocks.
            encoder_depth, encoder_num_heads: of the patch encoder, which has the same `dim`.
            grid: rows and columns of patches that the position embedding was trained for.
            camera_depth, camera_num_heads: of the camera head.
            dense_layers: the four layers that the dense heads read.
            dense_channels, dense_features: channels of the dense heads.

        Raises:
            ValueError: unknown head.
        """
        super().__init__()
        self.heads = _ordered_heads(heads, HEADS)
        self.compute_dtype = compute_dtype
        self.dense_layers = tuple(dense_layers)
        self.aggregator = Aggregator(dim, depth, num_heads, encoder_depth, encoder_num_heads, grid)
        set_matrix_type(self.aggregator, compute_dtype)
        if "camera" in self.heads:
            self.camera_head = CameraHead(2 * dim, camera_depth, camera_num_heads)
        if "point" in self.heads:
            self.point_head = DenseHead(2 * dim, 4, dense_channels, dense_features)
        if "depth" in self.heads:
            self.depth_head = DenseHead(2 * dim, 2, dense_channels, dense_features)

    @classmethod
    def from_checkpoint(
        cls,
        checkpoint: str | Path | Mapping[str, Tensor],
        heads: Sequence[str] = HEADS,
        compute_dtype: torch.dtype = torch.float32,
    ) -> "VGGT":
        """Return the network with official weights, on the CPU, in evaluation mode.

        Args:
            checkpoint: the official `model.pt` or `model.safetensors`, or its tensors by name (shared, not copied,
                where the type stays).
            heads, compute_dtype: as for the constructor. bfloat16 halves the memory of the weights.

        Raises:
            WeightsError: the file is no checkpoint, or of another model; names missing, unexpected, mis-shaped keys.
            ValueError: unknown head.
        """
        with torch.device("meta"):
            model = cls(heads, compute_dtype)
        load_checkpoint(model, checkpoint, "VGGT", ignore=model._ignored_keys)
        return model

    @property
    def _ignored_keys(self) -> tuple[str, ...]:
        """Prefixes of the official checkpoint's keys that the model does not need."""
        return tuple(f"{head}_head." for head in _CHECKPOINT_HEADS if head not in self.heads)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As `torch.nn.Module.load_state_dict`; keys of heads that are not held are ignored, strict or not."""
        held = {key: value for key, value in state_dict.items() if not key.startswith(self._ignored_keys)}
        return super().load_state_dict(held, strict=strict, assign=assign)

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Return the patch tokens (N, P, C) float32 of images (N, 3, H, W), P = H / 14 * W / 14.

        The tokens of an image depend on no other image: compute those of a map once and give them to `forward`.

        Raises:
            ValueError: wrong shape.
        """
        if images.ndim != 4:
            raise ValueError(f"images have shape {tuple(images.shape)}; expected (N, 3, H, W).")
        _check_images(images)
        tokens: Tensor = self.aggregator.patch_embed(images.float())
        return tokens

    @torch.no_grad()
    def forward(
        self, images: Tensor, heads: Sequence[str] | None = None, patch_tokens: Tensor | None = None
    ) -> dict[str, Any]:
        """Return what the heads predict, under the official names, float32.

        Args:
            images: (B, S, 3, H, W) or (S, 3, H, W), RGB in [0, 1], sides multiples of 14: S views of each of B
                scenes; the first view is the frame of the cameras. `load_images` makes such images.
            heads: which of the held heads to compute; None: all.
            patch_tokens: (B, S, P, C), or (S, P, C) like the images, of `encode`, if already computed. Then only the
                shape of `images` is read: `torch.empty(shape, device="meta")` will do.

        Returns:
            For "camera": `pose_enc` (B, S, 9), see `cameras_from_pose_encoding`, and `pose_enc_list`, the encoding
            after each step of the head. For "depth": `depth` (B, S, H, W, 1), along the camera's z, and `depth_conf`
            (B, S, H, W), at least 1. For "point": `world_points` (B, S, H, W, 3) and `world_points_conf` (B, S, H, W).
            Cameras, depth and points share one scale, which is not meters. B = 1 for images with four axes.

        Raises:
            ValueError: wrong shape, or a head that is not held.
        """
        if images.ndim == 4:
            images = images[None]
            patch_tokens = patch_tokens if patch_tokens is None else patch_tokens[None]
        if images.ndim != 5:
            raise ValueError(f"images have shape {tuple(images.shape)}; expected (B, S, 3, H, W) or (S, 3, H, W).")
        _check_images(images)
        B, S, _, H, W = images.shape
        heads = self.heads if heads is None else _ordered_heads(heads, self.heads)
        if patch_tokens is None:
            patch_tokens = self.encode(images.flatten(0, 1)).unflatten(0, (B, S))
        rows, columns = H // PATCH, W // PATCH
        expected = (B, S, rows * columns, self.aggregator.camera_token.shape[-1])
        if patch_tokens.shape != expected:
            raise ValueError(
                f"patch_tokens have shape {tuple(patch_tokens.shape)}; expected {expected} for images of shape "
                f"{tuple(images.shape)}."
            )
        last = len(self.aggregator.frame_blocks) - 1
        cameras_only = heads == ("camera",)
        read = {last} if cameras_only else {*self.dense_layers, *([last] if "camera" in heads else [])}
        layers = self.aggregator(patch_tokens, rows, columns, read, cameras_only)
        frames = 1 if patch_tokens.device.type == "cpu" else _FRAMES_AT_A_TIME
        output: dict[str, Any] = {}
        if "camera" in heads:
            output["pose_enc_list"] = self.camera_head(layers[last])
            output["pose_enc"] = output["pose_enc_list"][-1]
        if "depth" in heads:
            values, confidence = dense_output(self.depth_head, layers, self.dense_layers, (H, W), frames)
            output["depth"], output["depth_conf"] = values.exp(), confidence
        if "point" in heads:
            values, confidence = dense_output(self.point_head, layers, self.dense_layers, (H, W), frames)
            output["world_points"] = values.sign() * values.abs().expm1()
            output["world_points_conf"] = confidence
        return output


def _ordered_heads(heads: Sequence[str], held: Sequence[str]) -> tuple[str, ...]:
    """Return heads without repetition, in the order of `held`; refuse others."""
    if isinstance(heads, str) or not heads or not set(heads) <= set(held):
        raise ValueError(f"heads are {heads!r}; expected some of {list(held)}, in a list.")
    return tuple(head for head in held if head in heads)


def _check_images(images: Tensor) -> None:
    channels, height, width = images.shape[-3:]
    if channels != 3 or height % PATCH or width % PATCH or not images.numel():
        raise ValueError(
            f"images have shape {tuple(images.shape)}; expected 3 channels, at least one image, and height and width "
            f"that are multiples of {PATCH}. `load_images` makes such."
        )
