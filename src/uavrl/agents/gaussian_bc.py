r"""Behaviour cloning with a Gaussian-categorical policy: maximum likelihood, L = -E[\log \pi(d|s) + \log \pi(w|s, d)].

What a diffusion actor (`uavrl.agents.bc`) has to beat: one mode of w for each choice. Pomerleau 1989, "ALVINN", for the
idea; the likelihood is that of `uavrl.agents.gaussian_actor`.
"""

from __future__ import annotations

from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from uavrl.actions import HybridAction
from uavrl.agents.base import Agent, AgentConfig, Batch, Metrics, adam, minimise
from uavrl.agents.gaussian_actor import gaussian_action, gaussian_decision, log_likelihood
from uavrl.networks import Observation, Spaces, make_choice_actor


class GaussianBcConfig(AgentConfig):
    """Settings of Gaussian-categorical behaviour cloning."""

    name: Literal["gaussian_bc"] = "gaussian_bc"
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")


class GaussianBehaviourCloning(Agent):
    """Imitates the data's actions."""

    config: GaussianBcConfig

    def __init__(self, spaces: Spaces, config: GaussianBcConfig) -> None:
        self.spaces, self.config = spaces, config
        self.actor = make_choice_actor(spaces, config.network)
        self.networks = nn.ModuleDict({"actor": self.actor})
        self.optimisers = {"actor": adam(self.actor.parameters(), config)}

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Metrics]:
        """Negative log likelihood; there is no noise in it."""
        log_choice, log_displacement = log_likelihood(self.actor(batch.observation), batch.action)
        loss = -(log_choice + log_displacement).mean()
        parts = {"choice_loss": -log_choice.detach().mean(), "displacement_loss": -log_displacement.detach().mean()}
        return loss, {"bc_loss": loss.detach()} | parts

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """One step of the actor."""
        loss, metrics = self.actor_loss(batch)
        clip = self.config.gradient_clip
        metrics["actor_gradient"] = minimise(loss, self.actor, self.optimisers["actor"], clip)
        return metrics

    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """A sample of pi, or its mode."""
        return gaussian_action(self.actor, observation, generator, deterministic)

    def noise_shape(self, choices: int) -> tuple[int, int]:
        """A number for each entry of w and for each choice."""
        return 1, self.spaces.continuous + choices

    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """See `Agent`."""
        return gaussian_decision(self.actor, observation, noise)
