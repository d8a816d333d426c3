"""Activations and their slopes, beside torch's own."""

import pytest
import torch
from torch.nn import functional

from uavrl.networks.activations import ACTIVATIONS, ActivationName

THEIRS = {"silu": functional.silu, "mish": functional.mish, "relu": functional.relu}


@pytest.mark.parametrize("name", ["silu", "mish", "relu"])
def test_value_and_slope_are_torchs(name: ActivationName) -> None:
    x = torch.linspace(-90.0, 120.0, 4001, dtype=torch.float64, requires_grad=True)
    expected = THEIRS[name](x)
    (steep,) = torch.autograd.grad(expected.sum(), x)
    value, slope = ACTIVATIONS[name](x.detach(), True)
    torch.testing.assert_close(value, expected.detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(slope, steep, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["silu", "mish", "relu"])
def test_large_inputs_give_numbers_in_float32(name: ActivationName) -> None:
    x = torch.tensor([-1e30, -1e4, -100.0, 0.0, 100.0, 1e4, 1e30])
    value, slope = ACTIVATIONS[name](x, True)
    torch.testing.assert_close(value, x.clamp(min=0.0))
    assert slope is not None
    torch.testing.assert_close(slope[:3], torch.zeros(3))
    torch.testing.assert_close(slope[4:], torch.ones(3))


def test_a_slope_that_nobody_wants_is_not_computed() -> None:
    assert all(activation(torch.ones(2), False)[1] is None for activation in ACTIVATIONS.values())
