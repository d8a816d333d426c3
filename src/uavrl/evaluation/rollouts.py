"""Fly policies on equal layouts, starts and fading draws, all flights of a policy in one batch.

What a flight meets depends on the evaluation set alone: episode i's layout and start come from (seed, i), the draws of
its fading repeat f from (seed, i, f, step). So every policy meets the same, whatever it does, whichever flies first.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavrl.errors import ConfigError, ScenarioError
from uavrl.evaluation.episode import Episode
from uavrl.policies.base import Policy, SimulatorView
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.environment import check_layout, observe, random_positions
from uavrl.simulation.state import Draws, FlightAction, Outcome, SimState

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

EVALUATION_SEED = 1_000_000  # training's seeds stay below
TRIAL_SEED = 500_000  # flights for choosing settings: neither the data's seeds nor the evaluation's

_BLOCK = 64  # steps whose draws are made at once
_LATENCY_CALLS, _LATENCY_SECONDS = 50, 2.0


@dataclass(frozen=True)
class EvaluationSet:
    """E environments, each flown under F fading repeats: N = E F flights, flight n being (n // F, n % F)."""

    scenario: Scenario
    layouts: str  # "fixed", "random" or the file's name
    layout_m: Float  # (E, K, 2)
    start_m: Float  # (E, 2)
    unit: NDArray[np.int64]  # (E,) which independent unit an environment belongs to: what the bootstrap resamples
    seed: int
    fading_seeds: int
    first: int = 0  # index of environment 0: what its draws are made from

    def only(self, episode: int) -> EvaluationSet:
        """Environment `episode` alone, under the draws that it has in the whole set."""
        one = slice(episode, episode + 1)
        return replace(
            self,
            layout_m=self.layout_m[one],
            start_m=self.start_m[one],
            unit=np.zeros(1, dtype=np.int64),
            first=self.first + episode,
        )

    def equals(self, other: EvaluationSet) -> bool:
        """Whether flights on both meet the same layouts, starts and draws under the same scenario."""
        settings = ("scenario", "seed", "fading_seeds", "first")
        return all(getattr(self, name) == getattr(other, name) for name in settings) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in ("layout_m", "start_m")
        )

    @property
    def episodes(self) -> int:
        """E."""
        return len(self.start_m)

    @property
    def flights(self) -> int:
        """N."""
        return self.episodes * self.fading_seeds

    def draws(self, block: int, wanted: Bool) -> Draws:
        """Randomness of 64 steps from step 64 `block`: scatter (64, N, 2), sight (64, N); 1 and 0 unless `wanted`."""
        scatter, sight = np.ones((_BLOCK, self.flights, 2)), np.zeros((_BLOCK, self.flights))
        for flight in np.flatnonzero(wanted):
            episode, repeat = divmod(int(flight), self.fading_seeds)
            # both counted from 1: a seed sequence takes (seed, i) and (seed, i, 0) for the same
            generator = np.random.default_rng((self.seed, self.first + episode, 1 + repeat, 1 + block))
            scatter[:, flight] = generator.standard_normal((_BLOCK, 2))
            sight[:, flight] = generator.random(_BLOCK)
        return Draws(scatter=scatter, sight=sight)


def fixed_layout(scenario: Scenario) -> Float:
    """The one layout of "fixed", (K, 2) m: `numpy.random.default_rng(0).uniform(0, 1000, (10, 2))` for 10 devices."""
    return random_positions(np.random.default_rng(0), (scenario.traffic.devices, 2), scenario)


