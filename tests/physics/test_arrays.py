"""Vectors on both libraries and as plain numbers; the functions for one number."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from uavrl.physics.arrays import array_namespace, components, length, per_device


def test_length_of_a_vector() -> None:
    vectors = np.array([[3.0, 4.0], [-5.0, 12.0], [1e-9, 0.0], [1e6, 0.0]])
    assert length(*components(vectors)) == pytest.approx([5.0, 13.0, 1e-9, 1e6], rel=1e-15)
    tensors = torch.from_numpy(vectors).float()
    assert length(*components(tensors)).numpy() == pytest.approx([5.0, 13.0, 1e-9, 1e6], rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_length_at_zero_is_zero_with_a_finite_gradient(dtype: torch.dtype) -> None:
    vectors = torch.tensor([[0.0, 0.0], [3.0, 4.0]], dtype=dtype, requires_grad=True)
    result = length(*components(vectors))
    assert result[0] == 0.0
    (gradient,) = torch.autograd.grad(result.sum(), vectors)
    assert gradient[0].tolist() == [0.0, 0.0]
    assert gradient[1].tolist() == pytest.approx([0.6, 0.8])


def test_one_vector_of_numpy_is_two_numbers() -> None:
    x, y = components(np.array([3.0, -4.0]))
    assert (type(x), type(y)) == (float, float)
    assert length(x, y) == 5.0
    assert length(0.0, 0.0) == 0.0


def test_a_number_meets_the_devices_as_it_is() -> None:
    assert per_device(2.0) == 2.0
    assert per_device(np.ones(3)).shape == (3, 1)
    assert per_device(torch.ones(3)).shape == (3, 1)


@pytest.mark.parametrize("name", ["abs", "exp", "sqrt", "atan", "log1p", "log10"])
def test_functions_of_a_number_are_numpys(name: str) -> None:
    assert getattr(array_namespace(1.7), name)(1.7) == pytest.approx(getattr(np, name)(1.7), rel=1e-15)


@pytest.mark.parametrize(("a", "b"), [(-1.5, 2.0), (5.5, 2.0), (2.0, 2.0)])
def test_functions_of_two_numbers_are_numpys(a: float, b: float) -> None:
    for name in ("minimum", "maximum", "remainder"):
        assert getattr(array_namespace(a), name)(a, b) == getattr(np, name)(a, b)


def test_a_number_is_chosen_negated_and_zeroed() -> None:
    xp = array_namespace(True)
    assert (xp.where(True, 1.0, 2.0), xp.where(False, 1.0, 2.0)) == (1.0, 2.0)
    assert (xp.logical_not(True), xp.logical_not(False)) == (False, True)
    assert [repr(xp.zeros_like(value)) for value in (2.5, 3, True)] == ["0.0", "0", "False"]
    assert xp.stack((1.0, 2.0), axis=-1).tolist() == [1.0, 2.0]


def test_namespace_keeps_the_library() -> None:
    assert array_namespace(np.zeros(2)) is np
    assert isinstance(array_namespace(torch.zeros(2)).zeros(2), torch.Tensor)
    assert isinstance(array_namespace(np.float64(1.0)).asarray(1.0), np.ndarray)
