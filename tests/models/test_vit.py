"""Blocks of a vision transformer, and the buffer that they share."""

import pytest
import torch

from toolkit.models.vit import Block, SharedBuffer, set_matrix_type


def random_block(qk_norm_eps: float | None = None) -> Block:
    block = Block(16, 2, qk_norm_eps=qk_norm_eps).eval()
    generator = torch.Generator().manual_seed(0)
    for parameter in block.parameters():
        parameter.requires_grad_(False).copy_(torch.randn(parameter.shape, generator=generator) / 4)
    return block


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("qk_norm_eps", [None, 1e-5])
@pytest.mark.parametrize("every", [1, 3])
def test_blocks_that_share_a_buffer_give_the_same_numbers(
    dtype: torch.dtype, qk_norm_eps: float | None, every: int
) -> None:
    """Sizes that grow and shrink, as within views and among them; nothing returned is written over later."""
    block, buffer = random_block(qk_norm_eps), SharedBuffer()
    set_matrix_type(block, dtype)
    tokens = [torch.randn(shape, generator=torch.Generator().manual_seed(1)) for shape in ((2, 9, 16), (1, 36, 16))]
    tokens += [tokens[0][:1], tokens[1].to(dtype)]
    expected = [block(x, every=every) for x in tokens]
    found = [block(x, every=every, buffer=buffer) for x in tokens]
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
