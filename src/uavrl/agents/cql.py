r"""Conservative Q-learning on hybrid soft actor-critic, offline: Q is held down wherever the data say nothing.

Critic, for each Q_j, with y = r + \gamma (1 - terminated) V(s') as in `uavrl.agents.sac`:
    L = 1/2 E[(Q_j(s, a) - y)^2] + \alpha E[ T \log \sum_d \int e^{Q_j(s, w, d) / T} dw - Q_j(s, a) ]
The sum over d is exact. The integral over w is estimated by importance, from N uniform w, N of \pi(.|s) and
N of \pi(.|s'):
    \log \sum_d \sum_n \exp( Q_j(s, w_n, d) / T - \log p_n(w_n) ) - \log 3N,   p_n the density that w_n came from,
which is 2^-C for a uniform one. Actor and temperatures are those of hybrid SAC.

Kumar et al. 2020, "Conservative Q-learning for offline reinforcement learning" (arXiv:2006.04779), CQL(H), appendix F.
"""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Literal, NamedTuple

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
    minimise,
    move_towards,
)
from uavrl.agents.sac import (
    SquashedSample,
    entropy_target,
    named_pairs,
    soft_action,
    soft_actor_loss,
    soft_decision,
    soft_target,
    temperature_loss,
)
from uavrl.networks import Critic, Observation, Spaces, make_actor, make_critic, repeat
from uavrl.networks.interfaces import ActorOutput, Context


class CqlConfig(AgentConfig):
    """Settings of CQL."""

    name: Literal["cql"] = "cql"
    batch_size: int = Field(
        64, ge=1, description="transitions an update; each costs 3 cql_samples passes of the critic"
    )
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")
    polyak: float = Field(0.03, gt=0, le=1, description="rate of the target critic")
    cql_weight: float = Field(
        0.5,
        ge=0,
        description="alpha. Its slope is at most 1 a row, as is that of a Bellman error beyond `huber` = 1: from 1 on "
        "the penalty outweighs what the data say; 0 skips it",
    )
    cql_samples: int = Field(10, ge=1, description="N, displacements of each of the three kinds in the penalty's sum")
    penalty_temperature: float = Field(1.0, gt=0, description="T; towards 0 the sum becomes a maximum")
    soft_backup: bool = Field(False, description="V(s') with its entropies; false, as the authors: expected Q alone")
    continuous_entropy: float = Field(-2.0, description="target entropy of tanh w, H_c: minus its number of entries")
    choice_entropy: float = Field(
        0.1, ge=0, lt=1, description="target entropy of d, as a share of log D; offline there is nothing to explore"
    )
    initial_temperature: float = Field(0.1, gt=0, description="both temperatures at the start")


class PenaltyNoise(NamedTuple):
    """Randomness of one penalty."""

    uniform: Tensor  # (B, N, C) displacements in [-1, 1]
    here: Tensor  # (B, N, C) standard normal, of w ~ pi(.|s)
    after: Tensor  # (B, N, C) standard normal, of w ~ pi(.|s')

    @classmethod
    def draw(cls, rows: int, samples: int, continuous: int, generator: torch.Generator) -> PenaltyNoise:
        """For N = `samples` displacements of each kind."""
        shape, device = (rows, samples, continuous), generator.device
        uniform = 2.0 * torch.rand(shape, generator=generator, device=device) - 1.0
        normal = torch.randn((2, *shape), generator=generator, device=device)
        return cls(uniform, normal[0], normal[1])


def proposals(here: ActorOutput, after: ActorOutput, noise: PenaltyNoise) -> tuple[Tensor, Tensor]:
    """3N displacements a row and their log densities: uniform ones, those of the policy at s, those of it at s'.

    Returns:
        w (B x 3N, C), the 3N of each row in a row, and log density (B x 3N,).
    """
    rows, samples, continuous = noise.uniform.shape
    drawn, densities = [noise.uniform], [torch.full_like(noise.uniform[..., 0], -continuous * math.log(2.0))]
    for output, normal in ((here, noise.here), (after, noise.after)):
        sample = SquashedSample(ActorOutput(*repeat(output, samples)), normal.flatten(0, 1))
        drawn.append(sample.continuous.view(rows, samples, continuous))
        densities.append(sample.log_density.view(rows, samples))
    return torch.cat(drawn, dim=1).flatten(0, 1), torch.cat(densities, dim=1).flatten()


