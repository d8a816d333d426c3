"""From a declared space and a configuration to networks."""

from __future__ import annotations

from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from uavrl.errors import ConfigError
from uavrl.networks.activations import ActivationName
from uavrl.networks.devices import SetActor, SetChoiceActor, SetConditional, SetCritic, SetDenoiser
from uavrl.networks.interfaces import Actor, ChoiceActor, Conditional, Critic, Denoiser, Observation
from uavrl.networks.mlp import MlpActor, MlpChoiceActor, MlpConditional, MlpCritic, MlpDenoiser, Normaliser


class Spaces(BaseModel):
    """What an agent acts in, declared and never inferred from data."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    observation: int | None = Field(description="entries of a flat observation; none: a set of devices")
    continuous: int = Field(ge=1, description="continuous entries of an action, each in [-1, 1]")
    choices: int = Field(
        ge=1, description="choices of an action; for a set of devices, K + 1; 1: the action is continuous alone"
    )


class NetworkConfig(BaseModel):
    """Shape of every network of an agent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["mlp", "devices"] = Field("devices", description="perceptron, or a network over the set of devices")
    width: int = Field(64, ge=1, description="units of a hidden layer")
    depth: int = Field(3, ge=1, description="hidden layers of a perceptron")
    activation: ActivationName = Field("silu", description="of a perceptron")
    layer_norm: bool = Field(False, description="layer normalisation in the critic")
    choice_heads: bool = Field(True, description="perceptron critic: one output a choice; false: choice is an input")
    log_inputs: bool = Field(True, description="perceptron: log(1 + |s|) of each entry beside the entry itself")
    scale_m: float = Field(500.0, gt=0, description="set network: distances are divided by this (m)")
    reach_m: float = Field(25.0, ge=0, description="set network: metres of a unit displacement")


def _flat_size(spaces: Spaces, config: NetworkConfig) -> int:
    if spaces.observation is None:
        raise ConfigError(f"network.kind = {config.kind!r} takes a flat observation, allowed here: 'devices'")
    return spaces.observation


def _needs_set(spaces: Spaces, config: NetworkConfig) -> None:
    if spaces.observation is not None:
        raise ConfigError(f"network.kind = {config.kind!r} takes a set of devices, allowed here: 'mlp'")
    if spaces.choices < 2:
        raise ConfigError("choices = 1, allowed for a set of devices: K + 1, idling and at least one device")


def _perceptron(config: NetworkConfig) -> dict[str, Any]:
    """What every perceptron takes from the configuration."""
    return {
        "log": config.log_inputs,
        "width": config.width,
        "depth": config.depth,
        "activation": config.activation,
    }


def make_critic(spaces: Spaces, config: NetworkConfig) -> Critic:
    """Two Q functions."""
    if config.kind == "devices":
        _needs_set(spaces, config)
        return SetCritic(
            spaces.continuous,
            width=config.width,
            scale_m=config.scale_m,
            reach_m=config.reach_m,
            layer_norm=config.layer_norm,
        )
    return MlpCritic(
        _flat_size(spaces, config),
        spaces.continuous,
        spaces.choices,
        heads=config.choice_heads,
        layer_norm=config.layer_norm,
        **_perceptron(config),
    )


def make_denoiser(spaces: Spaces, config: NetworkConfig) -> Denoiser:
    """The diffusion actor's network."""
    if config.kind == "devices":
        _needs_set(spaces, config)
        return SetDenoiser(spaces.continuous, width=config.width, scale_m=config.scale_m)
    return MlpDenoiser(
        _flat_size(spaces, config),
        spaces.continuous + spaces.choices,
        layer_norm=False,
        **_perceptron(config),
    )


def make_actor(spaces: Spaces, config: NetworkConfig) -> Actor:
    """The Gaussian-categorical actor."""
    if config.kind == "devices":
        _needs_set(spaces, config)
        return SetActor(spaces.continuous, width=config.width, scale_m=config.scale_m)
    return MlpActor(
        _flat_size(spaces, config),
        spaces.continuous,
        spaces.choices,
        layer_norm=False,
        **_perceptron(config),
    )


def make_choice_actor(spaces: Spaces, config: NetworkConfig) -> ChoiceActor:
    """The Gaussian-categorical actor whose displacement depends on its choice."""
    return _choice_actor(spaces, config, spaces.continuous)


def make_classifier(spaces: Spaces, config: NetworkConfig) -> ChoiceActor:
    """A categorical over the choice alone: means and deviations are empty."""
    return _choice_actor(spaces, config, 0)


def _choice_actor(spaces: Spaces, config: NetworkConfig, continuous: int) -> ChoiceActor:
    if config.kind == "devices":
        _needs_set(spaces, config)
        return SetChoiceActor(continuous, width=config.width, scale_m=config.scale_m)
    flat = _flat_size(spaces, config)
    return MlpChoiceActor(flat, continuous, spaces.choices, layer_norm=False, **_perceptron(config))


def make_conditional(
    spaces: Spaces, config: NetworkConfig, *, outputs: int, inputs: int = 0, choice: bool = False
) -> Conditional:
    """A function of s, of `inputs` further numbers, and of a choice where `choice`."""
    if config.kind == "devices":
        _needs_set(spaces, config)
        return SetConditional(inputs, outputs, choice=choice, width=config.width, scale_m=config.scale_m)
    flat, choices = _flat_size(spaces, config), spaces.choices if choice else 0
    return MlpConditional(flat, inputs, choices, outputs, layer_norm=False, **_perceptron(config))


def fit_normalisers(networks: nn.Module, observation: Observation) -> None:
    """Set every normaliser inside `networks` from observations (n, ...); set networks scale by constants instead."""
    if isinstance(observation, Tensor):
        with torch.no_grad():
            for module in networks.modules():
                if isinstance(module, Normaliser):
                    module.fit(observation)
