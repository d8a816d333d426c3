from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

from tests.agents.problems import copies, equal, network
from tests.datasets.flights import small_scenario
from uavrl.agents.sac import SacConfig
from uavrl.datasets import Transitions, validate
from uavrl.errors import CheckpointError, ConfigError, DivergenceError
from uavrl.evaluation.rollouts import fixed_layout
from uavrl.scenario import Scenario
from uavrl.simulation.dynamics import advance
from uavrl.simulation.state import Draws, FlightAction, SimState
from uavrl.training.checkpoint import agent_tensors, load_checkpoint
from uavrl.training.online import CollectConfig, OnlineLearner

SCENARIO = small_scenario(devices=3, max_steps=6, fading="none")


def config(
    layouts: Literal["fixed", "random"] = "random", kind: Literal["mlp", "devices"] = "devices", **changes: Any
) -> CollectConfig:
    agent = SacConfig(network=network(kind, width=8), batch_size=8, **changes.pop("agent", {}))
    settings = {
        "episodes": 5,
        "environments": 2,
        "random_steps": 9,
        "steps_per_update": 2,
        "centre_every": 3,
        "seed": 4,
    }
    return CollectConfig(scenario=SCENARIO, layouts=layouts, agent=agent, **{**settings, **changes})


def quiet(done: int, text: str) -> None:
    """A reporter that says nothing."""


def rows(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]


def stop_at(step: int, error: BaseException | None = None) -> Any:
    """A reporter in whose call Ctrl-C is pressed, or an error raised, once `step` rows are logged."""
    done_before = False

    def report(done: int, text: str) -> None:
        nonlocal done_before
        if done >= step and not done_before:
            done_before = True
            if error is not None:
                raise error
            signal.raise_signal(signal.SIGINT)

    return report


@pytest.mark.parametrize(("kind", "layouts"), [("devices", "random"), ("mlp", "fixed")])
def test_an_interrupted_run_ends_as_one_that_was_not(
    tmp_path: Path, kind: Literal["mlp", "devices"], layouts: Literal["fixed", "random"]
) -> None:
    """Interrupted in the random phase, in the learning phase, and killed since its last checkpoint."""
    straight = OnlineLearner(config(layouts, kind))
    expected = straight.run(tmp_path / "straight", quiet)
    assert len(expected) == 5 * 6
    assert straight.updates == 11
    place, transitions = tmp_path / "broken", None
    for step, error in ((4, None), (12, None), (17, None), (25, RuntimeError("killed")), (1000, None)):
        learner = OnlineLearner.resume(place) or OnlineLearner(config(layouts, kind))
        try:
            transitions = learner.run(place, stop_at(step, error))
        except (KeyboardInterrupt, RuntimeError):
            assert len(learner.log) >= step
    assert transitions is not None
    assert transitions.digest() == expected.digest()
    assert equal(copies(learner.agent.networks), copies(straight.agent.networks))
    assert equal(agent_tensors(learner.agent)["optimisers"], agent_tensors(straight.agent)["optimisers"])
    assert rows(place) == rows(tmp_path / "straight")
    ended = [load_checkpoint(directory / "checkpoint") for directory in (tmp_path / "straight", place)]
    assert ended[0].document == ended[1].document
    assert all(equal(ended[0].tensors[name], ended[1].tensors[name]) for name in ended[0].tensors)


