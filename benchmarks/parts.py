"""Whose part is the excess: a critic's policy with the hover heuristic's moves, and with its choice of device.

    python -m benchmarks.parts [--planner] [--held=40] runs/layouts [MORE ...]

The planner's line takes minutes. With --held=N every policy's flights are shown, too, with N steps before them in which
the aircraft holds its place and idles. On trial flights of preset `released`, which no evaluation uses. The tables in
docs/what-matters.md are made of such.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tyro.conf import Positional, UseAppendAction

from benchmarks import script
from uavrl.agents.diffusion_sac import DiffusionSac
from uavrl.cli.policies import checkpoint_and_decision
from uavrl.errors import ConfigError
from uavrl.evaluation.rollouts import TRIAL_SEED, Flights, evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.policies.base import Policy
from uavrl.scenario import load_scenario
from uavrl.simulation.environment import observe
from uavrl.simulation.state import FlightAction
from uavrl.training.batches import to_tensors
from uavrl.training.policy import AgentPolicy, load_policy, trained_scenario

LAYOUTS, FADINGS = 100, 3
EARLY = 50
LATER = 100
STUCK = 0.2  # share of the steps after the first LATER


class Swapped:
    """Hover's moves with the critic's best device for them, or the agent's moves with hover's devices."""

    needs: Literal["paper", "devices", "state"] = "state"

    def __init__(self, policy: AgentPolicy, moves: Literal["own", "hover's"]) -> None:
        self.policy, self.moves, self.name = policy, moves, f"{moves} moves"
        self.hover: Policy = make_policy("hover")

    def reset(self, count: int) -> None:
        """Of both parts."""
        self.hover.reset(count)
        self.policy.reset(count)

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        """One part of each."""
        seen = observe("devices", observation.scenario, observation.layout_m, observation.state)
        known = self.hover.act(observation, generator=generator, deterministic=True)
        if self.moves == "own":
            own = self.policy.act(seen, generator=generator, deterministic=True)
            return FlightAction(own.displacement_m, known.device)
        return FlightAction(known.displacement_m, best_device(self.policy, seen, known.displacement_m)[0])


class Held:
    """A policy that takes over after some steps of holding the place and serving nobody."""

    needs: Literal["paper", "devices", "state"] = "state"

    def __init__(self, policy: Policy, steps: int) -> None:
        self.policy, self.steps, self.name = policy, steps, f"{policy.name} after {steps}"

    def reset(self, count: int) -> None:
        """Of the policy and of the steps."""
        self.policy.reset(count)
        self.step = 0

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        """Nothing, or what the policy does."""
        self.step += 1
        if self.step <= self.steps:
            flights = len(observation.layout_m)
            return FlightAction(np.zeros((flights, 2)), np.zeros(flights, dtype=np.int64))
        if self.policy.needs != "state":
            observation = observe(self.policy.needs, observation.scenario, observation.layout_m, observation.state)
        return self.policy.act(observation, generator=generator, deterministic=deterministic)


def best_device(policy: AgentPolicy, seen: Any, displacement_m: NDArray[np.float64]) -> tuple[Any, Any]:
    """(device, min Q), each (N,): what the critic would choose beside given moves (N, 2), and what it thinks of it."""
    critic = cast(DiffusionSac, policy.agent).critic
    w = torch.from_numpy(displacement_m / policy.reach_m).float()
    with torch.no_grad():
        best = critic.all_choices(critic.encode(to_tensors(seen)), w).amin(dim=0).max(dim=-1)
    return best.indices.numpy(), best.values.numpy()


def line(name: str, flights: Flights) -> str:
    """Returns, what the first steps cost of them, idling, and whether it ends in idling."""
    reward = flights.reward * flights.active
    returns, start = reward.sum(axis=0), reward[:EARLY].sum(axis=0).mean()
    of_layout = returns.reshape(-1, FADINGS).mean(axis=1)
    half = 1.96 * of_layout.std(ddof=1) / len(of_layout) ** 0.5
    idle = (flights.device == 0) & flights.active
    early, late = (idle[part].sum() / flights.active[part].sum() for part in (slice(LATER), slice(LATER, None)))
    stuck = (idle[LATER:].sum(axis=0) > STUCK * flights.active[LATER:].sum(axis=0)).mean()
    return (
        f"| {name} | {returns.mean():.0f} ± {half:.0f} | {np.median(returns):.0f} | {start:.0f} | {100 * early:.1f} | "
        f"{100 * late:.1f} | {100 * stuck:.0f} |"
    )


def learned(spec: str | Path) -> AgentPolicy:
    """A checkpoint's policy, whose critic knows every choice.

    Raises:
        ConfigError: it is another.
    """
    scenario = load_scenario("released")
    path, decision = checkpoint_and_decision(str(spec))
    policy = load_policy(path, scenario, decision)
    known = isinstance(policy.agent, DiffusionSac) and policy.needs == "devices"
    if not known or trained_scenario(path) != scenario:
        raise ConfigError(f"{path}: allowed here: Diffusion-SAC with a set network, trained in preset 'released'")
    return policy


def main(
    paths: Positional[tuple[str, ...]],
    held: Annotated[tuple[int, ...], UseAppendAction] = (),
    planner: bool = False,
) -> None:
    """Print the table.

    Args:
        paths: runs of `uavrl train diffusion_sac`, or pretrained:NAME, with @SETTINGS behind them or not.
        held: steps of holding the place before each policy takes over; repeat it.
        planner: show its flights, too, which takes minutes.
    """
    script.needed("RUN", paths)
    torch.set_num_threads(1)
    policies = {path: learned(path) for path in paths}
    scenario = load_scenario("released")
    trial = evaluation_set(scenario, "random", LAYOUTS, seed=TRIAL_SEED, fading_seeds=FADINGS)
    columns = ("policy", "return", "median", f"steps 1-{EARLY}", f"idle, first {LATER} steps, %", "idle after, %")
    print(f"| {' | '.join(columns)} | flights that idle on, % |")
    print("|---" * 7 + "|")

    def show(name: str, policy: Policy) -> None:
        print(line(name, fly(policy, trial, deterministic=True)), flush=True)
        for steps in held:
            print(line(f"- after {steps} steps of holding", fly(Held(policy, steps), trial, deterministic=True)))

    for name in ["hover", "planner"] if planner else ["hover"]:
        show(name, make_policy(name))
    for path, policy in policies.items():
        show(path, policy)
        print(line("- hover's moves, its devices", fly(Swapped(policy, "hover's"), trial)))
        print(line("- its moves, hover's devices", fly(Swapped(policy, "own"), trial)), flush=True)


if __name__ == "__main__":
    script.run(main, "benchmarks.parts")
