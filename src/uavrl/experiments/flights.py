"""One run of the paper's experiments: learn, or not, then fly the test environments.

Everything a run depends on is in its `Run`; what comes back is small enough to be committed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from uavrl.agents.registry import OfflineConfig
from uavrl.agents.sac import SacConfig
from uavrl.datasets import Quality, Transitions, load_source, relabelled, select
from uavrl.errors import DivergenceError
from uavrl.evaluation.metrics import flight_metrics
from uavrl.evaluation.rollouts import EVALUATION_SEED, EvaluationSet, Flights, evaluation_set, fly
from uavrl.evaluation.statistics import unit_means
from uavrl.experiments.runner import Row, Run, Scores
from uavrl.policies import make_policy
from uavrl.policies.base import Policy
from uavrl.scenario import Scenario
from uavrl.training.log import read_metrics
from uavrl.training.offline import OfflineLearner, TrainConfig
from uavrl.training.online import CollectConfig, OnlineLearner
from uavrl.training.policy import AgentPolicy, load_policy

SHOWN = ("return", "age_per_step_s", "energy_per_step_j")  # of a learning curve, as the paper's figures
KEPT = (  # of every environment
    *SHOWN,
    "age_per_second_s",
    "worst_device_age_s",
    "energy_per_episode_j",
    "throughput_mbps",
    "data_mb",
    "transmission_mean_s",
    "transmission_median_s",
    "jain_age",
    "jain_bits",
    "steps",
    "duration_s",
)
DIGITS = 5  # significant ones of a kept number
_ONLINE_POINTS = 50  # of an online learner's curve


class Data(BaseModel):
    """What a run learns from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field("layouts", description="built-in data, or a file")
    size: int = Field(30_000, ge=1, description="rows")
    quality: Quality = "mixed"
    seed: int = Field(0, ge=0, description="of the selection")
    never_served: tuple[int, ...] = Field((), description="devices 1..K whose services are taken out of the log")


