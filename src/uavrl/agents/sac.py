r"""Hybrid soft actor-critic, online: exact over the choice d, reparameterised over the displacement w.

V(s) = E_w[ \sum_d \pi(d|s) ( \min_j Q_j(s, w, d) - a_d \log \pi(d|s) ) - a_c \log \pi(w|s) ]

Haarnoja et al. 2018 with the hybrid action of Delalleau et al. 2019 (arXiv:1912.11077): two temperatures, one for each
part, because their entropies have different units.
"""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from uavrl.actions import HybridAction
from uavrl.agents.base import (
    Agent,
    AgentConfig,
    Batch,
    Metrics,
    RewardConfig,
    action_value,
    adam,
    bellman_loss,
    discounts,
    frozen,
    minimise,
    move_towards,
)
from uavrl.agents.gaussian_actor import drawn_choice
from uavrl.networks import Actor, Critic, Observation, Spaces, make_actor, make_critic
from uavrl.networks.interfaces import ActorOutput


class SacConfig(AgentConfig):
    """Settings of hybrid SAC."""

    name: Literal["sac"] = "sac"
    reward: RewardConfig = RewardConfig(transform="centred", clip=10.0)
    batch_size: int = Field(128, ge=1, description="transitions an update")
    learning_rate: float = Field(6e-4, gt=0, description="of Adam")
    discount: float = Field(0.995, ge=0, lt=1, description="gamma; at .99 a flight to a better place barely pays")
    huber: float | None = Field(None, gt=0, description="as in AgentConfig; online, plain squares learned well")
    continuous_entropy: float = Field(-2.0, description="target entropy of tanh w, H_c")
    choice_entropy: float = Field(0.3, ge=0, lt=1, description="target entropy of d, as a share of log D")
    initial_temperature: float = Field(0.1, gt=0, description="both temperatures at the start")


class SquashedSample:
    """w = tanh(u), u = mean + std noise, with its log density."""

    def __init__(self, output: ActorOutput, noise: Tensor) -> None:
        self.pre = output.mean + output.log_std.exp() * noise
        self.continuous = torch.tanh(self.pre)  # (B, C)
        normal = -0.5 * noise.square() - output.log_std - 0.5 * math.log(2.0 * math.pi)
        # log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), which does not lose its digits at the edge
        squash = 2.0 * (math.log(2.0) - self.pre - functional.softplus(-2.0 * self.pre))
        self.log_density = (normal - squash).sum(dim=-1)  # (B,)


def soft_value(q: Tensor, log_choice: Tensor, log_density: Tensor, a_c: Tensor, a_d: Tensor) -> Tensor:
    """V of the module's docstring for one w a row: q and log_choice (B, D), log_density (B,) -> (B,)."""
    return (log_choice.exp() * (q - a_d * log_choice)).sum(dim=-1) - a_c * log_density


def soft_target(
    target: Critic, output: ActorOutput, noise: Tensor, temperature: Tensor, batch: Batch, config: AgentConfig
) -> Tensor:
    """r + gamma (1 - terminated) V(s'), (B,), by the target critic.

    Args:
        target: two Q functions.
        output: the policy at s'.
        noise: (B, C), of w'.
        temperature: (2,) a_c and a_d; zeros leave the entropies out.
        batch: B transitions.
        config: the discount's.
    """
    sample = SquashedSample(output, noise)
    q = target.all_choices(target.encode(batch.next_observation), sample.continuous).amin(dim=0)
    a_c, a_d = temperature
    value = soft_value(q, output.logits.log_softmax(dim=-1), sample.log_density, a_c, a_d)
    return batch.reward + discounts(batch, config) * value


def soft_actor_loss(
    actor: Actor, critic: Critic, temperature: Tensor, observation: Observation, noise: Tensor
) -> tuple[Tensor, Metrics]:
    """-V(s) under the current critic; temperature (2,), noise (B, C). The metrics hold both entropies, (2,)."""
    output = actor(observation)
    sample = SquashedSample(output, noise)
    with frozen(critic):
        q = critic.all_choices(critic.encode(observation), sample.continuous).amin(dim=0)
    log_choice = output.logits.log_softmax(dim=-1)
    a_c, a_d = temperature
    loss = -soft_value(q, log_choice, sample.log_density, a_c, a_d).mean()
    entropy = torch.stack([-sample.log_density.mean(), -(log_choice.exp() * log_choice).sum(dim=-1).mean()])
    return loss, {"actor_loss": loss.detach(), "entropy": entropy.detach()}


def entropy_target(continuous: float, choice: float, choices: int, device: torch.device) -> Tensor:
    """(2,): what the entropies of w and of d are to be, that of d as a share of log D."""
    return torch.tensor([continuous, choice * math.log(choices)], device=device)