def test_the_log_is_what_the_environment_did(tmp_path: Path) -> None:
    learner = OnlineLearner(config())
    log = learner.run(tmp_path, quiet)
    validate(log, SCENARIO)
    # every flight whole, from its start to its limit
    assert log.episode.tolist() == sorted(list(range(5)) * 6)
    assert log.step.tolist() == list(range(6)) * 5
    assert log.truncated.tolist() == ([False] * 5 + [True]) * 5
    assert not log.terminated.any()
    # flown again from what was logged, without fading: the same
    zero = np.zeros(len(log))
    position, ages, last, used = (a.astype(np.float64) for a in (log.position_m, log.age_s, log.energy_j, log.used_j))
    before = SimState(position, ages, last, used, zero, log.step)
    action = FlightAction(log.displacement_m.astype(np.float64), log.device)
    draws = Draws(np.zeros((len(log), 2)), np.zeros(len(log)))
    after, outcome = advance(SCENARIO, log.layout_m.astype(np.float64), before, action, draws)
    np.testing.assert_allclose(log.next_age_s, after.age_s, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(log.next_position_m, after.position_m, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(log.reward, outcome.reward, rtol=1e-4, atol=1e-5)
    # and the returns that it wrote down are the sums of the rewards
    written = sorted(row["return"] for row in rows(tmp_path) if "return" in row)
    sums = sorted(log.reward[log.episode == episode].sum() for episode in range(5))
    np.testing.assert_allclose(written, sums, rtol=1e-5)
    assert [row["episode"] for row in rows(tmp_path)] == [2, 2, 4, 4, 5]


def test_layouts_are_one_or_many_and_none_of_the_evaluation(tmp_path: Path) -> None:
    def flown(layouts: Literal["fixed", "random"]) -> Transitions:
        return OnlineLearner(config(layouts)).run(tmp_path / layouts, quiet)

    fixed, many = flown("fixed"), flown("random")
    np.testing.assert_allclose(fixed.layout_m, np.broadcast_to(fixed_layout(SCENARIO), fixed.layout_m.shape), rtol=1e-6)
    assert len(np.unique(many.layout_m.reshape(len(many), -1), axis=0)) == 5
    assert len(np.unique(fixed.position_m[fixed.step == 0], axis=0)) == 5
    with pytest.raises(ValueError, match="seed"):
        config(seed=1_000_000)


def test_the_first_steps_are_uniformly_random_and_the_later_ones_the_agents(tmp_path: Path) -> None:
    learner = OnlineLearner(config(episodes=40, environments=4, random_steps=10_000))
    log = learner.run(tmp_path, quiet)
    assert learner.updates == 0
    reach = SCENARIO.airframe.max_displacement_m
    assert set(log.device.tolist()) == {0, 1, 2, 3}
    assert np.abs(log.displacement_m).max() <= reach
    assert log.displacement_m.std() == pytest.approx(reach / 3**0.5, rel=0.1)
    assert (log.device == 0).mean() == pytest.approx(0.25, abs=0.1)


def test_recentring_moves_the_level_of_q_and_no_difference() -> None:
    learner = OnlineLearner(config(agent={"discount": 0.9, "reward": {"transform": "centred", "clip": None}}))
    while len(learner.log) < 24:
        learner._fly()
    learner.agent.critic.shift(40.0)
    observation = {name: torch.from_numpy(value) for name, value in learner.observation.items()}

    def values() -> torch.Tensor:
        networks = (learner.agent.critic, learner.agent.target)
        with torch.no_grad():
            return torch.stack([q.all_choices(q.encode(observation), torch.zeros(2, 2)) for q in networks])

    before = values()
    learner._recentre()
    assert learner.seen.level == pytest.approx(float(np.median(learner.log.take(np.arange(len(learner.log))).reward)))
    moved = values() - before
    torch.testing.assert_close(moved, moved.flatten()[0].expand_as(moved), rtol=1e-4, atol=1e-4)
    assert values()[0].abs().max() < 10.0


@pytest.mark.parametrize(
    ("transform", "scenario", "centred"),
    [
        ("centred", SCENARIO, True),
        ("none", SCENARIO, False),
        ("centred", SCENARIO.replace(energy_budget_j=1e6), False),
        ("centred", SCENARIO.replace(energy_budget_j=1e6, max_transmission_s=2.0), True),
    ],
)
def test_rewards_are_centred_where_asked_and_where_no_flight_ends_by_itself(
    transform: str, scenario: Scenario, centred: bool, tmp_path: Path
) -> None:
    settings = config(agent={"reward": {"transform": transform, "clip": 10.0}}).model_copy(
        update={"scenario": scenario}
    )
    learner = OnlineLearner(settings)
    learner.run(tmp_path, quiet)
    assert (learner.seen.level != 0.0) == centred


@pytest.mark.parametrize("transform", ["zscore", "robust"])
def test_a_transform_that_needs_all_data_is_refused(transform: str) -> None:
    with pytest.raises(ConfigError, match=rf"reward.transform = '{transform}' needs all data"):
        OnlineLearner(config(agent={"reward": {"transform": transform}}))


def test_a_loss_that_is_not_finite_stops_the_run_and_the_last_checkpoint_stays(tmp_path: Path) -> None:
    learner = OnlineLearner(config(episodes=20))
    real = learner.agent.update

    def update(*arguments: Any) -> dict[str, torch.Tensor]:
        metrics = real(*arguments)
        return metrics if learner.updates < 8 else metrics | {"actor_loss": torch.tensor(float("nan"))}

    learner.agent.update = update  # type: ignore[method-assign,assignment]  # what a run that diverges does
    with pytest.raises(DivergenceError, match=r"actor_loss = nan after 8 updates; the checkpoint keeps step 2\d"):
        learner.run(tmp_path, quiet, save_every=10)
    resumed = OnlineLearner.resume(tmp_path)
    assert resumed is not None
    assert 10 <= len(resumed.log) < 30


def test_resume_refuses_what_it_cannot_go_on_with(tmp_path: Path) -> None:
    assert OnlineLearner.resume(tmp_path) is None
    OnlineLearner(config(episodes=1)).run(tmp_path, quiet)
    manifest = tmp_path / "checkpoint" / "checkpoint.json"
    document = json.loads(manifest.read_text())
    for change, message in (
        ({"kind": "offline"}, "kind 'offline'"),
        ({"collect": {**document["collect"], "surprise": 1}}, "no run of this version"),
        ({"collect": None}, "no run of this version"),
    ):
        manifest.write_text(json.dumps(document | change))
        with pytest.raises(CheckpointError, match=message) as error:
            OnlineLearner.resume(tmp_path)
        assert "\n" not in str(error.value)


def test_flights_that_end_by_time_alone_are_logged_whole(tmp_path: Path) -> None:
    timed = SCENARIO.replace(max_steps=None, time_budget_s=3.0)
    log = OnlineLearner(config().model_copy(update={"scenario": timed})).run(tmp_path, quiet)
    assert set(log.episode.tolist()) == set(range(config().episodes))
    for episode in range(config().episodes):
        duration_s = log.duration_s[log.episode == episode]
        assert duration_s[:-1].sum() <= 3.0 < duration_s.sum()
