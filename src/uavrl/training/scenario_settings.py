"""Settings that were found in `released`, for another scenario and for a log of one layout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from uavrl.agents.base import AgentConfig
from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.sac import SacConfig
from uavrl.datasets.mapped import MappedTransitions
from uavrl.datasets.transitions import Transitions
from uavrl.scenario import Scenario, load_scenario
from uavrl.training.offline import SAMPLE_ROWS

STEP_S = 0.4  # mean duration of a step in the built-in logs of `released`, where our presets were found
MOST_DISCOUNT, FASTEST_POLYAK = 0.99, 0.05  # a second; an update: docs/what-matters.md
ADVANTAGE_WEIGHT = 0.9  # of Diffusion-SAC: a step changes little, and what it changes shows in later steps alone
TRIED = tuple(load_scenario(name).objective for name in ("released", "realistic"))  # here scales were found by trials
HELD = TRIED[0]  # under which holding short moves was tried; that of `realistic` is better off with all flown
ONE_LAYOUT_RELOCATION = 0.5  # of Diffusion-SAC under the same objective

Config = TypeVar("Config", bound=AgentConfig)


def relocation_for(config: AgentConfig, scenario: Scenario, transitions: Transitions) -> float:
    """`TrainConfig.relocation`: not 0 for Diffusion-SAC with a set network and a log of one layout, where it was tried.

    Of mapped data `SAMPLE_ROWS` rows are looked at.
    """
    if not isinstance(config, DiffusionSacConfig) or config.network.kind != "devices" or scenario.objective != HELD:
        return 0.0
    known = transitions.sample(SAMPLE_ROWS) if isinstance(transitions, MappedTransitions) else transitions
    alike = bool((known.layout_m == known.layout_m[:1]).all())
    return ONE_LAYOUT_RELOCATION if alike else 0.0


def for_scenario(config: Config, scenario: Scenario, chosen: Sequence[str] = ()) -> Config:
    """`config` as it is, or what corresponds to it in a scenario of another objective, area or longest move.

    A network over the set of devices counts distances in halves of the area's longer side and knows the longest move.

    Under a reward per second the discount is gamma^duration (a semi-Markov decision process) of as long a horizon for
    steps of `STEP_S`, at most that of `MOST_DISCOUNT`, and rewards, which shrink with the step, are scaled up to what a
    step of the other objective is worth. A level that a minibatch pins is too noisy to be charged by the second: it is
    not pinned. Diffusion-SAC has `ADVANTAGE_WEIGHT` and believes its critic alone. Under any objective that is none of
    `TRIED` an offline algorithm's rewards get their scale from the log ("robust"); an online one has no log to take it
    from. Short moves are held under the objective of `released` alone.

    Args:
        config: a preset.
        scenario: what is learned for.
        chosen: settings, name=value, to be made by hand: with discount_per among them nothing is made per second, with
            reward.transform the scale does not come from the log.
    """
    objective, reward = scenario.objective, config.reward
    by_hand = {setting.partition("=")[0] for setting in chosen}
    changes: dict[str, Any] = {}
    offline = not isinstance(config, SacConfig)
    if objective not in TRIED and offline and reward.transform == "centred" and "reward.transform" not in by_hand:
        reward = reward.model_copy(update={"transform": "robust"})
    if objective.reward == "per_second" and config.discount_per == "step" and "discount_per" not in by_hand:
        clip = None if reward.clip is None else reward.clip / STEP_S
        scale = reward.scale if reward.transform == "robust" else reward.scale / STEP_S
        reward = reward.model_copy(update={"scale": scale, "clip": clip})
        changes = {
            "discount": min(config.discount ** (1.0 / STEP_S), MOST_DISCOUNT),
            "discount_per": "second",
            "polyak": min(config.polyak, FASTEST_POLYAK),
        }
        if isinstance(config, DiffusionSacConfig):
            changes |= {"pinned_level": False, "advantage_weight": ADVANTAGE_WEIGHT, "choice_prior": 0.0}
    if reward != config.reward:
        changes["reward"] = reward
    if objective != HELD and config.shortest_move > 0 and "shortest_move" not in by_hand:
        changes["shortest_move"] = 0.0
    area, network = scenario.area, config.network
    if network.kind == "devices":
        sizes = {"scale_m": 0.5 * max(area.width_m, area.depth_m), "reach_m": scenario.airframe.max_displacement_m}
        network = network.model_copy(update=sizes)
    if network != config.network:
        changes["network"] = network
    return config.model_copy(update=changes) if changes else config
