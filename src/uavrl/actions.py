"""The hybrid action and its diffusion vector. Continuous entries lie in [-1, 1]; choice 0 means idle."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional


class HybridAction(NamedTuple):
    """A batch of hybrid actions, NumPy or torch.

    continuous: (N, C) in [-1, 1]; for the aircraft C = 2, displacement / d_max.
    choice: (N,) integers in 0..K.
    """

    continuous: Any
    choice: Any


def encode(action: HybridAction, choices: int) -> Tensor:
    """The diffusion vector x = [w, 2 onehot(d) - 1], (N, C + choices), entries in [-1, 1] (paper, Section V-B)."""
    onehot = functional.one_hot(action.choice, choices).to(action.continuous.dtype)
    return torch.cat([action.continuous, 2.0 * onehot - 1.0], dim=-1)


def decode(vector: Tensor, continuous: int) -> HybridAction:
    """Inverse of `encode` for any real vector: w clipped to [-1, 1], d the argmax of the rest."""
    return HybridAction(vector[..., :continuous].clamp(-1.0, 1.0), vector[..., continuous:].argmax(dim=-1))
