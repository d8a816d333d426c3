"""Environment steps a second: in a batch, through Gymnasium, and over the numbers of devices and environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch

from uavrl.benchmarks.timing import copied_bytes_per_s, rate
from uavrl.physics.arrays import Array
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.state import Draws, FlightAction, Outcome, SimState

BATCH = 8_192
SINGLE_ACTIONS = 512
SCALED_ENVIRONMENTS = (1, 10, 100, 1_000, 10_000, 100_000)  # with 10 devices
SCALED_DEVICES = (1, 10, 100, 1_000)  # with 1,000 environments


class Batch:
    """N environments that fly random actions on random layouts; `step` goes on from where the last one ended.

    Actions are drawn once, the fading anew at each step: it is the simulator's own work.
    """

    def __init__(self, scenario: Scenario, count: int, device: str | None = None) -> None:
        devices, area = scenario.traffic.devices, np.array([scenario.area.width_m, scenario.area.depth_m])
        generator = np.random.default_rng(0)
        reach_m = scenario.airframe.max_displacement_m
        arrays: list[Array] = [
            generator.random((count, devices, 2)) * area,
            generator.random((count, 2)) * area,
            generator.uniform(-reach_m, reach_m, (count, 2)),
            generator.integers(0, devices + 1, count),
        ]
        self.generator: Any = generator
        if device is not None:
            arrays = [torch.from_numpy(array).to(device) for array in arrays]
            arrays[:3] = [array.float() for array in arrays[:3]]
            self.generator = torch.Generator(device).manual_seed(0)
        self.scenario, self.layout_m, self.on = scenario, arrays[0], device
        self.state, self.action = initial_state(arrays[1], devices), FlightAction(arrays[2], arrays[3])

    def _draw(self) -> Draws:
        count = len(self.action.device)
        if self.on is None:
            return Draws(self.generator.standard_normal((count, 2)), self.generator.random(count))
        scatter = torch.randn((count, 2), generator=self.generator, device=self.on)
        return Draws(scatter, torch.rand((count,), generator=self.generator, device=self.on))

    def step(self) -> None:
        """Every environment once."""
        self.state, _ = advance(self.scenario, self.layout_m, self.state, self.action, self._draw())
        if self.on not in (None, "cpu"):
            torch.cuda.synchronize()


def step_bytes(scenario: Scenario) -> int:
    """Least memory traffic of one environment's step in float64: what goes in is read, what comes out written, once."""
    before, devices = np.zeros((1, 2)), scenario.traffic.devices
    state, action = initial_state(before, devices), FlightAction(before, np.ones(1, dtype=np.int64))
    draws = Draws(np.ones((1, 2)), np.ones(1))
    after, outcome = advance(scenario, np.zeros((1, devices, 2)), state, action, draws)

    def size(*parts: SimState | FlightAction | Draws | Outcome) -> int:
        fields = [part._asdict() if isinstance(part, FlightAction) else vars(part) for part in parts]
        return sum(int(np.asarray(value).nbytes) for values in fields for value in values.values())

    served_position = 2 * 8  # of the whole layout a step needs one device's place
    return size(state, action, draws, after, outcome) + served_position


class Returning(gymnasium.Env[Any, Any]):
    """An environment that does nothing: what Gymnasium's own loop and wrappers cost."""

    def __init__(self, like: gymnasium.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = like.observation_space, like.action_space
        self.observation, self.info = like.reset(seed=0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """The same each time."""
        return self.observation.copy(), self._info()

    def _info(self) -> dict[str, Any]:
        return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in self.info.items()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """The same each time."""
        return self.observation.copy(), 0.0, False, False, self._info()


class Single:
    """The registered environment, or one that does nothing in the same wrappers, with random actions."""

    def __init__(self, scenario: Scenario, *, nothing: bool = False) -> None:
        self.environment = gymnasium.make("uavrl/DataCollection-v0", scenario=scenario)
        if nothing:
            wrappers = (gymnasium.wrappers.PassiveEnvChecker, gymnasium.wrappers.OrderEnforcing)
            inner: gymnasium.Env[Any, Any] = Returning(self.environment.unwrapped)
            for wrapper in wrappers:
                inner = wrapper(inner)
            self.environment = inner
        self.environment.action_space.seed(0)
        self.actions = [self.environment.action_space.sample() for _ in range(SINGLE_ACTIONS)]
        self.environment.reset(seed=0)

    def fly(self) -> None:
        """Every action once, with a reset where an episode ends."""
        for action in self.actions:
            *_, terminated, truncated, _ = self.environment.step(action)
            if terminated or truncated:
                self.environment.reset()


def measure(seconds: float) -> dict[str, float]:
    """Steps a second of the batch and of the single environment, with their floors; the batch on a GPU if there is one.

    The batch's floor is the least memory traffic at the rate of a plain copy; the single environment's, Gymnasium's own
    loop around an environment that does nothing.
    """
    scenario = load_scenario("released")
    batch = Batch(scenario, BATCH)
    size = step_bytes(scenario)
    found = {
        "batch_steps_per_s": rate(batch.step, work=BATCH, seconds=seconds).per_s,
        "batch_steps_floor_per_s": copied_bytes_per_s(size * BATCH // 2) / size,
        "single_steps_per_s": rate(Single(scenario).fly, work=SINGLE_ACTIONS, seconds=seconds).per_s,
        "single_steps_floor_per_s": rate(
            Single(scenario, nothing=True).fly, work=SINGLE_ACTIONS, seconds=seconds
        ).per_s,
    }
    if torch.cuda.is_available():
        found["gpu_batch_steps_per_s"] = rate(Batch(scenario, BATCH, "cuda").step, work=BATCH, seconds=seconds).per_s
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
