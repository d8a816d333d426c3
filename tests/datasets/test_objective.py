from __future__ import annotations

import numpy as np
import pytest

from uavrl.datasets import load_builtin, relabelled, validate
from uavrl.datasets.objective import costs, with_objective
from uavrl.errors import DatasetError
from uavrl.scenario import load_scenario


def test_the_scenario_flown_gives_the_logged_rewards_back() -> None:
    rows = load_builtin("layouts", 1_000)
    again = relabelled(rows, load_scenario("released"))
    np.testing.assert_allclose(again.reward, rows.reward, rtol=2e-5)
    np.testing.assert_allclose(again.age_term, rows.age_term, rtol=2e-5)


def test_another_objective_by_hand() -> None:
    rows = load_builtin("layouts", 50)
    weights = (0.55,) + (0.05,) * 9
    scenario = load_scenario("paper", age_weight=0.25, priority=weights)
    reward = -(0.25 * rows.next_age_s @ np.array(weights) + 0.75 * rows.next_energy_j) / 400.0
    again = relabelled(rows, scenario)
    np.testing.assert_allclose(again.reward, reward, rtol=1e-5)
    np.testing.assert_array_equal(again.next_age_s, rows.next_age_s)
    validate(again, scenario)
    np.testing.assert_allclose(costs(rows, scenario).reward, reward, rtol=1e-5)


def test_another_number_of_devices_is_refused() -> None:
    with pytest.raises(DatasetError, match="data has 10 devices, the scenario 5: they must agree"):
        relabelled(load_builtin("layouts", 10), load_scenario("released", devices=5))


def test_the_objective_and_the_priorities_are_taken_over_and_nothing_else() -> None:
    released, paper = load_scenario("released"), load_scenario("paper")
    assert with_objective(released, paper) == paper
    flown = load_scenario("released", max_steps=50, fading="none")
    wanted = paper.replace(priority=(0.55,) + (0.05,) * 9, altitude_m=60.0)
    found = with_objective(flown, wanted)
    assert (found.objective, found.traffic.priority) == (wanted.objective, wanted.traffic.priority)
    assert found.name == "released-paper"
    assert found.replace(name="released", objective=flown.objective, priority=None) == flown
