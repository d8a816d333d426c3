from __future__ import annotations

import pytest

from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.registry import preset
from uavrl.agents.sac import SacConfig
from uavrl.datasets import load_builtin
from uavrl.networks import NetworkConfig
from uavrl.scenario import load_scenario
from uavrl.training.scenario_settings import STEP_S, for_scenario, relocation_for

PER_SECOND = load_scenario("realistic")


def test_the_objective_that_settings_were_found_for_changes_nothing() -> None:
    config = preset("diffusion_sac", "default")
    assert for_scenario(config, load_scenario("released")) is config
    assert for_scenario(config, load_scenario("released", devices=20)) is config


def test_a_set_network_knows_the_area_and_the_longest_move() -> None:
    scenario = load_scenario("released", width_m=3000.0, max_displacement_m=50.0)
    found = for_scenario(preset("iql", "default"), scenario)
    assert (found.network.scale_m, found.network.reach_m) == (1500.0, 50.0)
    flat = SacConfig(network=NetworkConfig(kind="mlp"))
    assert for_scenario(flat, scenario) is flat


@pytest.mark.parametrize("agent", ["diffusion_sac", "cql", "iql", "bcq", "bc"])
def test_rewards_of_other_units_get_their_scale_from_the_log_for_every_algorithm(agent: str) -> None:
    config = preset(agent, "default")
    for scenario in (load_scenario("paper"), load_scenario("released", age_weight=0.9)):
        found = for_scenario(config, scenario)
        assert found.reward == config.reward.model_copy(update={"transform": "robust"})
        alike = {"reward": config.reward, "shortest_move": config.shortest_move}
        assert found.model_copy(update=alike) == config


def test_rewards_a_second_of_other_units_are_not_scaled_twice() -> None:
    config, scenario = preset("iql", "default"), PER_SECOND.replace(age_reference_s=400.0)
    found = for_scenario(config, scenario)
    assert config.reward.clip is not None
    assert (found.discount_per, found.reward.transform, found.reward.scale) == ("second", "robust", 1.0)
    assert found.reward.clip == for_scenario(config, PER_SECOND).reward.clip
    by_hand = for_scenario(config, scenario, ["reward.transform=zscore"])
    assert by_hand == for_scenario(config, PER_SECOND)


def test_an_online_learner_has_no_log_and_another_transform_stays() -> None:
    assert for_scenario(SacConfig(), load_scenario("paper")) == SacConfig()
    kept = preset("iql", "paper")
    assert for_scenario(kept, load_scenario("paper")) is kept


@pytest.mark.parametrize("config", [SacConfig(), preset("iql", "default"), preset("bcq", "default")])
def test_a_typical_step_keeps_its_discount_and_the_scale_of_its_reward(config: SacConfig) -> None:
    found = for_scenario(config, PER_SECOND)
    assert found.discount_per == "second"
    assert found.discount == pytest.approx(min(0.99, config.discount ** (1 / STEP_S)))
    assert found.reward.scale * STEP_S == pytest.approx(config.reward.scale)  # a second's cost is that of a step
    assert config.reward.clip is not None and found.reward.clip is not None
    assert found.reward.clip * STEP_S == pytest.approx(config.reward.clip)
    assert found.polyak == min(0.05, config.polyak)
    changed = ("discount", "discount_per", "polyak", "reward")
    assert found.model_copy(update={name: getattr(config, name) for name in changed}) == config


def test_by_the_second_no_level_is_pinned_and_advantages_are_learned() -> None:
    config = preset("diffusion_sac", "default")
    found = for_scenario(config, PER_SECOND)
    assert isinstance(config, DiffusionSacConfig) and isinstance(found, DiffusionSacConfig)
    assert (config.pinned_level, config.advantage_weight, config.choice_prior) == (True, 0.0, 1.0)
    assert (found.pinned_level, found.advantage_weight, found.choice_prior) == (False, 0.9, 0.0)


def test_short_moves_are_held_under_the_objective_where_that_was_tried_or_where_it_is_asked_for() -> None:
    config = preset("diffusion_sac", "default")
    assert for_scenario(config, load_scenario("released", devices=20)).shortest_move == config.shortest_move == 0.04
    for scenario in (load_scenario("paper"), PER_SECOND):
        assert for_scenario(config, scenario).shortest_move == 0
        assert for_scenario(config, scenario, ["discount_per=second"]).shortest_move == 0
        assert for_scenario(config, scenario, ["shortest_move=0.04"]).shortest_move == 0.04


def test_devices_are_moved_for_a_log_of_one_layout_that_diffusion_sac_learns_from() -> None:
    config, released = preset("diffusion_sac", "default"), load_scenario("released")
    one, many = load_builtin("fixed", 50), load_builtin("layouts", 50)
    assert relocation_for(config, released, one) == 0.5
    assert relocation_for(config, released, many) == 0
    assert relocation_for(config, load_scenario("paper"), one) == 0
    assert relocation_for(preset("cql", "default"), released, one) == 0
    assert relocation_for(preset("diffusion_sac", "paper"), released, one) == 0  # a perceptron


def test_settings_that_are_of_seconds_or_chosen_by_hand_stay() -> None:
    config = SacConfig(discount=0.97, discount_per="second")
    assert for_scenario(config, PER_SECOND) is config
    assert for_scenario(SacConfig(), PER_SECOND, ["polyak=0.1", "discount_per=step"]) == SacConfig()
    assert for_scenario(SacConfig(), PER_SECOND, ["discount=0.97"]).discount_per == "second"
