"""Behaviour cloning with a diffusion actor: eq. (diffRL_loss) alone, the paper's eta = 1. No critic is trained."""

from __future__ import annotations

from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from uavrl.actions import HybridAction, encode
from uavrl.agents.base import Agent, AgentConfig, Batch, Metrics, adam, minimise, move_towards
from uavrl.agents.diffusion_actor import ChainNoise, DiffusionActor, DiffusionConfig, block_mean
from uavrl.diffusion import denoising_loss
from uavrl.networks import Observation, Spaces


class BcConfig(AgentConfig):
    """Settings of behaviour cloning."""

    name: Literal["bc"] = "bc"
    diffusion: DiffusionConfig = DiffusionConfig()
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")
    displacement_weight: float = Field(3.0, gt=0, description="weight of a continuous entry; 1 in the paper")
    actor_average: float = Field(0.995, ge=0, lt=1, description="decay of the actor's moving average")


class BehaviourCloning(Agent):
    """Imitates the data's actions."""

    config: BcConfig

    def __init__(self, spaces: Spaces, config: BcConfig) -> None:
        self.spaces, self.config = spaces, config
        self.actor = DiffusionActor(spaces, config.network, config.diffusion)
        self.networks = nn.ModuleDict({"actor": self.actor})
        self.optimisers = {"actor": adam(self.actor.denoiser.parameters(), config)}

    def actor_loss(self, batch: Batch, step: Tensor, noise: Tensor) -> tuple[Tensor, Metrics]:
        """Eq. (diffRL_loss); step (B,) in 1..M, noise (B, C + D)."""
        context = self.actor.denoiser.encode(batch.observation)
        error = denoising_loss(
            lambda x, i: self.actor.denoiser(context, x, i),
            self.actor.schedule(noise.device),
            encode(batch.action, self.spaces.choices),
            step,
            noise,
        )
        loss = block_mean(error, self.spaces.continuous, self.config.displacement_weight)
        return loss, {"bc_loss": loss.detach()}

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """One step of the denoiser and of its average."""
        count, device = len(batch.reward), generator.device
        step = torch.randint(1, self.config.diffusion.steps + 1, (count,), generator=generator, device=device)
        size = self.spaces.continuous + self.spaces.choices
        noise = torch.randn((count, size), generator=generator, device=device)
        loss, metrics = self.actor_loss(batch, step, noise)
        clip = self.config.gradient_clip
        metrics["actor_gradient"] = minimise(loss, self.actor.denoiser, self.optimisers["actor"], clip)
        move_towards(self.actor.average, self.actor.denoiser, 1.0 - self.config.actor_average)
        return metrics

    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """A sample of the chain."""
        with torch.no_grad():
            return self.actor.act(self.actor.average.encode(observation), generator, deterministic)

    def noise_shape(self, choices: int) -> tuple[int, int]:
        """That of a chain: its start and its steps."""
        return self.actor.noise_steps + 1, self.spaces.continuous + choices

    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """See `Agent`."""
        chain = None if noise is None else ChainNoise.of_rows(noise, self.actor.noise_steps)
        with torch.no_grad():
            return self.actor.decide(self.actor.average.encode(observation), chain)
