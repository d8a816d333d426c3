"""The bounds: known values, brute force on small cases, tightness, and nothing simulated below them."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from tests.policies.flying import fly, layouts_and_starts
from uavrl.errors import ConfigError
from uavrl.evaluation.bounds import hover_age_bound_s, mean_age_bound_s, service_s, step_mean_age_bound_s
from uavrl.physics.channel import expected_service
from uavrl.policies import POLICIES, make_policy
from uavrl.scenario import PRESETS, Scenario

NONE = PRESETS["released"].replace(fading="none")
UNEQUAL: dict[str, Any] = {"devices": 4, "priority": (0.1, 0.4, 0.3, 0.2), "packet_bits": (2e6, 1e6, 2e6, 4e6)}


def test_known_values() -> None:
    np.testing.assert_allclose(mean_age_bound_s(NONE, [400.0, 80.0]), [0.640, 0.632], atol=5e-4)
    assert step_mean_age_bound_s(NONE, 400) == pytest.approx(0.558, abs=5e-4)
    assert service_s(NONE.replace(fading="ergodic"), 0.0)[0] == pytest.approx(0.1335, abs=5e-5)


def test_the_bound_over_time_is_the_best_split_of_services() -> None:
    """(1/2) sum delta T / (N + 1) at its best real N under sum N c <= T, by sampling the shares of time."""
    scenario = NONE.replace(**UNEQUAL)
    c, delta, T = service_s(scenario, 0.0), np.array(UNEQUAL["priority"]), 20.0
    assert c[3] == pytest.approx(4 * (c[1] - 0.02) + 0.02)
    counts = np.random.default_rng(0).dirichlet(np.ones(4), 300_000) * T / c
    best = (0.5 * T * delta / (counts + 1)).sum(axis=1).min()
    bound = float(mean_age_bound_s(scenario, T))
    assert bound <= best <= 1.005 * bound


@pytest.mark.parametrize("unequal", [{}, UNEQUAL])
def test_the_bound_over_steps_against_every_sequence(unequal: dict[str, Any]) -> None:
    """All sequences of six choices above devices in one place: the best of them is not below the bound, nor far."""
    scenario = NONE.replace(**(unequal or {"devices": 4}))
    c, delta = service_s(scenario, 0.0), np.array(scenario.traffic.priority_each)
    best = np.inf
    for sequence in itertools.product(range(5), repeat=6):
        age, total = np.zeros(4), 0.0
        for choice in sequence:
            age += c[choice - 1] if choice else 0.02
            if choice:
                age[choice - 1] = 0.0
            total += float(age @ delta)
        best = min(best, total / 6)
    bound = step_mean_age_bound_s(scenario, 6)
    assert bound <= best + 1e-12
    assert bound > 0.5 * best


@pytest.mark.parametrize("scenario", [NONE, NONE.replace(reward="per_second", max_steps=None, time_budget_s=80.0)])
def test_the_bounds_are_nearly_reached_where_all_devices_are_in_one_place(scenario: Scenario) -> None:
    layout = np.repeat(layouts_and_starts(scenario, 1, 1_000_000)[1][:, None], 10, axis=1)
    flown = fly(scenario, make_policy("tdm"), 1, layout_m=layout)
    elapsed = float(flown.time_s[0])
    assert 1.0 <= flown.time_age_s[0] / mean_age_bound_s(scenario, elapsed) < 1.02
    assert 1.0 <= flown.step_age_s[0] / step_mean_age_bound_s(scenario, int(flown.steps[0])) < 1.06


@pytest.mark.parametrize(
    "scenario",
    [
        PRESETS["released"].replace(fading="none", max_steps=100),
        PRESETS["released"].replace(fading="ergodic", max_steps=60),
        PRESETS["released"].replace(fading="none", max_steps=60, **UNEQUAL),
        PRESETS["realistic"].replace(fading="none", time_budget_s=15.0, min_idle_s=0.02),
    ],
    ids=["released", "ergodic", "unequal", "realistic"],
)
def test_nothing_simulated_is_below(scenario: Scenario) -> None:
    layout, start = layouts_and_starts(scenario, 6, 1_000_000)
    clustered = np.clip(start[:, None] + 0.02 * (layout - 500.0), 0.0, 1000.0)  # where the bounds bite
    for name, where in itertools.product(POLICIES, (layout, clustered)):
        flown = fly(scenario, make_policy(name), 6, layout_m=where)
        assert (flown.time_age_s >= mean_age_bound_s(scenario, flown.time_s)).all(), name
        steps = np.array([step_mean_age_bound_s(scenario, int(count)) for count in flown.steps])
        assert (flown.step_age_s >= steps).all(), name
        if name in ("tdm", "index", "saver"):  # those that never move
            assert (flown.time_age_s >= hover_age_bound_s(scenario, where, start, flown.time_s)).all(), name


LOSSY = PRESETS["realistic"].replace(time_budget_s=80.0)


@pytest.mark.parametrize(
    "scenario",
    [LOSSY, LOSSY.replace(fading="rayleigh", max_transmission_s=0.12)],
    ids=["rician, hardly a loss", "rayleigh, many lost"],
)
def test_under_fading_a_packet_the_mean_over_flights_is_not_below_nor_far(scenario: Scenario) -> None:
    start = layouts_and_starts(scenario, 40, 1_000_000)[1]
    above = np.repeat(start[:, None], 10, axis=1)
    flown = fly(scenario, make_policy("index"), 40, layout_m=above)
    bounds = mean_age_bound_s(scenario, flown.time_s)
    assert 1.0 <= (flown.time_age_s / bounds).mean() < 1.08
    assert (flown.time_age_s / mean_age_bound_s(scenario.replace(fading="none"), flown.time_s)).mean() > 1.0
    np.testing.assert_allclose(hover_age_bound_s(scenario, above, start, flown.time_s), bounds)


@pytest.mark.parametrize(("limit_s", "overhead"), [(0.1, False), (0.5, True)])
def test_under_fading_the_bound_counts_the_fastest_delivery_from_anywhere(limit_s: float, overhead: bool) -> None:
    """Overhead there is no luck: under a limit below the mean, fading farther away delivers more."""
    scenario, away_m = LOSSY.replace(max_transmission_s=limit_s), np.linspace(0.0, 300.0, 61)
    seconds, arrival = expected_service(away_m, np.full(61, 2e6), scenario.channel)
    delivery_s = (seconds + 0.02) / arrival
    np.testing.assert_allclose(service_s(scenario, away_m[:, None])[:, 0], delivery_s)
    least_s = 10 * delivery_s.min()
    assert (delivery_s.argmin() == 0) == overhead
    assert mean_age_bound_s(scenario, 50.0) == pytest.approx(
        25.0 * least_s / (50.0 + limit_s + 0.02 + least_s), rel=1e-3
    )


def test_hovering_above_everything_is_the_general_bound_and_farther_is_worse() -> None:
    layout = np.full((1, 10, 2), 300.0)
    above, beside = (hover_age_bound_s(NONE, layout, np.array([[x, 300.0]]), 100.0)[0] for x in (300.0, 500.0))
    assert above == pytest.approx(float(mean_age_bound_s(NONE, 100.0)))
    assert beside > 1.1 * above


def test_a_device_out_of_reach_is_as_old_as_the_flight() -> None:
    scenario = NONE.replace(devices=2, packet_bits=(2e6, 2e8), max_transmission_s=1.0)
    alone = float(mean_age_bound_s(NONE.replace(devices=1), 50.0))
    assert float(mean_age_bound_s(scenario, 50.0)) == pytest.approx(0.5 * alone + 0.5 * 25.0)
    never = NONE.replace(max_transmission_s=0.01)
    assert step_mean_age_bound_s(never, 10) == pytest.approx(0.02 * 5.5)


def test_a_device_that_hardly_ever_hears_hides_no_other_and_overflows_nothing() -> None:
    nine, one = LOSSY.replace(devices=9), LOSSY.replace(devices=10, packet_bits=(*[2e6] * 9, 1e10))
    assert float(mean_age_bound_s(one, 80.0)) == pytest.approx(0.9 * float(mean_age_bound_s(nine, 80.0)) + 4.0)
    far = LOSSY.replace(fading="rayleigh", max_transmission_s=0.1)
    layout = np.linspace(300.0, 1400.0, 45)[:, None, None] * np.array([1.0, 0.0]) + np.zeros((10, 1))
    bounds = hover_age_bound_s(far, layout, np.zeros((45, 2)), 50.0)
    assert (np.diff(bounds) >= -1e-9).all()
    assert bounds[-1] == pytest.approx(25.0)  # all as old as the flight


@pytest.mark.parametrize(
    ("overrides", "elapsed", "message"),
    [
        ({"fading": "rayleigh"}, 10.0, "channel.fading = 'rayleigh' without channel.max_transmission_s"),
        (
            {"fading": "rician", "max_transmission_s": 2.0, "rician_max_db": 30.0},
            10.0,
            "rician_max_db = 30: the bounds need",
        ),
        ({"decision_time": "measured"}, 10.0, "airframe.decision_time = 'measured'"),
        ({"max_age_s": 5.0}, 10.0, "elapsed_s = 10, allowed: at most traffic.max_age_s = 5"),
        ({}, 0.0, "elapsed_s = 0, allowed"),
    ],
)
def test_what_has_no_bound_is_refused(overrides: dict[str, Any], elapsed: float, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        mean_age_bound_s(NONE.replace(**overrides), elapsed)


def test_ages_after_each_step_have_no_bound_under_fading_a_packet() -> None:
    with pytest.raises(ConfigError, match=r"channel\.fading = 'rician': the bound a step needs"):
        step_mean_age_bound_s(LOSSY, 10)
