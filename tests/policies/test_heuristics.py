"""What each heuristic chooses, in states small enough to check by eye."""

from __future__ import annotations

import numpy as np
import pytest

from tests.policies.flying import fly, layouts_and_starts
from uavrl.errors import ConfigError
from uavrl.policies import POLICIES, Policy, SimulatorView, make_policy
from uavrl.policies.service import service_model
from uavrl.scenario import PRESETS, Scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.state import Draws, FlightAction, SimState

SCENARIO = PRESETS["released"].replace(devices=3, fading="none")
LAYOUT = np.array([[[100.0, 100.0], [500.0, 500.0], [1000.0, 1000.0]]])


def view_at(
    position: tuple[float, float],
    age: tuple[float, ...] = (0.0, 0.0, 0.0),
    scenario: Scenario = SCENARIO,
    step: int = 0,
) -> SimulatorView:
    state = initial_state(np.array([position]), 3)
    state = state._replace(age_s=np.array([age]), step=np.array([step]))
    return SimulatorView(scenario, LAYOUT, state)


def first_action(name: str, view: SimulatorView) -> FlightAction:
    policy = make_policy(name)
    policy.reset(1)
    return policy.act(view, generator=np.random.default_rng(0))


def end_of_flight(policy: Policy, view: SimulatorView, steps: int) -> SimState:
    policy.reset(1)
    state = view.state
    for _ in range(steps):
        action = policy.act(SimulatorView(view.scenario, view.layout_m, state), generator=np.random.default_rng(0))
        state, _ = advance(view.scenario, view.layout_m, state, action, Draws(np.zeros((1, 2)), np.zeros(1)))
    return state


def test_names() -> None:
    fixed = {"tdm", "saver", "random_walk", "max_age", "index", "hover", "planner"}
    assert fixed <= set(POLICIES)
    assert {name: make_policy(name).name for name in POLICIES} == {name: name for name in POLICIES}
    with pytest.raises(ConfigError, match=r"^policy 'tmd' does not exist, allowed: tdm, .*planner") as error:
        make_policy("tmd")
    assert "\n" not in str(error.value)


def test_tdm_takes_turns_where_it_starts() -> None:
    for step, device in enumerate([1, 2, 3, 1, 2]):
        action = first_action("tdm", view_at((300.0, 300.0), (9.0, 0.0, 0.0), step=step))
        assert action.device.tolist() == [device]
        assert not action.displacement_m.any()


def test_saver_serves_the_nearest_where_it_starts() -> None:
    action = first_action("saver", view_at((700.0, 700.0), (9.0, 0.0, 9.0)))
    assert action.device.tolist() == [2]
    assert not action.displacement_m.any()


def test_idle_does_nothing() -> None:
    action = first_action("idle", view_at((700.0, 700.0), (9.0, 0.0, 9.0)))
    assert action.device.tolist() == [0]
    assert not action.displacement_m.any()


def test_index_weighs_age_priority_and_service_time_where_it_starts() -> None:
    near_far = view_at((100.0, 100.0), (2.0, 0.0, 2.0))
    assert first_action("index", near_far).device.tolist() == [1]  # equal ages: the cheaper one
    assert first_action("index", view_at((100.0, 100.0), (2.0, 0.0, 9.0))).device.tolist() == [3]
    favoured = SCENARIO.replace(priority=(0.01, 0.0, 0.99))
    assert first_action("index", view_at((100.0, 100.0), (2.0, 0.0, 2.0), favoured)).device.tolist() == [3]
    small = SCENARIO.replace(packet_bits=(2e6, 2e6, 1e5))
    assert first_action("index", view_at((100.0, 100.0), (2.0, 0.0, 2.0), small)).device.tolist() == [3]
    assert not first_action("index", near_far).displacement_m.any()


def test_max_age_serves_the_oldest_on_its_way_to_the_median() -> None:
    view = view_at((100.0, 400.0), (2.0, 3.0, 1.0))
    action = first_action("max_age", view)
    assert action.device.tolist() == [2]
    assert np.linalg.norm(action.displacement_m) == pytest.approx(25.0)
    end = end_of_flight(make_policy("max_age"), view, 40)
    np.testing.assert_allclose(end.position_m, [[500.0, 500.0]], atol=0.5)  # of three in a line: the middle one


