"""Activations by name, each with its slope, for layers that write out their own gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

ActivationName = Literal["silu", "mish", "relu"]

Activation = Callable[[Tensor, bool], tuple[Tensor, Tensor | None]]
"""x (...) and whether its slope is wanted -> y (...) and slope dy/dx (...), None where it is not wanted."""

_TWO = torch.tensor(2.0)  # a number of Python's is turned into a tensor at each use, for as long as the operation takes


def silu(x: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """y = x q with q the sigmoid of x; its slope q + x q (1 - q) (Elfwing et al. 2018)."""
    sigmoid = torch.sigmoid(x)
    return x * sigmoid, torch.ops.aten.sigmoid_backward(x, sigmoid).add_(sigmoid) if slope else None


def mish(x: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """y = x t, t = tanh(softplus(x)) = n / (2 - n) with n = q (2 - q); its slope t + x (1 - t^2) q (Misra 2020).

    One sigmoid; torch's own Mish takes an exponential, a logarithm and a hyperbolic tangent.
    """
    sigmoid = torch.sigmoid(x)
    n = torch.sub(_TWO, sigmoid).mul_(sigmoid)
    t = n.div_(torch.sub(_TWO, n))
    # tanh_backward(x, t) is x (1 - t^2) in one pass over memory
    return x * t, torch.addcmul(t, torch.ops.aten.tanh_backward(x, t), sigmoid) if slope else None


def relu(x: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """y = max(x, 0)."""
    return torch.relu(x), (x > 0).to(x.dtype) if slope else None


ACTIVATIONS: dict[ActivationName, Activation] = {"silu": silu, "mish": mish, "relu": relu}
