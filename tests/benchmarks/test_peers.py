from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize

from benchmarks.peers import ours, point_mass, settings
from benchmarks.peers.table import difference, interval


def test_one_step_by_hand() -> None:
    observation = np.array([[1.0, 0.0, 0.5, 0.0]])
    after, reward = point_mass.step(observation, np.array([[-1.0, 3.0]]), np.array([[0.0, 1.0]]))
    # v_x = .9 * .5 - .2, v_y = .2 (the push is held in the box) + .05; p' = p + .2 v'
    np.testing.assert_allclose(after, [[1.05, 0.05, 0.25, 0.25]])
    np.testing.assert_allclose(reward, [-0.2 * (1.0 + 0.1 * 0.25 + 0.1 * 2.0)])


def test_the_regulator_is_the_best_linear_controller() -> None:
    episodes = 500
    gains = -ours.best_controller()(np.array([[1.0, 0.0, 0.0, 1.0]]))[0]
    near = np.array([0.2, 0.2, 0.2, 0.2])  # near the origin, where the box does not bind

    def cost(trial: np.ndarray) -> float:
        generator = np.random.default_rng(0)
        state = point_mass.starts(episodes, generator) * near
        total = 0.0
        for _ in range(80):  # noise adds the same optimal gains and only blurs them
            action = -trial[0] * state[:, :2] - trial[1] * state[:, 2:]
            state, reward = point_mass.step(state, action, np.zeros((episodes, 2)))
            total -= float(reward.mean())
        return total

    found = minimize(cost, np.array([1.0, 1.0]), method="Nelder-Mead").x
    np.testing.assert_allclose(gains, found, rtol=0.01)


def test_the_regulator_beats_what_logged_the_data() -> None:
    logged = point_mass.log(100, 0).returns
    best = point_mass.fly(ours.best_controller(), 100, 0).returns  # same starts, same gusts
    assert (best > logged).all()
    assert best.mean() > 0.5 * logged.mean()


def test_the_data_follow_from_their_seed() -> None:
    first, again, other = (point_mass.log(5, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.observation, again.observation)
    np.testing.assert_array_equal(first.action, again.action)
    assert not np.array_equal(first.action, other.action)


def test_both_sides_learn_from_the_same_transitions(tmp_path: Path) -> None:
    path = tmp_path / settings.DATA
    point_mass.save(path, point_mass.log(4, 0))
    data = point_mass.load(path)
    mine = point_mass.transitions(data)
    theirs: dict[str, list[np.ndarray]] = {name: [] for name in mine}
    for episode in point_mass.cut_episodes(data):
        for t in range(len(episode["rewards"]) - 1):  # an episode that was cut ends one row early, there
            theirs["observation"].append(episode["observations"][t])
            theirs["action"].append(episode["actions"][t])
            theirs["reward"].append(episode["rewards"][t, 0])
            theirs["next_observation"].append(episode["observations"][t + 1])
    for name, array in mine.items():
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, np.array(theirs[name]))


def test_what_we_learn_from_is_never_terminal_and_unscaled() -> None:
    log = {name: torch.as_tensor(array) for name, array in point_mass.transitions(point_mass.log(2, 0)).items()}
    rows = torch.tensor([49, 99])  # the last step of each episode
    batch = ours.batch(log, rows)
    assert not batch.terminated.any()
    torch.testing.assert_close(batch.reward, log["reward"][rows])
    for config in (ours.cql_config(), ours.iql_config()):
        assert (config.huber, config.gradient_clip, config.discount) == (None, None, settings.DISCOUNT)


def test_a_few_updates_already_beat_the_data() -> None:
    data = point_mass.log(settings.EPISODES, settings.DATA_SEED)
    policy = ours.learn("cql", data, seed=0, updates=300)
    assert point_mass.fly(policy, 50, 1).returns.mean() > data.returns.mean()


def test_intervals_against_tabled_t() -> None:
    assert interval(np.array([1.0, 2.0, 3.0])) == "2.000 [-0.484, 4.484]"  # t_.975 with 2 degrees is 4.303
    # equal variances and sizes: Welch's degrees are 4, t_.975 2.776, standard error sqrt(2 / 3)
    assert difference(np.array([2.0, 3.0, 4.0]), np.array([1.0, 2.0, 3.0])) == "+1.000 [-1.267, +3.267]"
