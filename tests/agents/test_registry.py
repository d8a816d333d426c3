"""Agents by name."""

from __future__ import annotations

from typing import Any, get_args, get_type_hints

import pytest
from pydantic import TypeAdapter

from tests.agents.problems import NAMES, spaces
from uavrl.agents.base import AgentConfig
from uavrl.agents.registry import AGENTS, PRESETS, AnyConfig, OfflineConfig, make_agent, preset
from uavrl.cli.train import Train
from uavrl.errors import ConfigError
from uavrl.networks import NetworkConfig


def test_every_agent_is_registered_once_and_under_its_own_name() -> None:
    names = [config.model_fields["name"].default for config in AGENTS]
    assert sorted(names) == sorted(NAMES)  # and the conformance suite knows it
    assert {*PRESETS, "sac", "one_step"} == set(names)
    for name, presets in PRESETS.items():
        assert set(presets) == {"default", "paper"}
        assert all(config.name == name for config in presets.values())


@pytest.mark.parametrize("name", PRESETS)
def test_settings_are_read_back_as_those_of_their_agent(name: str) -> None:
    for config in PRESETS[name].values():
        unions: tuple[Any, ...] = (OfflineConfig, AnyConfig)
        for union in unions:
            assert TypeAdapter(union).validate_python(config.model_dump(mode="json")) == config


def test_the_command_line_takes_every_agent_by_its_name_and_with_hyphens() -> None:
    literal = get_args(get_type_hints(Train, include_extras=True)["agent"])[0]
    assert set(get_args(literal)) == {*PRESETS, *(name.replace("_", "-") for name in PRESETS)}
    assert preset("gaussian-bc", "default") is preset("gaussian_bc", "default")
    with pytest.raises(ConfigError, match="agent = 'sac', allowed: diffusion_sac, cql"):
        preset("sac", "default")


def test_settings_of_no_agent_are_refused() -> None:
    with pytest.raises(ConfigError, match="config = AgentConfig, allowed: DiffusionSacConfig, CqlConfig"):
        make_agent(spaces("mlp"), AgentConfig(network=NetworkConfig(kind="mlp")))


@pytest.mark.parametrize("name", ["cql", "iql", "bcq", "gaussian_bc"])
def test_the_papers_settings_of_the_baselines(name: str) -> None:
    config = preset(name, "paper")
    assert (config.network.kind, config.network.width, config.network.depth) == ("mlp", 256, 3)
    assert (config.batch_size, config.discount, config.reward.transform) == (64, 0.99, "zscore")
