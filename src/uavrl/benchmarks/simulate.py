"""Environment steps a second: in a batch, through Gymnasium, and over the numbers of devices and environments."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch

from uavrl.benchmarks.timing import copied_bytes_per_s, rate
from uavrl.physics.arrays import Array
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.environment import DataCollectionVectorEnv
from uavrl.simulation.state import Draws, FlightAction, Outcome, SimState

BATCH = 8_192
ACTIONS = 16  # of each environment, in turn
EPISODE = 400
SINGLE_ACTIONS = 512
SCALED_ENVIRONMENTS = (1, 10, 100, 1_000, 10_000, 100_000)  # with 10 devices
SCALED_DEVICES = (1, 10, 100, 1_000)  # with 1,000 environments


class Batch:
    """N environments that fly random actions on random layouts, and start anew when their episodes end.

    The actions are a few that were drawn once, in turn; the fading is drawn at each step, as the simulator's own work.
    """

    def __init__(self, scenario: Scenario, count: int, device: str | None = None) -> None:
        devices, area = scenario.traffic.devices, np.array([scenario.area.width_m, scenario.area.depth_m])
        generator = np.random.default_rng(0)
        reach_m = scenario.airframe.max_displacement_m
        arrays: list[Array] = [
            generator.random((count, devices, 2)) * area,
            generator.random((count, 2)) * area,
            generator.uniform(-reach_m, reach_m, (ACTIONS, count, 2)),
            generator.integers(0, devices + 1, (ACTIONS, count)),
        ]
        self.generator: Any = generator
        if device is not None:
            arrays = [torch.from_numpy(array).to(device) for array in arrays]
            arrays[:3] = [array.float() for array in arrays[:3]]
            self.generator = torch.Generator(device).manual_seed(0)
        self.scenario, self.layout_m, self.on = scenario, arrays[0], device
        self.start, self.actions = initial_state(arrays[1], devices), FlightAction(arrays[2], arrays[3])
        self.state, self.steps = self.start, 0

    def _draw(self) -> Draws:
        count = len(self.layout_m)
        if self.on is None:
            return Draws(self.generator.standard_normal((count, 2)), self.generator.random(count))
        scatter = torch.randn((count, 2), generator=self.generator, device=self.on)
        return Draws(scatter, torch.rand((count,), generator=self.generator, device=self.on))

    def step(self) -> None:
        """Every environment once."""
        if self.steps == EPISODE:
            self.state, self.steps = self.start, 0
        turn = self.steps % ACTIONS
        action = FlightAction(self.actions.displacement_m[turn], self.actions.device[turn])
        self.state, _ = advance(self.scenario, self.layout_m, self.state, action, self._draw())
        self.steps += 1
        if self.on not in (None, "cpu"):
            torch.cuda.synchronize()


def step_bytes(scenario: Scenario) -> int:
    """Memory traffic of one environment's step in float64: what goes in is read, what comes out is written, once."""
    before, devices = np.zeros((1, 2)), scenario.traffic.devices
    state, action = initial_state(before, devices), FlightAction(before, np.ones(1, dtype=np.int64))
    draws = Draws(np.ones((1, 2)), np.ones(1))
    after, outcome = advance(scenario, np.zeros((1, devices, 2)), state, action, draws)

    def size(*parts: SimState | FlightAction | Draws | Outcome) -> int:
        return sum(int(np.asarray(value).nbytes) for part in parts for value in part)

    served_position = 2 * 8  # of the whole layout a step needs one device's place
    return size(state, action, draws, after, outcome) + served_position


class Returning(gymnasium.Env[Any, Any]):
    """An environment that does nothing: what Gymnasium's own loop and wrappers cost."""

    def __init__(self, like: gymnasium.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = like.observation_space, like.action_space
        observation, info = like.reset(seed=0)
        self.answers = itertools.cycle([(observation.copy(), 0.0, False, False, copy.deepcopy(info)) for _ in range(2)])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """What the real one answered, prebuilt; two in turn, since Gymnasium warns of one and the same object."""
        observation, *_, info = next(self.answers)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As `reset`."""
        return next(self.answers)


class Single:
    """The registered environment, or one that does nothing in the same wrappers, with random actions."""

    def __init__(self, scenario: Scenario, *, nothing: bool = False) -> None:
        self.environment = gymnasium.make("uavrl/DataCollection-v0", scenario=scenario)
        if nothing:
            checked = gymnasium.wrappers.PassiveEnvChecker(Returning(self.environment.unwrapped))
            self.environment = gymnasium.wrappers.OrderEnforcing(checked)
        self.environment.action_space.seed(0)
        self.actions = [self.environment.action_space.sample() for _ in range(SINGLE_ACTIONS)]
        self.environment.reset(seed=0)

    def fly(self) -> None:
        """Every action once, with a reset where an episode ends."""
        for action in self.actions:
            *_, terminated, truncated, _ = self.environment.step(action)
            if terminated or truncated:
                self.environment.reset()


def vector_environment(scenario: Scenario) -> Callable[[], Any]:
    """A step of the vector environment with random actions: observation, info and resets included."""
    environment = DataCollectionVectorEnv(BATCH, scenario)
    environment.action_space.seed(0)
    environment.reset(seed=0)
    turns = itertools.cycle([environment.action_space.sample() for _ in range(ACTIONS)])
    return lambda: environment.step(next(turns))


def measure(seconds: float) -> dict[str, float]:
    """Steps a second of a batch, of the vector environment and of the single one, with their floors.

    The floor of the first two is the memory traffic of arguments and results at the rate of a plain copy of that size;
    the single environment's is Gymnasium's own loop around an environment that does nothing. On a GPU, where there is
    one, the batch is measured without a floor.
    """
    scenario = load_scenario("released")
    size = step_bytes(scenario)
    memory = copied_bytes_per_s(size * BATCH // 2) / size
    alone = rate(Single(scenario, nothing=True).fly, work=SINGLE_ACTIONS, seconds=seconds)
    found = {
        **rate(Batch(scenario, BATCH).step, work=BATCH, seconds=seconds).named("batch_steps"),
        "batch_steps_floor_per_s": memory,
        **rate(vector_environment(scenario), work=BATCH, seconds=seconds).named("vector_steps"),
        "vector_steps_floor_per_s": memory,
        **rate(Single(scenario).fly, work=SINGLE_ACTIONS, seconds=seconds).named("single_steps"),
        "single_steps_floor_per_s": alone.per_s,
    }
    if torch.cuda.is_available():
        found |= rate(Batch(scenario, BATCH, "cuda").step, work=BATCH, seconds=seconds).named("gpu_batch_steps")
    return found


def scaling(seconds: float) -> list[dict[str, float]]:
    """Seconds of one batched step over N with 10 devices, and over K with 1,000 environments."""
    sizes = [(count, 10) for count in SCALED_ENVIRONMENTS] + [(1_000, devices) for devices in SCALED_DEVICES]
    rows = []
    for count, devices in dict.fromkeys(sizes):
        batch = Batch(load_scenario("released", devices=devices), count)
        found = rate(batch.step, seconds=seconds, repeats=3)
        rows.append({"environments": count, "devices": devices, "step_s": 1.0 / found.per_s})
    return rows
