r"""Implicit Q-learning, offline: no network is ever asked about an action that is not in the data.

Value:  L_V = E[ |\tau - 1(u < 0)| u^2 ],  u = \min_j Q'_j(s, a) - V(s): the \tau-expectile of Q over the data's actions
Critic: L_Q = 1/2 E[ (Q_j(s, a) - r - \gamma (1 - terminated) V(s'))^2 ] for each Q_j
Actor:  L_\pi = -E[ \min(e^{\beta (\min_j Q'_j(s, a) - V(s))}, 100) (\log \pi(d|s) + \log \pi(w|s, d)) ]

Kostrikov, Nair, Levine 2022, "Offline reinforcement learning with implicit Q-learning" (arXiv:2110.06169); the actor is
advantage-weighted regression (Peng et al. 2019, arXiv:1910.00177) on `uavrl.agents.gaussian_actor`.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from uavrl.actions import HybridAction
from uavrl.agents.base import (
    Agent,
    AgentConfig,
    Batch,
    Metrics,
    action_value,
    adam,
    bellman_loss,
    discounts,
    minimise,
    move_towards,
)
from uavrl.agents.gaussian_actor import gaussian_action, gaussian_decision, log_likelihood
from uavrl.networks import Observation, Spaces, make_choice_actor, make_conditional, make_critic


class IqlConfig(AgentConfig):
    """Settings of IQL. Names follow their meaning; the paper's letters are beside them."""

    name: Literal["iql"] = "iql"
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")
    polyak: float = Field(0.03, gt=0, le=1, description="rate of the target critic")
    expectile: float = Field(0.7, gt=0, lt=1, description="tau: .5 values the data's policy, towards 1 its best action")
    inverse_temperature: float = Field(3.0, ge=0, description="beta: 0 clones the data, more follows the advantage")
    weight_limit: float = Field(100.0, gt=0, description="largest weight of a transition in the actor's loss")


class Iql(Agent):
    """IQL for declared spaces."""

    config: IqlConfig
    acts_best_deterministically = True  # the data's spread around an action is jitter

    def __init__(self, spaces: Spaces, config: IqlConfig) -> None:
        self.spaces, self.config = spaces, config
        self.actor = make_choice_actor(spaces, config.network)
        self.value = make_conditional(spaces, config.network, outputs=1)
        self.critic = make_critic(spaces, config.network)
        self.target = deepcopy(self.critic).requires_grad_(False)
        self.networks = nn.ModuleDict(
            {"actor": self.actor, "value": self.value, "critic": self.critic, "target": self.target}
        )
        trained = {"actor": self.actor, "value": self.value, "critic": self.critic}
        self.optimisers = {name: adam(network.parameters(), config) for name, network in trained.items()}

    def state_value(self, observation: Observation) -> Tensor:
        """V(s), (B,)."""
        value: Tensor = self.value(self.value.encode(observation))
        return value.squeeze(-1)

    @torch.no_grad()
    def target_q(self, batch: Batch) -> Tensor:
        """min_j Q'_j of the data's actions, (B,)."""
        context = self.target.encode(batch.observation)
        return action_value(self.target, context, batch.action, self.spaces.choices).amin(dim=0)

    def value_loss(self, batch: Batch) -> tuple[Tensor, Metrics]:
        """L_V."""
        value = self.state_value(batch.observation)
        loss = expectile_loss(self.target_q(batch) - value, self.config.expectile)
        return loss, {"value_loss": loss.detach(), "v": value.detach().mean()}

    def critic_loss(self, batch: Batch) -> tuple[Tensor, Metrics]:
        """L_Q, both Q functions summed."""
        with torch.no_grad():
            target = batch.reward + discounts(batch, self.config) * self.state_value(batch.next_observation)
        q = action_value(self.critic, self.critic.encode(batch.observation), batch.action, self.spaces.choices)
        loss = bellman_loss(q, target, self.config.huber)
        return loss, {"critic_loss": loss.detach(), "q": q.detach().mean(), "target_q": target.mean()}

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Metrics]:
        """L_pi."""
        config = self.config
        with torch.no_grad():
            advantage = self.target_q(batch) - self.state_value(batch.observation)
            weight = torch.exp(config.inverse_temperature * advantage).clamp(max=config.weight_limit)
        log_choice, log_displacement = log_likelihood(self.actor(batch.observation), batch.action)
        loss = -(weight * (log_choice + log_displacement)).mean()
        metrics = {
            "actor_loss": loss.detach(),
            "bc_loss": -(log_choice + log_displacement).detach().mean(),
            "weight": weight.mean(),
            "weights_at_limit": (weight >= config.weight_limit).float().mean(),
        }
        return loss, metrics

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """Value, critic, actor, target critic; none of the losses has noise."""
        clip, metrics = self.config.gradient_clip, Metrics()
        loss, more = self.value_loss(batch)
        metrics |= more | {"value_gradient": minimise(loss, self.value, self.optimisers["value"], clip)}
        loss, more = self.critic_loss(batch)
        metrics |= more | {"critic_gradient": minimise(loss, self.critic, self.optimisers["critic"], clip)}
        loss, more = self.actor_loss(batch)
        metrics |= more | {"actor_gradient": minimise(loss, self.actor, self.optimisers["actor"], clip)}
        move_towards(self.target, self.critic, self.config.polyak)
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


def expectile_loss(difference: Tensor, expectile: float) -> Tensor:
    """Mean of |tau - 1(u < 0)| u^2 over u (B,)."""
    weight = torch.where(difference < 0, 1.0 - expectile, expectile)
    return (weight * difference.square()).mean()
