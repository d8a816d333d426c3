"""All offline agents by name, and the presets of their settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

from pydantic import Field

from uavrl.agents.base import Agent, AgentConfig, RewardConfig
from uavrl.agents.bc import BcConfig, BehaviourCloning
from uavrl.agents.bcq import Bcq, BcqConfig
from uavrl.agents.cql import Cql, CqlConfig
from uavrl.agents.diffusion_actor import DiffusionConfig
from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig
from uavrl.agents.gaussian_bc import GaussianBcConfig, GaussianBehaviourCloning
from uavrl.agents.iql import Iql, IqlConfig
from uavrl.agents.one_step import OneStep, OneStepConfig
from uavrl.agents.sac import Sac, SacConfig
from uavrl.errors import ConfigError
from uavrl.networks import NetworkConfig, Spaces

Offline = DiffusionSacConfig | CqlConfig | IqlConfig | BcqConfig | BcConfig | GaussianBcConfig | OneStepConfig
OfflineConfig = Annotated[Offline, Field(discriminator="name")]
AnyConfig = Annotated[Offline | SacConfig, Field(discriminator="name")]

Config = TypeVar("Config", bound=AgentConfig)

AGENTS: dict[type[AgentConfig], Callable[[Spaces, Any], Agent]] = {
    DiffusionSacConfig: DiffusionSac,
    CqlConfig: Cql,
    IqlConfig: Iql,
    BcqConfig: Bcq,
    BcConfig: BehaviourCloning,
    GaussianBcConfig: GaussianBehaviourCloning,
    OneStepConfig: OneStep,
    SacConfig: Sac,
}

# Table I and Section V-B of the paper: as printed, where its text leaves a choice see docs/diffusion-sac.md
_PAPER_NETWORK = NetworkConfig(kind="mlp", width=256, depth=3, activation="mish", choice_heads=False, log_inputs=False)
_PAPER_CHAIN = DiffusionConfig(schedule="linear", steps=50, sampler="ddpm", variance="beta", clip_x0=False)
_PAPER_REWARD = RewardConfig(transform="zscore", clip=None)
_PAPER_CLONE: dict[str, Any] = {
    "network": _PAPER_NETWORK,
    "reward": _PAPER_REWARD,
    "batch_size": 64,
    "learning_rate": 3e-4,
}
_PAPER_CRITIC: dict[str, Any] = {"discount": 0.99, "polyak": 0.005, "huber": None}  # of the baselines

PRESETS: dict[str, dict[str, Offline]] = {
    "diffusion_sac": {
        "default": DiffusionSacConfig(  # for flights, which are long and cut, not ended: docs/what-matters.md
            discount=0.9995,
            polyak=0.5,
            pinned_level=True,
            final_action_noise=0.02,
            cql_weight=0.15,
            cql_samples=0,
            huber=3.0,
            reward=RewardConfig(clip=10.0),
            choice_prior=1.0,
            null_candidate=True,
            shortest_move=0.04,  # twice the final action noise
        ),
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
            action_noise=0.0,
        ),
    },
    "cql": {
        "default": CqlConfig(  # this one and those of IQL and BCQ: results/quality, "Tuning the baselines"
            discount=0.998, polyak=0.1, cql_weight=0.15, huber=3.0, reward=RewardConfig(clip=10.0)
        ),
        "paper": CqlConfig(
            **{**_PAPER_CLONE, "network": _PAPER_NETWORK.model_copy(update={"choice_heads": True})},
            **_PAPER_CRITIC,
            cql_weight=1.0,
        ),
    },
    "iql": {
        "default": IqlConfig(learning_rate=3e-4),
        "paper": IqlConfig(**_PAPER_CLONE, **_PAPER_CRITIC),
    },
    "bcq": {
        "default": BcqConfig(discount=0.9995, polyak=0.5),
        "paper": BcqConfig(**_PAPER_CLONE, **_PAPER_CRITIC),
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
    "gaussian_bc": {
        "default": GaussianBcConfig(),
        "paper": GaussianBcConfig(**_PAPER_CLONE),
    },
}


def preset(agent: str, name: str) -> Offline:
    """Settings by agent, hyphens for underscores allowed, and preset.

    Raises:
        ConfigError: unknown agent or preset.
    """
    known = agent.replace("-", "_")
    if known not in PRESETS:
        raise ConfigError(f"agent = {agent!r}, allowed: {', '.join(PRESETS)}")
    if name not in PRESETS[known]:
        raise ConfigError(f"preset = {name!r} of {agent}, allowed: {', '.join(PRESETS[known])}")
    return PRESETS[known][name]


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with settings changed, those of a section by a dict of their own.

    Raises:
        pydantic.ValidationError: no such setting, or a value that is not allowed.
    """
    data = config.model_dump()
    for name, value in changes.items():
        data[name] = data[name] | value if isinstance(value, dict) else value
    return type(config).model_validate(data)


def acts_best_deterministically(config: AgentConfig) -> bool:
    """Whether its deterministic action is to be flown rather than a sample, as its class says."""
    return bool(getattr(AGENTS[type(config)], "acts_best_deterministically", False))


def make_agent(spaces: Spaces, config: AgentConfig) -> Agent:
    """An untrained agent; weights come from torch's global generator, which the caller seeds.

    Raises:
        ConfigError: settings of no agent that is registered here.
    """
    if type(config) not in AGENTS:
        known = ", ".join(one.__name__ for one in AGENTS)
        raise ConfigError(f"config = {type(config).__name__}, allowed: {known}")
    return AGENTS[type(config)](spaces, config)
