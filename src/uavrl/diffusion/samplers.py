"""Diffusion samplers and the denoising loss: pure functions, with every random number passed in.

Common shapes: N samples of D entries, M steps. Steps are numbered 1 to M, and entry i-1 of a schedule or of a noise
tensor belongs to step i. All samplers are one chain: predict x_0, optionally clip it, then move to x_{i-1}, a weighted
sum of x_i, x_0 and noise. Step 1 ends on the predicted x_0 in each of them. Nothing here waits for the device.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from uavrl.diffusion.schedules import Schedule

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""x (N, D), step (N,) int64 in 1..M -> predicted noise (N, D)."""

ChainDenoiser = Callable[[Tensor, int], Tensor]
"""The same where all samples are at one step, as they are throughout a chain."""

Variance = Literal["beta", "posterior"]

_Update = Callable[[int, Tensor, Tensor], Tensor]  # i, x_i, x_0 -> x_{i-1}


def add_noise(schedule: Schedule, x0: Tensor, step: Tensor, noise: Tensor) -> Tensor:
    """Noised sample x_i (N, D) of x0 (N, D) at each sample's own step (N,), eq. (mapping); noise (N, D) ~ N(0, I).

    Raises IndexError (on the CPU) for a step outside 1..M.
    """
    signal_scale, noise_scale = _scales(schedule, step, x0.dtype)
    return signal_scale * x0 + noise_scale * noise


def predict_x0(schedule: Schedule, x: Tensor, step: Tensor, predicted_noise: Tensor, clip: bool) -> Tensor:
    """Clean sample x_0 (N, D) that eq. (mapping) gives for x (N, D) at step (N,) and its predicted noise (N, D).

    `clip` holds it in [-1, 1] by `straight_through_clamp`. Raises IndexError (on the CPU) for a step outside 1..M.
    """
    return _predict_x0(x, predicted_noise, *_scales(schedule, step, x.dtype), clip)


def straight_through_clamp(x: Tensor) -> Tensor:
    """Clamp x (any shape) to [-1, 1] exactly, with the identity as its gradient (Bengio et al. 2013) but outwards.

    The gradient of a plain clamp is zero outside the box, so guidance could never bring a sample back. The identity
    alone lets guidance push a sample out for ever, for what it is clamped to no longer changes: predicted noise grew
    until it was worse than none. So a gradient passes unless it leads further out.
    """
    if not torch.is_grad_enabled():
        return x.clamp(-1, 1)
    clamped: Tensor = _Clamp.apply(x)  # type: ignore[no-untyped-call]  # torch leaves Function.apply without types
    return clamped


class _Clamp(torch.autograd.Function):
    """Clamp to [-1, 1] through which a loss pulls inwards from anywhere, and outwards only from within."""

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.clamp(-1, 1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        kept: Tensor = gradient * ((x.abs() <= 1) | (gradient * x > 0))  # descent goes against the gradient
        return kept

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int], x: Tensor) -> tuple[Tensor, int]:
        clamped: Tensor = _Clamp.apply(x)  # type: ignore[no-untyped-call]  # as above
        return clamped, in_dims[0]  # entry by entry


_Clamp.forward.__signature__ = inspect.signature(_Clamp.forward)  # type: ignore[attr-defined]  # torch works it out at each use


