r"""Diffusion-SAC (paper, Section V, Algorithm 2): a diffusion actor guided by a double-Q critic, offline.

Critic, eqs. (bellman_error), (crtici_CQL), for each Q_j:
    L = 1/2 E[(Q_j(s, a) - r - \gamma \min_j Q'_j(s', a'))^2]
        + \alpha E[\log \sum_d E_{w \sim U}[e^{Q_j(s, w, d)}] 2^C - Q_j(s, a)],   a' from the target actor
    or with cql_samples = 0 \alpha E[\log \sum_d e^{Q_j(s, w, d)} - Q_j(s, a)] at the logged w, the cross-entropy of the
    logged choice under softmax(Q_j)
Actor, eqs. (diffRL_loss), (Q_guidance_Loss), (actor_loss_all):
    L = \eta L_bc + (1 - \eta) L_g,   L_g = -E[\sum_d p_d \min_j Q_j(s, w, d)] / sg(scale of Q), p = softmax(z / \tau)
where [w, z] is what the denoising chain returns. The guidance must reach the actor's weights through that chain, for w
and for z alike: an argmax or a sampler without graph would leave nothing but behaviour cloning.

Beyond the paper: `action_noise` on w in the backup and in L_g, `pinned_level`, `advantage_weight` and `greedy_choice`
in the backup, the penalty over choices alone; at a decision the null action among the candidates, and `choice_prior`.
"""

from __future__ import annotations

from copy import deepcopy
from types import MappingProxyType
from typing import Literal, NamedTuple, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from uavrl.actions import HybridAction, decode, encode
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
from uavrl.agents.cql import conservative_penalty
from uavrl.agents.diffusion_actor import ChainNoise, DiffusionActor, DiffusionConfig, block_mean
from uavrl.diffusion import add_noise, predict_x0, straight_through_clamp
from uavrl.errors import ConfigError
from uavrl.networks import Observation, Spaces, make_critic, repeat
from uavrl.networks.devices import NEVER
from uavrl.networks.interfaces import Context


