"""Service costs, the index, hover points and medians against direct computation and brute force."""

from __future__ import annotations

import numpy as np
import pytest

from tests.policies.flying import fly, layouts_and_starts
from uavrl.physics.channel import expected_service
from uavrl.policies import make_policy
from uavrl.policies.service import geometric_median_m, service_model, towards
from uavrl.scenario import PRESETS, Scenario

UNEQUAL = {
    "devices": 4,
    "priority": (0.1, 0.4, 0.3, 0.2),
    "packet_bits": (2e6, 1e6, 2e6, 4e6),
}


@pytest.mark.parametrize("scenario", [PRESETS["released"], PRESETS["realistic"].replace(**UNEQUAL)])
def test_the_tables_hold_the_expected_service(scenario: Scenario) -> None:
    layout, position = layouts_and_starts(scenario, 20, 0)
    distance = np.linalg.norm(layout - position[:, None], axis=2)
    bits = np.broadcast_to(np.array(scenario.traffic.packet_bits_each), distance.shape)
    seconds, arrival = expected_service(distance, bits, scenario.channel)
    model = service_model(scenario)
    np.testing.assert_allclose(model.attempt_s(position, layout), seconds, rtol=1e-4)
    np.testing.assert_allclose(model.arrival(position, layout), arrival, rtol=1e-4)
    np.testing.assert_allclose(model.cost_s(position, layout), (seconds + 0.02) / arrival, rtol=1e-4)


def test_index_by_hand() -> None:
    model = service_model(PRESETS["released"].replace(**UNEQUAL))
    age, cost = np.array([[1.0, 0.0, 3.0, 400.0]]), np.array([[0.5, 0.2, 1.0, 401.0]])
    np.testing.assert_allclose(model.index(age, cost), [[0.1 * 2.25, 0.4 * 0.1, 0.3 * 8.0, 0.0]])


@pytest.mark.parametrize("unequal", [{}, UNEQUAL])
def test_the_index_comes_near_the_ideal_periods(unequal: dict[str, object]) -> None:
    """Over a long flight from a fixed place: within 12 % of the age that periods fitting each other would reach."""
    scenario = PRESETS["released"].replace(fading="none", max_steps=1500, **unequal)
    flown = fly(scenario, make_policy("index"), 30, 5)
    layout, start = layouts_and_starts(scenario, 30, 5)
    ideal = service_model(scenario).hover_age_s(start, layout)
    assert (flown.time_age_s / ideal).mean() < 1.12


@pytest.mark.parametrize("scenario", [PRESETS["released"], PRESETS["realistic"].replace(**UNEQUAL)])
def test_best_hover_point_against_a_fine_grid(scenario: Scenario) -> None:
    layout, _ = layouts_and_starts(scenario, 6, 1)
    model = service_model(scenario)
    axis = np.linspace(0.0, 1000.0, 201)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    brute = np.array([model.hover_age_s(grid, one).min() for one in layout])
    found = model.hover_age_s(model.best_hover_m(layout), layout)
    assert (found <= brute * (1 + 1e-3)).all()


def test_hover_age_is_the_age_of_the_best_periods() -> None:
    """Against a numerical search over the shares of time f_k = c_k / P_k, of cost sum delta_k P_k / 2."""
    scenario = PRESETS["released"].replace(**UNEQUAL)
    layout, position = layouts_and_starts(scenario, 1, 2)
    model = service_model(scenario)
    shares = np.random.default_rng(0).dirichlet(np.ones(4), 200_000)
    costs = 0.5 * (model.priority * model.cost_s(position, layout) / shares).sum(axis=1)
    known = float(model.hover_age_s(position, layout)[0])
    assert known <= costs.min() <= 1.01 * known


def test_geometric_median() -> None:
    square = np.array([[0.0, 0.0], [600.0, 600.0], [600.0, 0.0], [0.0, 300.0]])
    corner = np.array([[100.0, 100.0], [900.0, 100.0], [100.0, 900.0], [800.0, 900.0]])
    both = np.stack([square, corner])
    even = geometric_median_m(both, np.ones(4))
    np.testing.assert_allclose(even[0], [200.0, 200.0], atol=0.5)  # of a convex quadrilateral: where diagonals cross
    heavy = geometric_median_m(both, np.array([5.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(heavy, both[:, 0], atol=0.5)  # more than half the weight wins


def test_towards_is_as_long_as_allowed_and_stays_inside() -> None:
    size = np.array([1000.0, 1000.0])
    here = np.array([[10.0, 10.0], [990.0, 1000.0], [500.0, 500.0]])
    target = np.array([[10.0, 500.0], [1000.0, 1000.0], [500.0, 500.0]])
    move = towards(here, target, 25.0, size)
    np.testing.assert_allclose(np.linalg.norm(move, axis=1), [25.0, 10.0, 0.0], atol=1e-5)
    assert (here + move < size).all()
