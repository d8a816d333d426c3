"""Gymnasium environments around the one simulator: a single one and a native vector of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from uavrl.errors import ScenarioError
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.observations import (
    DEVICE_ENTRIES,
    ObservationKind,
    devices_observation,
    paper_observation,
)
from uavrl.simulation.state import Draws, FlightAction, Outcome, SimState

Float = NDArray[np.float64]
Observation = Any  # (N, K+3) array, or a dict of arrays, as the observation space says

ENVIRONMENT_ID = "uavrl/DataCollection-v0"  # registered in uavrl/__init__.py

_LARGEST = float(np.finfo(np.float32).max)

_Rows = TypeVar("_Rows", SimState, Outcome)


def check_layout(layout: ArrayLike, scenario: Scenario) -> Float:
    """Device positions as a (K, 2) float64 array (m).

    Raises:
        ScenarioError: wrong shape, not finite, or outside the area.
    """
    return _check_positions(layout, (scenario.traffic.devices, 2), "layout", scenario)


def _check_positions(values: ArrayLike, shape: tuple[int, ...], what: str, scenario: Scenario) -> Float:
    array = _numbers(values, what)
    if array.shape != shape:
        raise ScenarioError(f"{what} has shape {array.shape}, allowed: {shape} (x, y in metres)")
    size = np.array([scenario.area.width_m, scenario.area.depth_m])
    bad = ~np.isfinite(array) | (array < 0) | (array > size)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ScenarioError(f"{what}{list(index)} = {array[index]:g} lies outside the area 0..{size[index[-1]]:g} m")
    return array


def _numbers(values: ArrayLike, what: str) -> Float:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ScenarioError(f"{what} is no array of numbers, allowed: x and y in metres") from None


def check_action(action: Mapping[str, Any], lead: tuple[int, ...], scenario: Scenario) -> FlightAction:
    """The action as float64 (..., 2) and int64 (...) arrays, `lead` being the leading shape.

    Raises:
        ScenarioError: wrong shape, a displacement that is not finite, or a device that does not exist.
    """
    displacement_m, device = _numbers(action["displacement_m"], "displacement_m"), np.asarray(action["device"])
    count = scenario.traffic.devices
    if displacement_m.shape != (*lead, 2):
        raise ScenarioError(f"displacement_m has shape {displacement_m.shape}, allowed: {(*lead, 2)}")
    if device.shape != lead:
        raise ScenarioError(f"device has shape {device.shape}, allowed: {lead}")
    if not np.isfinite(displacement_m).all():
        raise ScenarioError(f"displacement_m = {_worst(displacement_m, ~np.isfinite(displacement_m))}, allowed: metres")
    if device.dtype.kind not in "iu":
        raise ScenarioError(f"device is of type {device.dtype}, allowed: integers, 0 (idle) to {count}")
    low, high = (device.min(), device.max()) if lead else (device, device)
    if low < 0 or high > count:
        raise ScenarioError(f"device = {_worst(device, (device < 0) | (device > count))}, allowed: 0 (idle) to {count}")
    return FlightAction(displacement_m, device.astype(np.int64, copy=False))


def check_reset(options: dict[str, Any] | None) -> dict[str, Any]:
    """The options of a reset.

    Raises:
        ScenarioError: one that does not exist.
    """
    options = options or {}
    unknown = set(options) - {"position_m", "layout"}
    if unknown:
        raise ScenarioError(f"reset option {sorted(unknown)[0]!r} does not exist, allowed: 'position_m', 'layout'")
    return options


def _worst(array: NDArray[Any], bad: NDArray[np.bool_]) -> str:
    return f"{array[bad].flat[0]:g}"


def random_positions(generator: np.random.Generator, shape: tuple[int, ...], scenario: Scenario) -> Float:
    """Uniform positions in the area, `shape` ending in 2 (m)."""
    positions: Float = generator.random(shape) * np.array([scenario.area.width_m, scenario.area.depth_m])
    return positions


def draw(generator: np.random.Generator, *count: int) -> Draws:
    """One step's randomness for `count` environments; without a count, of one, the same numbers as for a count of 1."""
    return Draws(scatter=generator.standard_normal((*count, 2)), sight=generator.random(count or None))


def observe(kind: ObservationKind, scenario: Scenario, layout_m: Float, state: SimState) -> Observation:
    """The float32 observation of `kind`: (..., K+3), or {"uav": (..., 4), "devices": (..., K, 6)}."""
    if kind == "paper":
        return paper_observation(state.position_m, state.age_s, state.energy_j).astype(np.float32)
    seen = devices_observation(scenario, layout_m, state.position_m, state.age_s, state.energy_j, state.used_j)
    return {"uav": seen.uav.astype(np.float32), "devices": seen.devices.astype(np.float32)}


