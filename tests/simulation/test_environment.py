"""The Gymnasium environments: the contract, equal draws, autoreset, options, and one clear line for every mistake."""

from __future__ import annotations

import re
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from uavrl.errors import ScenarioError
from uavrl.scenario import load_scenario
from uavrl.simulation import environment
from uavrl.simulation.environment import (
    ENVIRONMENT_ID,
    DataCollectionEnv,
    DataCollectionVectorEnv,
    check_layout,
    random_positions,
)
from uavrl.simulation.state import Draws

LAYOUT = np.random.default_rng(0).uniform(0, 1000, (10, 2))
KINDS = pytest.mark.parametrize("kind", ["paper", "devices"])
INFO = {
    "age_s", "rate_bps", "snr", "transmission_s", "move_s", "step_s", "energy_j", "energy_move_j",
    "energy_communication_j", "energy_idle_j", "device_energy_j", "served", "outage", "position_m", "layout_m",
    "time_s", "step", "age_term", "energy_term", "displacement_m", "duration_s", "bits", "reward", "terminated",
    "truncated",
}  # fmt: skip


def action(dx: float = 3.0, dy: float = 4.0, device: int = 1) -> dict[str, Any]:
    return {"displacement_m": np.array([dx, dy], dtype=np.float32), "device": device}


def actions(generator: np.random.Generator, count: int) -> dict[str, Any]:
    return {
        "displacement_m": generator.uniform(-25, 25, (count, 2)).astype(np.float32),
        "device": generator.integers(0, 11, count),
    }


def flat(observation: Any) -> NDArray[np.float32]:
    if isinstance(observation, dict):
        observation = np.concatenate([value.ravel() for value in observation.values()])
    result: NDArray[np.float32] = observation
    return result


class TestContract:
    @KINDS
    @pytest.mark.parametrize("scenario", ["paper", "released", "realistic"])
    def test_passes_gymnasiums_checker(self, kind: str, scenario: str) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # Gymnasium recommends actions within [-1, 1]; ours are metres, as its users read and log them
            warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
            made = gymnasium.make(ENVIRONMENT_ID, scenario=scenario, observation=kind)
            check_env(made.unwrapped, skip_render_check=True)

    @KINDS
    def test_made_with_a_layout_and_a_field_it_flies_without_any_warning(self, kind: str) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            made = gymnasium.make(ENVIRONMENT_ID, scenario="released", fading="none", layout=LAYOUT, observation=kind)
            made.reset(seed=0)
            for _ in range(3):
                made.step(made.action_space.sample())
        unwrapped = made.unwrapped
        assert isinstance(unwrapped, DataCollectionEnv)
        assert unwrapped.scenario == load_scenario("released", fading="none")
        assert unwrapped.layout_m.tolist() == LAYOUT.tolist()

    def test_spaces_are_metres_seconds_joules(self) -> None:
        made = DataCollectionEnv("paper", max_displacement_m=30.0)
        move = made.action_space["displacement_m"]  # type: ignore[index]  # a Dict space
        assert (move.low.tolist(), move.high.tolist()) == ([-30.0, -30.0], [30.0, 30.0])
        assert made.action_space["device"].n == 11  # type: ignore[index]  # a Dict space
        assert made.observation_space.shape == (13,)
        uav, devices = DataCollectionEnv("paper", observation="devices").observation_space.values()  # type: ignore[attr-defined]  # a Dict space
        assert {uav.shape, devices.shape} == {(4,), (10, 6)}

    def test_info_of_a_step(self) -> None:
        env = DataCollectionEnv("released", LAYOUT, fading="none")
        _, start = env.reset(seed=0, options={"position_m": [500.0, 500.0]})
        assert set(start) == {"age_s", "position_m", "layout_m"}
        observation, reward, terminated, truncated, info = env.step(action(device=4))
        assert set(info) == INFO
        assert type(reward) is float
        assert (type(terminated), type(truncated)) == (bool, bool)
        assert info["served"] is True
        assert info["outage"] is False
        assert info["position_m"].tolist() == [503.0, 504.0]
        assert info["move_s"] == pytest.approx(0.2)
        assert info["step_s"] == info["duration_s"] == pytest.approx(info["move_s"] + info["transmission_s"] + 0.02)
        assert info["transmission_s"] == pytest.approx(2e6 / info["rate_bps"])
        assert info["rate_bps"] == pytest.approx(1e6 * np.log2(1 + info["snr"]))
        assert info["energy_j"] == pytest.approx(info["energy_move_j"] + info["energy_communication_j"])
        assert info["device_energy_j"] == pytest.approx(0.1259 * info["transmission_s"])
        assert info["age_s"].shape == (10,)
        assert info["age_s"][3] == 0.0
        assert info["reward"] == reward
        assert observation[2:12] == pytest.approx(info["age_s"])
        assert reward == pytest.approx(-0.5 * info["age_term"] - 0.5 * info["energy_term"])

    def test_info_and_observation_are_the_callers_own(self) -> None:
        env = DataCollectionEnv("released", LAYOUT)
        env.reset(seed=0)
        _, _, _, _, info = env.step(action())
        before = env.state.age_s.copy()
        info["age_s"][:] = 77.0
        info["layout_m"][:] = 77.0
        assert env.state.age_s.tolist() == before.tolist()
        assert env.layout_m.tolist() == LAYOUT.tolist()

    def test_episode_ends_by_truncation(self) -> None:
        env = DataCollectionEnv("released", LAYOUT, max_steps=3)
        env.reset(seed=0)
        assert [env.step(action())[2:4] for _ in range(3)] == [(False, False), (False, False), (False, True)]

    def test_episode_ends_by_termination(self) -> None:
        env = DataCollectionEnv("released", LAYOUT, energy_budget_j=1.0)
        env.reset(seed=0)
        assert env.step(action(25.0, 0.0))[2:4] == (True, False)


