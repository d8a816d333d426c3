from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from tests.evaluation.flying import Scripted, Wanderer, overhead, timed_scenario
from uavrl.errors import ConfigError, ScenarioError
from uavrl.evaluation.rollouts import EvaluationSet, Flights, evaluation_set, fixed_layout, fly
from uavrl.policies.base import SimulatorView
from uavrl.scenario import load_scenario
from uavrl.simulation.environment import DataCollectionEnv
from uavrl.simulation.state import Draws, FlightAction


def equal(first: Flights, second: Flights) -> bool:
    names = [name for name, value in vars(first).items() if isinstance(value, np.ndarray) and name != "latency_s"]
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


def one_draw(environments: EvaluationSet, flight: int, step: int) -> Draws:
    block = environments.draws(step // 64, np.ones(environments.flights, dtype=bool))
    return Draws(block.scatter[step % 64, flight], float(block.sight[step % 64, flight]))


@pytest.mark.parametrize("scenario", ["released", "realistic"])
def test_every_flight_equals_the_environments_episode_for_equal_draws(
    scenario: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # time limits end the flights at different steps; each must be flown as if it were alone
    short = load_scenario(scenario, devices=4, max_steps=90, time_budget_s=14.0)
    environments = evaluation_set(short, "random", 3, fading_seeds=2)
    flights = fly(Scripted((1, 0, 3, 4, 2), (9.0, -4.0)), environments)
    assert len(set(flights.steps)) > 2
    for flight in range(environments.flights):
        place = flight // 2
        env = DataCollectionEnv(short, layout=environments.layout_m[place])
        env.reset(options={"position_m": environments.start_m[place]})
        episode = flights.episode(flight)
        for step in range(episode.steps):
            draws = one_draw(environments, flight, step)
            monkeypatch.setattr("uavrl.simulation.environment.draw", lambda generator, draws=draws: draws)
            action = {"displacement_m": (9.0, -4.0), "device": (1, 0, 3, 4, 2)[step % 5]}
            _, reward, terminated, truncated, info = env.step(action)
            assert reward == pytest.approx(episode.reward[step], rel=1e-12)
            assert info["age_s"] == pytest.approx(episode.age_s[step + 1], rel=1e-12)
            assert info["position_m"] == pytest.approx(episode.position_m[step + 1])
            assert (terminated or truncated) == (step == episode.steps - 1)
        assert info["time_s"] == pytest.approx(episode.time_s[-1])
        assert flights.bits[flights.active[:, flight], flight][-1] == pytest.approx(info["bits"])


def test_draws_belong_to_seed_episode_repeat_and_step_alone() -> None:
    scenario = load_scenario("released")
    small = evaluation_set(scenario, "random", 3, fading_seeds=2)
    large = evaluation_set(scenario, "fixed", 5, fading_seeds=4)
    wanted = np.ones(20, dtype=bool)
    few, many = small.draws(2, wanted[:6]), large.draws(2, wanted)
    for episode in range(3):
        for repeat in range(2):
            ours, theirs = (few.scatter[:, episode * 2 + repeat], many.scatter[:, episode * 4 + repeat])
            assert np.array_equal(ours, theirs)
    flat = many.scatter.reshape(64 * 20, 2)
    assert len(np.unique(flat, axis=0)) == len(flat)  # no two flights or steps share a draw
    assert not np.array_equal(many.scatter, large.draws(3, wanted).scatter)
    assert not np.array_equal(many.scatter, replace(large, seed=7).draws(2, wanted).scatter)


def test_draws_are_standard() -> None:
    draws = evaluation_set("released", "random", 200).draws(0, np.ones(200, dtype=bool))
    assert draws.scatter.mean() == pytest.approx(0, abs=0.03)
    assert draws.scatter.std() == pytest.approx(1, abs=0.03)
    assert draws.sight.mean() == pytest.approx(0.5, abs=0.015)
    assert ((draws.sight >= 0) & (draws.sight < 1)).all()


def test_one_environment_alone_meets_what_it_meets_among_all() -> None:
    environments = evaluation_set(load_scenario("released", max_steps=70), "random", 4, fading_seeds=2)
    policy = Scripted((1, 5, 0, 9), (2.0, 1.0))
    among, alone = fly(policy, environments), fly(policy, environments.only(2))
    assert among.reward[:, 4:6] == pytest.approx(alone.reward, rel=1e-12)  # sums are ordered by the batch size
    assert environments.only(2).unit.tolist() == [0]
    assert environments.only(1).only(0).equals(environments.only(1))
    assert not environments.only(1).equals(environments.only(2))


def test_a_policy_meets_the_same_whoever_flew_before() -> None:
    environments = evaluation_set(load_scenario("released", max_steps=70), "random", 2)
    alone = fly(Wanderer(), environments)
    fly(Scripted((1, 2)), environments)
    policy = Wanderer()
    assert equal(alone, fly(policy, environments))
    assert equal(alone, fly(policy, environments))  # and however often it has flown


def test_layouts_and_starts_of_an_episode_do_not_depend_on_how_many_are_flown() -> None:
    few, many = evaluation_set("released", "random", 3), evaluation_set("released", "random", 8)
    assert np.array_equal(few.layout_m, many.layout_m[:3])
    assert np.array_equal(few.start_m, many.start_m[:3])
    fixed = evaluation_set("released", "fixed", 8)
    assert np.array_equal(fixed.start_m, many.start_m)  # equal starts on other layouts
    assert np.array_equal(fixed.layout_m[3], np.random.default_rng(0).uniform(0, 1000, (10, 2)))
    assert len(np.unique(many.layout_m, axis=0)) == 8
    assert not np.array_equal(evaluation_set("released", "random", 3, seed=5).start_m, few.start_m)


def test_the_fixed_layout_fits_any_number_of_devices_and_any_area() -> None:
    layout = fixed_layout(load_scenario("released", devices=25, width_m=10.0))
    assert layout.shape == (25, 2)
    assert layout[:, 0].max() <= 10.0 < layout[:, 1].max()


def test_listed_layouts_are_flown_in_turn_and_resampled_as_wholes(tmp_path: Path) -> None:
    path = tmp_path / "layouts.json"
    listed = np.random.default_rng(3).uniform(0, 1000, (3, 10, 2))
    path.write_text(json.dumps(listed.tolist()))
    environments = evaluation_set("released", path, 7)
    assert np.array_equal(environments.layout_m, listed[[0, 1, 2, 0, 1, 2, 0]])
    assert environments.unit.tolist() == [0, 1, 2, 0, 1, 2, 0]
    path.write_text(json.dumps(listed[:1].tolist()))
    assert evaluation_set("released", path, 4).unit.tolist() == [0, 1, 2, 3]  # one layout: the starts vary


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[[[0, 0, 0]]]", "layout 0: layout has shape (1, 3), allowed: (10, 2)"),
        (json.dumps([[[1, 2]] * 10, [[1, 2]] * 9]), "layout 1: layout has shape (9, 2)"),
        (json.dumps([[[1, 2]] * 9 + [[1, 1001]]]), "layout 0: layout[9, 1] = 1001 lies outside"),
        ("[[[0, 0], [1", "not valid JSON"),
        ("{}", "holds no list"),
        ("[]", "holds no list"),
        ('[[["a", 1]]]', "no array of numbers"),
    ],
)
def test_a_file_of_layouts_that_cannot_be_flown_is_named(text: str, part: str, tmp_path: Path) -> None:
    path = tmp_path / "layouts.json"
    path.write_text(text)
    with pytest.raises(ScenarioError) as error:
        evaluation_set("released", path, 2)
    assert str(path) in str(error.value)
    assert part in str(error.value)


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        ({"episodes": 0}, "episodes = 0"),
        ({"fading_seeds": 0}, "fading_seeds = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"layouts": "circle"}, "'circle' is not 'fixed', 'random' or a file"),
        ({"scenario": load_scenario("released", max_steps=None, decision_s=0.0)}, "may never end"),
    ],
)
def test_settings_out_of_range_are_refused(changed: dict[str, Any], part: str) -> None:
    with pytest.raises((ConfigError, ScenarioError), match=part.replace("'", ".")):
        evaluation_set(**changed)


