r"""Batch-constrained Q-learning, offline: the best of a few actions that the data could have held.

Choice:       G(d|s) by cross-entropy; d is a candidate where G(d|s) / \max_d G(d|s) > threshold
Displacement: a conditional variational autoencoder of w given s and d, L = MSE + 1/2 KL, its decoder D(s, z, d)
Candidate:    w = D(s, z, d) + \Phi \xi(s, D(s, z, d), d),  z ~ N(0, 1) held in [-1/2, 1/2]
Critic:       y = r + \gamma (1 - terminated) \max over candidates at s' of 3/4 \min_j Q'_j + 1/4 \max_j Q'_j, with \xi'
Perturbation: \xi maximises Q_1(s, w, d) for the data's d

Fujimoto, Meger, Precup 2019, "Off-policy deep reinforcement learning without exploration" (arXiv:1812.02900), for w;
Fujimoto et al. 2019, "Benchmarking batch deep reinforcement learning algorithms" (arXiv:1910.01708), for d.
"""

from __future__ import annotations

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
    action_value,
    adam,
    bellman_loss,
    discounts,
    frozen,
    minimise,
    move_towards,
)
from uavrl.diffusion import straight_through_clamp
from uavrl.networks import (
    Conditional,
    Critic,
    Observation,
    Spaces,
    make_classifier,
    make_conditional,
    make_critic,
    repeat,
)
from uavrl.networks.interfaces import Context
from uavrl.networks.mlp import bounded_log_std


class BcqConfig(AgentConfig):
    """Settings of BCQ. Names follow their meaning; the papers' letters are beside them."""

    name: Literal["bcq"] = "bcq"
    batch_size: int = Field(64, ge=1, description="transitions an update; each costs target_candidates passes")
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")
    polyak: float = Field(0.03, gt=0, le=1, description="rate of the target critic and the target perturbation")
    threshold: float = Field(0.3, ge=0, lt=1, description="least G / max G of a choice; towards 1, cloning")
    perturbation: float = Field(0.05, ge=0, le=1, description="Phi, farthest from the decoder's displacement")
    latent_clip: float = Field(0.5, gt=0, description="z of a candidate is held within this, near the data's middle")
    kl_weight: float = Field(0.5, ge=0, description="of the autoencoder's KL beside its squared error")
    soft_minimum: float = Field(0.75, ge=0, le=1, description="lambda, weight of the smaller Q, the rest of the larger")
    target_candidates: int = Field(
        10, ge=1, description="candidates at s'. They go round the allowed choices, the likeliest first"
    )
    candidates: int = Field(50, ge=1, description="candidates at a decision; their cost is its cost")