def test_hover_ends_at_the_best_point() -> None:
    scenario = SCENARIO.replace(priority=(0.05, 0.05, 0.9))
    end = end_of_flight(make_policy("hover"), view_at((900.0, 400.0), scenario=scenario), 60)
    best = service_model(scenario).best_hover_m(LAYOUT)
    np.testing.assert_allclose(end.position_m, best, atol=1e-3)
    even = service_model(SCENARIO).best_hover_m(LAYOUT)
    assert np.linalg.norm(best - LAYOUT[:, 2]) < 0.4 * np.linalg.norm(even - LAYOUT[:, 2])  # drawn to what matters


@pytest.mark.parametrize(("name", "start"), [("saver_flying", (900.0, 980.0)), ("saver_flying", (450.0, 300.0))])
def test_saver_flying_arrives_above_the_nearest_also_in_a_corner(name: str, start: tuple[float, float]) -> None:
    end = end_of_flight(make_policy(name), view_at(start), 20)
    nearest = np.linalg.norm(LAYOUT[0] - np.array(start), axis=1).argmin()
    np.testing.assert_allclose(end.position_m[0], LAYOUT[0, nearest], atol=1e-3)
    assert end.age_s[0, nearest] == 0.0


def test_tdm_flying_heads_for_the_device_it_serves() -> None:
    for step, device in enumerate([1, 2, 3, 1]):
        here = np.array([300.0, 600.0])
        action = first_action("tdm_flying", view_at((300.0, 600.0), step=step))
        to = LAYOUT[0, device - 1] - here
        assert action.device.tolist() == [device]
        np.testing.assert_allclose(action.displacement_m[0], 25.0 * to / np.linalg.norm(to), atol=1e-4)


def test_random_walk_is_uniform_in_the_box_and_over_the_choices() -> None:
    layout = np.broadcast_to(LAYOUT, (20_000, 3, 2))
    view = SimulatorView(SCENARIO, layout, initial_state(np.zeros((20_000, 2)), 3))
    action = make_policy("random_walk").act(view, generator=np.random.default_rng(1))
    assert np.abs(action.displacement_m).max() <= 25.0
    np.testing.assert_allclose(action.displacement_m.mean(axis=0), 0.0, atol=0.5)
    np.testing.assert_allclose(action.displacement_m.std(axis=0), 50.0 / np.sqrt(12.0), rtol=0.02)
    np.testing.assert_allclose(np.bincount(action.device) / 20_000, 0.25, atol=0.02)


@pytest.mark.parametrize("name", sorted(set(POLICIES) - {"random_walk", "planner"}))
def test_a_flight_does_not_depend_on_its_batch(name: str) -> None:
    scenario = PRESETS["released"].replace(devices=3, max_steps=60)
    layout, _ = layouts_and_starts(scenario, 5, 1_000_000)
    whole = fly(scenario, make_policy(name), 5).returns
    first = fly(scenario, make_policy(name), 2, layout_m=layout[:2]).returns
    np.testing.assert_allclose(whole[:2], first, rtol=1e-12)


def test_a_reset_forgets_the_layout_before() -> None:
    policy = make_policy("hover")
    here = view_at((500.0, 100.0))
    policy.reset(1)
    before = policy.act(here, generator=np.random.default_rng(0)).displacement_m
    policy.reset(1)
    moved = SimulatorView(SCENARIO, LAYOUT[:, :, ::-1] * [0.1, 0.1], here.state)
    assert np.abs(policy.act(moved, generator=np.random.default_rng(0)).displacement_m - before).max() > 1.0


def test_the_order_of_the_measured_returns() -> None:
    """As measured over 100 layouts: hover, max age, index, TDM, then far behind the random walk and Saver."""
    names = ["hover", "max_age", "index", "tdm", "random_walk", "saver"]
    means = [fly(PRESETS["released"].replace(fading="ergodic"), make_policy(name), 60).returns.mean() for name in names]
    assert means == sorted(means, reverse=True)