def test_an_ended_flight_stays_where_it_ended() -> None:
    environments = overhead(timed_scenario(max_steps=None, time_budget_s=5.0), episodes=2)

    class TwoPaces(Scripted):
        def act(self, observation: Any, **rest: Any) -> FlightAction:
            return FlightAction(np.ones((len(observation.layout_m), 2)), np.array([1, 2])[: self.resets[-1]])

    flights = fly(TwoPaces(()), environments)
    assert flights.steps.tolist() == [4, 2]
    assert flights.time_s[2:, 1] == pytest.approx(flights.time_s[2, 1])
    assert flights.position_m[-1] == pytest.approx(500 + np.array([[4, 4], [2, 2]]))
    assert flights.episode(1).steps == 2


@pytest.mark.parametrize("needs", ["paper", "devices", "state"])
def test_a_policy_is_given_what_it_needs(needs: Literal["paper", "devices", "state"]) -> None:
    seen = []

    class Looker(Scripted):
        def act(self, observation: Any, **rest: Any) -> FlightAction:
            seen.append(observation)
            return super().act(observation, **rest)

    policy = Looker((1,), needs=needs)
    fly(policy, overhead(timed_scenario(), episodes=3))
    assert policy.resets == [1, 3]  # one flight to time it, then all
    last = seen[-1]
    if needs == "paper":
        assert last.shape == (3, 5)
    elif needs == "devices":
        assert last["devices"].shape == (3, 2, 6)
    else:
        assert isinstance(last, SimulatorView)
        assert last.state.step.tolist() == [3, 3, 3]