def ddpm(
    denoiser: ChainDenoiser,
    schedule: Schedule,
    start: Tensor,
    noise: Tensor,
    *,
    variance: Variance,
    clip_x0: bool,
    gradient_steps: int | None = None,
) -> Tensor:
    """Ancestral sample x_0 (N, D) from start (N, D) ~ N(0, I) and noise (M, N, D) ~ N(0, I), eq. (reverse_QL).

    `variance` "beta" without `clip_x0` is the equation as printed, since the mean of eq. (reverse) is the same line
    whether written with the predicted noise or with x_0; "posterior" is beta-tilde of eq. (reverse). No noise is added
    at step 1, so noise[0] is not read. `gradient_steps` k: the graph holds the last k steps only; None: all of them.

    Raises ValueError for another variance, a noise of another shape, or k outside 1..M.
    """
    _check_noise(noise, schedule, start)
    if variance not in get_args(Variance):
        raise ValueError(f"variance: {variance!r} is unknown; allowed: {', '.join(get_args(Variance))}")
    noise_ratio = (schedule.noise_scale[:-1] / schedule.noise_scale[1:]).square()
    x_weight = schedule.alpha[1:].sqrt() * noise_ratio
    x0_weight = schedule.signal_scale[:-1] * schedule.beta[1:] / schedule.noise_scale[1:].square()
    step_variance = schedule.beta if variance == "beta" else schedule.posterior_variance
    update = _affine(x_weight, x0_weight, start.dtype, noise[1:], step_variance[1:].sqrt())
    return _reverse(denoiser, schedule, start, update, clip_x0, gradient_steps)


def ddim(
    denoiser: ChainDenoiser,
    schedule: Schedule,
    start: Tensor,
    noise: Tensor | None,
    *,
    ddim_eta: float = 0.0,
    clip_x0: bool,
    gradient_steps: int | None = None,
) -> Tensor:
    """DDIM sample x_0 (N, D) from start (N, D) and noise (M, N, D), or None at ddim_eta 0 (Song et al. 2021, eq. 12).

    `ddim_eta` 0 is a deterministic map of start, 1 is `ddpm` with the posterior variance. With `clip_x0` the noise is
    taken anew from the clipped x_0, so that both stay consistent. `gradient_steps` and noise[0] as in `ddpm`.

    Raises ValueError for ddim_eta outside [0, 1], noise absent at ddim_eta > 0 or of another shape, or k outside 1..M.
    """
    if not 0 <= ddim_eta <= 1:
        raise ValueError(f"ddim_eta: {ddim_eta} is not allowed; allowed: 0 to 1")
    x_weight, x0_weight = _ddim_weights(schedule, ddim_eta)
    if ddim_eta == 0:
        update = _affine(x_weight, x0_weight, start.dtype)
    elif noise is None:
        raise ValueError(f"noise: None is not allowed at ddim_eta {ddim_eta}; allowed: a tensor (M, N, D)")
    else:
        _check_noise(noise, schedule, start)
        noise_weight = ddim_eta * schedule.posterior_variance[1:].sqrt()
        update = _affine(x_weight, x0_weight, start.dtype, noise[1:], noise_weight)
    return _reverse(denoiser, schedule, start, update, clip_x0, gradient_steps)


def dpm_solver_pp_2m(denoiser: ChainDenoiser, schedule: Schedule, start: Tensor, *, clip_x0: bool) -> Tensor:
    """DPM-Solver++(2M) sample x_0 (N, D), a deterministic map of start (N, D) (Lu et al. 2022, algorithm 2).

    DDIM at ddim_eta 0 with x_0 extrapolated from its last two predictions, in the half log-SNR
    log(sqrt(alpha_bar) / sqrt(1 - alpha_bar)); of second order on the schedule's own grid. The first step and the last,
    which ends where no noise is left, are of first order.
    """
    x_weight, x0_weight = _ddim_weights(schedule, ddim_eta=0.0)
    move = _affine(x_weight, x0_weight, start.dtype)
    log_snr = (schedule.signal_scale / schedule.noise_scale).log()
    width = log_snr[:-1] - log_snr[1:]
    slope = (0.5 * width[:-1] / width[1:]).to(start.dtype).unbind()  # 1 / (2r); entry i-2 belongs to step i
    x0_before: Tensor | None = None

    def update(i: int, x: Tensor, x0: Tensor) -> Tensor:
        nonlocal x0_before
        target = x0 if x0_before is None else x0 + slope[i - 2] * (x0 - x0_before)
        x0_before = x0
        return move(i, x, target)

    return _reverse(denoiser, schedule, start, update, clip_x0, None)


