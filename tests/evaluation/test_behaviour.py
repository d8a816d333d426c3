from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.evaluation.flying import Scripted
from uavrl.datasets.transitions import Transitions, transition_columns
from uavrl.errors import DatasetError
from uavrl.evaluation.behaviour import behaviour
from uavrl.evaluation.metrics import flight_metrics
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.state import Draws, FlightAction


def flown(scenario: Scenario, episodes: int) -> tuple[Transitions, dict[str, Any]]:
    """Whole flights of one policy as transitions, and the metrics of the same flights; fading none."""
    environments = evaluation_set(scenario, "random", episodes)
    policy = Scripted((1, 2, 0, 3), (3.0, 1.0))
    metrics = flight_metrics(fly(policy, environments))
    state, rows = initial_state(environments.start_m, scenario.traffic.devices), []
    active = np.ones(episodes, dtype=bool)
    draws = Draws(np.ones((episodes, 2)), np.zeros(episodes))
    step = 0
    while active.any():
        device = np.full(episodes, (1, 2, 0, 3)[step % 4])
        action = FlightAction(np.tile((3.0, 1.0), (episodes, 1)), device)
        after, outcome = advance(scenario, environments.layout_m, state, action, draws)
        numbers = np.arange(episodes), np.full(episodes, step)
        columns = transition_columns(environments.layout_m, state, action, after, outcome, *numbers)
        rows.append({name: values[active] for name, values in columns.items()})
        active = active & ~(outcome.terminated | outcome.truncated)
        state, step = after, step + 1
    joined = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    return Transitions(**joined), metrics


@pytest.mark.parametrize("preset", ["paper", "released", "realistic"])
def test_whole_flights_of_one_length_tell_their_own_metrics(preset: str) -> None:
    scenario = load_scenario(preset, fading="none", devices=3, max_steps=30, max_transmission_s=None)
    transitions, metrics = flown(scenario, 5)
    found = behaviour(transitions, scenario, seed=0)
    for name in ("return", "age_per_step_s", "energy_per_step_j", "energy_per_episode_j", "steps", "duration_s"):
        assert found[name].point == pytest.approx(metrics[name].mean(), rel=1e-5), name
    longest = metrics["age_per_second_s"] @ metrics["duration_s"] / metrics["duration_s"].sum()
    assert found["age_per_second_s"].point == pytest.approx(longest, rel=1e-5)


def test_a_seeded_part_of_the_rows_tells_about_the_same() -> None:
    scenario = load_scenario("released", fading="none", devices=3, max_steps=60)
    transitions, metrics = flown(scenario, 40)
    kept = np.random.default_rng(0).random(len(transitions)) < 0.3
    found = behaviour(transitions.take(kept), scenario, seed=0)
    mean, low, high = found["return"].interval()
    assert mean == pytest.approx(metrics["return"].mean(), rel=0.1)
    assert low < metrics["return"].mean() < high
    assert found["steps"].point == 60


def test_lengths_come_from_the_episodes_whose_end_is_there() -> None:
    scenario = load_scenario("released", fading="none", devices=3, max_steps=60, time_budget_s=12.0)
    transitions, metrics = flown(scenario, 8)
    lengths = metrics["steps"]
    assert len(set(lengths)) > 1
    ends = transitions.truncated & (transitions.episode < 3)
    early = transitions.step < 5
    found = behaviour(transitions.take(ends | early), scenario, seed=0)
    assert found["steps"].point == pytest.approx(lengths[:3].mean())
    assert behaviour(transitions.take(early), scenario, seed=0)["steps"].point == 5


def test_rewards_are_those_of_the_scenario_that_rates_them() -> None:
    scenario = load_scenario("released", fading="none", devices=3, max_steps=30)
    transitions, _ = flown(scenario, 4)
    own = behaviour(transitions, scenario, seed=0)
    assert own["return"].point == pytest.approx(transitions.reward.mean() * 30, rel=1e-5)
    energy_only = behaviour(transitions, scenario.replace(age_weight=0.0), seed=0)
    assert energy_only["return"].point == pytest.approx(-own["energy_per_episode_j"].point / 1000)


def test_intervals_are_over_episodes_not_rows() -> None:
    scenario = load_scenario("released", fading="none", devices=3, max_steps=30)
    transitions, metrics = flown(scenario, 30)
    _, low, high = behaviour(transitions, scenario, seed=0)["return"].interval()
    spread = metrics["return"].std() / np.sqrt(30)
    assert high - low == pytest.approx(2 * 1.96 * spread, rel=0.2)


def test_data_of_another_number_of_devices_is_refused() -> None:
    scenario = load_scenario("released", fading="none", devices=3, max_steps=5)
    transitions, _ = flown(scenario, 2)
    with pytest.raises(DatasetError, match="3 devices, the scenario 10"):
        behaviour(transitions, load_scenario("released"), seed=0)
    with pytest.raises(DatasetError, match="0 rows"):
        behaviour(transitions.take(slice(0, 0)), scenario, seed=0)