class Setting(BaseModel):
    """Where a run learns and is judged: the `options` of its `Run`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scenario: Scenario
    layouts: Literal["fixed", "random"] = "random"
    data: Data | None = Field(None, description="None: nothing is learned offline")
    deterministic: bool = Field(True, description="which action is judged; the other one's return is kept as well")
    episodes: int = Field(100, ge=1, description="environments")
    fading_seeds: int = Field(3, ge=1, description="flights in each")
    points: int = Field(8, ge=0, description="of the learning curve, each flown once in every environment; 0: no curve")
    seed: int = Field(EVALUATION_SEED, ge=0, description="of the environments")

    def environments(self, fading_seeds: int) -> EvaluationSet:
        """What is flown."""
        return evaluation_set(self.scenario, self.layouts, self.episodes, seed=self.seed, fading_seeds=fading_seeds)


def learned_from(data: Data, scenario: Scenario) -> Transitions:
    """The rows of `data` with the rewards of `scenario`.

    Raises:
        DatasetError: no such data, or too few rows.
    """
    transitions, _ = load_source(data.name)
    chosen = relabelled(select(transitions, data.size, data.quality, data.seed), scenario)
    return chosen.take(~np.isin(chosen.device, data.never_served))


def measure(run: Run, directory: Path) -> Scores:
    """Learn in `directory`, going on from a checkpoint there, and fly.

    Returns:
        flown: metric -> a number an environment, the mean over its fading repeats; other_return: that of the action
        not asked for; curve: metric -> numbers over "at", where asked for; decision_ms; diverged: why a training
        stopped early, its last good checkpoint being judged then.
    """
    setting = Setting.model_validate(run.options)
    scores: Scores = {}
    if run.problem == "policy":
        policy: Policy = make_policy(run.settings["policy"])
    elif run.problem == "online":
        policy, scores = _learn_online(run, setting, directory)
    else:
        policy, scores = _learn_offline(run, setting, directory)
    flown = fly(policy, setting.environments(setting.fading_seeds), deterministic=setting.deterministic)
    scores |= {"flown": kept(flown), "decision_ms": _short(np.array([np.median(flown.latency_s) * 1e3]))[0]}
    if run.problem != "policy":
        other = fly(policy, setting.environments(1), deterministic=not setting.deterministic)
        scores["other_return"] = _short(flight_metrics(other)["return"])
    return scores


def kept(flights: Flights) -> dict[str, list[float | None]]:
    """The metrics of `KEPT`: a number an environment, the mean over its fading repeats."""
    environments = flights.evaluation_set
    unit = np.arange(environments.flights) // environments.fading_seeds
    return {name: _short(unit_means(values, unit)) for name, values in flight_metrics(flights).items() if name in KEPT}


def _learn_offline(run: Run, setting: Setting, directory: Path) -> tuple[Policy, Scores]:
    agent = TypeAdapter[OfflineConfig](OfflineConfig).validate_python(run.settings)
    if setting.data is None:
        raise ValueError("an offline run needs data")
    every = max(1, run.updates // setting.points) if setting.points else 0
    plan = TrainConfig(
        scenario=setting.scenario,
        agent=agent,
        updates=run.updates,
        seed=run.seed,
        evaluate_every=every,
        save_every=min(1_000, every or max(1, run.updates // 8)),
    )
    transitions = learned_from(setting.data, setting.scenario)
    learner = OfflineLearner.resume(directory, transitions) or OfflineLearner(plan, transitions)
    tests = setting.environments(1)

    def evaluate(policy: AgentPolicy) -> dict[str, float]:
        metrics = flight_metrics(fly(policy, tests, deterministic=setting.deterministic))
        return {name: float(metrics[name].mean()) for name in SHOWN}

    scores: Scores = {}
    try:
        policy: Policy = learner.run(directory, lambda done, text: None, evaluate)
    except DivergenceError as error:
        if learner.saved is None:
            raise
        scores["diverged"] = str(error)
        policy = load_policy(directory, setting.scenario)
    if setting.points:
        rows = [row for row in read_metrics(directory / "metrics.jsonl") if SHOWN[0] in row]
        scores["curve"] = {"at": [row["step"] for row in rows]} | {
            name: _short(np.array([row[name] for row in rows])) for name in SHOWN
        }
    return policy, scores


def _learn_online(run: Run, setting: Setting, directory: Path) -> tuple[Policy, Scores]:
    """`updates` counts flights here. The curve is of the training's own flights, which explore."""
    learner = OnlineLearner.resume(directory)
    if learner is None:
        config = CollectConfig(
            scenario=setting.scenario,
            layouts=setting.layouts,
            agent=SacConfig.model_validate(run.settings),
            episodes=run.updates,
            seed=run.seed,
        )
        learner = OnlineLearner(config)
    log = learner.run(directory, lambda done, text: None)
    age = log.next_age_s @ np.array(setting.scenario.traffic.priority_each)
    totals = {
        "return": (log.reward, False),
        "age_per_step_s": (age, True),
        "energy_per_step_j": (log.next_energy_j, True),
    }
    parts = np.array_split(np.arange(run.updates), min(_ONLINE_POINTS, run.updates))
    curve: dict[str, list[Any]] = {"at": [float(part[-1] + 1) for part in parts]}
    steps = np.bincount(log.episode, minlength=run.updates)
    for name, (values, per_step) in totals.items():
        flights = np.bincount(log.episode, weights=values, minlength=run.updates) / (steps if per_step else 1.0)
        curve[name] = _short(np.array([flights[part].mean() for part in parts]))
    return AgentPolicy("sac", learner.agent, setting.scenario), {"curve": curve}


def _short(values: NDArray[Any]) -> list[float | None]:
    """Numbers with `DIGITS` significant digits; JSON has no NaN."""
    return [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values]


def flown(row: Row, metric: str) -> NDArray[np.float64]:
    """A metric of every environment of a finished run, (E,)."""
    return np.array(row["scores"]["flown"][metric], dtype=np.float64)