def denoising_loss(denoiser: Denoiser, schedule: Schedule, x0: Tensor, step: Tensor, noise: Tensor) -> Tensor:
    """Squared error (N, D) of the predicted noise, eq. (diffRL_loss), unreduced: the caller weights the entries.

    x0 (N, D) is the data, step (N,) int64 in 1..M, noise (N, D) ~ N(0, I).
    """
    return (noise - denoiser(add_noise(schedule, x0, step, noise), step)).square()


def _scales(schedule: Schedule, step: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Signal and noise scale (N, 1) at each sample's step; index_select refuses step 0, where [] would wrap to M."""
    entry = step - 1
    signal_scale = schedule.signal_scale.index_select(0, entry).to(dtype)
    noise_scale = schedule.noise_scale.index_select(0, entry).to(dtype)
    return signal_scale.unsqueeze(1), noise_scale.unsqueeze(1)


def _predict_x0(x: Tensor, predicted_noise: Tensor, signal_scale: Tensor, noise_scale: Tensor, clip: bool) -> Tensor:
    x0 = torch.addcmul(x, noise_scale, predicted_noise, value=-1) / signal_scale
    return straight_through_clamp(x0) if clip else x0


def _ddim_weights(schedule: Schedule, ddim_eta: float) -> tuple[Tensor, Tensor]:
    """Weights (M-1,) of x_i and of x_0 for i = 2..M; written as a sum of positive terms, for float32."""
    noise_ratio = schedule.noise_scale[:-1] / schedule.noise_scale[1:]
    x_weight = noise_ratio * (1 - ddim_eta**2 + ddim_eta**2 * schedule.alpha[1:] * noise_ratio.square()).sqrt()
    return x_weight, schedule.signal_scale[:-1] - x_weight * schedule.signal_scale[1:]


def _affine(
    x_weight: Tensor,
    x0_weight: Tensor,
    dtype: torch.dtype,
    noise: Tensor | None = None,
    noise_weight: Tensor | None = None,
) -> _Update:
    """The update x_weight x_i + x0_weight x_0 + noise_weight noise; weights (M-1,), noise (M-1, N, D), for i = 2..M."""
    x_weights, x0_weights = x_weight.to(dtype).unbind(), x0_weight.to(dtype).unbind()
    if noise is None or noise_weight is None:
        return lambda i, x, x0: torch.addcmul(x_weights[i - 2] * x, x0_weights[i - 2], x0)
    jitter = (noise_weight.to(dtype).view(-1, 1, 1) * noise).unbind()
    return lambda i, x, x0: torch.addcmul(torch.addcmul(jitter[i - 2], x_weights[i - 2], x), x0_weights[i - 2], x0)


def _reverse(
    denoiser: ChainDenoiser,
    schedule: Schedule,
    start: Tensor,
    update: _Update,
    clip_x0: bool,
    gradient_steps: int | None,
) -> Tensor:
    """Walk x from step M to x_0: `update` for i = M..2, then x_0 as predicted at step 1."""
    steps = schedule.steps
    if gradient_steps is not None and not 1 <= gradient_steps <= steps:
        raise ValueError(
            f"gradient_steps: {gradient_steps} is not allowed; allowed: 1 to {steps}, or None for all steps"
        )
    signal_scale = schedule.signal_scale.to(start.dtype).unbind()
    noise_scale = schedule.noise_scale.to(start.dtype).unbind()

    def walk(x: Tensor, order: range) -> Tensor:
        for i in order:
            predicted_noise = denoiser(x, i)
            x0 = _predict_x0(x, predicted_noise, signal_scale[i - 1], noise_scale[i - 1], clip_x0)
            x = x0 if i == 1 else update(i, x, x0)
        return x

    order = range(steps, 0, -1)
    without_graph = 0 if gradient_steps is None else steps - gradient_steps
    with torch.no_grad():
        x = walk(start, order[:without_graph])
    return walk(x, order[without_graph:])


def _check_noise(noise: Tensor, schedule: Schedule, start: Tensor) -> None:
    expected = (schedule.steps, *start.shape)
    if noise.shape != expected:
        raise ValueError(f"noise: shape {tuple(noise.shape)} does not fit; allowed: {expected}, one entry a step")
