"""Samplers against recursions written out in NumPy float64, from the published equations in their published form."""

from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.diffusion.reference import Array, reference_beta
from uavrl.diffusion import (
    ChainDenoiser,
    Schedule,
    ScheduleName,
    Variance,
    add_noise,
    ddim,
    ddpm,
    denoising_loss,
    dpm_solver_pp_2m,
    make_schedule,
    predict_x0,
    schedule_from_beta,
    straight_through_clamp,
)

AnyDenoiser = Callable[[Tensor, Tensor | int], Tensor]  # for chains, and for samples that are each at their own step
Sampler = Callable[[ChainDenoiser, Schedule, Tensor, Tensor], Tensor]

NAMES: tuple[ScheduleName, ...] = get_args(ScheduleName)
STEPS = (1, 5, 10, 20, 50)
MEAN, DEVIATION = 0.4, 0.3


def constants(beta: Array) -> tuple[Array, Array]:
    """Alpha, and alpha_bar with step 0 in front."""
    return 1 - beta, np.concatenate([[1.0], np.cumprod(1 - beta)])


def exact_denoiser(beta: Array) -> AnyDenoiser:
    """E[noise | x_i] for data N(MEAN, DEVIATION^2)."""
    alpha_bar = torch.from_numpy(constants(beta)[1])

    def denoise(x: Tensor, step: Tensor | int) -> Tensor:
        kept = alpha_bar[step].reshape(-1, 1).to(x.dtype)
        return (1 - kept).sqrt() * (x - kept.sqrt() * MEAN) / (kept * DEVIATION**2 + 1 - kept)

    return denoise


def network(steps: int, size: int = 3) -> tuple[AnyDenoiser, Callable[[Array, int], Array]]:
    """A fixed denoiser that is neither linear nor bounded by the box, in torch and in NumPy."""
    weight = np.random.default_rng(7).normal(size=(size, size))
    weight_t = torch.from_numpy(weight)

    def denoise(x: Tensor, step: Tensor | int) -> Tensor:
        return torch.tanh(x @ weight_t.to(x.dtype)) * (1 + torch.as_tensor(step).reshape(-1, 1) / steps)

    return denoise, lambda x, i: np.tanh(x @ weight) * (1 + i / steps)


def ddpm_as(variance: Variance, *, clip_x0: bool = False, gradient_steps: int | None = None) -> Sampler:
    return lambda *args: ddpm(*args, variance=variance, clip_x0=clip_x0, gradient_steps=gradient_steps)


def ddim_as(ddim_eta: float, *, clip_x0: bool = False, gradient_steps: int | None = None) -> Sampler:
    return lambda *args: ddim(*args, ddim_eta=ddim_eta, clip_x0=clip_x0, gradient_steps=gradient_steps)


def dpm_as(*, clip_x0: bool = False) -> Sampler:
    return lambda denoiser, schedule, start, noise: dpm_solver_pp_2m(denoiser, schedule, start, clip_x0=clip_x0)


def ddpm_affine(beta: Array, variance: Variance) -> list[tuple[float, float, float]]:
    """(a, b, c) of x_{i-1} = a x_i + b + c noise for i = M..1: eq. (reverse_QL) with the exact denoiser put in."""
    alpha, alpha_bar = constants(beta)
    coefficients = []
    for i in range(len(beta), 0, -1):
        now, previous = alpha_bar[i], alpha_bar[i - 1]
        slope = np.sqrt(1 - now) / (now * DEVIATION**2 + 1 - now)
        factor = beta[i - 1] / np.sqrt(alpha[i - 1] * (1 - now))
        noise_variance = beta[i - 1] if variance == "beta" else (1 - previous) / (1 - now) * beta[i - 1]
        coefficients.append(
            (
                1 / np.sqrt(alpha[i - 1]) - factor * slope,
                factor * slope * np.sqrt(now) * MEAN,
                np.sqrt(noise_variance) if i > 1 else 0.0,
            )
        )
    return coefficients


def ddim_affine(beta: Array, ddim_eta: float) -> list[tuple[float, float, float]]:
    """The same for Song et al. 2021, eqs. 12 and 16."""
    _, alpha_bar = constants(beta)
    coefficients = []
    for i in range(len(beta), 0, -1):
        now, previous = alpha_bar[i], alpha_bar[i - 1]
        sigma = ddim_eta * np.sqrt((1 - previous) / (1 - now)) * np.sqrt(1 - now / previous)
        slope = np.sqrt(1 - now) / (now * DEVIATION**2 + 1 - now)
        factor = np.sqrt(max(1 - previous - sigma**2, 0)) - np.sqrt(previous / now * (1 - now))
        coefficients.append(
            (np.sqrt(previous / now) + factor * slope, -factor * slope * np.sqrt(now) * MEAN, sigma),
        )
    return coefficients