class Bcq(Agent):
    """BCQ for declared spaces."""

    config: BcqConfig

    def __init__(self, spaces: Spaces, config: BcqConfig) -> None:
        self.spaces, self.config, self.latent = spaces, config, 2 * spaces.continuous
        entries, network, latent = spaces.continuous, config.network, self.latent
        self.classifier = make_classifier(spaces, network)
        self.encoder = make_conditional(spaces, network, inputs=entries, outputs=2 * latent, choice=True)
        self.decoder = make_conditional(spaces, network, inputs=latent, outputs=entries, choice=True)
        self.actor = make_conditional(spaces, network, inputs=entries, outputs=entries, choice=True)  # xi
        self.actor_target = deepcopy(self.actor).requires_grad_(False)
        self.critic = make_critic(spaces, network)
        self.target = deepcopy(self.critic).requires_grad_(False)
        self.coder = nn.ModuleDict({"encoder": self.encoder, "decoder": self.decoder})
        trained: dict[str, nn.Module] = {
            "classifier": self.classifier,
            "coder": self.coder,
            "actor": self.actor,
            "critic": self.critic,
        }
        self.networks = nn.ModuleDict(trained | {"actor_target": self.actor_target, "target": self.target})
        self.optimisers = {name: adam(one.parameters(), config) for name, one in trained.items()}

    def classifier_loss(self, batch: Batch) -> tuple[Tensor, Metrics]:
        """Cross-entropy of the data's choices under G."""
        loss = functional.cross_entropy(self.classifier(batch.observation).logits, batch.action.choice)
        return loss, {"choice_loss": loss.detach()}

    def coder_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Metrics]:
        """Squared error and KL of the autoencoder; noise (B, 2 C)."""
        one_hot = functional.one_hot(batch.action.choice, self.spaces.choices).float()
        w = batch.action.continuous
        mean, raw = self.encoder(self.encoder.encode(batch.observation), w, one_hot).chunk(2, dim=-1)
        log_std = bounded_log_std(raw)
        z = mean + log_std.exp() * noise
        error = (self._decoded(self.decoder.encode(batch.observation), z, one_hot) - w).square().mean()
        kl = -0.5 * (1.0 + 2.0 * log_std - mean.square() - (2.0 * log_std).exp()).mean()
        loss = error + self.config.kl_weight * kl
        return loss, {"coder_loss": loss.detach(), "coder_error": error.detach(), "coder_kl": kl.detach()}

    def critic_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Metrics]:
        """Bellman error of both Q functions, summed; noise (B, target_candidates, 2 C)."""
        with torch.no_grad():
            logits = self.classifier(batch.next_observation).logits
            w, one_hot = self.propose(batch.next_observation, logits, noise, self.actor_target)
            value = self.judge(self.target, batch.next_observation, w, one_hot).amax(dim=1)
            target = batch.reward + discounts(batch, self.config) * value
        q = action_value(self.critic, self.critic.encode(batch.observation), batch.action, self.spaces.choices)
        loss = bellman_loss(q, target, self.config.huber)
        return loss, {"critic_loss": loss.detach(), "q": q.detach().mean(), "target_q": target.mean()}

    def actor_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Metrics]:
        """-Q_1 of perturbed displacements for the data's choices; noise (B, 2 C)."""
        one_hot = functional.one_hot(batch.action.choice, self.spaces.choices).float()
        with torch.no_grad():
            z = noise.clamp(-self.config.latent_clip, self.config.latent_clip)
            w = self._decoded(self.decoder.encode(batch.observation), z, one_hot)
        w = self._perturbed(self.actor, self.actor.encode(batch.observation), w, one_hot)
        with frozen(self.critic):
            loss = -self.critic.value(self.critic.encode(batch.observation), w, one_hot)[0].mean()
        return loss, {"actor_loss": loss.detach()}

    def propose(
        self, observation: Observation, logits: Tensor, noise: Tensor, perturbation: Conditional
    ) -> tuple[Tensor, Tensor]:
        """Candidates w (B x N, C) and their one-hot choices (B x N, D), those of a row in a row.

        Args:
            observation: B rows.
            logits: (B, D) of G.
            noise: (B, N, 2 C) standard normal.
            perturbation: xi, or its target.
        """
        count = noise.shape[1]
        choice = candidate_choices(logits, self.config.threshold, count).flatten()
        one_hot = functional.one_hot(choice, logits.shape[1]).float()
        z = noise.flatten(0, 1).clamp(-self.config.latent_clip, self.config.latent_clip)
        w = self._decoded(repeat(self.decoder.encode(observation), count), z, one_hot)
        return self._perturbed(perturbation, repeat(perturbation.encode(observation), count), w, one_hot), one_hot

    def judge(self, critic: Critic, observation: Observation, w: Tensor, one_hot: Tensor) -> Tensor:
        """Soft minimum of both Q, (B, N), of N candidates a row."""
        context = critic.encode(observation)
        rows = context[0].shape[0]
        q = critic.value(repeat(context, w.shape[0] // rows), w, one_hot)
        return soft_minimum(q, self.config.soft_minimum).view(rows, -1)

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """Choice and displacement of the data, critic, perturbation, targets."""
        config, metrics = self.config, Metrics()

        def normal(*shape: int) -> Tensor:
            return torch.randn((len(batch.reward), *shape), generator=generator, device=generator.device)

        def step(name: str, loss: Tensor) -> None:
            gradient = minimise(loss, self.networks[name], self.optimisers[name], config.gradient_clip)
            metrics[f"{name}_gradient"] = gradient

        loss, more = self.classifier_loss(batch)
        step("classifier", loss)
        metrics |= more
        loss, more = self.coder_loss(batch, normal(self.latent))
        step("coder", loss)
        metrics |= more
        loss, more = self.critic_loss(batch, normal(config.target_candidates, self.latent))
        step("critic", loss)
        metrics |= more
        loss, more = self.actor_loss(batch, normal(self.latent))
        step("actor", loss)
        metrics |= more
        move_towards(self.target, self.critic, config.polyak)
        move_towards(self.actor_target, self.actor, config.polyak)
        return metrics

    @torch.no_grad()
    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """The best of `candidates`; deterministic: of the displacements at z = 0, one for each allowed choice."""
        if deterministic:
            return self.decide(observation, None)
        rows = len(observation["uav"] if isinstance(observation, dict) else observation)
        shape = (rows, *self.noise_shape(self.spaces.choices))
        return self.decide(observation, torch.randn(shape, generator=generator, device=generator.device))

    def noise_shape(self, choices: int) -> tuple[int, int]:
        """z of each candidate."""
        return self.config.candidates, self.latent

    @torch.no_grad()
    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """See `Agent`."""
        logits = self.classifier(observation).logits
        rows, choices = logits.shape
        if noise is None:
            noise = torch.zeros((rows, choices, self.latent), device=logits.device)
        w, one_hot = self.propose(observation, logits, noise, self.actor)
        best = self.judge(self.critic, observation, w, one_hot).argmax(dim=1)
        best = best + noise.shape[1] * torch.arange(rows, device=best.device)
        return HybridAction(w[best], one_hot[best].argmax(dim=1))

    def _decoded(self, context: Context, z: Tensor, one_hot: Tensor) -> Tensor:
        return torch.tanh(self.decoder(context, z, one_hot))

    def _perturbed(self, perturbation: Conditional, context: Context, w: Tensor, one_hot: Tensor) -> Tensor:
        moved = w + self.config.perturbation * torch.tanh(perturbation(context, w, one_hot))
        return straight_through_clamp(moved)


def candidate_choices(logits: Tensor, threshold: float, count: int) -> Tensor:
    """Choices of `count` candidates a row, (B, count), from logits of G (B, D).

    They go round those of G / max G > threshold, the likeliest first: as many as fit are taken, and equally often.
    """
    ratio = torch.exp(logits - logits.amax(dim=1, keepdim=True))
    allowed = (ratio > threshold).sum(dim=1, keepdim=True)  # at least the likeliest itself
    order = logits.argsort(dim=1, descending=True, stable=True)
    return order.gather(1, torch.arange(count, device=logits.device) % allowed)


def soft_minimum(q: Tensor, weight: float) -> Tensor:
    """weight min_j Q_j + (1 - weight) max_j Q_j, (2, B) -> (B,)."""
    return weight * q.amin(dim=0) + (1.0 - weight) * q.amax(dim=0)
