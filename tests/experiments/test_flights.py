from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uavrl.datasets import validate
from uavrl.evaluation.metrics import flight_metrics
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.experiments import flights
from uavrl.experiments.flights import KEPT, Data, Setting, flown, learned_from, measure
from uavrl.experiments.paper import PROTOCOLS, SCALES, Plan
from uavrl.experiments.runner import Run
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario
from uavrl.training.offline import OfflineLearner

PLAN = Plan(SCALES["smoke"])
SCENARIO = load_scenario("released", max_steps=15)


def learned(algorithm: str, **changes: Any) -> Run:
    (run,) = PLAN.learned(algorithm, PROTOCOLS["layouts"])
    return run.model_copy(update=changes)


def test_the_log_is_relabelled_selected_and_starved() -> None:
    scenario = load_scenario("paper", age_weight=0.9)
    rows = learned_from(Data(name="fixed", size=2_000, quality="good", never_served=(1, 2)), scenario)
    validate(rows, scenario)  # its rewards are the scenario's
    assert not np.isin(rows.device, (1, 2)).any()
    assert np.isin(rows.device, (0, 3, 10)).any()
    assert 1_000 < len(rows) < 2_000
    assert rows.episode.min() > 400  # of 700


def test_a_policy_is_flown_in_the_environments_that_evaluate_flies(tmp_path: Path) -> None:
    setting = Setting(scenario=SCENARIO, episodes=3, fading_seeds=2)
    run = Run(problem="policy", variant="TDM", settings={"policy": "tdm"}, updates=0, seed=0,
              options=setting.model_dump(mode="json"))  # fmt: skip
    row = {"scores": measure(run, tmp_path)}
    metrics = flight_metrics(fly(make_policy("tdm"), evaluation_set(SCENARIO, "random", 3, fading_seeds=2)))
    for name in KEPT:
        np.testing.assert_allclose(flown(row, name), metrics[name].reshape(3, 2).mean(axis=1), rtol=1e-4)
    assert "curve" not in row["scores"]


def test_a_learner_has_a_curve_and_the_other_action(tmp_path: Path) -> None:
    scores = measure(learned("BC"), tmp_path)
    assert scores["curve"]["at"] == [5, 10]
    assert len(scores["curve"]["return"]) == 2
    assert len(scores["flown"]["return"]) == len(scores["other_return"]) == 4
    assert scores["other_return"] != scores["flown"]["return"]


def test_a_run_that_was_interrupted_ends_as_if_it_had_not_been(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = learned("Diffusion-SAC")
    whole = measure(run, tmp_path / "whole")
    step = OfflineLearner.step

    def stops(learner: OfflineLearner) -> Any:
        if learner.updates == 7:
            raise KeyboardInterrupt
        return step(learner)

    monkeypatch.setattr(OfflineLearner, "step", stops)
    with pytest.raises(KeyboardInterrupt):
        measure(run, tmp_path / "parts")
    began: list[int] = []

    def watched(learner: OfflineLearner) -> Any:
        began.append(learner.updates)
        return step(learner)

    monkeypatch.setattr(OfflineLearner, "step", watched)
    parts = measure(run, tmp_path / "parts")
    assert began == [5, 6, 7, 8, 9]  # from the checkpoint after update 5
    for name in ("flown", "other_return", "curve"):
        assert parts[name] == whole[name]


@pytest.mark.parametrize("points", [2, 0])
def test_a_training_that_diverges_is_judged_by_its_last_good_checkpoint(
    points: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = OfflineLearner.step

    def explodes(learner: OfflineLearner) -> Any:
        metrics = step(learner)
        return metrics | ({"critic_loss": np.inf} if learner.updates > 5 else {})

    monkeypatch.setattr(OfflineLearner, "step", explodes)
    run = learned("Diffusion-SAC")
    scores = measure(run.model_copy(update={"options": run.options | {"points": points}}), tmp_path)
    assert "critic_loss = inf" in scores["diverged"]
    assert ("curve" in scores) == (points > 0)
    assert np.isfinite(scores["flown"]["return"]).all()


def test_an_online_learners_curve_is_of_its_own_flights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "_ONLINE_POINTS", 2)
    (run,) = [run for run in PLAN.online() if run.problem == "online"]
    scores = measure(run.model_copy(update={"updates": 4}), tmp_path)
    assert scores["curve"]["at"] == [2, 4]
    assert all(value < 0 for value in scores["curve"]["return"])
    assert 0 < scores["curve"]["age_per_step_s"][0] < 100


def test_what_does_not_exist_is_null() -> None:
    assert flights._short(np.array([1.23456789, np.nan])) == [1.2346, None]
    row = {"scores": {"flown": {"transmission_mean_s": [1.0, None]}}}
    np.testing.assert_array_equal(flown(row, "transmission_mean_s"), [1.0, np.nan])
