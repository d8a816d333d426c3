"""A policy and the planner side by side: their flights on the first four layouts of the evaluation, one figure.

    python -m benchmarks.paths POLICY OUT.png

POLICY as after `uavrl evaluate --policy`; its deterministic action is flown.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from benchmarks import script
from uavrl.cli.policies import resolve_all
from uavrl.cli.settings import check_writable
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.scenario import load_scenario
from uavrl.viewer.figures import trajectories

LAYOUTS = 4


def main(
    policy: Annotated[Positional[str], arg(metavar="POLICY")], out: Annotated[Positional[Path], arg(metavar="OUT.png")]
) -> None:
    """Fly both on equal layouts, starts and draws, and draw the policy's row above the planner's.

    Args:
        policy: as after `uavrl evaluate --policy`.
        out: a PNG.
    """
    check_writable(out)
    scenario = load_scenario("released")
    environments = evaluation_set(scenario, "random", LAYOUTS)
    flown = [
        fly(one, environments, name=name, deterministic=True)
        for name, one in resolve_all([policy, "planner"], scenario, deterministic=True).items()
    ]
    trajectories([flights.episode(index) for flights in flown for index in range(LAYOUTS)], out)


if __name__ == "__main__":
    script.run(main, "benchmarks.paths")
