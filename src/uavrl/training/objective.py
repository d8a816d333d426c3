"""Settings that were found for steps, for an objective that is counted in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from uavrl.agents.base import AgentConfig
from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.scenario import Scenario

STEP_S = 0.4  # mean duration of a step in the built-in logs of `released`, where our presets were found
MOST_DISCOUNT, FASTEST_POLYAK = 0.99, 0.05  # a second; an update: docs/what-matters.md
ADVANTAGE_WEIGHT = 0.9  # of Diffusion-SAC: a step changes little, and what it changes shows in later steps alone

Config = TypeVar("Config", bound=AgentConfig)


def for_objective(config: Config, scenario: Scenario, chosen: Sequence[str] = ()) -> Config:
    """`config` as it is, or under a reward per second what corresponds to it for steps of `STEP_S`.

    The discount is then gamma^duration (a semi-Markov decision process) of as long a horizon, at most that of
    `MOST_DISCOUNT`, and rewards, which shrink with the step, are scaled up to what a step of the other objective is
    worth. A level that a minibatch pins is too noisy to be charged by the second: it is not pinned. Diffusion-SAC has
    `ADVANTAGE_WEIGHT`.

    Args:
        config: a preset.
        scenario: whose objective counts.
        chosen: settings, name=value, that will be made by hand; with discount_per among them nothing is changed.
    """
    by_hand = any(setting.startswith("discount_per=") for setting in chosen)
    if scenario.objective.reward == "per_step" or config.discount_per == "second" or by_hand:
        return config
    reward = config.reward
    clip = None if reward.clip is None else reward.clip / STEP_S
    changes = {
        "discount": min(config.discount ** (1.0 / STEP_S), MOST_DISCOUNT),
        "discount_per": "second",
        "polyak": min(config.polyak, FASTEST_POLYAK),
        "reward": reward.model_copy(update={"scale": reward.scale / STEP_S, "clip": clip}),
    }
    if isinstance(config, DiffusionSacConfig):
        changes |= {"pinned_level": False, "advantage_weight": ADVANTAGE_WEIGHT}
    return config.model_copy(update=changes)
