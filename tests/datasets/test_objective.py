from __future__ import annotations

import numpy as np
import pytest

from uavrl.datasets import load_builtin, relabelled, validate
from uavrl.datasets.objective import costs
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
