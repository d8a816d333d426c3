"""How near policies come to the best place to hover, and what they return beside the hover heuristic on equal flights.

    python -m benchmarks.approach fixed|random POLICY [MORE ...]

On trial flights of preset `released`, which no evaluation uses; deterministic actions. The best place is where hover
ends up.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from tyro.conf import Positional

from benchmarks import script
from uavrl.cli.policies import resolve_all
from uavrl.evaluation.rollouts import TRIAL_SEED, Flights, evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario

STARTS, FADINGS = 100, 3
AT = (0, 50, 100, 200, 400)  # steps
LATER = 100


def line(name: str, flights: Flights, hover: Flights) -> str:
    """Return less hover's, idling, and the median distance left after some steps."""
    ahead = ((flights.reward * flights.active) - (hover.reward * hover.active)).sum(axis=0)
    of_start = ahead.reshape(-1, FADINGS).mean(axis=1)
    half = 1.96 * of_start.std(ddof=1) / len(of_start) ** 0.5
    idle = ((flights.device == 0) & flights.active)[LATER:].sum() / flights.active[LATER:].sum()
    left = np.linalg.norm(flights.position_m - hover.position_m[-1], axis=2)
    distances = (f"{np.median(left[min(step, len(left) - 1)]):.0f}" for step in AT)
    return f"| {name} | {of_start.mean():+.1f} ± {half:.1f} | {100 * idle:.1f} | {' | '.join(distances)} |"


def main(layouts: Positional[Literal["fixed", "random"]], policies: Positional[tuple[str, ...]]) -> None:
    """Print the table.

    Args:
        layouts: one, or one a flight.
        policies: as after `uavrl evaluate --policy`.
    """
    script.needed("POLICY", policies)
    torch.set_num_threads(1)
    scenario = load_scenario("released")
    flyable = resolve_all(policies, scenario, deterministic=True)
    trial = evaluation_set(scenario, layouts, STARTS, seed=TRIAL_SEED, fading_seeds=FADINGS)
    hover = fly(make_policy("hover"), trial)
    columns = ("paired to hover", f"idle after {LATER} steps, %", *(f"m left after {step}" for step in AT))
    print(f"| policy | {' | '.join(columns)} |")
    print("|---" * (1 + len(columns)) + "|")
    for name, policy in flyable.items():
        print(line(name, fly(policy, trial, deterministic=True), hover), flush=True)


if __name__ == "__main__":
    script.run(main, "benchmarks.approach")