class DiffusionSacConfig(AgentConfig):
    """Settings of Diffusion-SAC. Names follow their meaning; the paper's letters are beside them."""

    name: Literal["diffusion_sac"] = "diffusion_sac"
    diffusion: DiffusionConfig = DiffusionConfig()
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")
    discount: float = Field(
        0.998,
        ge=0,
        lt=1,
        description="gamma, per step or per second; a flight to a better place pays over all that follow",
    )
    polyak: float = Field(
        0.1, gt=0, le=1, description="rate of the target critic; a chain of 1 / (1 - gamma) backups needs many"
    )
    action_noise: float = Field(
        0.1,
        ge=0,
        description="standard deviation of noise on w where Q is asked, in the backup and in L_g (target policy "
        "smoothing, Fujimoto et al. 2018): a move costs its length, a cone whose tip would hold w at 0. Paper: 0",
    )
    final_action_noise: float | None = Field(
        None,
        gt=0,
        description="where action_noise ends, falling geometrically over a training: wide first, so that a drift pays; "
        "then narrow, since wide noise also makes a slow flight the best one; null: constant",
    )
    pinned_level: bool = Field(
        False,
        description="subtract the batch's mean from Q' in the backup (as relative value iteration does; in proportion "
        "to a step's duration where discount_per is second): differences need not wait for a level that is "
        "1 / (1 - gamma) rewards away. Not for data that can terminate",
    )
    advantage_weight: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="beta of advantage learning: the backup loses beta (V'(s) - Q'(s, a)), V' that of the target "
        "actor's action, so what sets actions apart stands out 1 / (1 - beta) times as much beside Q's errors "
        "(Bellemare et al. 2016, Increasing the action gap); 0 skips it",
    )
    bc_weight: float = Field(0.02, ge=0, le=1, description="eta of eq. (actor_loss_all)")
    cql_weight: float = Field(0.0, ge=0, description="alpha of eq. (crtici_CQL); 0 skips the penalty")
    cql_samples: int = Field(
        10, ge=0, description="uniform w that stand for the penalty's integral; 0: at the logged w, over d alone"
    )
    guidance: Literal["expectation", "straight_through", "softmax"] = Field(
        "expectation",
        description="choice in L_g: expected Q over p; argmax with p's gradient; or p itself as the critic's input",
    )
    gradient: Literal["full_chain", "last_k", "one_step"] = Field(
        "one_step",
        description="L_g through the whole chain (paper), its last gradient_steps, or one pass from a noised action",
    )
    gradient_steps: int = Field(1, ge=1, description="k of last_k")
    choice_temperature: float = Field(0.5, gt=0, description="tau of p = softmax(z / tau)")
    q_scale: Literal["spread", "absolute", "none"] = Field(
        "spread",
        description="L_g is divided by Q's mean deviation over the choices, which no shift of the rewards changes; "
        "by the batch's mean |Q|; or not at all (paper). Without a scale eta has no meaning",
    )
    displacement_weight: float = Field(3.0, gt=0, description="weight of a continuous entry in L_bc; 1 in the paper")
    actor_average: float = Field(0.98, ge=0, lt=1, description="decay of the target actor; 0: no average")
    greedy_choice: bool = Field(
        True,
        description="d' of the backup and d of a decision: the critic's best for the actor's w; false: the actor's own "
        "(paper). The critic knows every choice from one pass, and the data hold all of them, some rarely",
    )
    choice_prior: float = Field(
        0.0,
        ge=0,
        description="weight, in units of Q's deviation over the choices, of the chain's own entries z beside the "
        "critic's Q where that says d of a decision; 0: the critic alone. Where more devices are flown than the log "
        "had, the weight falls with their number",
    )
    candidates: int = Field(1, ge=1, description="actions drawn at a decision; the best is taken")
    null_candidate: bool = Field(
        False,
        description="beside them stands the null action, w = 0 with choice 0 (hold the place, serve nobody), which no "
        "network hits: of a move's cost the first metre is as dear as the last; who idles at a decision holds its "
        "place. Not in the backup",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.gradient == "last_k" and self.gradient_steps > self.diffusion.steps:
            raise ValueError(
                f"gradient_steps = {self.gradient_steps} must be <= diffusion.steps = {self.diffusion.steps}"
            )
        if self.guidance == "softmax" and (self.network.kind != "mlp" or self.network.choice_heads):
            raise ValueError(
                "guidance = 'softmax' needs a critic with the choice as input: kind 'mlp', choice_heads false"
            )
        if self.final_action_noise is not None and 0 < self.action_noise < self.final_action_noise:
            raise ValueError(
                f"action_noise = {self.action_noise} must be >= final_action_noise = {self.final_action_noise}, "
                "or that be null (constant noise)"
            )
        return self


def held(action: HybridAction) -> HybridAction:
    """Actions (N) with w = 0, which no network hits, where the choice is 0: who idles holds its place."""
    return action._replace(continuous=action.continuous * (action.choice > 0)[:, None])


def _prior_unit(every: Tensor, trained: int) -> Tensor:
    """What an entry z of 1 weighs beside Q (N, M, D), (N, 1, 1): Q's deviation over the choices of all M candidates.

    Among more choices than the `trained` ones of training it weighs less, in proportion: the chain's opinion does not
    carry over to many devices, the critic's does. Padded devices are left out.
    """
    real = every > NEVER / 2
    share = (trained / real[:, :1].sum(dim=2, keepdim=True)).clamp(max=1.0)
    count = real.sum(dim=(1, 2), keepdim=True)
    mean = torch.where(real, every, 0.0).sum(dim=(1, 2), keepdim=True) / count
    deviation = (torch.where(real, every - mean, 0.0).square().sum(dim=(1, 2), keepdim=True) / count).sqrt()
    return share * deviation


class CriticNoise(NamedTuple):
    """What `DiffusionSac.critic_loss` takes beside its batch."""

    chain: ChainNoise
    uniform: Tensor | None = None
    jitter: Tensor | None = None


class ActorNoise(NamedTuple):
    """What `DiffusionSac.actor_loss` takes beside its batch."""

    step: Tensor
    noise: Tensor
    chain: ChainNoise | None = None
    jitter: Tensor | None = None


class DiffusionSac(Agent):
    """Diffusion-SAC for declared spaces.

    Raises:
        ConfigError: a single choice, whose Q has no spread to scale L_g by.
    """

    config: DiffusionSacConfig
    acts_best_deterministically = True  # the chain's noise is jitter, and every metre of it costs time
    learning_only = MappingProxyType({"target.": "critic.", "actor.denoiser.": "actor.average."})

    def __init__(self, spaces: Spaces, config: DiffusionSacConfig) -> None:
        if spaces.choices == 1 and config.q_scale == "spread" and config.bc_weight < 1:
            raise ConfigError("q_scale = 'spread', allowed with a single choice: 'absolute' or 'none'")
        self.spaces, self.config = spaces, config
        self.actor = DiffusionActor(spaces, config.network, config.diffusion)
        self.critic = make_critic(spaces, config.network)
        self.target = deepcopy(self.critic).requires_grad_(False)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic, "target": self.target})
        self.optimisers = {
            "actor": adam(self.actor.denoiser.parameters(), config),
            "critic": adam(self.critic.parameters(), config),
        }

    def critic_loss(
        self, batch: Batch, noise: ChainNoise, uniform: Tensor | None, jitter: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """Eq. (crtici_CQL), both Q functions summed.

        Args:
            batch: B transitions.
            noise: of the target actor's chain at s', and at s for advantage learning, B samples.
            uniform: (B x cql_samples, C) displacements in [-1, 1] of the penalty; None where it has none, or no weight.
            jitter: (B, C) standard normal noise of w' in the backup; None: no action noise.
        """
        with torch.no_grad():
            _, q_next = self._followed(batch.next_observation, noise, jitter)
            if self.config.pinned_level:
                per_second = self.config.discount_per == "second"  # a level is lost in proportion to time then
                share = batch.duration_s / batch.duration_s.mean() if per_second else 1.0
                q_next = q_next - q_next.mean() * share
            target = batch.reward + discounts(batch, self.config) * q_next
            if self.config.advantage_weight > 0:
                here, value = self._followed(batch.observation, noise, jitter)
                logged = action_value(self.target, here, batch.action, self.spaces.choices).amin(dim=0)
                target = target - self.config.advantage_weight * (value - logged)
        context, penalty = self.critic.encode(batch.observation), None
        if self.config.cql_weight > 0 and self.config.cql_samples == 0:
            every = self.critic.all_choices(context, batch.action.continuous)
            q = every.gather(2, batch.action.choice.expand(2, -1)[..., None]).squeeze(2)
            penalty = (every.logsumexp(dim=2) - q).mean(dim=1).sum()
        else:
            q = action_value(self.critic, context, batch.action, self.spaces.choices)
            if uniform is not None:
                penalty = conservative_penalty(self.critic, context, uniform, q)
        loss = bellman_loss(q, target, self.config.huber)
        metrics = {"bellman_loss": loss.detach(), "q": q.detach().mean(), "target_q": target.mean()}
        if penalty is not None:
            loss = loss + self.config.cql_weight * penalty
            metrics["cql_penalty"] = penalty.detach()
        return loss, metrics | {"critic_loss": loss.detach()}

    def _followed(self, observation: Observation, noise: ChainNoise, jitter: Tensor | None) -> tuple[Context, Tensor]:
        """The target critic's encoding, and its min Q' (B,) of the target actor's w, as the backup sees it.

        With that actor's choice, or with the best one where the config says so.
        """
        actor, context = self.actor.average, self.target.encode(observation)
        action = decode(self.actor.sample(actor, actor.encode(observation), noise), self.spaces.continuous)
        action = action._replace(continuous=self._jittered(action.continuous, jitter))
        if self.config.greedy_choice:
            return context, self.target.all_choices(context, action.continuous).amin(dim=0).amax(dim=-1)
        return context, action_value(self.target, context, action, self.spaces.choices).amin(dim=0)

    def actor_loss(
        self, batch: Batch, step: Tensor, noise: Tensor, chain: ChainNoise | None, jitter: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """Eq. (actor_loss_all).

        Args:
            batch: B transitions.
            step: (B,) denoising steps in 1..M of L_bc, and of a one-step L_g.
            noise: (B, C + D) of the same.
            chain: of the chain whose actions L_g judges; None where the gradient is one_step or L_g has no weight.
            jitter: (B, C) standard normal noise of w in L_g; None: no action noise.
        """
        config, denoiser = self.config, self.actor.denoiser
        context = denoiser.encode(batch.observation)
        eta, loss = config.bc_weight, torch.zeros((), device=noise.device)
        metrics: Metrics = {}
        vector = None
        if eta > 0 or chain is None:
            schedule = self.actor.schedule(noise.device)
            noised = add_noise(schedule, encode(batch.action, self.spaces.choices), step, noise)
            predicted = denoiser(context, noised, step)
            bc_loss = block_mean((noise - predicted).square(), self.spaces.continuous, config.displacement_weight)
            loss = loss + eta * bc_loss
            metrics["bc_loss"] = bc_loss.detach()
            vector = predict_x0(schedule, noised, step, predicted, config.diffusion.clip_x0)
        if eta < 1:
            if chain is not None:
                steps = config.gradient_steps if config.gradient == "last_k" else None
                vector = self.actor.sample(denoiser, context, chain, steps)
            assert vector is not None  # noqa: S101  # for the type checker: one of the two branches above has run
            guidance, more = self.guidance_loss(batch.observation, vector, jitter)
            loss = loss + (1.0 - eta) * guidance
            metrics |= more
        return loss, metrics | {"actor_loss": loss.detach()}

    def guidance_loss(
        self, observation: Observation, vector: Tensor, jitter: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """Eq. (Q_guidance_Loss) of chain outputs `vector` (B, C + D), with gradient in both of its blocks.

        `jitter` (B, C) as in `actor_loss`.
        """
        config, continuous = self.config, self.spaces.continuous
        w, z = straight_through_clamp(vector[:, :continuous]), vector[:, continuous:]
        w = self._jittered(w, jitter)
        probability = functional.softmax(z / config.choice_temperature, dim=-1)
        with frozen(self.critic):
            context = self.critic.encode(observation)
            every = self.critic.all_choices(context, w).amin(dim=0)  # (B, D)
            soft = self.critic.value(context, w, probability) if config.guidance == "softmax" else None
        if soft is not None:
            q = soft.amin(dim=0)
        else:
            weight = probability
            if config.guidance == "straight_through":
                hard = functional.one_hot(z.argmax(dim=-1), z.shape[-1]).to(z.dtype)
                weight = hard + probability - probability.detach()
            q = (every * weight).sum(dim=-1)
        scale: Tensor | float = 1.0
        if config.q_scale == "absolute":
            scale = q.detach().abs().mean().clamp(min=1e-3)
        elif config.q_scale == "spread":
            scale = every.detach().std(dim=-1).mean().clamp(min=1e-3)
        metrics = {"guided_q": q.detach().mean(), "choice_confidence": probability.detach().amax(dim=-1).mean()}
        return -q.mean() / scale, metrics

    def draw(self, count: int, generator: torch.Generator) -> tuple[CriticNoise, ActorNoise]:
        """All randomness of an update on `count` transitions; what has no weight is not drawn."""
        config, device = self.config, generator.device
        continuous, steps = self.spaces.continuous, config.diffusion.steps
        size = continuous + self.spaces.choices
        chain = ChainNoise.draw(count, size, steps, generator)
        uniform, of_critic, of_actor = None, None, None
        if config.cql_weight > 0 and config.cql_samples > 0:
            shape = (count * config.cql_samples, continuous)
            uniform = 2.0 * torch.rand(shape, generator=generator, device=device) - 1.0
        if config.action_noise > 0:
            of_critic, of_actor = torch.randn((2, count, continuous), generator=generator, device=device)
        step = torch.randint(1, steps + 1, (count,), generator=generator, device=device)
        noise = torch.randn((count, size), generator=generator, device=device)
        guided = config.bc_weight < 1 and config.gradient != "one_step"
        guided_chain = ChainNoise.draw(count, size, steps, generator) if guided else None
        return CriticNoise(chain, uniform, of_critic), ActorNoise(step, noise, guided_chain, of_actor)

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """Critic, actor, target critic, target actor; what has no weight is not computed."""
        config, clip = self.config, self.config.gradient_clip
        of_critic, of_actor = self.draw(len(batch), generator)
        loss, metrics = self.critic_loss(batch, *of_critic)
        metrics["critic_gradient"] = minimise(loss, self.critic, self.optimisers["critic"], clip)
        loss, more = self.actor_loss(batch, *of_actor)
        metrics["actor_gradient"] = minimise(loss, self.actor.denoiser, self.optimisers["actor"], clip)
        move_towards(self.target, self.critic, config.polyak)
        move_towards(self.actor.average, self.actor.denoiser, 1.0 - config.actor_average)
        return metrics | more

    @torch.no_grad()
    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """A sample of the target actor's chain, the best (see `best`) of `candidates`; deterministic: DDIM from 0."""
        context = self.actor.average.encode(observation)
        if deterministic:
            return self._decide(observation, context, None)
        context = repeat(context, self.config.candidates)
        return self._decide(observation, context, self.actor.draw(context, generator))

    def noise_shape(self, choices: int) -> tuple[int, int]:
        """That of a chain, its start and its steps, for each candidate."""
        return self.config.candidates * (self.actor.noise_steps + 1), self.spaces.continuous + choices

    @torch.no_grad()
    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """See `Agent`."""
        context = self.actor.average.encode(observation)
        if noise is None:
            return self._decide(observation, context, None)
        chain = ChainNoise.of_rows(noise, self.actor.noise_steps)
        return self._decide(observation, repeat(context, self.config.candidates), chain)

    def _decide(self, observation: Observation, context: Context, noise: ChainNoise | None) -> HybridAction:
        """The best of a row's candidates, whose encodings stand one after another in `context`; 1 without noise."""
        return self.best(observation, self.actor.answer(context, noise), 1 if noise is None else self.config.candidates)

    def best(self, observation: Observation, vector: Tensor, count: int) -> HybridAction:
        """Of each row's `count` chain outputs (C + D), in turn, the best by min Q, its choice as configured.

        With `choice_prior` the chain's entries count beside Q in every comparison: of choices, candidates, null action.
        """
        config, continuous = self.config, self.spaces.continuous
        drawn = decode(vector, continuous)
        if count == 1 and not config.greedy_choice:
            return held(drawn) if config.null_candidate else drawn
        rows = vector.shape[0] // count
        w, choice = drawn.continuous.view(rows, count, -1), drawn.choice.view(rows, count)
        z = vector[:, continuous:].view(rows, count, -1)
        if config.null_candidate:  # in the same pass, last: where it is no better than another the other is taken
            w = torch.cat([w, torch.zeros_like(w[:, :1])], dim=1)
            z = torch.cat([z, z.mean(dim=1, keepdim=True)], dim=1)
        each = count + int(config.null_candidate)
        context = repeat(self.critic.encode(observation), each)
        every = self.critic.all_choices(context, w.flatten(0, 1)).amin(dim=0).view(rows, each, -1)
        if config.greedy_choice:
            if config.choice_prior > 0:
                every = every + config.choice_prior * _prior_unit(every, self.spaces.choices) * z
            q, choice = every[:, :count].max(dim=2)
        else:
            q = every[:, :count].gather(2, choice[..., None]).squeeze(2)
        if config.null_candidate:
            q = torch.cat([q, every[:, count:, 0]], dim=1)
            choice = torch.cat([choice, torch.zeros_like(choice[:, :1])], dim=1)
        best = q.argmax(dim=1, keepdim=True)
        w = w.gather(1, best[..., None].expand(-1, -1, w.shape[2]))
        chosen = HybridAction(w.squeeze(1), choice.gather(1, best).squeeze(1))
        return held(chosen) if config.null_candidate else chosen

    def noise_now(self) -> float:
        """Standard deviation of the action noise at this share of the training."""
        first, last = self.config.action_noise, self.config.final_action_noise
        return first if last is None or first == 0 else float(first * (last / first) ** self.progress)

    def _jittered(self, w: Tensor, jitter: Tensor | None) -> Tensor:
        """w (B, C) with action noise, in the box; its gradient leads back into the box, not out of it."""
        return w if jitter is None else straight_through_clamp(w + self.noise_now() * jitter)
