"""Blocks of a vision transformer, and the buffer that they share."""

import pytest
import torch

from toolkit.models.vit import Block, SharedBuffer, set_matrix_type


def random_block(qk_norm_eps: float | None = None, dinov3: bool = False) -> Block:
    block = Block(16, 2, qk_norm_eps=qk_norm_eps, dinov3=dinov3).eval()
    generator = torch.Generator().manual_seed(0)
    for parameter in block.parameters():
        parameter.requires_grad_(False).copy_(torch.randn(parameter.shape, generator=generator) / 4)
    return block


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("qk_norm_eps", [None, 1e-5])
@pytest.mark.parametrize("kept", [None, torch.tensor([0, 3, 7])])
def test_blocks_that_share_a_buffer_give_the_same_numbers(
    dtype: torch.dtype, qk_norm_eps: float | None, kept: torch.Tensor | None
) -> None:
    """Sizes that grow and shrink, as within views and among them; nothing returned is written over later."""
    block, buffer = random_block(qk_norm_eps), SharedBuffer()
    set_matrix_type(block, dtype)
    tokens = [torch.randn(shape, generator=torch.Generator().manual_seed(1)) for shape in ((2, 9, 16), (1, 36, 16))]
    tokens += [tokens[0][:1], tokens[1].to(dtype)]
    expected = [block(x, kept=kept) for x in tokens]
    found = [block(x, kept=kept, buffer=buffer) for x in tokens]
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def test_a_buffer_is_allocated_once() -> None:
    block, buffer = random_block(), SharedBuffer()
    x = torch.randn(2, 9, 16)
    hidden = buffer.linear(x, block.mlp.fc1.weight, block.mlp.fc1.bias)
    assert torch.equal(hidden, block.mlp.fc1(x))
    assert buffer.linear(x, block.attn.qkv.weight, block.attn.qkv.bias).data_ptr() == hidden.data_ptr()


def test_no_buffer_where_gradients_need_the_numbers() -> None:
    cpu = torch.device("cpu")
    assert SharedBuffer.for_device(cpu) is None
    for mode in (torch.inference_mode, torch.no_grad):
        with mode():
            assert SharedBuffer.for_device(cpu) is not None
            assert SharedBuffer.for_device(torch.device("meta")) is None


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