GAUSSIAN_CASES = [
    pytest.param(ddpm_as("beta"), lambda beta: ddpm_affine(beta, "beta"), id="ddpm-beta"),
    pytest.param(ddpm_as("posterior"), lambda beta: ddpm_affine(beta, "posterior"), id="ddpm-posterior"),
    pytest.param(ddim_as(0.0), lambda beta: ddim_affine(beta, 0.0), id="ddim-0"),
    pytest.param(ddim_as(0.5), lambda beta: ddim_affine(beta, 0.5), id="ddim-0.5"),
    pytest.param(ddim_as(1.0), lambda beta: ddim_affine(beta, 1.0), id="ddim-1"),
]


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("sampler", "affine"), GAUSSIAN_CASES)
def test_gaussian_data_follow_the_samplers_own_recursion(
    sampler: Sampler,
    affine: Callable[[Array], list[tuple[float, float, float]]],
    name: ScheduleName,
    steps: int,
) -> None:
    """The whole sampler is x_0 = p x_M + q + sum_i r_i noise_i; unit inputs read off p, q and every r_i."""
    schedule, beta = make_schedule(name, steps), reference_beta(name, steps)
    start = torch.zeros(steps + 2, 1, dtype=torch.float64)
    start[1] = 1
    noise = torch.zeros(steps, steps + 2, 1, dtype=torch.float64)
    noise[torch.arange(steps), torch.arange(steps) + 2] = 1
    out = sampler(exact_denoiser(beta), schedule, start, noise).squeeze(1).numpy()

    p, q, r, mean, variance = 1.0, 0.0, np.zeros(steps), 0.0, 1.0
    for i, (a, b, c) in zip(range(steps, 0, -1), affine(beta), strict=True):
        p, q, r = a * p, a * q + b, a * r
        r[i - 1] = c
        mean, variance = a * mean + b, a * a * variance + c * c

    np.testing.assert_allclose(out[0], q, atol=3e-6, rtol=0)
    np.testing.assert_allclose(out[1:] - out[0], np.concatenate([[p], r]), atol=3e-6, rtol=0)
    assert out[0] == pytest.approx(mean, abs=3e-6)
    assert float(((out[1:] - out[0]) ** 2).sum()) == pytest.approx(variance, abs=1e-5)


@pytest.mark.parametrize("sampler", [ddpm_as("posterior"), ddim_as(1.0), ddim_as(0.0), dpm_as()])
def test_many_steps_reach_the_data(sampler: Sampler) -> None:
    """With 1000 steps both moments are those of the data: no recursion in common with the one above."""
    steps = 1000
    schedule = make_schedule("vp", steps)
    start = torch.zeros(steps + 2, 1, dtype=torch.float64)
    start[1] = 1
    noise = torch.zeros(steps, steps + 2, 1, dtype=torch.float64)
    noise[torch.arange(steps), torch.arange(steps) + 2] = 1
    out = sampler(exact_denoiser(reference_beta("vp", steps)), schedule, start, noise).squeeze(1)
    assert out[0].item() == pytest.approx(MEAN, abs=0.02)
    assert (out[1:] - out[0]).square().sum().sqrt().item() == pytest.approx(DEVIATION, rel=0.02)


