"""Which parts of Diffusion-SAC matter: one setting changed at a time, on the hybrid bandit and on the fixed layout."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import torch

from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig
from uavrl.agents.registry import changed, preset
from uavrl.datasets import load_builtin
from uavrl.evaluation.rollouts import TRIAL_SEED, evaluation_set, fly
from uavrl.evaluation.statistics import over_seeds
from uavrl.experiments.bandit import SPACES, HybridBandit, fit_bandit, samples
from uavrl.experiments.runner import Run, Scores
from uavrl.networks import NetworkConfig
from uavrl.scenario import load_scenario
from uavrl.training.offline import OfflineLearner, TrainConfig

EPISODES = 50

_BANDIT_NETWORK = NetworkConfig(kind="mlp", width=128, depth=3)
# What solves the bandit (tests/agents/test_known_values.py says why)
BANDIT = DiffusionSacConfig(
    network=_BANDIT_NETWORK,
    batch_size=64,
    gradient="full_chain",
    bc_weight=0.7,
    displacement_weight=10.0,
    cql_weight=0.05,
    cql_samples=4,
    greedy_choice=False,
    action_noise=0.0,
)
FLIGHT = cast(DiffusionSacConfig, changed(preset("diffusion_sac", "default"), {"shortest_move": 0.0}))  # all is flown
BASES = {"bandit": BANDIT, "fixed": FLIGHT}
UPDATES = {"bandit": 2_500, "fixed": 2_000}

BASE = "base"
_HEADS = {"network": {"choice_heads": False}}  # a critic that takes a relaxed choice as its input
_CHAIN = {"gradient": "full_chain"}  # what shapes the gradient in z shows where the chain's own choice is flown
_OWN_CHOICE = {"greedy_choice": False}

# name in the table -> what it changes; {problem: ...} where one problem needs more
VARIANTS: dict[str, dict[str, Any]] = {
    BASE: {},
    "Q scale: mean |Q|": {"q_scale": "absolute"},
    "Q scale: none": {"q_scale": "none"},
    "target actor: no average": {"actor_average": 0.0},
    "choice by the chain, expectation": _OWN_CHOICE,
    "choice by the chain, straight-through": _OWN_CHOICE | {"guidance": "straight_through"},
    "choice by the chain, softmax": _OWN_CHOICE | {"guidance": "softmax"} | _HEADS,
    "no guidance (the released code)": {"bc_weight": 1.0},
    "one pass": {"gradient": "one_step"},
    "whole chain": _CHAIN,
    "vp, M = 10": {"diffusion": {"schedule": "vp", "steps": 10}},
    "vp, M = 50": {"diffusion": {"schedule": "vp", "steps": 50}},
    "linear, M = 5": {"diffusion": {"schedule": "linear", "steps": 5}},
    "linear, M = 10": {"diffusion": {"schedule": "linear", "steps": 10}},
    "linear, M = 50": {"diffusion": {"schedule": "linear", "steps": 50}},
    "displacement weight 1": {"displacement_weight": 1.0},
    "displacement weight 10": {"displacement_weight": 10.0},
    "rewards not centred": {"reward": {"transform": "none"}},
    "no action noise": {"action_noise": 0.0},
    "action noise constant": {"final_action_noise": None},
    "level not pinned": {"pinned_level": False},
    "discount .99": {"discount": 0.99},
    "discount .998": {"discount": 0.998},
    "target critic .1": {"polyak": 0.1},
    "no conservative penalty": {"cql_weight": 0.0},
    "conservative penalty .3": {"cql_weight": 0.3},
    "Bellman error linear from 1 on": {"huber": 1.0},
}
CANDIDATES = (10, 50)  # of the base policy, beside its single one: nothing is trained anew for them


def runs(problem: str, seeds: Sequence[int], variants: Iterable[str] = VARIANTS) -> list[Run]:
    """The runs of one problem; a variant that changes nothing there, or cannot be, is left out."""
    base, found = BASES[problem], []
    options = {"episodes": EPISODES, "trial_seed": TRIAL_SEED} if problem == "fixed" else {}
    for variant in variants:
        changes = VARIANTS[variant]
        if "network" in changes and base.network.kind != "mlp":
            continue  # the set network's critic has an output a choice
        config = changed(base, changes)
        if variant != BASE and config == base:
            continue
        own = options | ({"candidates": list(CANDIDATES)} if variant == BASE else {})
        settings = config.model_dump(mode="json")
        found += [
            Run(problem=problem, variant=variant, settings=settings, updates=UPDATES[problem], seed=seed, options=own)
            for seed in seeds
        ]
    return found


def measure(run: Run, directory: Path) -> Scores:
    """Train and judge: shares on the bandit; on the fixed layout the mean return of trial flights, by either action."""
    config = DiffusionSacConfig.model_validate(run.settings)
    return measure_bandit(run, config) if run.problem == "bandit" else measure_flights(run, config, directory)


def measure_bandit(run: Run, config: DiffusionSacConfig) -> dict[str, float]:
    """See `HybridBandit.score`."""
    bandit = HybridBandit.draw(run.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(run.seed)
        agent = DiffusionSac(SPACES, config)
    fit_bandit(agent, bandit, run.updates, run.seed)
    found = bandit.score(samples(agent, run.seed))
    for count in run.options.get("candidates", ()):
        agent.config = config.model_copy(update={"candidates": count})
        found |= {f"{name}@{count}": share for name, share in bandit.score(samples(agent, run.seed)).items()}
    return found


def measure_flights(run: Run, config: DiffusionSacConfig, directory: Path) -> dict[str, float]:
    """Returns of the deterministic action and of samples; learned from 30,000 mixed transitions of `fixed`."""
    scenario = load_scenario("released")
    plan = TrainConfig(scenario=scenario, agent=config, updates=run.updates, seed=run.seed)
    data = load_builtin("fixed")
    learner = OfflineLearner.resume(directory, data) or OfflineLearner(plan, data)
    policy = learner.run(directory, lambda done, text: None)
    flights = evaluation_set(scenario, "fixed", run.options["episodes"], seed=run.options["trial_seed"])

    def returned(deterministic: bool) -> float:
        flown = fly(policy, flights, deterministic=deterministic)
        return float((flown.reward * flown.active).sum(axis=0).mean())

    found = {"return_deterministic": returned(True), "return_sampled": returned(False)}
    for count in run.options.get("candidates", ()):
        learner.agent.config = config.model_copy(update={"candidates": count})
        found[f"return_sampled@{count}"] = returned(False)
    return found


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: a line a variant, mean over seeds with its 95 % t interval; of two seeds, both values.

    A score named `name@n` becomes column `name` of a line "n candidates".
    """
    lines: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        for name, value in row["scores"].items():
            column, _, count = name.partition("@")
            variant = f"{count} candidates" if count else row["variant"]
            lines.setdefault(variant, {}).setdefault(column, []).append(value)
    columns = list(dict.fromkeys(column for scores in lines.values() for column in scores))
    text = [f"| variant | seeds | {' | '.join(columns)} |", "|---" * (2 + len(columns)) + "|"]
    for variant, scores in lines.items():
        cells = [summary(scores[column]) if column in scores else "" for column in columns]
        name = variant.replace("|", r"\|")  # as in |Q|
        text.append(f"| {name} | {max(map(len, scores.values()))} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def summary(values: Sequence[float]) -> str:
    """Mean ± half of the 95 % t interval; of two values, both; of one, itself."""
    digits = 0 if max(map(abs, values)) > 10 else 3
    if len(values) > 2:
        mean, _, high = over_seeds(values)
        return f"{mean:.{digits}f} ± {high - mean:.{digits}f}"
    return ", ".join(f"{value:.{digits}f}" for value in values)
