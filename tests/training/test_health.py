from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from uavrl.training.health import Expected, complaints, summary

EXPECTED = Expected(q=(-300.0, 100.0), reward_deviation=1.0, bc_loss=1.0, gradient_clip=10.0)
COUNT = 60


def run(trials: tuple[float, ...] = (), **metrics: Callable[[np.ndarray], Any] | None) -> list[dict[str, Any]]:
    """A log as a healthy run of Diffusion-SAC writes it, but for what is said; a function of the time, 0 to 1."""
    noise = np.random.default_rng(0)
    time = np.arange(1, COUNT + 1) / COUNT
    shape: dict[str, Any] = {
        "q": lambda t: -8 * t + 20 * (1 - np.exp(-6 * t)) + 0.3 * noise.normal(size=COUNT),
        "bc_loss": lambda t: 0.5 + 0.1 * noise.normal(size=COUNT),
        "critic_gradient": lambda t: 3 + noise.random(COUNT),
        "actor_gradient": lambda t: 80 + 20 * noise.normal(size=COUNT),  # clipped throughout, as our default is
        "support_distance": lambda t: 0.05 + 0.1 * np.exp(-5 * t),
    }
    shape = {name: function for name, function in (shape | metrics).items() if function is not None}
    columns = {name: np.broadcast_to(function(time), COUNT).tolist() for name, function in shape.items()}
    rows: list[dict[str, Any]] = [
        {"step": 100 * (index + 1)} | {name: column[index] for name, column in columns.items()}
        for index in range(COUNT)
    ]
    for number, value in enumerate(trials, start=1):
        rows.append({"step": 100 * number * (COUNT // len(trials)), "return": value, "return_median": value})
    return sorted(rows, key=lambda row: row["step"])


def settled(level: float) -> Callable[[np.ndarray], Any]:
    return lambda t: level * (1 - np.exp(-9 * t)) + 0.2 * np.random.default_rng(1).normal(size=COUNT)


HEALTHY: dict[str, list[dict[str, Any]]] = {
    "as our default": run(q=settled(12.0), trials=(-400.0, -280.0, -275.0)),
    "a trial that is a little worse": run(q=settled(12.0), trials=(-400.0, -270.0, -290.0)),
    "no Q, no trials": run(q=None, critic_gradient=None),
    "a Q that stays where it began": run(q=lambda t: 0.3 * np.random.default_rng(2).normal(size=COUNT)),
    "a Q that settles slowly": run(
        q=lambda t: 12 * (1 - np.exp(-2.5 * t)) + 0.2 * np.random.default_rng(4).normal(size=COUNT)
    ),
    "a Q that creeps by less than rewards are told apart": run(q=lambda t: 0.3 * t),
    "gradients at rest but for some rows": run(q=settled(12.0), actor_gradient=lambda t: 80.0 * (np.arange(COUNT) % 3)),
    "far at the start only": run(q=settled(12.0), support_distance=lambda t: np.where(t < 0.7, 1.0, 0.1)),
    "a knowing actor that did not at first": run(q=settled(12.0), bc_loss=lambda t: np.where(t < 0.7, 1.5, 0.6)),
}

UNHEALTHY: dict[str, tuple[list[dict[str, Any]], str]] = {
    "predicts no noise": (run(q=settled(12.0), bc_loss=lambda t: 1.01), "bc_loss 1.01 is no better"),
    "above any return": (run(q=settled(150.0)), r"Q 150 is outside \[-300, 100\]"),
    "below any return": (run(q=lambda t: -900 * t), r"Q -8\d\d is outside"),
    "moves on": (run(q=lambda t: 20 * t + 0.3 * np.random.default_rng(3).normal(size=COUNT)), r"Q still moves, by \+3"),
    "moves on, downwards": (run(q=lambda t: -30 * t), "Q still moves, by -5"),
    "moves on after a turn": (run(q=lambda t: 10 * np.abs(t - 0.5)), "Q still moves"),
    "explodes": (run(q=settled(12.0), critic_gradient=lambda t: 3 * 10 ** (4 * t)), "critic_gradient .* hundred times"),
    "no gradient": (run(q=settled(12.0), actor_gradient=lambda t: 0.0), "actor_gradient is 0: nothing reaches"),
    "off the data": (run(q=settled(12.0), support_distance=lambda t: 0.1 + t), "actions are 1 of a longest move"),
    "worse than it was": (
        run(q=settled(12.0), trials=(-400.0, -270.0, -281.0, -310.0)),
        "trial return fell from -270 after 3,000 updates to -310",
    ),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_run_is_left_alone(name: str) -> None:
    assert complaints(HEALTHY[name], EXPECTED) == []
    assert summary(HEALTHY[name], EXPECTED).startswith("healthy: ")


@pytest.mark.parametrize("name", UNHEALTHY)
def test_what_is_wrong_is_said_and_nothing_else(name: str) -> None:
    rows, message = UNHEALTHY[name]
    (found,) = complaints(rows, EXPECTED)
    assert re.search(message, found), found
    line = summary(rows, EXPECTED)
    assert line == f"unhealthy: {found}"
    assert "\n" not in line


def test_several_faults_are_one_line() -> None:
    rows = run(bc_loss=lambda t: 2.0, actor_gradient=lambda t: 0.0, trials=(-100.0, -200.0))
    assert len(complaints(rows, EXPECTED)) == 3
    assert summary(rows, EXPECTED).count("; ") == 2


def test_a_healthy_summary_says_by_which_numbers() -> None:
    rows = run(q=settled(12.0), bc_loss=lambda t: 0.5, support_distance=lambda t: 0.06, trials=(-280.0, -275.5))
    line = summary(rows, EXPECTED)
    assert line.startswith("healthy: Q 1")
    assert line.endswith("bc_loss 0.5, distance to logged actions 0.06, trial return -275.5 (best -275.5)")


def test_what_is_no_measure_of_an_agent_is_not_judged() -> None:
    free = Expected(q=(-300.0, 100.0), reward_deviation=1.0, bc_loss=None, gradient_clip=None)
    rows = run(q=settled(12.0), bc_loss=lambda t: 4.0, critic_gradient=lambda t: 1e5)
    assert complaints(rows, free) == []


@pytest.mark.parametrize("seed", range(40))
def test_noise_alone_is_no_movement(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=COUNT)
    assert complaints(run(q=lambda t: 5.0 + noise), EXPECTED) == []
    assert complaints(run(q=lambda t: 5.0 * noise), EXPECTED) == []


def test_a_log_that_is_too_short_is_not_judged() -> None:
    rows = [row | {"bc_loss": 1.2} for row in run()]
    assert summary(rows[:9], EXPECTED) == "health unknown: 9 rows in the log, at least 10 are needed"
    assert summary([], EXPECTED).startswith("health unknown: 0 rows")
    assert summary(rows[:10], EXPECTED).startswith("unhealthy: bc_loss 1.2")


def test_a_number_that_was_not_finite_is_passed_over() -> None:
    rows = [row | {"q": None, "return": None} if "return" in row else row | {"q": None} for row in run(trials=(-3.0,))]
    assert complaints(rows, EXPECTED) == []
