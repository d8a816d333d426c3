"""The planner: its rollouts against the simulator, its choices against brute force, its flights against the others."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import wilcoxon

from tests.policies.flying import fly, layouts_and_starts
from uavrl.policies import POLICIES, SimulatorView, make_policy
from uavrl.policies.planner import Plan, Rollouts, _cheapest, better_plan, possible_actions
from uavrl.scenario import PRESETS, Scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.state import Draws, FlightAction, SimState

UNEQUAL: dict[str, Any] = {
    "devices": 4,
    "priority": (0.1, 0.4, 0.3, 0.2),
    "packet_bits": (2e6, 1e6, 2e6, 4e6),
}
# scenarios whose channel is its own mean, so that rollouts and simulator must agree
DETERMINISTIC = {
    "released": PRESETS["released"].replace(fading="ergodic", max_steps=60),
    "paper": PRESETS["paper"].replace(fading="none", max_steps=60),
    "realistic": PRESETS["realistic"].replace(fading="ergodic", time_budget_s=15.0),
    "clipped": PRESETS["realistic"].replace(fading="none", time_budget_s=15.0, max_age_s=1.5, **UNEQUAL),
    "clipped per step": PRESETS["released"].replace(fading="none", max_steps=50, max_age_s=1.5, **UNEQUAL),
    "battery": PRESETS["released"].replace(fading="none", energy_budget_j=60.0, **UNEQUAL),
    "lost": PRESETS["released"].replace(fading="none", max_steps=50, max_transmission_s=0.13, charge_idle_hover=True),
}


def some_plans(count: int, start_m: np.ndarray[Any, Any], generator: np.random.Generator) -> Plan:
    """Plans of every kind."""
    return Plan(
        wait=generator.integers(0, 3, count) * 7,
        target_m=np.where(np.arange(count)[:, None] % 3 > 0, generator.uniform(0, 1000, (count, 2)), start_m),
        stride_m=generator.choice([2.5, 10.0, 25.0], count),
        threshold_s=generator.choice([0.0, 0.5, 1.2, np.inf], count, p=[0.4, 0.3, 0.2, 0.1]),
        in_turn=generator.random(count) < 0.2,
    )


def simulated_cost(
    scenario: Scenario, layout: np.ndarray[Any, Any], state: SimState, plan: Plan, first: FlightAction | None, seed: int
) -> np.ndarray[Any, Any]:
    """Cost of following `plan` in the simulator itself."""
    rollouts, generator = Rollouts(scenario), np.random.default_rng(seed)
    count = len(layout)
    cost, live = np.zeros(count), np.ones(count, dtype=bool)
    while live.any():
        actions = possible_actions(rollouts, SimulatorView(scenario, layout, state), plan)
        action = FlightAction(actions.displacement_m[:, 0], actions.device[:, 0])
        if first is not None:
            action, first = first, None
        draws = Draws(generator.standard_normal((count, 2)), generator.random(count))
        state, outcome = advance(scenario, layout, state, action, draws)
        cost -= live * outcome.reward
        live = live & ~(outcome.terminated | outcome.truncated)
        plan = replace(plan, wait=np.maximum(plan.wait - 1, 0))
    return cost


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_rollouts_equal_the_simulator_where_nothing_is_random(name: str) -> None:
    scenario, generator = DETERMINISTIC[name], np.random.default_rng(2)
    layout, start = layouts_and_starts(scenario, 24, 3)
    state = initial_state(start, scenario.traffic.devices)
    state = state._replace(age_s=generator.uniform(0, 1.4, state.age_s.shape), step=np.full(24, 5))
    plan = some_plans(24, start, generator)
    tolerance = 1e-2 if name == "lost" else 1e-3  # the tables blur the edge of the range
    rolled = Rollouts(scenario).cost(layout, state, plan)
    np.testing.assert_allclose(rolled, simulated_cost(scenario, layout, state, plan, None, 0), rtol=tolerance)
    hop = np.clip(start + generator.uniform(-15, 15, (24, 2)), 1.0, 999.0) - start
    first = FlightAction(hop, generator.integers(0, scenario.traffic.devices + 1, 24))
    rolled = Rollouts(scenario).cost(layout, state, plan, first)
    np.testing.assert_allclose(rolled, simulated_cost(scenario, layout, state, plan, first, 0), rtol=tolerance)


def test_rollouts_are_the_mean_over_lost_packets() -> None:
    """Round robin where many packets are lost: choices do not depend on ages, so means must agree."""
    scenario = PRESETS["realistic"].replace(max_transmission_s=0.25, reward="per_step", max_steps=80)
    layout, start = (np.repeat(values, 100, axis=0) for values in layouts_and_starts(scenario, 1, 8))
    state = initial_state(start, 10)
    in_turn = Plan(np.zeros(100, dtype=np.int64), start, np.ones(100), np.zeros(100), np.ones(100, dtype=bool))
    sampled = simulated_cost(scenario, layout, state, in_turn, None, 1)
    rolled = Rollouts(scenario).cost(layout, state, in_turn)[0]
    error = sampled.std() / 10.0
    assert abs(rolled - sampled.mean()) < 4.0 * error
    certain = Rollouts(scenario.replace(max_transmission_s=None)).cost(layout, state, in_turn)[0]
    assert abs(certain - sampled.mean()) > 8.0 * error  # without losses it is another number


@pytest.mark.parametrize("preset", ["released", "paper"])
def test_the_planner_comes_near_the_best_of_all_sequences(preset: str) -> None:
    """Two devices, seven steps, nowhere to fly to: against all 3^7 sequences of services and idling."""
    scenario = PRESETS[preset].replace(fading="none", devices=2, max_steps=7, max_displacement_m=1e-6)
    layout, start = layouts_and_starts(scenario, 1, 4)
    sequences = np.array(list(itertools.product(range(3), repeat=7)))
    count = len(sequences)
    state = initial_state(np.repeat(start, count, axis=0), 2)._replace(age_s=np.full((count, 2), 2.0))
    total = np.zeros(count)
    for step in range(7):
        action = FlightAction(np.zeros((count, 2)), sequences[:, step])
        draws = Draws(np.zeros((count, 2)), np.zeros(count))
        state, outcome = advance(scenario, np.repeat(layout, count, axis=0), state, action, draws)
        total += outcome.reward
    planner, state, reached = make_policy("planner"), initial_state(start, 2)._replace(age_s=np.full((1, 2), 2.0)), 0.0
    planner.reset(1)
    for _ in range(7):
        action = planner.act(SimulatorView(scenario, layout, state), generator=np.random.default_rng(0))
        state, outcome = advance(scenario, layout, state, action, Draws(np.zeros((1, 2)), np.zeros(1)))
        reached += float(outcome.reward[0])
    assert -reached <= 1.02 * -total.max()
    assert total.max() > np.sort(total)[-100] + 1e-3  # the best is not one of many alike


@pytest.mark.parametrize("name", ["released", "paper", "realistic", "clipped", "battery"])
def test_no_heuristic_beats_the_planner_in_any_flight_without_randomness(name: str) -> None:
    scenario = DETERMINISTIC[name]
    planner = fly(scenario, make_policy("planner"), 8).returns
    for other in sorted(set(POLICIES) - {"planner", "random_walk"}):
        gain = planner - fly(scenario, make_policy(other), 8).returns
        assert (gain >= -1e-4 * np.abs(planner)).all(), other  # the table's rounding
    hover = fly(scenario, make_policy("hover"), 8).returns
    assert (planner - hover).mean() > 0.005 * np.abs(planner).mean()


def test_the_planner_minimises_the_scenarios_own_objective() -> None:
    """Energy alone: it never moves nor serves. Age alone: it does."""
    only_energy = PRESETS["released"].replace(age_weight=0.0, max_steps=30)
    assert fly(only_energy, make_policy("planner"), 4).energy_j.tolist() == [0.0] * 4
    only_age = PRESETS["released"].replace(age_weight=1.0, max_steps=80)
    assert (fly(only_age, make_policy("planner"), 4).energy_j > 0.0).all()


def test_the_present_plan_wins_ties() -> None:
    """Where energy alone counts, to idle is free whatever one waits for or strides with: nothing changes."""
    scenario = PRESETS["released"].replace(age_weight=0.0)
    layout, start = layouts_and_starts(scenario, 3, 5)
    view = SimulatorView(scenario, layout, initial_state(start, 10))
    plan = Plan(np.full(3, 3), start, np.full(3, 7.0), np.full(3, np.inf), np.zeros(3, dtype=bool))
    kept = better_plan(Rollouts(scenario), view, plan)
    for field in vars(plan):
        np.testing.assert_array_equal(getattr(kept, field), getattr(plan, field))
    costs = np.array([[1.0, 1.0, 1.0 - 1e-12], [1.0, 0.5, 0.5], [2.0, 2.0, 1.9]])
    assert _cheapest(costs).tolist() == [0, 1, 2]


def test_a_flight_does_not_depend_on_its_batch() -> None:
    scenario = PRESETS["released"].replace(max_steps=40)
    layout, _ = layouts_and_starts(scenario, 4, 1_000_000)
    whole = fly(scenario, make_policy("planner"), 4).returns
    first = fly(scenario, make_policy("planner"), 2, layout_m=layout[:2]).returns
    np.testing.assert_allclose(whole[:2], first, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("preset", list(PRESETS))
def test_the_planner_beats_every_heuristic_on_each_preset(preset: str) -> None:
    """100 random layouts, paired over equal draws: in the mean, and by rank, for a rare deep fade sways the mean."""
    scenario = PRESETS[preset]
    planner = fly(scenario, make_policy("planner"), 100).returns
    for other in sorted(set(POLICIES) - {"planner"}):
        gain = planner - fly(scenario, make_policy(other), 100).returns
        assert gain.mean() > 0.0, other
        assert wilcoxon(gain, alternative="greater").pvalue < 1e-4, other
