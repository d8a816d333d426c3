from __future__ import annotations

import pytest

from uavrl.agents.registry import preset
from uavrl.agents.sac import SacConfig
from uavrl.scenario import load_scenario
from uavrl.training.objective import STEP_S, for_objective

PER_SECOND = load_scenario("realistic")


def test_an_objective_a_step_changes_nothing() -> None:
    config = preset("diffusion_sac", "default")
    assert for_objective(config, load_scenario("released")) is config


@pytest.mark.parametrize("config", [SacConfig(), preset("diffusion_sac", "default"), preset("iql", "default")])
def test_a_typical_step_keeps_its_discount_and_the_scale_of_its_reward(config: SacConfig) -> None:
    found = for_objective(config, PER_SECOND)
    assert found.discount_per == "second"
    assert found.discount**STEP_S == pytest.approx(config.discount)
    assert found.reward.scale * STEP_S == pytest.approx(config.reward.scale)  # a second's cost is that of a step
    same = {"discount": config.discount, "discount_per": "step", "reward": config.reward}
    assert found.model_copy(update=same) == config


def test_settings_that_are_of_seconds_already_stay() -> None:
    config = SacConfig(discount=0.97, discount_per="second")
    assert for_objective(config, PER_SECOND) is config
