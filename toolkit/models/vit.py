"""Modules of a vision transformer (Dosovitskiy et al., ICLR 2021), with the key names of DINOv2 and DINOv3.

`set_matrix_type` can give the matrices of a block another data type than its input. The block then computes in the
type of its matrices, and adds the result to its input in the type of the input.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

PATCH = 14
"""Side of a patch of DINOv2, pixels."""
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_ROPE_BASE = 100.0

Rope = tuple[Tensor, Tensor]
"""Cosines and signed sines of a rotary position embedding, each (N, C / heads); see `rotate_`."""


def normalized(images: Tensor) -> Tensor:
    """Normalize each channel of images (..., 3, H, W) in [0, 1] by ImageNet's mean and standard deviation."""
    mean, std = (images.new_tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std


def rotate_(x: Tensor, rope: Rope, groups: int = 2) -> Tensor:
    """Rotate each pair of channels of queries or keys (B, heads, N, D) by its own angle, in place.

    This is rotary position embedding (Su et al., RoFormer, 2021). The channels form `groups` groups of D / groups. The
    first half of a group holds the first channels of its pairs, the second half the second channels. With two groups,
    one can encode y and the other x. The sines of the first channels are negative.
    """
    cosine, sine = rope
    halves = x.chunk(2 * groups, dim=-1)
    swapped = torch.cat([halves[index ^ 1] for index in range(2 * groups)], dim=-1)
    return x.mul_(cosine).addcmul_(swapped, sine)


def places_of_view(rows: int, columns: int, special: int, device: torch.device) -> Tensor:
    """Return the row and column of each token of a view, (special + rows * columns, 2), float32.

    Special tokens come first and have place 0; the rows and columns of patches count from 1.
    """
    places = torch.zeros(special + rows * columns, 2, device=device)
    places[special:] = 1 + torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).to(places)
    return places


def rope_of_places(places: Tensor, head_dim: int) -> Rope:
    """Return the rotary position embedding of tokens at places (T, 2), cosines and signed sines (T, head_dim).

    Of D = head_dim channels, the row rotates the first half and the column the second half. Each half has D / 4 pairs;
    pair i rotates by place * 100 ** (-4 i / D) radians.
    """
    half = head_dim // 2
    frequencies = 1.0 / _ROPE_BASE ** (torch.arange(0, half, 2, device=places.device).float() / half)
    angles = places[:, :, None] * frequencies  # (tokens, y and x, D / 4)
    cosine, sine = angles.cos(), angles.sin()
    cosine = torch.stack([cosine, cosine], dim=2).flatten(1)
    sine = torch.stack([-sine, sine], dim=2).flatten(1)
    return cosine, sine