def observation_space(kind: ObservationKind, scenario: Scenario) -> spaces.Space[Any]:
    """Space of one environment's observation.

    Raises:
        ScenarioError: `kind` is neither "paper" nor "devices".
    """
    width, depth = scenario.area.width_m, scenario.area.depth_m
    count, oldest = scenario.traffic.devices, scenario.traffic.max_age_s
    if kind == "paper":
        high = np.array([width, depth, *[oldest] * count, _LARGEST], dtype=np.float32)
        return spaces.Box(np.zeros_like(high), high, dtype=np.float32)
    if kind == "devices":
        uav = np.array([width, depth, _LARGEST, 1.0], dtype=np.float32)
        packet = max(scenario.traffic.packet_bits_each) / 1e6
        high = np.array([width, depth, oldest, count, packet, 1.0], dtype=np.float32)
        low = np.array([-width, -depth, 0.0, 0.0, 0.0, 0.0], dtype=np.float32)
        shape = (count, len(DEVICE_ENTRIES))
        return spaces.Dict(
            uav=spaces.Box(np.zeros_like(uav), uav, dtype=np.float32),
            devices=spaces.Box(np.broadcast_to(low, shape), np.broadcast_to(high, shape), dtype=np.float32),
        )
    raise ScenarioError(f"observation = {kind!r}, allowed: 'paper', 'devices'")


def action_space(scenario: Scenario) -> spaces.Dict:
    """Dict(displacement_m: Box(-d_max, d_max, (2,)), device: Discrete(K + 1)), device 0 being idle."""
    reach = scenario.airframe.max_displacement_m
    return spaces.Dict(
        displacement_m=spaces.Box(-reach, reach, (2,), dtype=np.float32),
        device=spaces.Discrete(scenario.traffic.devices + 1),
    )


def outcome_info(state: SimState, outcome: Outcome, layout_m: Float) -> dict[str, Any]:
    """The `info` of a step: every field of the outcome, ages, positions and clocks."""
    info = outcome._asdict() | {"age_s": state.age_s, "position_m": state.position_m, "layout_m": layout_m}
    return info | {"time_s": state.time_s, "step": state.step, "step_s": outcome.duration_s}


class DataCollectionVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """N environments advanced at once, from one generator; a finished one is reset by the next step.

    Args:
        num_envs: N.
        scenario: preset name, TOML file or Scenario.
        layout: (K, 2) or (N, K, 2) device positions (m); None draws a new layout at each reset.
        observation: "paper" (positions of devices unseen) or "devices".
        overrides: any scenario field, such as `fading="none"`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  # Gymnasium's own form

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Scenario = "released",
        layout: ArrayLike | None = None,
        observation: ObservationKind = "paper",
        render_mode: None = None,
        **overrides: Any,
    ) -> None:
        if num_envs < 1:
            raise ScenarioError(f"num_envs = {num_envs}, allowed: 1 or more")
        if render_mode is not None:
            raise ScenarioError(f"render_mode = {render_mode!r}: the vector environment has none, use the single one")
        self.scenario = load_scenario(scenario, **overrides)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.kind = observation
        self._fixed_layout = None if layout is None else self._layouts(layout)
        self.single_observation_space = observation_space(observation, self.scenario)
        self.single_action_space = action_space(self.scenario)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.layout_m = np.zeros((num_envs, self.scenario.traffic.devices, 2))
        self.state = initial_state(np.zeros((num_envs, 2)), self.scenario.traffic.devices)
        self._done = np.zeros(num_envs, dtype=bool)

    def _layouts(self, layout: ArrayLike) -> Float:
        array = _numbers(layout, "layout")
        if array.ndim == 3:
            if len(array) != self.num_envs:
                raise ScenarioError(f"layout has shape {array.shape}, allowed: (K, 2) or ({self.num_envs}, K, 2)")
            return np.stack([check_layout(one, self.scenario) for one in array])
        one = check_layout(array, self.scenario)
        return np.broadcast_to(one, (self.num_envs, *one.shape)).copy()

    def _restart(self, mask: NDArray[np.bool_], options: dict[str, Any] | None) -> None:
        """Reset the environments of `mask`; draws for all of them, so that streams do not depend on the mask."""
        options = check_reset(options)
        count, devices = self.num_envs, self.scenario.traffic.devices
        layout = random_positions(self.np_random, (count, devices, 2), self.scenario)
        position = random_positions(self.np_random, (count, 2), self.scenario)
        if options.get("layout") is not None:
            layout = self._layouts(options["layout"])
        elif self._fixed_layout is not None:
            layout = self._fixed_layout
        if options.get("position_m") is not None:
            wanted = _numbers(options["position_m"], "position_m")
            shape = (count, 2) if wanted.ndim > 1 else (2,)
            position = np.broadcast_to(_check_positions(wanted, shape, "position_m", self.scenario), (count, 2))
        self.layout_m = np.where(mask[:, None, None], layout, self.layout_m)
        self.state = _rows(mask, initial_state(position, devices), self.state)
        self._done = self._done & ~mask

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start N episodes. `options`: position_m (2,) or (N, 2), layout (K, 2) or (N, K, 2)."""
        if isinstance(seed, list):
            raise ScenarioError("seed is a list, allowed: one integer (the vector environment has one generator)")
        super().reset(seed=seed)
        self._restart(np.ones(self.num_envs, dtype=bool), options)
        info = {"age_s": self.state.age_s, "position_m": self.state.position_m, "layout_m": self.layout_m}
        return self.observation(), info

    def observation(self) -> Observation:
        """What `reset` and `step` last returned as observation."""
        return observe(self.kind, self.scenario, self.layout_m, self.state)

    def restore(self, state: SimState, layout_m: Float, done: NDArray[np.bool_]) -> None:
        """Go on from a saved state; `done` (N,) marks the environments that the next step resets."""
        self.state, self.layout_m, self._done = state, layout_m, done

    def step(self, actions: dict[str, Any]) -> Any:
        """Advance N environments; those that ended in the step before are reset instead, their outcome all 0."""
        return self._advance(check_action(actions, (self.num_envs,), self.scenario))

    def _advance(self, action: FlightAction) -> Any:
        before = self._done
        state, outcome = advance(self.scenario, self.layout_m, self.state, action, draw(self.np_random, self.num_envs))
        self.state = state
        if before.any():
            self._restart(before, None)
            outcome = _rows(before, Outcome(*map(np.zeros_like, outcome)), outcome)
        self._done = outcome.terminated | outcome.truncated
        info = outcome_info(self.state, outcome, self.layout_m)
        return self.observation(), outcome.reward, outcome.terminated, outcome.truncated, info


