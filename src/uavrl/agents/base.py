"""What every agent is: a frozen config, a bundle of networks and optimisers, `update` and `act`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional

from uavrl.actions import HybridAction
from uavrl.networks import Critic, NetworkConfig, Observation, Spaces
from uavrl.networks.interfaces import Context

Metrics = dict[str, Tensor]  # 0-d tensors, read only when they are logged: no host synchronisation in the loop


@dataclass(frozen=True)
class Batch:
    """B transitions."""

    observation: Observation  # (B, ...)
    action: HybridAction  # continuous (B, C) in [-1, 1], choice (B,) int64
    reward: Tensor  # (B,) as the agent is to see it, see `RewardConfig`
    duration_s: Tensor  # (B,)
    terminated: Tensor  # (B,) float, 1 where no future follows; a truncation is 0 and bootstraps
    next_observation: Observation  # (B, ...)

    def __len__(self) -> int:
        return len(self.reward)

    def take(self, rows: Tensor) -> Batch:
        """Rows by their numbers (M,), as often as they are named."""
        return self._each(lambda values: values.index_select(0, rows))

    def grouped(self, groups: int) -> Batch:
        """Its rows as (groups, B / groups, ...), one group after another."""
        return self._each(lambda values: values.unflatten(0, (groups, -1)))

    def to(self, device: torch.device) -> Batch:
        """Itself where it is there already, else a copy."""
        return self._each(lambda values: values.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Batch:
        def seen(observation: Observation) -> Observation:
            if isinstance(observation, dict):
                return {key: change(values) for key, values in observation.items()}
            return change(observation)

        return Batch(
            observation=seen(self.observation),
            action=HybridAction(change(self.action.continuous), change(self.action.choice)),
            reward=change(self.reward),
            duration_s=change(self.duration_s),
            terminated=change(self.terminated),
            next_observation=seen(self.next_observation),
        )


class RewardConfig(BaseModel):
    """From logged rewards to what the critic learns from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    transform: Literal["none", "zscore", "centred", "robust"] = Field(
        "centred",
        description="zscore: eq. (rewards_norm); centred: minus the median, which puts Q near 0 from the start and "
        "changes no optimum while episodes are only truncated; robust: centred, and over ten times the median absolute "
        "deviation, which leaves rewards of `released` about as they are and brings those of other units there",
    )
    clip: float | None = Field(6.0, gt=0, description="transformed rewards are held in [-clip, clip]")
    scale: float = Field(1.0, gt=0, description="factor after the transform")


class AgentConfig(BaseModel):
    """What all agents share."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    network: NetworkConfig = NetworkConfig()
    reward: RewardConfig = RewardConfig()
    batch_size: int = Field(256, ge=1, description="transitions an update")
    learning_rate: float = Field(3e-4, gt=0, description="of Adam")
    weight_decay: float = Field(
        0.0, ge=0, description="of every network, decoupled (Loshchilov and Hutter 2019): weights shrink by rate x this"
    )
    discount: float = Field(0.99, ge=0, lt=1, description="gamma, per step or per second")
    discount_per: Literal["step", "second"] = Field(
        "step", description="per second: gamma^duration, the semi-Markov discount of a per-second objective"
    )
    polyak: float = Field(0.005, gt=0, le=1, description="target <- (1 - polyak) target + polyak network, each update")
    huber: float | None = Field(
        1.0,
        gt=0,
        description="Bellman errors beyond this count linearly: with fading drawn once a packet rewards have no finite "
        "variance; none: squared, as in the paper",
    )
    gradient_clip: float | None = Field(10.0, gt=0, description="largest gradient norm of a network")
    shortest_move: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="a w shorter than this is not flown (w = 0), which no network hits; learning does not know of it",
    )


class Agent(ABC):
    """Networks and optimisers of one algorithm for declared spaces."""

    config: AgentConfig
    spaces: Spaces
    networks: nn.ModuleDict  # everything that is saved, targets and averages included
    optimisers: dict[str, torch.optim.Optimizer]
    acts_best_deterministically = False  # whether a trial should fly its deterministic action rather than a sample
    learning_only: Mapping[str, str] = MappingProxyType({})  # networks that no decision asks -> one of the same shape
    progress = 0.0  # share of the training that is done; a loop that knows its length sets it before an update

    @abstractmethod
    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """One gradient step of every network; all noise comes from `generator`."""

    @abstractmethod
    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """Actions for B observations."""

    def to_fly(self, action: HybridAction) -> HybridAction:
        """Decided actions (N) as a policy flies them, see `AgentConfig.shortest_move`."""
        if self.config.shortest_move == 0:
            return action
        length = action.continuous.square().sum(dim=1, keepdim=True).sqrt()
        return action._replace(continuous=action.continuous * (length >= self.config.shortest_move))

    @abstractmethod
    def noise_shape(self, choices: int) -> tuple[int, int]:
        """(R, E): rows and entries of noise that a sampled decision between `choices` takes."""

    @abstractmethod
    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """`act` as a pure function: of standard normal noise (B, R, E), or for None the deterministic action."""


def discounts(batch: Batch, config: AgentConfig) -> Tensor:
    """gamma (1 - terminated) of each transition, (B,); gamma^duration where discounting is per second."""
    if config.discount_per == "second":
        return torch.pow(config.discount, batch.duration_s) * (1.0 - batch.terminated)
    return config.discount * (1.0 - batch.terminated)


def action_value(critic: Critic, context: Context, action: HybridAction, choices: int) -> Tensor:
    """Q of hybrid actions, (2, B); the critic sees a legal one-hot of D = `choices`."""
    return critic.value(context, action.continuous, functional.one_hot(action.choice, choices).float())


def bellman_loss(q: Tensor, target: Tensor, huber: float | None) -> Tensor:
    """Half the squared error of both Q (2, B) to the target (B,), each a mean, summed; linear from `huber` on."""
    wanted = target.expand_as(q)
    if huber is None:
        return 0.5 * functional.mse_loss(q, wanted, reduction="none").mean(dim=1).sum()
    return functional.huber_loss(q, wanted, reduction="none", delta=huber).mean(dim=1).sum()


def minimise(
    loss: Tensor, network: nn.Module | list[Tensor], optimiser: torch.optim.Optimizer, clip: float | None
) -> Tensor:
    """One optimiser step on `network` alone, whatever else `loss` depends on; returns the gradient's norm."""
    parameters = list(network.parameters()) if isinstance(network, nn.Module) else network
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient.contiguous()  # as its weights lie: fused Adam pairs entries by their place in memory
    norm = torch.nn.utils.clip_grad_norm_(parameters, clip if clip is not None else float("inf"))
    optimiser.step()
    return norm


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Inside, what `network` computes has gradients for its inputs alone; those for its weights cost as much again."""
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    for parameter in trained:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)


@torch.no_grad()
def move_towards(target: nn.Module, source: nn.Module, rate: float) -> None:
    """Polyak averaging, target <- (1 - rate) target + rate source; buffers are copied."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), rate)
    for mine, theirs in zip(target.buffers(), source.buffers(), strict=True):
        mine.copy_(theirs)


def adam(parameters: Iterable[Tensor], config: AgentConfig, *, decays: bool = True) -> torch.optim.Optimizer:
    """The optimiser of everything that is trained, fused; `decays`: by the config's decoupled weight decay."""
    weight_decay = config.weight_decay if decays else 0.0
    return torch.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=weight_decay, fused=True)