def test_measured_decision_time_is_charged(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr("uavrl.evaluation.rollouts.time.perf_counter", lambda: 0.25 * next(clock))
    scenario = timed_scenario(decision_time="measured")
    flights = fly(Scripted((0,)), overhead(scenario))
    assert flights.latency_s == pytest.approx(0.25)
    assert flights.duration_s[:, 0] == pytest.approx(0.25)
    assert fly(Scripted((0,)), overhead(timed_scenario())).duration_s[:, 0] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("action", "part"),
    [
        (FlightAction(np.zeros((3, 2)), np.zeros(3)), "device must be an integer"),
        (FlightAction(np.zeros((3, 2)), np.array([0, 1, 3])), "0 .idle. to 2"),
        (
            FlightAction(np.zeros((3, 3)), np.zeros(3, dtype=int)),
            r"displacement_m has shape \(3, 3\), needed: \(3, 2\)",
        ),
        (FlightAction(np.zeros((3, 2)), np.zeros((3, 1), dtype=int)), "device has shape"),
        (FlightAction(np.full((3, 2), np.nan), np.zeros(3, dtype=int)), "not finite"),
        (None, "returned no"),
    ],
)
def test_an_impossible_action_names_the_policy(action: Any, part: str) -> None:
    class Odd(Scripted):
        def act(self, observation: Any, **rest: Any) -> FlightAction:
            good = super().act(observation, **rest)
            answer: FlightAction = good if self.resets[-1] == 1 else action
            return answer

    with pytest.raises(ConfigError, match=f"policy 'scripted': .*{part}"):
        fly(Odd((1,)), overhead(timed_scenario(), episodes=3))


def test_an_unknown_need_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs = 'pixels'"):
        fly(Scripted((1,), needs="pixels"), overhead(timed_scenario()))  # type: ignore[arg-type]  # the user's mistake
