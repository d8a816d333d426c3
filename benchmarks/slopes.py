"""What a metre costs and what it buys: the critic's answer beside the flights' own (Monte Carlo).

    python -m benchmarks.slopes runs/layouts [MORE ...]

At one step of each trial flight the aircraft holds, or flies a whole step towards the hover heuristic's point, or away
from it; then the policy goes on under the same draws. Half of towards less away, a metre, is what a metre nearer is
worth; hold less the mean of both is what a metre costs. Returns are discounted as Q is, but end with the flight, and
their tails are not clipped. Left out are flights within `NEAR_M` of the point, which have arrived; those that would
meet the border if they flew away; and those in which one draw decides. Intervals are over layouts.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tyro.conf import Positional

from benchmarks import script
from benchmarks.parts import LAYOUTS, best_device, learned
from uavrl.evaluation.rollouts import TRIAL_SEED, EvaluationSet, evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario
from uavrl.simulation.state import FlightAction
from uavrl.training.policy import AgentPolicy

Float = NDArray[np.float64]

FADINGS = 6
STEPS = (30, 60)
NEAR_M = 200.0
RARE = 60.0  # a return that one move changes by more than this was decided by another draw of the fading
MOVES = {"hold": 0.0, "towards": 1.0, "away": -1.0}


class Moved:
    """A policy, but for one step, in which it makes the given move with the critic's best device for it."""

    needs: Literal["paper", "devices", "state"] = "devices"
    name = "moved"

    def __init__(self, policy: AgentPolicy, step: int, displacement_m: Float) -> None:
        self.policy, self.step, self.displacement_m = policy, step, displacement_m
        self.count, self.q = 0, np.zeros(0)

    def reset(self, count: int) -> None:
        """Of the policy, and of the step."""
        self.policy.reset(count)
        self.count = 0

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        """The policy's action, or the move."""
        own = self.policy.act(observation, generator=generator, deterministic=True)
        self.count += 1
        if self.count - 1 != self.step or len(own.device) != len(self.displacement_m):
            return own
        device, self.q = best_device(self.policy, observation, self.displacement_m)
        return FlightAction(self.displacement_m, device)


def answers(policy: AgentPolicy, trial: EvaluationSet, step: int) -> tuple[Float, Float, Float, Float]:
    """Where each flight was and headed (n, 2), and what came of each of `MOVES`, (3, n), by flights and by the critic.

    The position is in metres; the heading leads to the hover point and is as long as the way to it.
    """
    point = fly(make_policy("hover"), trial).position_m[-1]
    position = fly(policy, trial, deterministic=True).position_m[step]
    way = point - position
    heading = way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    discount = policy.agent.config.discount
    flown, said = [], []
    for sign in MOVES.values():
        moved = Moved(policy, step, sign * policy.reach_m * heading)
        flights = fly(moved, trial)
        reward = (flights.reward * flights.active)[step:]
        flown.append((discount ** np.arange(len(reward))[:, None] * reward).sum(axis=0))
        said.append(moved.q)
    return position, way, np.array(flown), np.array(said, dtype=np.float64)


def interval(values: Float, layout: NDArray[np.int64]) -> str:
    """Mean over layouts of each one's mean, and half of its normal 95 % interval."""
    means = np.array([values[layout == one].mean() for one in np.unique(layout)])
    return f"{means.mean():.3f} ± {1.96 * means.std(ddof=1) / len(means) ** 0.5:.3f}"


def main(paths: Positional[tuple[str, ...]]) -> None:
    """Print the table.

    Args:
        paths: as of `python -m benchmarks.parts`.
    """
    script.needed("RUN", paths)
    torch.set_num_threads(1)
    policies = {path: learned(path) for path in paths}
    scenario = load_scenario("released")
    trial = evaluation_set(scenario, "random", LAYOUTS, seed=TRIAL_SEED, fading_seeds=FADINGS)
    layout, size_m = np.repeat(np.arange(LAYOUTS), FADINGS), np.array([scenario.area.width_m, scenario.area.depth_m])
    print(
        "| policy | step | flights (near, border, rare) | a metre nearer, flown | by Q | a metre's cost, flown | by Q |"
    )
    print("|---" * 7 + "|")
    for path, policy in policies.items():
        for step in STEPS:
            position, way, *found = answers(policy, trial, step)
            distance = np.linalg.norm(way, axis=1)
            behind = position - policy.reach_m * way / np.maximum(distance, 1e-9)[:, None]
            near, border = distance <= NEAR_M, ((behind < 0) | (behind > size_m)).any(axis=1)
            rare = np.abs(found[0] - found[0][0]).max(axis=0) >= RARE
            kept = ~(near | border | rare)
            left_out = f"{near.sum()}, {(~near & border).sum()}, {(~near & ~border & rare).sum()}"
            hold, towards, away = np.moveaxis(np.array(found)[:, :, kept], 1, 0) / policy.reach_m
            cells = [interval(one, layout[kept]) for one in (*(towards - away) / 2, *(hold - (towards + away) / 2))]
            print(f"| {path} | {step} | {kept.sum()} ({left_out}) | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    script.run(main, "benchmarks.slopes")
