"""Noise schedules: how much of the clean action is left after each of the M diffusion steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args

import torch
from torch import Tensor

ScheduleName = Literal["vp", "cosine", "linear", "linear_rescaled"]

_BETA_MAX = 0.999
_COSINE_OFFSET = 0.008
_LINEAR_FIRST, _LINEAR_LAST, _LINEAR_STEPS = 1e-4, 2e-2, 1000
_VP_MIN, _VP_MAX = 0.1, 10.0


@dataclass(frozen=True, eq=False)
class Schedule:
    """Constants of a diffusion with M steps; entry i-1 of each tensor belongs to step i. All float32, without units.

    The two scales are kept next to `alpha_bar` because 1 - alpha_bar loses its digits in float32 where alpha_bar is
    near 1: each is rounded once, from float64.
    """

    beta: Tensor  # (M,) variance of the noise that step i adds, eq. (forward)
    alpha: Tensor  # (M,) 1 - beta
    alpha_bar: Tensor  # (M,) alpha_1 ... alpha_i, eq. (mapping)
    alpha_bar_previous: Tensor  # (M,) alpha_bar of step i-1; 1 at i = 1
    posterior_variance: Tensor  # (M,) beta-tilde of eq. (reverse); 0 at i = 1
    signal_scale: Tensor  # (M,) sqrt(alpha_bar)
    noise_scale: Tensor  # (M,) sqrt(1 - alpha_bar)

    @property
    def steps(self) -> int:
        """The number of steps M."""
        return self.beta.shape[0]

    def to(self, device: torch.device | str) -> Schedule:
        """The same schedule on `device`."""
        return Schedule(*(getattr(self, field.name).to(device) for field in fields(self)))


def schedule_from_beta(beta: Tensor) -> Schedule:
    """Derive every constant from beta (M,), each entry in (0, 1); computed in float64, stored in float32."""
    beta = beta.double()
    return _derived(beta, torch.log1p(-beta).cumsum(0))


def _derived(beta: Tensor, log_alpha_bar: Tensor) -> Schedule:
    """All constants, of float64; alpha_bar is not taken from beta, which may round to 1 where few steps go far."""
    log_alpha_bar_previous = torch.cat([log_alpha_bar.new_zeros(1), log_alpha_bar[:-1]])
    noise_variance, noise_variance_previous = -torch.expm1(log_alpha_bar), -torch.expm1(log_alpha_bar_previous)
    constants = (
        beta,
        1 - beta,
        log_alpha_bar.exp(),
        log_alpha_bar_previous.exp(),
        beta * noise_variance_previous / noise_variance,
        (log_alpha_bar / 2).exp(),
        noise_variance.sqrt(),
    )
    return Schedule(*(constant.float() for constant in constants))


def make_schedule(name: ScheduleName, steps: int) -> Schedule:
    """The schedule `name` with M = `steps` steps, on the CPU.

    - `vp`: beta_i = 1 - exp(-.1 / M - 9.9 (2i - 1) / (2 M^2)) (Xiao et al. 2022); alpha_bar_M = .0064 for every M.
    - `cosine`: Nichol & Dhariwal 2021, offset .008, beta at most .999.
    - `linear`: beta from 1e-4 to 2e-2 (Ho et al. 2020) whatever M is, as the paper has it. Made for 1000 steps: with
      few, most of the signal is left at step M (alpha_bar_M = .951 for M = 5), yet sampling starts from pure noise.
    - `linear_rescaled`: the linear beta times 1000 / M, at most .999; its single step, M = 1, is the last of the line.

    Raises ValueError for an unknown name or fewer than one step.
    """
    if name not in get_args(ScheduleName):
        raise ValueError(f"schedule: {name!r} is unknown; allowed: {', '.join(get_args(ScheduleName))}")
    if steps < 1:
        raise ValueError(f"steps: {steps} is too few; allowed: an integer of at least 1")
    return schedule_from_beta(_BETAS[name](steps))


def thinned(name: ScheduleName, steps: int, fewer: int) -> tuple[Schedule, list[int]]:
    """`fewer` steps of those of `make_schedule(name, steps)`, evenly spaced, the last among them, and which they are.

    Each keeps its alpha_bar, so a denoiser trained with all of them serves the ones that are left (Song et al. 2021).
    Raises ValueError as `make_schedule`, and for `fewer` outside 1..steps.
    """
    every = make_schedule(name, steps)
    if not 1 <= fewer <= steps:
        raise ValueError(f"steps: {fewer} is not allowed; allowed: 1 to {steps}")
    kept = [round(steps * k / fewer) for k in range(1, fewer + 1)]
    if fewer == steps:
        return every, kept
    log_alpha_bar = torch.log1p(-_BETAS[name](steps)).cumsum(0)[torch.tensor(kept) - 1]
    return _derived(-torch.expm1(log_alpha_bar.diff(prepend=log_alpha_bar.new_zeros(1))), log_alpha_bar), kept


def _vp(steps: int) -> Tensor:
    i = torch.arange(1, steps + 1, dtype=torch.float64)
    return -torch.expm1(-_VP_MIN / steps - 0.5 * (_VP_MAX - _VP_MIN) * (2 * i - 1) / steps**2)


def _cosine(steps: int) -> Tensor:
    time = torch.arange(steps + 1, dtype=torch.float64) / steps
    alpha_bar = torch.cos((time + _COSINE_OFFSET) / (1 + _COSINE_OFFSET) * (math.pi / 2)).square()
    return (1 - alpha_bar[1:] / alpha_bar[:-1]).clamp(max=_BETA_MAX)


def _linear(steps: int) -> Tensor:
    return torch.linspace(_LINEAR_FIRST, _LINEAR_LAST, steps, dtype=torch.float64)


def _linear_rescaled(steps: int) -> Tensor:
    backwards = torch.linspace(_LINEAR_LAST, _LINEAR_FIRST, steps, dtype=torch.float64)  # M = 1 keeps the noisy end
    return (backwards.flip(0) * (_LINEAR_STEPS / steps)).clamp(max=_BETA_MAX)


_BETAS = {"vp": _vp, "cosine": _cosine, "linear": _linear, "linear_rescaled": _linear_rescaled}