def evaluation_set(
    scenario: str | Scenario = "released",
    layouts: str | Path = "random",
    episodes: int = 100,
    *,
    seed: int = EVALUATION_SEED,
    fading_seeds: int = 1,
) -> EvaluationSet:
    """Draw the environments that policies are judged on.

    Args:
        scenario: preset, TOML file or Scenario.
        layouts: "fixed" (one layout, other starts), "random" (a new layout an episode) or a JSON file with a list of
            K x 2 layouts, episode i flying layout i mod n.
        episodes: E.
        seed: the environments' and the draws' seed.
        fading_seeds: F, how often each environment is flown, under other draws.

    Raises:
        ScenarioError: a layout that cannot be flown, or a scenario whose flights may never end.
        ConfigError: `episodes`, `fading_seeds` or `seed` out of range.
    """
    scenario = load_scenario(scenario)
    for name, value in (("episodes", episodes), ("fading_seeds", fading_seeds)):
        if value < 1:
            raise ConfigError(f"{name} = {value}, allowed: 1 or more")
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed = {seed}, allowed: 0 to {2**32 - 1}")
    frame = scenario.airframe
    if scenario.limits.max_steps is None and max(frame.decision_s, frame.min_idle_s) == 0:
        raise ScenarioError(
            "limits.max_steps = none needs airframe.decision_s or min_idle_s > 0: flights may never end"
        )
    layout_m, start_m = np.empty((episodes, scenario.traffic.devices, 2)), np.empty((episodes, 2))
    for i in range(episodes):
        generator = np.random.default_rng((seed, i))
        layout_m[i] = random_positions(generator, (scenario.traffic.devices, 2), scenario)
        start_m[i] = random_positions(generator, (2,), scenario)
    unit = np.arange(episodes)
    if layouts == "fixed":
        layout_m[:] = fixed_layout(scenario)
    elif layouts != "random":
        listed = read_layouts(Path(layouts), scenario)
        layout_m = listed[unit % len(listed)]
        if len(listed) > 1:  # with one layout, as with "fixed", the starts are what varies
            unit = unit % len(listed)
    return EvaluationSet(scenario, str(layouts), layout_m, start_m, unit, seed, fading_seeds)


def read_layouts(path: Path, scenario: Scenario) -> Float:
    """Layouts (n, K, 2) in metres from a JSON list of K x 2 lists.

    Raises:
        ScenarioError: the file cannot be read, is no such list, or holds a layout that does not fit the scenario.
    """
    try:
        listed = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror
        raise ScenarioError(f"layouts '{path}' is not 'fixed', 'random' or a file that can be read: {reason}") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"layouts file '{path}' is not valid JSON: {error}") from None
    devices = scenario.traffic.devices
    if not isinstance(listed, list) or not listed:
        raise ScenarioError(f"layouts file '{path}' holds no list, allowed: a list of {devices} x 2 layouts in metres")
    checked = []
    for index, layout in enumerate(listed):
        try:
            checked.append(check_layout(layout, scenario))
        except ScenarioError as error:
            raise ScenarioError(f"layouts file '{path}', layout {index}: {error}") from None
    return np.stack(checked)


