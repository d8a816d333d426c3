"""All offline agents by name, and the presets of their settings."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from uavrl.agents.base import Agent, RewardConfig
from uavrl.agents.bc import BcConfig, BehaviourCloning
from uavrl.agents.diffusion_actor import DiffusionConfig
from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig
from uavrl.agents.sac import Sac, SacConfig
from uavrl.errors import ConfigError
from uavrl.networks import NetworkConfig, Spaces

OfflineConfig = Annotated[BcConfig | DiffusionSacConfig, Field(discriminator="name")]
AnyConfig = Annotated[BcConfig | DiffusionSacConfig | SacConfig, Field(discriminator="name")]

# Table I and Section V-B of the paper: as printed, where its text leaves a choice see docs/diffusion-sac.md
_PAPER_NETWORK = NetworkConfig(kind="mlp", width=256, depth=3, activation="mish", choice_heads=False, log_inputs=False)
_PAPER_CHAIN = DiffusionConfig(schedule="linear", steps=50, sampler="ddpm", variance="beta", clip_x0=False)
_PAPER_REWARD = RewardConfig(transform="zscore", clip=None)

PRESETS: dict[str, dict[str, BcConfig | DiffusionSacConfig]] = {
    "diffusion_sac": {
        "default": DiffusionSacConfig(),
        "paper": DiffusionSacConfig(
            network=_PAPER_NETWORK,
            diffusion=_PAPER_CHAIN,
            reward=_PAPER_REWARD,
            batch_size=64,
            learning_rate=3e-4,
            discount=0.99,
            polyak=0.005,
            actor_average=0.995,
            gradient="full_chain",
            bc_weight=0.5,
            cql_weight=0.0,
            q_scale="none",
            huber=None,
            greedy_choice=False,
            displacement_weight=1.0,
        ),
    },
    "bc": {
        "default": BcConfig(),
        "paper": BcConfig(
            network=_PAPER_NETWORK,
            diffusion=_PAPER_CHAIN,
            reward=_PAPER_REWARD,
            batch_size=64,
            learning_rate=3e-4,
            displacement_weight=1.0,
        ),
    },
}


def preset(agent: str, name: str) -> BcConfig | DiffusionSacConfig:
    """Settings by agent and preset.

    Raises:
        ConfigError: unknown agent or preset.
    """
    if agent not in PRESETS:
        raise ConfigError(f"agent = {agent!r}, allowed: {', '.join(PRESETS)}")
    if name not in PRESETS[agent]:
        raise ConfigError(f"preset = {name!r} of {agent}, allowed: {', '.join(PRESETS[agent])}")
    return PRESETS[agent][name]


def make_agent(spaces: Spaces, config: BcConfig | DiffusionSacConfig | SacConfig) -> Agent:
    """An untrained agent; weights come from torch's global generator, which the caller seeds."""
    if isinstance(config, DiffusionSacConfig):
        return DiffusionSac(spaces, config)
    if isinstance(config, SacConfig):
        return Sac(spaces, config)
    return BehaviourCloning(spaces, config)
