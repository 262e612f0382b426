"""The parts of a vision transformer (Dosovitskiy et al., ICLR 2021) in the form and with the key names of DINOv2.

Modules may stand in another type than their input's numbers: `LayerNorm` weights and the layer scales fit any, and a
block computes in the type of its matrices (`set_matrix_type`) what it adds to its input in the input's type.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

Rope = tuple[Tensor, Tensor]
"""Cosines and signed sines of a rotary position embedding, each (N, C / heads): see `rotate_`."""


class Scratch:
    """Room for the widest numbers of a block, which the next block's are written over.

    On a CPU arrays of tens of MB come from the system for each layer anew, which clears them page by page: 2 to 6 % of
    a network's time in float32, and the more, the faster the products are.
    """

    def __init__(self) -> None:
        self._held = torch.empty(0)

    @classmethod
    def on(cls, device: torch.device) -> "Scratch | None":
        """Return room for a pass over some blocks, None where it is of no use: elsewhere, or with gradients."""
        return cls() if device.type == "cpu" and not torch.is_grad_enabled() else None

    def linear(self, layer: nn.Linear, x: Tensor) -> Tensor:
        """Return `layer(x)`, (..., C); what was returned before is lost."""
        shape = (*x.shape[:-1], layer.out_features)
        count = math.prod(shape)
        if self._held.numel() < count or self._held.dtype != x.dtype:
            self._held = x.new_empty(count)
        out = self._held[:count].view(-1, layer.out_features)
        return torch.addmm(layer.bias, x.flatten(0, -2), layer.weight.t(), out=out).view(shape)


def rotate_(x: Tensor, rope: Rope) -> Tensor:
    """Turn each pair of channels of queries or keys (B, heads, N, D) by an angle of its own, in place.

    Rotary position embedding (Su et al., RoFormer, 2021) in two dimensions: of the four quarters of D, the first
    two hold pairs (first, second) for y, the last two for x. The sines come with the sign of the pair's other half.
    """
    cosine, sine = rope
    first_y, second_y, first_x, second_x = x.chunk(4, dim=-1)
    swapped = torch.cat([second_y, first_y, second_x, first_x], dim=-1)
    return x.mul_(cosine).addcmul_(swapped, sine)


class Attention(nn.Module):
    """Self-attention of all tokens of a sequence, (B, N, C) -> (B, N, C)."""

    def __init__(self, dim: int, num_heads: int, qk_norm_eps: float | None = None) -> None:
        """
        Args:
            dim, num_heads: C, and into how many parts it is cut.
            qk_norm_eps: where given, queries and keys of each head go through a LayerNorm with this epsilon.
        """
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.has_qk_norm = qk_norm_eps is not None
        if qk_norm_eps is not None:
            self.q_norm = nn.LayerNorm(dim // num_heads, eps=qk_norm_eps)
            self.k_norm = nn.LayerNorm(dim // num_heads, eps=qk_norm_eps)
        self.proj = nn.Linear(dim, dim)

    def forward(
        self, x: Tensor, rope: Rope | None = None, every: int = 1, scratch: Scratch | None = None
    ) -> Tensor:
        """Return what tokens 0, every, 2 * every, ... gather from all tokens, (B, ceil(N / every), C)."""
        q, k, v = self._parts(x, every, scratch)
        if self.has_qk_norm:
            # The norm takes, and makes, numbers in order; where they are converted before, at once in that order.
            ordered = {"dtype": torch.float32, "memory_format": torch.contiguous_format}
            q, k = self.q_norm(q.to(**ordered)), self.k_norm(k.to(**ordered))
        if rope is not None:
            q, k = rotate_(q, (rope[0][::every], rope[1][::every])), rotate_(k, rope)
        gathered = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        del q, k, v  # for as long as the projection takes, a fifth of what the network holds
        return self.proj(gathered.transpose(1, 2).reshape(len(x), -1, x.shape[-1]))

    def _parts(self, x: Tensor, every: int, scratch: Scratch | None) -> tuple[Tensor, ...]:
        """Return queries, of tokens 0, every, 2 * every, ..., keys and values, each (B, heads, tokens, C / heads)."""
        C = x.shape[-1]
        if every == 1:
            together = self.qkv(x) if scratch is None else scratch.linear(self.qkv, x)
            parts = together.split(C, dim=-1)
        else:
            weight, bias = self.qkv.weight, self.qkv.bias
            q = F.linear(x[:, ::every], weight[:C], bias[:C])
            parts = (q, *F.linear(x, weight[C:], bias[C:]).split(C, dim=-1))
        return tuple(part.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for part in parts)


class Mlp(nn.Module):
    """Two linear layers with an exact (not tanh) GELU between them."""

    def __init__(self, dim: int, hidden: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim if out is None else out)

    def forward(self, x: Tensor, scratch: Scratch | None = None) -> Tensor:
        hidden = self.fc1(x) if scratch is None else scratch.linear(self.fc1, x)
        return self.fc2(torch.ops.aten.gelu_(hidden))  # in place: the hidden layer is the largest array


class LayerScale(nn.Module):
    """A learnt factor for each channel of a residual (Touvron et al., ICCV 2021)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(dim))

    def forward(self, stream: Tensor, residual: Tensor) -> Tensor:
        """Return stream + gamma * residual, in one pass over memory."""
        return torch.addcmul(stream, residual, self.gamma)


class Block(nn.Module):
    """A transformer block: attention and MLP, each on the normalised stream and added to it, scaled."""

    def __init__(self, dim: int, num_heads: int, eps: float = 1e-6, qk_norm_eps: float | None = None) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, num_heads, qk_norm_eps)
        self.ls1 = LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, 4 * dim)
        self.ls2 = LayerScale(dim)

    def forward(
        self, x: Tensor, rope: Rope | None = None, every: int = 1, scratch: Scratch | None = None
    ) -> Tensor:
        """Return the tokens (B, N, C) one block further.

        Args:
            x: (B, N, C).
            rope: position of each token, for queries and keys.
            every: return only tokens 0, every, 2 * every, ...; what is read of the others alone is computed.
            scratch: shared by the blocks of one pass.
        """
        matrix_type = self.attn.qkv.weight.dtype
        x = self.ls1(x[:, ::every], self.attn(self.norm1(x).to(matrix_type), rope, every, scratch))
        return self.ls2(x, self.mlp(self.norm2(x).to(matrix_type), scratch))


class PatchEmbed(nn.Module):
    """Cut images (B, 3, H, W) into patches and embed each: (B, H / patch * W / patch, C), row by row."""

    def __init__(self, dim: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, kernel_size=patch, stride=patch)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images).flatten(2).transpose(1, 2)


def set_matrix_type(module: nn.Module, dtype: torch.dtype) -> None:
    """Convert the linear layers of a module, and these alone, to a type that its blocks then compute in.

    Norms, layer scales, learnt tokens and the stream of tokens keep theirs: float32 sums of bfloat16 products.
    """
    for part in module.modules():
        if isinstance(part, nn.Linear):
            part.to(dtype)
