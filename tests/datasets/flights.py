"""Flights to test with: a heuristic in the simulator, logged as an online learner logs itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavrl.datasets import ReplayLog, Transitions, transition_columns
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.environment import draw, random_positions
from uavrl.simulation.state import FlightAction, SimState


def small_scenario(devices: int = 3, max_steps: int = 12, **overrides: object) -> Scenario:
    return load_scenario("released", devices=devices, max_steps=max_steps, **overrides)


def fly(
    scenario: Scenario,
    *,
    environments: int = 3,
    steps: int = 40,
    seed: int = 0,
    layout: NDArray[np.float64] | None = None,
) -> Transitions:
    """Fly to the oldest device, with noise, in a few environments at once; the last episodes stay unfinished."""
    generator = np.random.default_rng(seed)
    count, devices = environments, scenario.traffic.devices
    log = ReplayLog(devices)
    episode = np.arange(count)
    layouts = random_positions(generator, (count, devices, 2), scenario)
    layouts = layouts if layout is None else np.broadcast_to(layout, layouts.shape)
    state = initial_state(random_positions(generator, (count, 2), scenario), devices)
    for _ in range(steps):
        oldest = state.age_s.argmax(axis=1)
        towards = layouts[np.arange(count), oldest] - state.position_m + generator.normal(0, 30, (count, 2))
        action = FlightAction(
            np.clip(towards, -scenario.airframe.max_displacement_m, scenario.airframe.max_displacement_m),
            np.where(generator.random(count) < 0.2, 0, oldest + 1),
        )
        after, outcome = advance(scenario, layouts, state, action, draw(generator, count))
        log.append(transition_columns(layouts, state, action, after, outcome, episode, state.step))
        done = outcome.terminated | outcome.truncated
        episode = np.where(done, episode.max() + np.cumsum(done), episode)
        fresh = initial_state(random_positions(generator, (count, 2), scenario), devices)
        if layout is None:
            new = random_positions(generator, (count, devices, 2), scenario)
            layouts = np.where(done[:, None, None], new, layouts)
        state = SimState(
            **{
                name: np.where(done[:, None] if value.ndim == 2 else done, getattr(fresh, name), value)
                for name, value in after._asdict().items()
            }
        )
    return log.to_transitions()