@pytest.mark.parametrize("variance", get_args(Variance))
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("clip_x0", [False, True])
def test_ddpm_with_a_nonlinear_denoiser(variance: Variance, name: ScheduleName, clip_x0: bool) -> None:
    """Eq. (reverse_QL) as printed, or, clipped, the mean of q(x_{i-1} | x_i, clipped x_0) at every step."""
    steps = 6
    schedule = make_schedule(name, steps)
    denoise, denoise_np = network(steps)
    rng = np.random.default_rng(0)
    start, noise = rng.normal(size=(4, 3)), rng.normal(size=(steps, 4, 3))
    beta = reference_beta(name, steps)
    alpha, alpha_bar = constants(beta)
    x, outside = start, 0
    for i in range(steps, 0, -1):
        now, previous, predicted = alpha_bar[i], alpha_bar[i - 1], denoise_np(x, i)
        if clip_x0:
            raw = (x - np.sqrt(1 - now) * predicted) / np.sqrt(now)
            outside += int((np.abs(raw) > 1).sum())
            mean = np.sqrt(previous) * beta[i - 1] / (1 - now) * np.clip(raw, -1, 1)
            mean = mean + np.sqrt(alpha[i - 1]) * (1 - previous) / (1 - now) * x
        else:
            mean = x / np.sqrt(alpha[i - 1]) - beta[i - 1] / np.sqrt(alpha[i - 1] * (1 - now)) * predicted
        scale = beta[i - 1] if variance == "beta" else (1 - previous) / (1 - now) * beta[i - 1]
        x = mean + (np.sqrt(scale) * noise[i - 1] if i > 1 else 0)
    assert outside > 10 or not clip_x0
    out = ddpm(denoise, schedule, torch.from_numpy(start), torch.from_numpy(noise), variance=variance, clip_x0=clip_x0)
    np.testing.assert_allclose(out.numpy(), x, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_clipped_ddim_takes_its_noise_from_the_clipped_x0(name: ScheduleName) -> None:
    steps = 6
    schedule = make_schedule(name, steps)
    denoise, denoise_np = network(steps)
    start = np.random.default_rng(0).normal(size=(4, 3))
    _, alpha_bar = constants(reference_beta(name, steps))
    x = start
    for i in range(steps, 0, -1):
        now, previous = alpha_bar[i], alpha_bar[i - 1]
        x0 = np.clip((x - np.sqrt(1 - now) * denoise_np(x, i)) / np.sqrt(now), -1, 1)
        x = np.sqrt(previous) * x0 + np.sqrt(1 - previous) * (x - np.sqrt(now) * x0) / np.sqrt(1 - now)
    out = ddim(denoise, schedule, torch.from_numpy(start), None, clip_x0=True)
    np.testing.assert_allclose(out.numpy(), x, atol=1e-5)


@given(
    st.sampled_from(NAMES),
    st.integers(1, 12),
    st.booleans(),
    st.integers(0, 2**31),
)
def test_ddim_at_eta_1_is_ddpm_with_the_posterior_variance(
    name: ScheduleName, steps: int, clip_x0: bool, seed: int
) -> None:
    schedule = make_schedule(name, steps)
    generator = torch.Generator().manual_seed(seed)
    start = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(steps, 5, 3, generator=generator, dtype=torch.float64)
    denoise = exact_denoiser(reference_beta(name, steps)) if not clip_x0 else network(steps)[0]
    left = ddim(denoise, schedule, start, noise, ddim_eta=1.0, clip_x0=clip_x0)
    right = ddpm(denoise, schedule, start, noise, variance="posterior", clip_x0=clip_x0)
    torch.testing.assert_close(left, right, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("clip_x0", [False, True])
def test_ddim_at_eta_0_ignores_noise_and_repeats_itself(clip_x0: bool) -> None:
    schedule = make_schedule("vp", 5)
    denoise, _ = network(5)
    start = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    alone = ddim(denoise, schedule, start, None, clip_x0=clip_x0)
    assert torch.equal(alone, ddim(denoise, schedule, start, None, clip_x0=clip_x0))
    assert torch.equal(alone, ddim(denoise, schedule, start, torch.full((5, 4, 3), 9.0), clip_x0=clip_x0))


@pytest.mark.parametrize("sampler", [ddpm_as("beta"), ddpm_as("posterior"), ddim_as(0.7)])
def test_noise_reaches_every_step_but_the_first(sampler: Sampler) -> None:
    schedule = make_schedule("vp", 4)
    noise = torch.zeros(4, 2, 3)
    plain = sampler(network(4)[0], schedule, torch.ones(2, 3), noise)
    for i in range(1, 5):
        changed = noise.clone()
        changed[i - 1] = float("nan") if i == 1 else 1.0
        out = sampler(network(4)[0], schedule, torch.ones(2, 3), changed)
        assert torch.equal(out, plain) == (i == 1)


def smooth_beta(steps: int) -> Array:
    """Equal steps in the half log-SNR from -3 to 6, where sigma is 2e-3: twice as many halve each."""
    log_snr = np.linspace(6, -3, steps)
    alpha_bar = 1 / (1 + np.exp(-2 * log_snr))
    beta: Array = 1 - alpha_bar / np.concatenate([[1.0], alpha_bar[:-1]])
    return beta


def ode_error(sampler: Sampler, beta: Array) -> float:
    """Largest distance from the exact probability-flow solution for Gaussian data, which keeps every z-score."""
    kept = constants(beta)[1][-1]
    start = np.linspace(-2, 2, 9)[:, None]
    exact = MEAN + DEVIATION * (start - np.sqrt(kept) * MEAN) / np.sqrt(kept * DEVIATION**2 + 1 - kept)
    out = sampler(
        exact_denoiser(beta), schedule_from_beta(torch.from_numpy(beta)), torch.from_numpy(start), torch.empty(0)
    )
    return float(np.abs(out.numpy() - exact).max())


def test_dpm_solver_is_of_second_order_and_ddim_of_first() -> None:
    counts = (21, 41, 81)  # 20, 40 and 80 intervals between the two ends
    dpm = [ode_error(dpm_as(), smooth_beta(steps)) for steps in counts]
    first = [ode_error(ddim_as(0.0), smooth_beta(steps)) for steps in counts]
    assert dpm[0] / dpm[1] == pytest.approx(4, rel=0.2)
    assert dpm[1] / dpm[2] == pytest.approx(4, rel=0.2)
    assert first[0] / first[1] == pytest.approx(2, rel=0.2)
    assert all(5 * ours < theirs for ours, theirs in zip(dpm, first, strict=True))


@pytest.mark.parametrize("steps", [10, 20, 50])
@pytest.mark.parametrize("name", ["vp", "cosine"])
def test_dpm_solver_beats_ddim_on_real_schedules(name: ScheduleName, steps: int) -> None:
    beta = reference_beta(name, steps)
    assert ode_error(dpm_as(), beta) < ode_error(ddim_as(0.0), beta)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("clip_x0", [False, True])
def test_dpm_solver_with_a_nonlinear_denoiser(name: ScheduleName, clip_x0: bool) -> None:
    """Algorithm 2 of Lu et al. 2022 in its own terms; the grids of these schedules are uneven."""
    steps = 6
    schedule = make_schedule(name, steps)
    denoise, denoise_np = network(steps)
    start = np.random.default_rng(0).normal(size=(4, 3))
    _, alpha_bar = constants(reference_beta(name, steps))
    signal, sigma = np.sqrt(alpha_bar), np.sqrt(1 - alpha_bar)
    log_snr = np.log(signal[1:] / sigma[1:])  # entry i-1 is step i
    x, before = start, start
    for i in range(steps, 0, -1):
        x0 = (x - sigma[i] * denoise_np(x, i)) / signal[i]
        x0 = np.clip(x0, -1, 1) if clip_x0 else x0
        if i == 1:
            x = x0
            break
        h = log_snr[i - 2] - log_snr[i - 1]
        target = x0
        if i < steps:
            r = (log_snr[i - 1] - log_snr[i]) / h
            target = (1 + 1 / (2 * r)) * x0 - 1 / (2 * r) * before
        x, before = sigma[i - 1] / sigma[i] * x - signal[i - 1] * (np.exp(-h) - 1) * target, x0
    out = dpm_solver_pp_2m(denoise, schedule, torch.from_numpy(start), clip_x0=clip_x0)
    np.testing.assert_allclose(out.numpy(), x, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("clip_x0", [False, True])
@pytest.mark.parametrize("gradient_steps", [None, 1, 2, 5])
@pytest.mark.parametrize("make", [ddpm_as, ddim_as])
def test_gradient_reaches_the_last_steps_and_no_others(
    make: Callable[..., Sampler], gradient_steps: int | None, clip_x0: bool
) -> None:
    """A weight of its own for every step shows which steps the graph holds, and that their gradient is the full one."""
    schedule = make_schedule("vp", 5)
    kind: object = "posterior" if make is ddpm_as else 0.5
    noise = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(0))
    start = torch.linspace(-1, 1, 12).view(4, 3)

    def run(steps: int | None) -> tuple[Tensor, Tensor]:
        weight = torch.full((5,), 0.3, requires_grad=True)
        out = make(kind, clip_x0=clip_x0, gradient_steps=steps)(
            lambda x, step: weight[step - 1] * (x + 0.1), schedule, start, noise
        )
        out.square().sum().backward()
        assert weight.grad is not None
        return out.detach(), weight.grad

    out, gradient = run(gradient_steps)
    full_out, full_gradient = run(None)
    held = torch.arange(5) < (gradient_steps or 5)
    assert bool((full_gradient != 0).all())
    assert torch.equal(out, full_out)
    torch.testing.assert_close(gradient, torch.where(held, full_gradient, 0.0))


@pytest.mark.parametrize("sampler", [ddpm_as("beta"), ddpm_as("posterior"), ddim_as(0.0), ddim_as(0.5), dpm_as()])
def test_gradient_through_the_whole_chain_is_the_finite_difference(sampler: Sampler) -> None:
    schedule = make_schedule("vp", 4)
    noise = torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weight = torch.linspace(0.1, 0.4, 4, dtype=torch.float64).requires_grad_()
    start = torch.linspace(-1, 1, 6, dtype=torch.float64).view(2, 3).requires_grad_()

    def sample(weight: Tensor, start: Tensor) -> Tensor:
        return sampler(lambda x, step: weight[step - 1] * torch.sin(x), schedule, start, noise)

    assert torch.autograd.gradcheck(sample, (weight, start))


@given(st.floats(-(2.0**100), 2.0**100, width=32))
def test_straight_through_clamp_is_exact_and_its_gradient_never_leads_further_out(value: float) -> None:
    x = torch.tensor([value], requires_grad=True)
    out = straight_through_clamp(x)
    assert out.item() == min(max(value, -1.0), 1.0)
    for slope in (3.0, -3.0):
        (gradient,) = torch.autograd.grad(slope * out, x, retain_graph=True)
        outwards = abs(value) > 1 and slope * value < 0  # descent goes against the slope
        assert gradient.item() == (0.0 if outwards else slope)
    with torch.no_grad():
        assert straight_through_clamp(x).item() == out.item()


@given(
    st.sampled_from([ddpm_as("beta", clip_x0=True), ddpm_as("posterior", clip_x0=True), ddim_as(0.0, clip_x0=True)])
    | st.just(dpm_as(clip_x0=True)),
    st.sampled_from(NAMES),
    st.integers(1, 20),
    st.floats(-1e3, 1e3),
    st.booleans(),
)
def test_clipped_samples_end_in_the_box(
    sampler: Sampler, name: ScheduleName, steps: int, predicted: float, graph: bool
) -> None:
    schedule = make_schedule(name, steps)
    generator = torch.Generator().manual_seed(0)
    start = 10 * torch.randn(8, 3, generator=generator)
    noise = 10 * torch.randn(steps, 8, 3, generator=generator)
    with torch.set_grad_enabled(graph):
        out = sampler(lambda x, step: torch.full_like(x, predicted), schedule, start.requires_grad_(graph), noise)
    assert out.abs().max().item() <= 1


@pytest.mark.parametrize("clip", [False, True])
@given(st.sampled_from(NAMES), st.integers(1, 30), st.integers(0, 2**31))
def test_single_samples_against_one_at_a_time(clip: bool, name: ScheduleName, steps: int, seed: int) -> None:
    """add_noise, predict_x0 and denoising_loss: each sample has its own step."""
    schedule = make_schedule(name, steps)
    denoise, denoise_np = network(steps)
    _, alpha_bar = constants(reference_beta(name, steps))
    rng = np.random.default_rng(seed)
    x0, noise, step = rng.uniform(-1, 1, (6, 3)), rng.normal(size=(6, 3)), rng.integers(1, steps + 1, 6)
    args = schedule, torch.from_numpy(x0), torch.from_numpy(step), torch.from_numpy(noise)
    noised = add_noise(*args)
    estimate = predict_x0(schedule, noised, args[2], denoise(noised, args[2]), clip)
    loss = denoising_loss(denoise, *args)
    direct = predict_x0(schedule, noised, args[2], args[3], clip)
    assert loss.shape == (6, 3)
    for n in range(6):
        kept, i = alpha_bar[step[n]], int(step[n])
        x = np.sqrt(kept) * x0[n] + np.sqrt(1 - kept) * noise[n]
        predicted = denoise_np(x, i)
        guess = (x - np.sqrt(1 - kept) * predicted) / np.sqrt(kept)
        guess = np.clip(guess, -1, 1) if clip else guess
        np.testing.assert_allclose(noised[n].numpy(), x, atol=1e-6)
        np.testing.assert_allclose(estimate[n].numpy(), guess, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(loss[n].numpy(), (noise[n] - predicted) ** 2, atol=1e-5)
        np.testing.assert_allclose(direct[n].numpy(), x0[n], atol=1e-6)  # the true noise gives the data back


def test_a_clipped_estimate_passes_its_gradient_inwards() -> None:
    schedule = make_schedule("vp", 5)
    weight = torch.tensor(50.0, requires_grad=True)
    step = torch.tensor([1, 5])
    x = add_noise(schedule, torch.ones(2, 3), step, torch.ones(2, 3))
    out = predict_x0(schedule, x, step, weight * x, True)
    assert bool((out == -1).all())
    (inwards,) = torch.autograd.grad(-out.sum(), weight, retain_graph=True)
    assert inwards.item() > 0
    (outwards,) = torch.autograd.grad(out.sum(), weight)
    assert outwards.item() == 0


@pytest.mark.parametrize("step", [0, 6])
def test_step_outside_the_schedule_is_refused(step: int) -> None:
    with pytest.raises(IndexError):
        add_noise(make_schedule("vp", 5), torch.zeros(1, 3), torch.tensor([step]), torch.zeros(1, 3))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.parametrize("sampler", [ddpm_as("posterior", clip_x0=True), ddim_as(0.5), dpm_as()])
def test_dtype_follows_the_inputs(sampler: Sampler, dtype: torch.dtype) -> None:
    schedule = make_schedule("vp", 3)
    seen = set()

    def denoise(x: Tensor, step: Tensor | int) -> Tensor:
        if isinstance(step, int):
            seen.add((x.dtype, step))
        return 0.1 * x

    start = torch.ones(2, 3, dtype=dtype)
    noise = torch.ones(3, 2, 3, dtype=dtype)
    assert sampler(denoise, schedule, start, noise).dtype == dtype
    assert seen == {(dtype, 1), (dtype, 2), (dtype, 3)}
    assert add_noise(schedule, start, torch.tensor([1, 3]), noise[0]).dtype == dtype
    assert predict_x0(schedule, start, torch.tensor([1, 3]), noise[0], True).dtype == dtype


@pytest.mark.parametrize("sampler", [ddpm_as("beta", clip_x0=True), ddim_as(0.5, gradient_steps=2), dpm_as()])
def test_nothing_waits_for_the_device(sampler: Sampler) -> None:
    """Tensors on the meta device hold no values: reading one on the host raises."""
    schedule = make_schedule("vp", 3).to("meta")
    start, step = torch.empty(2, 3, device="meta"), torch.empty(2, dtype=torch.int64, device="meta")

    def denoise(x: Tensor, step: Tensor | int) -> Tensor:
        return x / torch.as_tensor(step, device="meta").reshape(-1, 1)

    assert sampler(denoise, schedule, start, torch.empty(3, 2, 3, device="meta")).shape == (2, 3)
    assert predict_x0(schedule, start, step, denoise(start, step), True).shape == (2, 3)
    assert denoising_loss(denoise, schedule, start, step, start).shape == (2, 3)


def test_bad_arguments_are_refused() -> None:
    schedule, start, noise = make_schedule("vp", 5), torch.zeros(2, 3), torch.zeros(5, 2, 3)
    denoise, _ = network(5)
    with pytest.raises(ValueError, match=r"^variance: 'learned' .* beta, posterior$"):
        ddpm(denoise, schedule, start, noise, variance="learned", clip_x0=True)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^noise: shape \(4, 2, 3\) .*\(5, 2, 3\)"):
        ddpm(denoise, schedule, start, noise[1:], variance="beta", clip_x0=True)
    with pytest.raises(ValueError, match=r"^noise: shape \(5, 1, 3\) .*\(5, 2, 3\)"):
        ddim(denoise, schedule, start, noise[:, :1], ddim_eta=0.5, clip_x0=True)
    with pytest.raises(ValueError, match=r"^noise: None .* ddim_eta 0.5"):
        ddim(denoise, schedule, start, None, ddim_eta=0.5, clip_x0=True)
    for ddim_eta in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=rf"^ddim_eta: {ddim_eta} .* 0 to 1$"):
            ddim(denoise, schedule, start, noise, ddim_eta=ddim_eta, clip_x0=True)
    for gradient_steps in (0, 6):
        with pytest.raises(ValueError, match=rf"^gradient_steps: {gradient_steps} .* 1 to 5"):
            ddpm(denoise, schedule, start, noise, variance="beta", clip_x0=True, gradient_steps=gradient_steps)
