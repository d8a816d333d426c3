from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import tuning
from uavrl.agents.registry import preset
from uavrl.errors import ConfigError
from uavrl.evaluation.rollouts import TRIAL_SEED
from uavrl.experiments.paper import ALGORITHMS, OURS, PROTOCOLS, SCALES, Plan
from uavrl.experiments.runner import finished

RUNS = tuning.runs(tuple(ALGORITHMS))
BEST = {
    "CQL": "cql_weight .15, gamma .998, polyak .1, huber 3, rewards to 10",
    "IQL": "learning_rate .0003",
    "BCQ": "gamma .9995, polyak .5",
    "BC": tuning.BASE,
}


def test_nothing_is_tuned_on_the_comparisons_seeds_or_layouts() -> None:
    judged = Plan(SCALES["standard"]).comparison(PROTOCOLS["layouts"])
    assert {run.options["seed"] for run in RUNS} == {TRIAL_SEED}
    assert not {run.options["seed"] for run in judged} & {TRIAL_SEED}
    assert not {run.seed for run in RUNS if run.updates} & {run.seed for run in judged}


def test_the_best_of_each_is_its_default() -> None:
    settings = {run.variant: run.settings for run in RUNS}
    for name, choice in BEST.items():
        candidates = {"candidates": 10} if name == "BCQ" else {}
        default = preset(ALGORITHMS[name], "default").model_dump(mode="json")
        assert settings[f"{name}, {choice}"] == default | candidates


def test_the_committed_rows_are_those_of_the_command() -> None:
    rows = finished(Path(__file__).parents[2] / "results" / "quality" / "tuning.jsonl")
    assert set(rows) == {run.key for run in RUNS}
    returned: dict[str, list[float]] = {}
    for run in RUNS:
        returned.setdefault(run.variant, []).append(np.mean(rows[run.key]["scores"]["flown"]["return"]))
    for name, choice in BEST.items():
        every = {variant: values for variant, values in returned.items() if variant.startswith(f"{name},")}
        seeds = max(map(len, every.values()))  # where finalists had more than one, one alone decides nothing
        own = {variant: np.mean(values) for variant, values in every.items() if len(values) == seeds}
        assert max(own, key=own.__getitem__) == f"{name}, {choice}"


def test_an_unknown_algorithm_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"algorithm = 'PPO', allowed: {OURS}, CQL"):
        tuning.main(tmp_path, ("PPO",))
    assert not any(tmp_path.iterdir())
