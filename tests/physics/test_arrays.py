"""The vector's length, on both libraries."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from uavrl.physics.arrays import array_namespace, length


def test_length_of_a_vector() -> None:
    vectors = np.array([[3.0, 4.0], [-5.0, 12.0], [1e-9, 0.0], [1e6, 0.0]])
    assert length(vectors) == pytest.approx([5.0, 13.0, 1e-9, 1e6], rel=1e-15)
    assert length(torch.from_numpy(vectors).float()).numpy() == pytest.approx([5.0, 13.0, 1e-9, 1e6], rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_length_at_zero_is_zero_with_a_finite_gradient(dtype: torch.dtype) -> None:
    vectors = torch.tensor([[0.0, 0.0], [3.0, 4.0]], dtype=dtype, requires_grad=True)
    result = length(vectors)
    assert result[0] == 0.0
    (gradient,) = torch.autograd.grad(result.sum(), vectors)
    assert gradient[0].tolist() == [0.0, 0.0]
    assert gradient[1].tolist() == pytest.approx([0.6, 0.8])


def test_namespace_keeps_the_library() -> None:
    assert array_namespace(np.zeros(2)) is np
    assert isinstance(array_namespace(torch.zeros(2)).zeros(2), torch.Tensor)
    assert isinstance(array_namespace(np.float64(1.0)).asarray(1.0), np.ndarray)