@dataclass(frozen=True)
class Flights:
    """What one policy did on an evaluation set. S steps of the longest flight, N flights, K devices.

    Rows after a flight's end are masked by `active`; positions, ages and clocks stay there as they ended.
    """

    policy: str
    evaluation_set: EvaluationSet
    active: Bool  # (S, N) the flight had not ended before this step
    position_m: Float  # (S + 1, N, 2), row t is before step t
    age_s: Float  # (S + 1, N, K)
    time_s: Float  # (S + 1, N)
    device: NDArray[np.int64]  # (S, N) commanded, 0 = idle
    reward: Float  # (S, N)
    duration_s: Float  # (S, N)
    transmission_s: Float  # (S, N)
    energy_j: Float  # (S, N)
    device_energy_j: Float  # (S, N)
    bits: Float  # (S, N)
    served: Bool  # (S, N)
    outage: Bool  # (S, N)
    latency_s: Float  # (calls,) measured time of a decision for one flight

    @property
    def steps(self) -> NDArray[np.int64]:
        """(N,) length of each flight."""
        steps: NDArray[np.int64] = self.active.sum(axis=0, dtype=np.int64)
        return steps

    def episode(self, flight: int) -> Episode:
        """Flight n, cut where it ended."""
        steps = int(self.steps[flight])
        return Episode(
            policy=self.policy,
            scenario=self.evaluation_set.scenario,
            layout_m=self.evaluation_set.layout_m[flight // self.evaluation_set.fading_seeds],
            position_m=self.position_m[: steps + 1, flight],
            age_s=self.age_s[: steps + 1, flight],
            time_s=self.time_s[: steps + 1, flight],
            device=self.device[:steps, flight],
            served=self.served[:steps, flight],
            energy_j=self.energy_j[:steps, flight],
            reward=self.reward[:steps, flight],
        )


_RECORDED = (
    "reward", "duration_s", "transmission_s", "energy_j", "device_energy_j", "bits", "served", "outage",
)  # fmt: skip


def fly(
    policy: Policy,
    environments: EvaluationSet,
    *,
    name: str | None = None,
    deterministic: bool = False,
    show_progress: bool = False,
) -> Flights:
    """Fly every flight of the set to its end.

    Args:
        policy: what decides; it is reset first.
        environments: what is flown.
        name: what the flights are filed under, the policy's own name if None.
        deterministic: ask the policy for its deterministic action.
        show_progress: a bar on stderr where that is a terminal.

    Raises:
        ConfigError: the policy's `needs` is unknown, or its action has a wrong shape or value.
    """
    name = name or policy.name
    scenario, count = environments.scenario, environments.flights
    latency_s = measure_latency(policy, environments, deterministic=deterministic)
    charged = np.full(count, latency_s.mean()) if scenario.airframe.decision_time == "measured" else None
    layout_m = np.repeat(environments.layout_m, environments.fading_seeds, axis=0)
    state = initial_state(np.repeat(environments.start_m, environments.fading_seeds, axis=0), layout_m.shape[1])
    # five words: no draw's seed is as long
    generator = np.random.default_rng((environments.seed, 0, 0, 0, 1))
    active = np.ones(count, dtype=bool)
    states: list[SimState] = [state]
    outcomes: list[Outcome] = []
    devices: list[NDArray[np.int64]] = []
    masks: list[Bool] = []
    policy.reset(count)
    with _progress(show_progress) as bar:
        task = bar.add_task(name, total=1.0, rate="")
        began, flown = time.perf_counter(), 0
        while active.any():
            step = len(masks)
            if step % _BLOCK == 0:
                block = environments.draws(step // _BLOCK, active)
            draws = Draws(scatter=block.scatter[step % _BLOCK], sight=block.sight[step % _BLOCK])
            action = _decide(policy, scenario, layout_m, state, generator, deterministic)
            after, outcome = advance(scenario, layout_m, state, action, draws, charged)
            state = _keep_ended(state, after, active)
            states.append(state)
            outcomes.append(outcome)
            devices.append(action.device)
            masks.append(active)
            active = active & ~(outcome.terminated | outcome.truncated)
            flown += int(masks[-1].sum())
            rate = f"{flown / (time.perf_counter() - began):,.0f} steps/s"
            bar.update(task, completed=_share_done(scenario, state, active), rate=rate)
    return _flights(name, environments, states, outcomes, devices, masks, latency_s)


def _flights(
    name: str,
    environments: EvaluationSet,
    states: list[SimState],
    outcomes: list[Outcome],
    devices: list[NDArray[np.int64]],
    masks: list[Bool],
    latency_s: Float,
) -> Flights:
    recorded: dict[str, Any] = {
        field: np.stack([getattr(outcome, field) for outcome in outcomes]) for field in _RECORDED
    }
    return Flights(
        policy=name,
        evaluation_set=environments,
        active=np.stack(masks),
        position_m=np.stack([state.position_m for state in states]),
        age_s=np.stack([state.age_s for state in states]),
        time_s=np.stack([state.time_s for state in states]),
        device=np.stack(devices),
        latency_s=latency_s,
        **recorded,
    )


def measure_latency(policy: Policy, environments: EvaluationSet, *, deterministic: bool = False) -> Float:
    """Time of `act` for a single flight (calls,) in seconds, over the first steps of flight 0, warm-up left out."""
    scenario = environments.scenario
    layout_m, state = environments.layout_m[:1], initial_state(environments.start_m[:1], scenario.traffic.devices)
    generator = np.random.default_rng((environments.seed, 0, 0, 0, 2))
    wanted = np.arange(environments.flights) == 0
    block = environments.draws(0, wanted)
    times: list[float] = []
    policy.reset(1)
    for call in range(2 + _LATENCY_CALLS):
        seen = observation_for(policy, scenario, layout_m, state)
        began = time.perf_counter()
        action = policy.act(seen, generator=generator, deterministic=deterministic)
        times.append(time.perf_counter() - began)
        draws = Draws(scatter=block.scatter[call, :1], sight=block.sight[call, :1])
        state, outcome = advance(scenario, layout_m, state, check_action(action, policy, scenario, 1), draws)
        enough = len(times) > 5 and sum(times) > _LATENCY_SECONDS
        if enough or outcome.terminated[0] or outcome.truncated[0]:
            break
    return np.array(times[min(2, len(times) - 1) :])


def observation_for(policy: Policy, scenario: Scenario, layout_m: Float, state: SimState) -> Any:
    """What the policy declared that it needs, for N flights.

    Raises:
        ConfigError: `needs` is none of "paper", "devices", "state".
    """
    if policy.needs == "state":
        return SimulatorView(scenario, layout_m, state)
    if policy.needs in ("paper", "devices"):
        return observe(policy.needs, scenario, layout_m, state)
    raise ConfigError(f"policy '{policy.name}' needs = {policy.needs!r}, allowed: 'paper', 'devices', 'state'")


def _decide(
    policy: Policy,
    scenario: Scenario,
    layout_m: Float,
    state: SimState,
    generator: np.random.Generator,
    deterministic: bool,
) -> FlightAction:
    seen = observation_for(policy, scenario, layout_m, state)
    action = policy.act(seen, generator=generator, deterministic=deterministic)
    return check_action(action, policy, scenario, len(layout_m))


def check_action(action: Any, policy: Policy, scenario: Scenario, count: int) -> FlightAction:
    """The action as float64 and int64 arrays; a user's own policy may have made anything.

    Raises:
        ConfigError: wrong shape, a displacement that is not finite, or a device that does not exist.
    """
    try:
        displacement_m, device = action
        displacement_m, device = np.asarray(displacement_m, dtype=np.float64), np.asarray(device)
    except (TypeError, ValueError):
        raise ConfigError(f"policy '{policy.name}': act returned no (displacement_m, device) of arrays") from None
    for what, array, shape in (("displacement_m", displacement_m, (count, 2)), ("device", device, (count,))):
        if array.shape != shape:
            raise ConfigError(f"policy '{policy.name}': {what} has shape {array.shape}, needed: {shape}")
    if not np.isfinite(displacement_m).all():
        raise ConfigError(f"policy '{policy.name}': displacement_m is not finite, allowed: metres")
    devices = scenario.traffic.devices
    if not np.issubdtype(device.dtype, np.integer) or ((device < 0) | (device > devices)).any():
        raise ConfigError(f"policy '{policy.name}': device must be an integer, 0 (idle) to {devices}")
    return FlightAction(displacement_m, device.astype(np.int64))


def _keep_ended(before: SimState, after: SimState, active: Bool) -> SimState:
    """`after` where a flight is active, else the state it ended in: no clock of an ended flight runs on."""
    row = active[:, None]
    return SimState(
        **{
            field: np.where(row if value.ndim == 2 else active, getattr(after, field), value)
            for field, value in before._asdict().items()
        }
    )


def _share_done(scenario: Scenario, state: SimState, active: Bool) -> float:
    """Share of the work behind us: steps or time against their limits, whichever is nearer."""
    share = np.zeros(len(active))
    if scenario.limits.max_steps is not None:
        share = np.maximum(share, state.step / scenario.limits.max_steps)
    if scenario.limits.time_budget_s is not None:
        share = np.maximum(share, state.time_s / scenario.limits.time_budget_s)
    return float(np.where(active, np.minimum(share, 1.0), 1.0).mean())


def _progress(show: bool) -> Progress:
    return Progress(
        TextColumn("{task.description:>16}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %  {task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
        disable=not (show and sys.stderr.isatty()),
    )
