"""Small flights for the pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from uavrl.evaluation.episode import Episode
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario


def flight(policy: str = "hover", scenario: str = "released", **overrides: Any) -> Episode:
    """One flight of a heuristic."""
    return fly(make_policy(policy), evaluation_set(load_scenario(scenario, **overrides), "random", 1)).episode(0)


def written_by_hand() -> Episode:
    """Three steps over two devices in 4 s: serve 1, lose a packet of 2, idle."""
    return Episode(
        policy="<b>by hand</b></script>",
        scenario=load_scenario("released", devices=2),
        layout_m=np.array([[100.0, 200.0], [900.0, 800.0]]),
        position_m=np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [20.0, 0.0]]),
        age_s=np.array([[0.0, 0.0], [1.0, 1.0], [3.0, 3.0], [4.0, 4.0]]),
        time_s=np.array([0.0, 1.0, 3.0, 4.0]),
        device=np.array([1, 2, 0]),
        served=np.array([True, False, False]),
        energy_j=np.array([5.0, 7.0, 0.0]),
        reward=np.array([-1.0, -2.0, -4.0]),
    )
