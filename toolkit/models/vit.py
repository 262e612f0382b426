"""The parts of a vision transformer (Dosovitskiy et al., ICLR 2021) in the form and with the key names of DINOv2.

Modules may stand in another type than their input's numbers: `LayerNorm` weights and the layer scales fit any, and a
block computes in the type of its matrices (`set_matrix_type`) what it adds to its input in the input's type.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

Rope = tuple[Tensor, Tensor]
"""Cosines and signed sines of a rotary position embedding, each (N, C / heads): see `rotate_`."""


class SharedRoom:
    """One array that the widest layers of a pass write into, each over what the one before left.

    On a CPU glibc has arrays above 32 MB from the system, anew for each layer, and the system clears them page by page:
    2 to 6 % of a network's time in float32, and the more, the faster the products are. For one pass in one mode:
    numbers of `torch.inference_mode` cannot be written over outside of it.
    """

    def __init__(self) -> None:
        self._held = torch.empty(0)

    @classmethod
    def on(cls, device: torch.device) -> "SharedRoom | None":
        """Return room for a pass; None on another device, where it does not help, and where gradients are recorded,
        which need what would be written over."""
        return cls() if device.type == "cpu" and not torch.is_grad_enabled() else None

    def linear(self, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return `F.linear(x, weight, bias)`, (..., C); what was returned before is lost."""
        count = x.shape[:-1].numel() * len(weight)
        if self._held.numel() < count or self._held.dtype != x.dtype:
            self._held = torch.empty(0)  # let go before more is asked for
            self._held = x.new_empty(count)
        out = self._held[:count].view(-1, len(weight))
        return torch.addmm(bias, x.flatten(0, -2), weight.t(), out=out).view(*x.shape[:-1], len(weight))


def _linear(x: Tensor, weight: Tensor, bias: Tensor, room: SharedRoom | None) -> Tensor:
    return F.linear(x, weight, bias) if room is None else room.linear(x, weight, bias)


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
        self, x: Tensor, rope: Rope | None = None, every: int = 1, room: SharedRoom | None = None
    ) -> Tensor:
        """Return what tokens 0, every, 2 * every, ... gather from all tokens, (B, ceil(N / every), C)."""
        q, k, v = self._parts(x, every, room)
        if self.has_qk_norm:
            # The norm takes, and makes, numbers in order; where they are converted before, at once in that order.
            q = self.q_norm(q.to(torch.float32, memory_format=torch.contiguous_format))
            k = self.k_norm(k.to(torch.float32, memory_format=torch.contiguous_format))
        if rope is not None:
            q, k = rotate_(q, (rope[0][::every], rope[1][::every])), rotate_(k, rope)
        gathered = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        del q, k, v  # with norms of their own, a fifth of what a pass holds: let go before the projection
        return self.proj(gathered.transpose(1, 2).reshape(len(x), -1, x.shape[-1]))

    def _parts(self, x: Tensor, every: int, room: SharedRoom | None) -> tuple[Tensor, ...]:
        """Return queries, of tokens 0, every, 2 * every, ..., keys and values, each (B, heads, tokens, C / heads)."""
        C = x.shape[-1]
        weight, bias = self.qkv.weight, self.qkv.bias
        if every == 1:
            parts = _linear(x, weight, bias, room).split(C, dim=-1)
        else:
            q = F.linear(x[:, ::every], weight[:C], bias[:C])
            parts = (q, *_linear(x, weight[C:], bias[C:], room).split(C, dim=-1))
        return tuple(part.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for part in parts)


class Mlp(nn.Module):
    """Two linear layers with an exact (not tanh) GELU between them."""

    def __init__(self, dim: int, hidden: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim if out is None else out)

    def forward(self, x: Tensor, room: SharedRoom | None = None) -> Tensor:
        hidden = _linear(x, self.fc1.weight, self.fc1.bias, room)
        return self.fc2(torch.ops.aten.gelu_(hidden))  # in place: the hidden layer is the largest array


class LayerScale(nn.Module):
    """A learned factor for each channel of a residual (Touvron et al., ICCV 2021)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(dim))

    def forward(self, stream: Tensor, residual: Tensor) -> Tensor:
        """Return stream + gamma * residual, in one pass over memory."""
        return torch.addcmul(stream, residual, self.gamma)


class Block(nn.Module):
    """A transformer block: attention and MLP, each on the normalized stream and added to it, scaled."""

    def __init__(self, dim: int, num_heads: int, eps: float = 1e-6, qk_norm_eps: float | None = None) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, num_heads, qk_norm_eps)
        self.ls1 = LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, 4 * dim)
        self.ls2 = LayerScale(dim)

    def forward(
        self, x: Tensor, rope: Rope | None = None, every: int = 1, room: SharedRoom | None = None
    ) -> Tensor:
        """Return the tokens (B, N, C) one block further.

        Args:
            x: (B, N, C).
            rope: position of each token, for queries and keys.
            every: return only tokens 0, every, 2 * every, ...; what is read of the others alone is computed.
            room: of this pass, shared by its blocks.
        """
        matrix_type = self.attn.qkv.weight.dtype
        x = self.ls1(x[:, ::every], self.attn(self.norm1(x).to(matrix_type), rope, every, room))
        return self.ls2(x, self.mlp(self.norm2(x).to(matrix_type), room))


class PatchEmbed(nn.Module):
    """Cut images (B, 3, H, W) into patches and embed each: (B, H / patch * W / patch, C), row by row."""

    def __init__(self, dim: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, kernel_size=patch, stride=patch)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images).flatten(2).transpose(1, 2)


def set_matrix_type(module: nn.Module, dtype: torch.dtype) -> None:
    """Convert the linear layers of a module, and these alone, to a type that its blocks then compute in.

    Norms, layer scales, learned tokens and the stream of tokens keep theirs: float32 sums of bfloat16 products.
    """
    for part in module.modules():
        if isinstance(part, nn.Linear):
            part.to(dtype)
