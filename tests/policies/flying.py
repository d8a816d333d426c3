"""Fly a policy over random layouts; layouts, starts and draws come from the episode alone, so that flights pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavrl.physics.age import age_integral_s2
from uavrl.policies import Policy, SimulatorView
from uavrl.scenario import Scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.environment import random_positions
from uavrl.simulation.state import Draws

Float = NDArray[np.float64]
_BLOCK = 128


@dataclass(frozen=True)
class Flights:
    """What N flights came to, (N,) each."""

    returns: Float
    steps: Float
    time_s: Float
    step_age_s: Float  # weighted age after a step, averaged over steps
    time_age_s: Float  # weighted age averaged over time
    energy_j: Float


def layouts_and_starts(scenario: Scenario, episodes: int, seed: int) -> tuple[Float, Float]:
    """Random device positions (N, K, 2) and starts (N, 2)."""
    shape = (scenario.traffic.devices, 2)
    generators = [np.random.default_rng([seed, episode]) for episode in range(episodes)]
    layout = np.stack([random_positions(generator, shape, scenario) for generator in generators])
    return layout, np.stack([random_positions(generator, (2,), scenario) for generator in generators])


def fly(
    scenario: Scenario, policy: Policy, episodes: int, seed: int = 1_000_000, layout_m: Float | None = None
) -> Flights:
    """Fly `episodes` flights to their end."""
    layout, start = layouts_and_starts(scenario, episodes, seed)
    layout = layout if layout_m is None else layout_m
    generators = [np.random.default_rng([seed, 1, episode]) for episode in range(episodes)]
    own = np.random.default_rng(seed)
    priority = np.array(scenario.traffic.priority_each)
    state = initial_state(start, layout.shape[1])
    policy.reset(episodes)
    returns, steps, time_s, step_age, time_age, energy = np.zeros((6, episodes))
    live = np.ones(episodes, dtype=bool)
    step = 0
    while live.any():
        if step % _BLOCK == 0:
            scatter = np.stack([generator.standard_normal((_BLOCK, 2)) for generator in generators], axis=1)
            sight = np.stack([generator.random(_BLOCK) for generator in generators], axis=1)
        action = policy.act(SimulatorView(scenario, layout, state), generator=own)
        draws = Draws(scatter[step % _BLOCK], sight[step % _BLOCK])
        before = state
        state, outcome = advance(scenario, layout, state, action, draws)
        area = age_integral_s2(before.age_s, outcome.duration_s, scenario.traffic.max_age_s) @ priority
        returns += live * outcome.reward
        steps += live
        time_s += live * outcome.duration_s
        step_age += live * (state.age_s @ priority)
        time_age += live * area
        energy += live * outcome.energy_j
        live = live & ~(outcome.terminated | outcome.truncated)
        step += 1
    return Flights(returns, steps, time_s, step_age / steps, time_age / time_s, energy)