def temperature_loss(log_temperature: Tensor, entropy: Tensor, wanted: Tensor) -> Tensor:
    """Raises a temperature whose entropy is under its target, lowers the other; all (2,)."""
    return (log_temperature * (entropy - wanted)).sum()


def named_pairs(entropy: Tensor, log_temperature: Tensor) -> Metrics:
    """Entropies and temperatures, (2,) each, as they are logged."""
    names = ("entropy_continuous", "entropy_choice", "temperature_continuous", "temperature_choice")
    return dict(zip(names, (*entropy, *log_temperature.detach().exp()), strict=True))


@torch.no_grad()
def soft_action(
    actor: Actor, observation: Observation, generator: torch.Generator, deterministic: bool
) -> HybridAction:
    """A sample of pi, or its mode."""
    if deterministic:
        return soft_decision(actor, observation, None)
    output = actor(observation)
    noise = torch.randn(output.mean.shape, generator=generator, device=generator.device)
    choice = torch.multinomial(output.logits.softmax(dim=-1), 1, generator=generator).squeeze(-1)
    return HybridAction(SquashedSample(output, noise).continuous, choice)


@torch.no_grad()
def soft_decision(actor: Actor, observation: Observation, noise: Tensor | None) -> HybridAction:
    """The same with noise (B, 1, C + D) given, that of w and that of d; without: the mode."""
    output = actor(observation)
    if noise is None:
        return HybridAction(torch.tanh(output.mean), output.logits.argmax(dim=-1))
    continuous = output.mean.shape[-1]
    sample = SquashedSample(output, noise[:, 0, :continuous])
    return HybridAction(sample.continuous, drawn_choice(output.logits, noise[:, 0, continuous:]))


class Sac(Agent):
    """Hybrid SAC for declared spaces."""

    config: SacConfig

    def __init__(self, spaces: Spaces, config: SacConfig) -> None:
        self.spaces, self.config = spaces, config
        self.actor = make_actor(spaces, config.network)
        self.critic = make_critic(spaces, config.network)
        self.target = deepcopy(self.critic).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.full((2,), math.log(config.initial_temperature)))  # a_c, a_d
        self.networks = nn.ModuleDict(
            {
                "actor": self.actor,
                "critic": self.critic,
                "target": self.target,
                "temperature": nn.ParameterList([self.log_temperature]),
            }
        )
        self.optimisers = {
            "actor": adam(self.actor.parameters(), config),
            "critic": adam(self.critic.parameters(), config),
            "temperature": adam([self.log_temperature], config, decays=False),
        }

    def critic_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Metrics]:
        """Bellman error of both Q functions, summed; noise (B, C)."""
        with torch.no_grad():
            output, temperature = self.actor(batch.next_observation), self.log_temperature.exp()
            target = soft_target(self.target, output, noise, temperature, batch, self.config)
        q = action_value(self.critic, self.critic.encode(batch.observation), batch.action, self.spaces.choices)
        loss = bellman_loss(q, target, self.config.huber)
        return loss, {"critic_loss": loss.detach(), "q": q.detach().mean()}

    def actor_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Metrics]:
        """-V(s) under the current critic; noise (B, C)."""
        return soft_actor_loss(self.actor, self.critic, self.log_temperature.detach().exp(), batch.observation, noise)

    def temperature_loss(self, entropy: Tensor, choices: int) -> Tensor:
        """Raises a temperature whose entropy (2,) is under its target, lowers the other."""
        config = self.config
        wanted = entropy_target(config.continuous_entropy, config.choice_entropy, choices, entropy.device)
        return temperature_loss(self.log_temperature, entropy, wanted)

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """Critic, actor, temperatures, target."""
        shape, clip, device = batch.action.continuous.shape, self.config.gradient_clip, generator.device
        loss, metrics = self.critic_loss(batch, torch.randn(shape, generator=generator, device=device))
        metrics["critic_gradient"] = minimise(loss, self.critic, self.optimisers["critic"], clip)
        loss, more = self.actor_loss(batch, torch.randn(shape, generator=generator, device=device))
        metrics["actor_gradient"] = minimise(loss, self.actor, self.optimisers["actor"], clip)
        entropy = more.pop("entropy")
        loss = self.temperature_loss(entropy, self.spaces.choices)
        minimise(loss, [self.log_temperature], self.optimisers["temperature"], None)
        move_towards(self.target, self.critic, self.config.polyak)
        return metrics | more | named_pairs(entropy, self.log_temperature)

    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """A sample of pi, or its mode."""
        return soft_action(self.actor, observation, generator, deterministic)

    def noise_shape(self, choices: int) -> tuple[int, int]:
        """A number for each entry of w and for each choice."""
        return 1, self.spaces.continuous + choices

    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """See `Agent`."""
        return soft_decision(self.actor, observation, noise)