def _rows(mask: NDArray[np.bool_], chosen: _Rows, other: _Rows) -> _Rows:
    """The rows of `chosen` where `mask` (N,), else those of `other`."""
    merged = {
        name: np.where(mask[:, None] if value.ndim == 2 else mask, getattr(chosen, name), value)
        for name, value in other._asdict().items()
    }
    return type(other)(**merged)


class DataCollectionEnv(gymnasium.Env[Any, Any]):
    """One environment; arguments as `DataCollectionVectorEnv`. `render_mode="rgb_array"` draws the map.

    `info` holds, as floats and (K,) or (2,) arrays: age_s, rate_bps, snr, transmission_s, move_s, step_s, energy_j and
    its parts, device_energy_j, served, outage, and what else `Outcome` says.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # Gymnasium's own form

    def __init__(
        self,
        scenario: str | Scenario = "released",
        layout: ArrayLike | None = None,
        observation: ObservationKind = "paper",
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ScenarioError(f"render_mode = {render_mode!r}, allowed: none, 'rgb_array'")
        self.scenario = load_scenario(scenario, **overrides)
        self.render_mode = render_mode
        self.kind = observation
        self._fixed_layout = None if layout is None else check_layout(layout, self.scenario)
        self.observation_space = observation_space(observation, self.scenario)
        self.action_space = action_space(self.scenario)
        self.layout_m = np.zeros((self.scenario.traffic.devices, 2))
        self._start(np.zeros(2))

    def _start(self, position_m: Float) -> None:
        ages = np.zeros(self.scenario.traffic.devices)
        self.state = SimState(position_m, ages, energy_j=0.0, used_j=0.0, time_s=0.0, step=0)
        self._path_m, self._served = [position_m], 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode. `options`: position_m (2,), layout (K, 2)."""
        super().reset(seed=seed)
        wanted = check_reset(options)
        # both are drawn whatever is given, so that streams do not depend on it
        layout = random_positions(self.np_random, (self.scenario.traffic.devices, 2), self.scenario)
        position = random_positions(self.np_random, (2,), self.scenario)
        if wanted.get("layout") is not None:
            layout = check_layout(wanted["layout"], self.scenario)
        elif self._fixed_layout is not None:
            layout = self._fixed_layout
        if wanted.get("position_m") is not None:
            position = _check_positions(wanted["position_m"], (2,), "position_m", self.scenario)
        self.layout_m = layout.copy()
        self._start(position.copy())
        return self._observation(), self._kept({})

    def step(self, action: dict[str, Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fly and serve once."""
        wanted = check_action(action, (), self.scenario)
        served = int(wanted.device)
        self.state, outcome = advance(
            self.scenario, self.layout_m, self.state, wanted._replace(device=served), draw(self.np_random)
        )
        self._path_m.append(self.state.position_m)
        self._served = served
        info = self._kept(outcome_info(self.state, outcome, self.layout_m))
        return self._observation(), float(outcome.reward), outcome.terminated, outcome.truncated, info

    def _observation(self) -> Observation:
        return observe(self.kind, self.scenario, self.layout_m, self.state)

    def _kept(self, info: dict[str, Any]) -> dict[str, Any]:
        """`info` with copies of what the next step reads: what is handed out may be written to."""
        info["age_s"], info["position_m"] = self.state.age_s.copy(), self.state.position_m.copy()
        info["layout_m"] = self.layout_m.copy()
        return info

    def render(self) -> NDArray[np.uint8] | None:
        """The map with devices coloured by age, the trajectory and the served link, (H, W, 3)."""
        if self.render_mode is None:
            return None
        from uavrl.simulation.rendering import draw_frame  # here: matplotlib is slow to import

        frame: NDArray[np.uint8] = draw_frame(
            self.scenario, self.layout_m, np.array(self._path_m), self.state.age_s, self._served
        )
        return frame
