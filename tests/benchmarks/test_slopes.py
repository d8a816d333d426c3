from __future__ import annotations

import numpy as np

from benchmarks import slopes
from benchmarks.slopes import Moved, answers
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario
from uavrl.training.policy import AgentPolicy

SCENARIO = load_scenario("released", max_steps=12)


def test_only_one_step_is_another(learned: AgentPolicy) -> None:
    trial = evaluation_set(SCENARIO, "random", 4, seed=3)
    move = np.full((4, 2), 5.0)
    own, moved = fly(learned, trial, deterministic=True), fly(Moved(learned, 3, move), trial)
    np.testing.assert_array_equal(moved.position_m[:4], own.position_m[:4])
    np.testing.assert_array_equal(moved.device[:3], own.device[:3])
    inside = np.all((own.position_m[3] + move > 0) & (own.position_m[3] + move < 1000), axis=1)
    np.testing.assert_allclose((moved.position_m[4] - moved.position_m[3])[inside], move[inside])
    assert inside.any()


def test_answers_are_of_holding_of_flying_nearer_and_away(learned: AgentPolicy) -> None:
    trial = evaluation_set(SCENARIO, "random", 4, seed=3)
    position, way, flown, said = answers(learned, trial, 2)
    own, point = fly(learned, trial, deterministic=True), fly(make_policy("hover"), trial).position_m[-1]
    np.testing.assert_array_equal(position, own.position_m[2])
    np.testing.assert_allclose(way, point - position)
    distance = np.linalg.norm(way, axis=1)
    hold = fly(Moved(learned, 2, np.zeros((4, 2))), trial)
    gamma = learned.agent.config.discount ** np.arange(10)
    np.testing.assert_allclose(flown[0], gamma @ (hold.reward * hold.active)[2:])
    assert flown.shape == said.shape == (3, 4)
    towards = Moved(learned, 2, learned.reach_m * way / distance[:, None])
    nearer = np.linalg.norm(fly(towards, trial).position_m[3] - point, axis=1)
    np.testing.assert_allclose(nearer, distance - learned.reach_m)
    np.testing.assert_array_equal(said[1], towards.q)


def test_an_interval_is_over_layouts() -> None:
    values, layout = np.array([0.0, 2.0, 3.0, 3.0, 3.0]), np.array([4, 4, 7, 7, 7])
    assert slopes.interval(values, layout) == "2.000 \u00b1 1.960"
