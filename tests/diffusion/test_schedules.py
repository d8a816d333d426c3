"""Schedules against their published formulas, in NumPy float64."""

from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from tests.diffusion.reference import reference_beta
from uavrl.diffusion import Schedule, ScheduleName, make_schedule, schedule_from_beta, thinned

NAMES: tuple[ScheduleName, ...] = get_args(ScheduleName)
FIELDS = (
    "beta",
    "alpha",
    "alpha_bar",
    "alpha_bar_previous",
    "posterior_variance",
    "signal_scale",
    "noise_scale",
)
names = st.sampled_from(NAMES)
step_counts = st.integers(1, 200)


@given(names, step_counts)
def test_every_constant_is_its_formula(name: ScheduleName, steps: int) -> None:
    schedule = make_schedule(name, steps)
    beta = reference_beta(name, steps)
    alpha_bar = np.cumprod(1 - beta)
    previous = np.concatenate([[1.0], alpha_bar[:-1]])
    expected = {
        "beta": beta,
        "alpha": 1 - beta,
        "alpha_bar": alpha_bar,
        "alpha_bar_previous": previous,
        "posterior_variance": beta * (1 - previous) / (1 - alpha_bar),
        "signal_scale": np.sqrt(alpha_bar),
        "noise_scale": np.sqrt(1 - alpha_bar),
    }
    assert schedule.steps == steps
    for field in FIELDS:
        constant = getattr(schedule, field)
        assert constant.dtype == torch.float32
        np.testing.assert_allclose(constant.numpy(), expected[field], rtol=3e-7, err_msg=field)


@given(names, step_counts)
def test_signal_only_falls_and_noise_only_grows(name: ScheduleName, steps: int) -> None:
    schedule = make_schedule(name, steps)
    assert bool(((schedule.beta > 0) & (schedule.beta <= 0.999)).all())
    assert bool((schedule.beta.diff() >= 0).all())
    assert bool((schedule.alpha_bar.diff() < 0).all())
    assert bool((schedule.noise_scale.diff() >= 0).all())
    assert bool((schedule.posterior_variance <= schedule.beta).all())
    assert schedule.alpha_bar_previous[0] == 1
    assert schedule.posterior_variance[0] == 0


@given(step_counts)
def test_vp_ends_at_the_same_noise_for_every_number_of_steps(steps: int) -> None:
    assert make_schedule("vp", steps).alpha_bar[-1].item() == pytest.approx(0.0064, abs=2e-5)


@pytest.mark.parametrize(("steps", "left"), [(5, 0.951), (10, 0.904), (20, 0.817), (50, 0.603), (1000, 4.036e-5)])
def test_linear_leaves_most_of_the_signal_when_steps_are_few(steps: int, left: float) -> None:
    assert make_schedule("linear", steps).alpha_bar[-1].item() == pytest.approx(left, rel=1e-3)


@pytest.mark.parametrize("steps", [1, 2, 5, 10, 20, 50, 100])
def test_rescaled_linear_ends_in_noise(steps: int) -> None:
    assert make_schedule("linear_rescaled", steps).alpha_bar[-1].item() < 0.002


def test_rescaled_linear_is_linear_at_a_thousand_steps() -> None:
    torch.testing.assert_close(
        make_schedule("linear_rescaled", 1000).alpha_bar, make_schedule("linear", 1000).alpha_bar
    )


def test_small_noise_keeps_its_digits() -> None:
    """In float32 1 - alpha_bar would be 1.0133e-6 for beta = 1e-6: two digits."""
    schedule = schedule_from_beta(torch.tensor([1e-6, 1e-6]))
    np.testing.assert_allclose(schedule.noise_scale.numpy(), [1e-3, np.sqrt(2e-6 - 1e-12)], rtol=2e-7)


def test_to_moves_every_tensor() -> None:
    moved: Schedule = make_schedule("vp", 3).to("meta")
    assert {getattr(moved, field).device.type for field in FIELDS} == {"meta"}
    assert moved.steps == 3


def test_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^schedule: 'sigmoid' .* vp, cosine, linear, linear_rescaled$"):
        make_schedule("sigmoid", 5)  # type: ignore[arg-type]


@pytest.mark.parametrize("steps", [0, -3])
def test_no_steps_are_refused(steps: int) -> None:
    with pytest.raises(ValueError, match=rf"^steps: {steps} .* at least 1$"):
        make_schedule("vp", steps)


@given(names, step_counts, st.integers(1, 200))
@example("linear_rescaled", 10, 1)  # their betas round to 1
@example("linear_rescaled", 12, 2)
def test_steps_that_are_left_keep_their_noise(name: ScheduleName, steps: int, wanted: int) -> None:
    fewer = min(wanted, steps)
    schedule, kept = thinned(name, steps, fewer)
    assert (len(kept), kept[-1]) == (fewer, steps)
    assert min(np.diff([0, *kept])) >= 1
    every = make_schedule(name, steps)
    entries = torch.tensor(kept) - 1
    for field in ("alpha_bar", "signal_scale", "noise_scale"):
        np.testing.assert_allclose(getattr(schedule, field), getattr(every, field)[entries], rtol=3e-6, err_msg=field)


def test_steps_that_are_left_are_evenly_spaced() -> None:
    assert thinned("vp", 50, 5)[1] == [10, 20, 30, 40, 50]
    assert thinned("vp", 5, 1)[1] == [5]
    assert bool((thinned("vp", 7, 7)[0].beta == make_schedule("vp", 7).beta).all())
    for fewer in (0, 6):
        with pytest.raises(ValueError, match=f"steps: {fewer} is not allowed; allowed: 1 to 5"):
            thinned("vp", 5, fewer)
