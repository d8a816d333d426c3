"""Settings that were found for steps, for an objective that is counted in seconds."""

from __future__ import annotations

from typing import TypeVar

from uavrl.agents.base import AgentConfig
from uavrl.scenario import Scenario

STEP_S = 0.4  # mean duration of a step in the built-in logs of `released`, where our presets were found

Config = TypeVar("Config", bound=AgentConfig)


def for_objective(config: Config, scenario: Scenario) -> Config:
    """`config` as it is, or under a reward per second what equals it for steps of `STEP_S`.

    The discount is then gamma^duration (a semi-Markov decision process) of as long a horizon, and rewards, which shrink
    with the step, are scaled up to what a step of the other objective is worth.
    """
    if scenario.objective.reward == "per_step" or config.discount_per == "second":
        return config
    reward = config.reward.model_copy(update={"scale": config.reward.scale / STEP_S})
    return config.model_copy(
        update={"discount": config.discount ** (1.0 / STEP_S), "discount_per": "second", "reward": reward}
    )