def conservative_penalty(
    critic: Critic,
    context: Context,
    displacements: Tensor,
    q_data: Tensor,
    log_density: Tensor | None = None,
    temperature: float = 1.0,
) -> Tensor:
    """log-sum-exp of Q over actions less Q of the data, eq. (crtici_CQL), mean over rows, both Q functions summed.

    The sum is exact over d and importance-weighted over w: the mean of e^Q / density estimates the integral.

    Args:
        critic: two Q functions.
        context: encoded observations, B rows.
        displacements: (B x N, C) w, N of each row in a row.
        q_data: (2, B) Q of the data's actions.
        log_density: (B x N,) of the displacements; None: uniform ones, of density 2^-C.
        temperature: T of T log-sum-exp(Q / T).
    """
    rows = q_data.shape[1]
    samples = len(displacements) // rows
    q = critic.all_choices(repeat(context, samples), displacements)  # (2, B N, D)
    if log_density is None:
        q = q / temperature + (displacements.shape[1] * math.log(2.0) - math.log(samples))
    else:
        q = q / temperature - (log_density + math.log(samples))[:, None]
    total = temperature * q.view(2, rows, -1).logsumexp(dim=-1)
    return (total - q_data).mean(dim=1).sum()


class Cql(Agent):
    """CQL(H) for declared spaces."""

    config: CqlConfig
    acts_best_deterministically = True  # what noise the entropies keep is jitter

    def __init__(self, spaces: Spaces, config: CqlConfig) -> None:
        self.spaces, self.config = spaces, config
        self.actor = make_actor(spaces, config.network)
        self.critic = make_critic(spaces, config.network)
        self.target = deepcopy(self.critic).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.full((2,), math.log(config.initial_temperature)))  # a_c, a_d
        temperature = nn.ParameterList([self.log_temperature])
        self.networks = nn.ModuleDict(
            {"actor": self.actor, "critic": self.critic, "target": self.target, "temperature": temperature}
        )
        self.optimisers = {
            "actor": adam(self.actor.parameters(), config),
            "critic": adam(self.critic.parameters(), config),
            "temperature": adam([self.log_temperature], config, decays=False),
        }

    def critic_loss(self, batch: Batch, following: Tensor, penalty: PenaltyNoise | None) -> tuple[Tensor, Metrics]:
        """The module's L, both Q functions summed.

        Args:
            batch: B transitions.
            following: (B, C) standard normal, of the backup's w'.
            penalty: of its displacements; None where its weight is 0.
        """
        config = self.config
        with torch.no_grad():
            after = self.actor(batch.next_observation)
            temperature = self.log_temperature.exp() * float(config.soft_backup)
            target = soft_target(self.target, after, following, temperature, batch, config)
        context = self.critic.encode(batch.observation)
        q = action_value(self.critic, context, batch.action, self.spaces.choices)
        loss = bellman_loss(q, target, config.huber)
        metrics = {"bellman_loss": loss.detach(), "q": q.detach().mean(), "target_q": target.mean()}
        if penalty is not None:
            with torch.no_grad():
                w, log_density = proposals(self.actor(batch.observation), after, penalty)
            above = conservative_penalty(self.critic, context, w, q, log_density, config.penalty_temperature)
            loss = loss + config.cql_weight * above
            metrics["cql_penalty"] = above.detach()
        return loss, metrics | {"critic_loss": loss.detach()}

    def actor_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Metrics]:
        """-V(s) under the current critic; noise (B, C)."""
        temperature = self.log_temperature.detach().exp()
        return soft_actor_loss(self.actor, self.critic, temperature, batch.observation, noise)

    def temperature_loss(self, entropy: Tensor) -> Tensor:
        """Of the entropies (2,) to their targets."""
        config = self.config
        wanted = entropy_target(config.continuous_entropy, config.choice_entropy, self.spaces.choices, entropy.device)
        return temperature_loss(self.log_temperature, entropy, wanted)

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """Critic, actor, temperatures, target."""
        config, clip, device = self.config, self.config.gradient_clip, generator.device
        shape = batch.action.continuous.shape
        following = torch.randn(shape, generator=generator, device=device)
        penalty = (
            PenaltyNoise.draw(shape[0], config.cql_samples, shape[1], generator) if config.cql_weight > 0 else None
        )
        loss, metrics = self.critic_loss(batch, following, penalty)
        metrics["critic_gradient"] = minimise(loss, self.critic, self.optimisers["critic"], clip)

        loss, more = self.actor_loss(batch, torch.randn(shape, generator=generator, device=device))
        metrics["actor_gradient"] = minimise(loss, self.actor, self.optimisers["actor"], clip)
        entropy = more.pop("entropy")
        minimise(self.temperature_loss(entropy), [self.log_temperature], self.optimisers["temperature"], None)
        move_towards(self.target, self.critic, config.polyak)
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