class TestResets:
    def test_equal_seeds_fly_equal_episodes(self) -> None:
        runs = []
        for _ in range(2):
            env = DataCollectionEnv("released")
            observation, _ = env.reset(seed=7)
            runs.append([observation.tolist(), *(env.step(action(device=2))[0].tolist() for _ in range(5))])
        assert runs[0] == runs[1]

    def test_a_new_layout_each_episode(self) -> None:
        env = DataCollectionEnv("released")
        layouts = [env.reset(seed=0 if i == 0 else None)[1]["layout_m"] for i in range(3)]
        assert not np.array_equal(layouts[0], layouts[1])
        assert not np.array_equal(layouts[1], layouts[2])
        assert all(((layout >= 0) & (layout <= 1000)).all() for layout in layouts)

    def test_a_fixed_layout_stays_while_the_start_varies(self) -> None:
        env = DataCollectionEnv("released", LAYOUT)
        infos = [env.reset(seed=0 if i == 0 else None)[1] for i in range(3)]
        assert all(info["layout_m"].tolist() == LAYOUT.tolist() for info in infos)
        assert len({tuple(info["position_m"]) for info in infos}) == 3

    def test_options_hold_for_one_episode(self) -> None:
        env = DataCollectionEnv("released", LAYOUT)
        other = LAYOUT[::-1]
        _, info = env.reset(seed=0, options={"position_m": (1.0, 2.0), "layout": other})
        assert info["position_m"].tolist() == [1.0, 2.0]
        assert info["layout_m"].tolist() == other.tolist()
        _, info = env.reset()
        assert info["layout_m"].tolist() == LAYOUT.tolist()
        assert info["position_m"].tolist() != [1.0, 2.0]

    def test_positions_fill_an_area_that_is_no_square(self) -> None:
        scenario = load_scenario("released", width_m=100.0, depth_m=900.0)
        positions = random_positions(np.random.default_rng(0), (2000, 2), scenario)
        assert positions.max(axis=0) == pytest.approx([100.0, 900.0], rel=0.01)
        assert positions.min(axis=0) == pytest.approx([0.0, 0.0], abs=9.0)


