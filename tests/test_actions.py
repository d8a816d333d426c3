"""The hybrid action and its diffusion vector."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from uavrl.actions import HybridAction, decode, encode


def test_vector_is_the_move_then_a_one_hot_in_minus_one_and_one() -> None:
    action = HybridAction(torch.tensor([[0.5, -1.0], [0.0, 0.25]]), torch.tensor([0, 2]))
    assert encode(action, 3).tolist() == [[0.5, -1.0, 1.0, -1.0, -1.0], [0.0, 0.25, -1.0, -1.0, 1.0]]


@given(seed=st.integers(0, 1000), count=st.integers(1, 8), choices=st.integers(1, 12), dims=st.integers(1, 3))
def test_decode_inverts_encode(seed: int, count: int, choices: int, dims: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    continuous = torch.rand(count, dims, generator=generator) * 2 - 1
    choice = torch.randint(choices, (count,), generator=generator)
    vector = encode(HybridAction(continuous, choice), choices)
    assert vector.shape == (count, dims + choices)
    assert vector.dtype == continuous.dtype
    back = decode(vector, dims)
    assert torch.equal(back.continuous, continuous)
    assert torch.equal(back.choice, choice)


def test_decode_of_any_real_vector_is_an_action() -> None:
    back = decode(torch.tensor([[3.0, -7.0, -9.0, -2.0, -5.0]]), 2)
    assert back.continuous.tolist() == [[1.0, -1.0]]
    assert back.choice.tolist() == [1]


def test_encode_refuses_a_choice_that_does_not_exist() -> None:
    with pytest.raises(RuntimeError):
        encode(HybridAction(torch.zeros(1, 2), torch.tensor([3])), 3)


def test_gradient_reaches_the_move() -> None:
    continuous = torch.tensor([[0.5, -0.5]], requires_grad=True)
    encode(HybridAction(continuous, torch.tensor([1])), 3).sum().backward()
    assert continuous.grad is not None
    assert continuous.grad.tolist() == [[1.0, 1.0]]