class Attention(nn.Module):
    """Self-attention among all tokens of a sequence, (B, N, C) -> (B, N, C)."""

    def __init__(self, dim: int, num_heads: int, qk_norm_eps: float | None = None, dinov3: bool = False) -> None:
        """`qk_norm_eps` is the epsilon of a LayerNorm on the queries and keys of each head; None: no LayerNorm.

        `dinov3`: multiply the bias of queries, keys and values by a mask (0 for keys), and rotate pairs of channels
        that are half a head apart.
        """
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.dinov3 = dinov3
        if dinov3:
            self.qkv.register_buffer("bias_mask", torch.empty(3 * dim))
        self.has_qk_norm = qk_norm_eps is not None
        if qk_norm_eps is not None:
            self.q_norm = nn.LayerNorm(dim // num_heads, eps=qk_norm_eps)
            self.k_norm = nn.LayerNorm(dim // num_heads, eps=qk_norm_eps)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rope: Rope | None = None, kept: Tensor | None = None) -> Tensor:
        """Return the attention output of all tokens, (B, N, C), or of the tokens `kept` only, (B, len(kept), C)."""
        C = x.shape[-1]
        weight: Tensor = self.qkv.weight
        bias: Tensor = self.qkv.bias
        if self.dinov3:
            bias = bias * self.qkv.get_buffer("bias_mask")
        if kept is None:
            parts = F.linear(x, weight, bias).split(C, dim=-1)
        else:
            q = F.linear(x[:, kept], weight[:C], bias[:C])
            parts = (q, *F.linear(x, weight[C:], bias[C:]).split(C, dim=-1))
        q, k, v = (part.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for part in parts)  # (B, heads, tokens, D)
        del parts
        if self.has_qk_norm:
            # LayerNorm needs contiguous input: convert type and layout in one copy.
            q = self.q_norm(q.to(torch.float32, memory_format=torch.contiguous_format))
            k = self.k_norm(k.to(torch.float32, memory_format=torch.contiguous_format))
        if rope is not None:
            q_rope = rope if kept is None else (rope[0][kept], rope[1][kept])
            groups = 1 if self.dinov3 else 2
            q, k = rotate_(q.float(), q_rope, groups), rotate_(k.float(), rope, groups)
        attended = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        del q, k, v  # with qk norms, they take a fifth of the memory of a forward pass
        return self.proj(attended.transpose(1, 2).reshape(len(x), -1, C))


class Mlp(nn.Module):
    """Two linear layers with an exact GELU (not the tanh approximation) between them."""

    def __init__(self, dim: int, hidden: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim if out is None else out)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(torch.ops.aten.gelu_(self.fc1(x)))  # in place: the hidden layer is the largest tensor


class LayerScale(nn.Module):
    """A learned factor for each channel of a residual (Touvron et al., ICCV 2021)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(dim))

    def forward(self, stream: Tensor, residual: Tensor) -> Tensor:
        """Return stream + gamma * residual; `addcmul` reads memory once."""
        return torch.addcmul(stream, residual, self.gamma)


class Block(nn.Module):
    """A transformer block: attention, then an MLP, each on normalized tokens, with a scaled residual."""

    def __init__(
        self, dim: int, num_heads: int, eps: float = 1e-6, qk_norm_eps: float | None = None, dinov3: bool = False
    ) -> None:
        """For `qk_norm_eps` and `dinov3`, see `Attention`."""
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, num_heads, qk_norm_eps, dinov3)
        self.ls1 = LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, 4 * dim)
        self.ls2 = LayerScale(dim)

    def forward(self, x: Tensor, rope: Rope | None = None, kept: Tensor | None = None) -> Tensor:
        """Return the tokens (B, N, C) after this block, for tokens x (B, N, C) with position embeddings for queries and
        keys.

        Only the tokens with indices `kept` are returned; None: all. Of others, the block computes only keys and values.
        """
        matrix_type = self.attn.qkv.weight.dtype
        stream = x if kept is None else x[:, kept]
        x = self.ls1(stream, self.attn(self.norm1(x).to(matrix_type), rope, kept))
        return self.ls2(x, self.mlp(self.norm2(x).to(matrix_type)))


class PatchEmbed(nn.Module):
    """Splits images (B, 3, H, W) into patches and embeds each: (B, H / patch * W / patch, C), row by row."""

    def __init__(self, dim: int, patch: int = PATCH) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, kernel_size=patch, stride=patch)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images).flatten(2).transpose(1, 2)


class Dinov2(nn.Module):
    """DINOv2 ViT-14 (Oquab et al., 2023). Subclasses add tokens and define `forward`."""

    def __init__(
        self,
        dim: int,
        depth: int,
        num_heads: int,
        grid: int,
        norm_eps: float = 1e-6,
        qk_norms: tuple[int, float] | None = None,
    ) -> None:
        """`grid` has the rows and columns of patches for which the position embedding was trained, `norm_eps` is of the
        last norm; `qk_norms`: the first block that normalizes queries and keys, and the epsilon; None: no block does.
        """
        super().__init__()
        self.grid = grid
        self.patch_embed = PatchEmbed(dim)
        self.cls_token = nn.Parameter(torch.empty(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.empty(1, grid * grid + 1, dim))
        first, eps = qk_norms or (depth, None)
        self.blocks = nn.ModuleList([
            Block(dim, num_heads, qk_norm_eps=eps if block >= first else None) for block in range(depth)
        ])  # fmt: skip
        self.norm = nn.LayerNorm(dim, eps=norm_eps)

    def _tokens(self, images: Tensor, *registers: Tensor) -> Tensor:
        """Return the tokens after the last block, before the norm: class token, `registers` (1, R, C), patches."""
        x = self._embedded(images, *registers)
        for block in self.blocks:
            x = block(x)
        return x

    def _embedded(self, images: Tensor, *registers: Tensor) -> Tensor:
        """Return the tokens before the first block."""
        position = self._position(images.shape[2] // PATCH, images.shape[3] // PATCH)
        patches = self.patch_embed(images.to(self.patch_embed.proj.weight.dtype))
        cls_token = (self.cls_token + position[:, :1]).to(patches.dtype)
        special = torch.cat([cls_token, *registers], dim=1).expand(len(images), -1, -1)
        return torch.cat([special, patches + position[:, 1:].to(patches.dtype)], dim=1)

    def _position(self, rows: int, columns: int) -> Tensor:
        """Return the position embedding of the class token and the patches, (1, 1 + rows * columns, C)."""
        if rows == columns == self.grid:
            return self.pos_embed
        trained = self.pos_embed[:, 1:].float().unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
        patches = self._resize(trained, rows, columns)
        return torch.cat([self.pos_embed[:, :1].float(), patches.flatten(2).transpose(1, 2)], dim=1)

    def _resize(self, trained: Tensor, rows: int, columns: int) -> Tensor:
        """Resize the position embedding (1, C, grid, grid) to (1, C, rows, columns)."""
        # Add 0.1 as in training: the weights have learned to expect this offset.
        factors = ((rows + 0.1) / self.grid, (columns + 0.1) / self.grid)
        return F.interpolate(trained, scale_factor=factors, mode="bicubic", antialias=False)


def set_matrix_type(module: nn.Module, dtype: torch.dtype) -> None:
    """Convert only the linear layers of a module to the data type in which its blocks shall compute.

    Norms, layer scales, learned tokens and the residual sums keep their type: products may be bfloat16, sums float32.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            layer.to(dtype)