class TestMistakes:
    @pytest.mark.parametrize(
        ("layout", "message"),
        [
            (np.zeros((10, 3)), "layout has shape (10, 3), allowed: (10, 2)"),
            (np.zeros((9, 2)), "layout has shape (9, 2), allowed: (10, 2)"),
            (np.full((10, 2), np.nan), "layout[0, 0] = nan lies outside the area 0..1000 m"),
            ([[0.0, 0.0]] * 9 + [[0.0, 1000.5]], "layout[9, 1] = 1000.5 lies outside the area 0..1000 m"),
            ([[0.0, 0.0]] * 9 + [[-1.0, 0.0]], "layout[9, 0] = -1 lies outside"),
            ([[0.0, 0.0]] * 9 + [[0.0]], "layout is no array of numbers"),
            ("here", "layout is no array of numbers"),
            (np.zeros((2, 10, 2)), "layout has shape (2, 10, 2), allowed: (10, 2)"),
        ],
    )
    def test_a_layout(self, layout: Any, message: str) -> None:
        with pytest.raises(ScenarioError, match=re.escape(message)):
            DataCollectionEnv("released", layout)
        env = DataCollectionEnv("released")
        with pytest.raises(ScenarioError, match=re.escape(message)):
            env.reset(options={"layout": layout})

    def test_check_layout_takes_the_border(self) -> None:
        edge = [[0.0, 0.0]] * 9 + [[1000.0, 1000.0]]
        assert check_layout(edge, load_scenario("released")).tolist() == edge

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"position": [0, 0]}, "reset option 'position' does not exist, allowed: 'position_m', 'layout'"),
            ({"position_m": [0.0, 0.0, 0.0]}, "position_m has shape (3,), allowed: (2,)"),
            ({"position_m": [0.0, 1001.0]}, "position_m[1] = 1001 lies outside the area 0..1000 m"),
            ({"position_m": "home"}, "position_m is no array of numbers"),
            ({"position_m": [[0.0], [0.0, 1.0]]}, "position_m is no array of numbers"),
        ],
    )
    def test_a_reset_option(self, options: dict[str, Any], message: str) -> None:
        with pytest.raises(ScenarioError, match=re.escape(message)):
            DataCollectionEnv("released").reset(options=options)

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            (action(device=11), "device = 11, allowed: 0 (idle) to 10"),
            (action(device=-1), "device = -1, allowed: 0 (idle) to 10"),
            ({"displacement_m": [0.0, 0.0], "device": 1.5}, "device is of type float64, allowed: integers"),
            (action(float("nan")), "displacement_m = nan, allowed: metres"),
            ({"displacement_m": [0.0, 0.0, 0.0], "device": 1}, "displacement_m has shape (3,), allowed: (2,)"),
            ({"displacement_m": "up", "device": 1}, "displacement_m is no array of numbers"),
        ],
    )
    def test_an_action(self, wrong: dict[str, Any], message: str) -> None:
        env = DataCollectionEnv("released", LAYOUT)
        env.reset(seed=0)
        with pytest.raises(ScenarioError, match=re.escape(message)):
            env.step(wrong)

    def test_an_action_of_a_vector(self) -> None:
        env = DataCollectionVectorEnv(3, "released", LAYOUT)
        env.reset(seed=0)
        with pytest.raises(ScenarioError, match=r"device = 12, allowed: 0 \(idle\) to 10"):
            env.step({"displacement_m": np.zeros((3, 2)), "device": np.array([0, 12, 0])})
        with pytest.raises(ScenarioError, match=r"device has shape \(2,\), allowed: \(3,\)"):
            env.step({"displacement_m": np.zeros((3, 2)), "device": np.array([0, 1])})
        with pytest.raises(ScenarioError, match="displacement_m = inf, allowed: metres"):
            env.step({"displacement_m": np.full((3, 2), np.inf), "device": np.array([0, 1, 2])})

    def test_arguments(self) -> None:
        with pytest.raises(ScenarioError, match="num_envs = 0, allowed: 1 or more"):
            DataCollectionVectorEnv(0)
        with pytest.raises(ScenarioError, match="render_mode = 'human', allowed: none, 'rgb_array'"):
            DataCollectionEnv(render_mode="human")
        with pytest.raises(ScenarioError, match="render_mode = 'rgb_array': the vector environment has none"):
            DataCollectionVectorEnv(2, render_mode="rgb_array")  # type: ignore[arg-type]  # what must fail
        with pytest.raises(ScenarioError, match="'fadin' does not exist, nearest: fading"):
            gymnasium.make(ENVIRONMENT_ID, fadin="none")
        with pytest.raises(ScenarioError, match="seed is a list"):
            DataCollectionVectorEnv(2).reset(seed=[1, 2])


