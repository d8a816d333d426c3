from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import parts
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario
from uavrl.training.policy import AgentPolicy

SCENARIO = load_scenario("released", max_steps=12)


def test_one_part_is_lent_and_the_other_kept(learned: AgentPolicy) -> None:
    trial = evaluation_set(SCENARIO, "random", 6, seed=3)
    hover, own = fly(make_policy("hover"), trial), fly(learned, trial, deterministic=True)
    moved = fly(parts.Swapped(learned, "hover's"), trial)
    served = fly(parts.Swapped(learned, "own"), trial)
    np.testing.assert_array_equal(moved.position_m, hover.position_m)
    np.testing.assert_array_equal(served.position_m[1], own.position_m[1])  # ages, and so moves, differ from there on
    assert (moved.device != hover.device).any()
    assert (served.position_m[1] != hover.position_m[1]).any()
    np.testing.assert_array_equal(served.device[0], hover.device[0])


def test_a_line_counts_flown_steps_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "FADINGS", 1)
    steps, flights = 120, 2
    device = np.ones((steps, flights), dtype=int)
    device[:10, 0] = 0  # 5 % of the first hundred steps of both
    device[100:105, 1] = 0  # half of flight 1's later steps, a quarter of all
    active = np.ones((steps, flights), dtype=bool)
    active[110:] = False
    reward = np.full((steps, flights), -1.0)
    reward[:, 1] = -2.0
    made: Any = SimpleNamespace(reward=reward, active=active, device=device)
    # returns -110 and -220, +-1.96 * 77.8 / sqrt 2; the first fifty steps -50 and -100
    assert parts.line("made", made) == "| made | -165 \u00b1 108 | -165 | -75 | 5.0 | 25.0 | 50 |"


def test_a_policy_takes_over_after_the_steps_of_holding(learned: AgentPolicy) -> None:
    trial = evaluation_set(SCENARIO, "random", 4, seed=3)
    held = fly(parts.Held(learned, 5), trial, deterministic=True)
    assert (held.device[:5] == 0).all()
    np.testing.assert_array_equal(held.position_m[5], held.position_m[0])
    own = fly(learned, trial, deterministic=True)
    assert (held.position_m[6] != held.position_m[5]).any()
    np.testing.assert_array_equal(fly(parts.Held(learned, 0), trial, deterministic=True).reward, own.reward)
