"""Blocks of a vision transformer."""

import torch

from toolkit.models.vit import Block


def random_block(qk_norm_eps: float | None = None, dinov3: bool = False) -> Block:
    block = Block(16, 2, qk_norm_eps=qk_norm_eps, dinov3=dinov3).eval()
    generator = torch.Generator().manual_seed(0)
    for parameter in block.parameters():
        parameter.requires_grad_(False).copy_(torch.randn(parameter.shape, generator=generator) / 4)
    return block


def test_kept_tokens_are_those_of_all() -> None:
    block, kept = random_block(1e-5), torch.tensor([7, 2, 3])
    x, angles = torch.randn(2, 9, 16), torch.rand(9, 8)
    rope = (angles.cos(), angles.sin())
    torch.testing.assert_close(block(x, rope, kept), block(x, rope)[:, kept])


def test_attention_as_of_dinov3() -> None:
    """Written out: masked biases, and channels i and i + D / 2 of a head as the parts of a complex number."""
    attention = random_block(dinov3=True).attn
    mask = attention.qkv.get_buffer("bias_mask").uniform_(generator=torch.Generator().manual_seed(1))
    x, angles = torch.randn(2, 9, 16), torch.rand(9, 4)
    q, k, v = (x @ attention.qkv.weight.T + mask * attention.qkv.bias).view(2, 9, 3, 2, 8).permute(2, 0, 3, 1, 4)
    turn = torch.polar(torch.ones(9, 4), angles)
    q, k = (torch.complex(part[..., :4], part[..., 4:]) * turn for part in (q, k))
    scores = (q[:, :, :, None] * k[:, :, None].conj()).real.sum(dim=-1) / 8**0.5
    expected = attention.proj((scores.softmax(dim=-1) @ v).transpose(1, 2).flatten(2))
    rope = (angles.cos().repeat(1, 2), torch.cat([-angles.sin(), angles.sin()], dim=1))
    torch.testing.assert_close(attention(x, rope), expected)