class TestVector:
    @KINDS
    def test_of_one_equals_the_single_environment_for_equal_seeds(self, kind: Any) -> None:
        single = DataCollectionEnv("released", observation=kind)
        vector = DataCollectionVectorEnv(1, "released", observation=kind)
        left, _ = single.reset(seed=3)
        right, _ = vector.reset(seed=3)
        generator = np.random.default_rng(0)
        assert flat(left).tolist() == flat(right).ravel().tolist()
        for _ in range(400):
            acts = actions(generator, 1)
            left, reward, terminated, truncated, info = single.step({key: value[0] for key, value in acts.items()})
            right, rewards, terminations, truncations, infos = vector.step(acts)
            # where NumPy has AVX-512, its logarithm of an array may differ from that of a number in the last digit
            assert flat(left) == pytest.approx(flat(right).ravel(), rel=1e-6)
            assert reward == pytest.approx(rewards[0], rel=1e-12)
            assert (terminated, truncated) == (terminations[0], truncations[0])
            assert set(info) == set(infos)
            assert all(info[key] == pytest.approx(infos[key][0], rel=1e-12) for key in info)
            if truncated:
                return
        pytest.fail("the episode did not end")

    @pytest.mark.parametrize("scenario", ["released", "realistic"])
    def test_of_three_equals_three_single_ones_for_equal_draws(
        self, scenario: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        generator = np.random.default_rng(5)
        layouts = generator.uniform(0, 1000, (3, 10, 2))
        starts = generator.uniform(0, 1000, (3, 2))
        drawn = [Draws(generator.standard_normal((3, 2)), generator.random(3)) for _ in range(60)]
        acts = [actions(generator, 3) for _ in range(60)]
        stream = iter(drawn)
        monkeypatch.setattr(environment, "draw", lambda _generator, *_count: next(stream))

        vector = DataCollectionVectorEnv(3, scenario, layouts, max_steps=60)
        vector.reset(seed=0, options={"position_m": starts})
        together = [vector.step(one) for one in acts]
        for n in range(3):
            stream = iter(Draws(d.scatter[n], float(d.sight[n])) for d in drawn)
            single = DataCollectionEnv(scenario, layouts[n], max_steps=60)
            single.reset(seed=9, options={"position_m": starts[n]})
            for one, (observation, rewards, terminations, truncations, infos) in zip(acts, together, strict=True):
                seen, reward, terminated, truncated, info = single.step({k: v[n] for k, v in one.items()})
                assert seen == pytest.approx(observation[n], rel=1e-6)
                assert reward == pytest.approx(rewards[n], rel=1e-12)
                assert (terminated, truncated) == (terminations[n], truncations[n])
                assert all(info[key] == pytest.approx(infos[key][n], rel=1e-12) for key in info)
            assert truncated

    def test_autoreset_is_the_next_step(self) -> None:
        """As Gymnasium defines NEXT_STEP: the step after the last ignores its action, and returns a fresh episode."""
        vector = DataCollectionVectorEnv(2, "released", max_steps=None, time_budget_s=2.0, fading="none")
        assert vector.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
        vector.reset(seed=0)
        first_layout = vector.layout_m.copy()
        acts = {"displacement_m": np.array([[25.0, 0.0], [0.0, 0.0]]), "device": np.array([1, 0])}
        while True:  # flight 0 takes steps of more than a second, flight 1 idles
            observation, _, _, truncated, info = vector.step(acts)
            if truncated[0]:
                break
        assert not truncated[1]
        assert info["step"][0] >= 2
        assert observation[0, 2:].any()
        assert vector.layout_m.tolist() == first_layout.tolist(), "the last observation is of the old episode"

        clock = info["time_s"][1]
        observation, reward, terminated, truncated, info = vector.step(acts)
        assert observation[0, 2:].tolist() == [0.0] * 11
        assert observation[0, :2] == pytest.approx(info["position_m"][0])
        assert (reward[0], terminated[0], truncated[0]) == (0.0, False, False)
        assert not np.array_equal(vector.layout_m[0], first_layout[0])
        assert np.array_equal(vector.layout_m[1], first_layout[1])
        assert info["step"].tolist()[0] == 0
        assert info["time_s"][1] == pytest.approx(clock + 0.02), "the other flight goes on"
        fresh = {key: value[0] for key, value in info.items() if key not in ("position_m", "layout_m")}
        assert not any(np.any(value) for value in fresh.values()), "nothing is reported of a step that was not flown"

        _, reward, _, _, info = vector.step(acts)
        assert info["step"][0] == 1
        assert reward[0] < 0.0

    def test_fixed_layouts_survive_the_autoreset(self) -> None:
        layouts = np.random.default_rng(1).uniform(0, 1000, (2, 10, 2))
        vector = DataCollectionVectorEnv(2, "released", layouts, max_steps=2)
        vector.reset(seed=0)
        for _ in range(7):
            vector.step(actions(np.random.default_rng(0), 2))
            assert vector.layout_m.tolist() == layouts.tolist()

    def test_make_vec_takes_the_native_one(self) -> None:
        vector = gymnasium.make_vec(ENVIRONMENT_ID, num_envs=3, scenario="paper", fading="none", observation="devices")
        assert isinstance(vector.unwrapped, DataCollectionVectorEnv)
        observation, _ = vector.reset(seed=0)
        assert vector.observation_space.contains(observation)
        observation, reward, terminated, truncated, _ = vector.step(vector.action_space.sample())
        assert vector.observation_space.contains(observation)
        assert reward.shape == terminated.shape == truncated.shape == (3,)

    def test_restored_it_goes_on_as_it_would_have(self) -> None:
        vector = DataCollectionVectorEnv(2, "released", max_steps=3)
        vector.reset(seed=0)
        generator = np.random.default_rng(0)
        for _ in range(3):
            _, _, terminated, truncated, _ = vector.step(actions(generator, 2))
        other = DataCollectionVectorEnv(2, "released", max_steps=3)
        other.np_random.bit_generator.state = vector.np_random.bit_generator.state
        other.restore(vector.state, vector.layout_m, terminated | truncated)
        assert other.observation().tolist() == vector.observation().tolist()
        for _ in range(5):
            acts = actions(generator, 2)
            assert other.step(acts)[0].tolist() == vector.step(acts)[0].tolist()
