"""Perceptrons over a flat observation: the paper's networks (three hidden layers of 256)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from uavrl.networks.interfaces import (
    Actor,
    ActorOutput,
    ChoiceActor,
    ChoiceActorOutput,
    Conditional,
    Context,
    Critic,
    Denoiser,
    Observation,
)

LOG_STD_RANGE = (-5.0, 2.0)


class Normaliser(nn.Module):
    """Eq. (state_norm), (s - mu) / (sigma + eps); with `log`, the same of sign(s) log(1 + |s|) beside it.

    mu and sigma are buffers: set once from data with `fit`, saved with the weights.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: int, log: bool) -> None:
        super().__init__()
        self.log = log
        self.size = 2 * size if log else size
        self.register_buffer("mean", torch.zeros(self.size))
        self.register_buffer("std", torch.ones(self.size))

    def _raw(self, observation: Tensor) -> Tensor:
        if not self.log:
            return observation
        return torch.cat([observation, torch.sign(observation) * torch.log1p(observation.abs())], dim=-1)

    def fit(self, observation: Tensor) -> None:
        """Take mean and standard deviation from observations (n, size)."""
        raw = self._raw(observation.double())
        self.mean.copy_(raw.mean(dim=0))
        self.std.copy_(raw.std(dim=0, correction=0))

    def forward(self, observation: Tensor) -> Tensor:
        """(B, size) -> (B, size or 2 size)."""
        normal: Tensor = (self._raw(observation) - self.mean) / (self.std + 1e-6)
        return normal


def activation_layer(name: str) -> nn.Module:
    """A fresh activation: "silu", "mish" or "relu"."""
    return {"silu": nn.SiLU, "mish": nn.Mish, "relu": nn.ReLU}[name]()


def hidden_layers(width: int, depth: int, activation: str, layer_norm: bool) -> nn.Sequential:
    """What follows the first linear layer: activation, then depth - 1 further hidden layers."""
    layers: list[nn.Module] = [nn.LayerNorm(width)] if layer_norm else []
    layers.append(activation_layer(activation))
    for _ in range(depth - 1):
        layers.append(nn.Linear(width, width))
        if layer_norm:
            layers.append(nn.LayerNorm(width))
        layers.append(activation_layer(activation))
    return nn.Sequential(*layers)


def step_embedding(step: Tensor, size: int) -> Tensor:
    """Sinusoidal embedding of the denoising step (B,) -> (B, size) (Vaswani et al. 2017)."""
    frequency = torch.exp(torch.arange(size // 2, device=step.device) * (-math.log(1e4) / (size // 2 - 1)))
    angle = step[:, None].float() * frequency
    return torch.cat([torch.sin(angle), torch.cos(angle)], dim=-1)


def _flat(observation: Observation) -> Tensor:
    if isinstance(observation, dict):
        raise TypeError('a perceptron takes a flat observation, observation = "paper"')
    return observation


class _MlpQ(nn.Module):
    """One Q function. `heads`: one output a choice; else d is an input, as in the paper."""

    def __init__(
        self, size: int, continuous: int, choices: int, heads: bool, width: int, depth: int, activation: str, norm: bool
    ) -> None:
        super().__init__()
        self.observation = nn.Linear(size, width)
        self.continuous = nn.Linear(continuous, width, bias=False)
        self.choice = None if heads else nn.Linear(choices, width, bias=False)
        self.hidden = hidden_layers(width, depth, activation, norm)
        self.out = nn.Linear(width, choices if heads else 1)

    def all_choices(self, context: Tensor, continuous: Tensor) -> Tensor:
        first = context + self.continuous(continuous)
        if self.choice is None:
            q: Tensor = self.out(self.hidden(first))
        else:
            q = self.out(self.hidden(first[:, None] + self.choice.weight.T)).squeeze(-1)
        return q

    def value(self, context: Tensor, continuous: Tensor, choice: Tensor) -> Tensor:
        first = context + self.continuous(continuous)
        if self.choice is None:
            q: Tensor = (self.out(self.hidden(first)) * choice).sum(dim=-1)
        else:
            q = self.out(self.hidden(first + self.choice(choice))).squeeze(-1)
        return q


class MlpCritic(Critic):
    """Two perceptron Q functions behind one normaliser."""

    def __init__(
        self,
        size: int,
        continuous: int,
        choices: int,
        *,
        heads: bool,
        log: bool,
        width: int,
        depth: int,
        activation: str,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        sizes = (self.normaliser.size, continuous, choices)
        self.first = _MlpQ(*sizes, heads, width, depth, activation, layer_norm)
        self.second = _MlpQ(*sizes, heads, width, depth, activation, layer_norm)

    def encode(self, observation: Observation) -> Context:
        """The first layer's observation part of both Q functions."""
        features = self.normaliser(_flat(observation))
        return self.first.observation(features), self.second.observation(features)

    def all_choices(self, context: Context, continuous: Tensor) -> Tensor:
        """See `Critic`."""
        first, second = context
        return torch.stack([self.first.all_choices(first, continuous), self.second.all_choices(second, continuous)])

    def value(self, context: Context, continuous: Tensor, choice: Tensor) -> Tensor:
        """See `Critic`."""
        first, second = context
        values = (self.first.value(first, continuous, choice), self.second.value(second, continuous, choice))
        return torch.stack(values)

    @torch.no_grad()
    def shift(self, amount: float) -> None:
        """See `Critic`."""
        for q in (self.first, self.second):
            q.out.bias.add_(amount)


class MlpDenoiser(Denoiser):
    """Perceptron over [s, a^i, embedding of i]."""

    def __init__(
        self, size: int, vector: int, *, log: bool, width: int, depth: int, activation: str, layer_norm: bool
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.vector = vector
        self.embedding_size = 16
        self.observation = nn.Linear(self.normaliser.size, width)
        self.action = nn.Linear(vector, width, bias=False)
        self.step = nn.Linear(self.embedding_size, width, bias=False)
        self.hidden = hidden_layers(width, depth, activation, layer_norm)
        self.out = nn.Linear(width, vector)

    def encode(self, observation: Observation) -> Context:
        """The first layer's observation part."""
        return (self.observation(self.normaliser(_flat(observation))),)

    def forward(self, context: Context, vector: Tensor, step: Tensor) -> Tensor:
        """See `Denoiser`."""
        first = context[0] + self.action(vector) + self.step(step_embedding(step, self.embedding_size))
        noise: Tensor = self.out(self.hidden(first))
        return noise

    def vector_size(self, context: Context) -> int:
        """C + D."""
        return self.vector


class MlpActor(Actor):
    """Perceptron to mean, log standard deviation and logits."""

    def __init__(
        self,
        size: int,
        continuous: int,
        choices: int,
        *,
        log: bool,
        width: int,
        depth: int,
        activation: str,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.sizes = (continuous, continuous, choices)
        self.first = nn.Linear(self.normaliser.size, width)
        self.hidden = hidden_layers(width, depth, activation, layer_norm)
        self.out = nn.Linear(width, sum(self.sizes))

    def forward(self, observation: Observation) -> ActorOutput:
        """See `Actor`."""
        hidden = self.hidden(self.first(self.normaliser(_flat(observation))))
        mean, log_std, logits = self.out(hidden).split(self.sizes, dim=-1)
        return ActorOutput(mean, bounded_log_std(log_std), logits)


class MlpChoiceActor(ChoiceActor):
    """Perceptron to a logit, a mean and a log standard deviation for each choice."""

    def __init__(
        self,
        size: int,
        continuous: int,
        choices: int,
        *,
        log: bool,
        width: int,
        depth: int,
        activation: str,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.continuous = continuous
        self.first = nn.Linear(self.normaliser.size, width)
        self.hidden = hidden_layers(width, depth, activation, layer_norm)
        self.out = nn.Linear(width, choices * (1 + 2 * continuous))

    def forward(self, observation: Observation) -> ChoiceActorOutput:
        """See `ChoiceActor`."""
        hidden = self.hidden(self.first(self.normaliser(_flat(observation))))
        return choice_output(self.out(hidden).unflatten(-1, (-1, 1 + 2 * self.continuous)))


class MlpConditional(Conditional):
    """Perceptron over [s, inputs, one-hot choice]."""

    def __init__(
        self,
        size: int,
        inputs: int,
        choices: int,
        outputs: int,
        *,
        log: bool,
        width: int,
        depth: int,
        activation: str,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.observation = nn.Linear(self.normaliser.size, width)
        self.inputs = nn.Linear(inputs, width, bias=False) if inputs else None
        self.choice = nn.Linear(choices, width, bias=False) if choices else None
        self.hidden = hidden_layers(width, depth, activation, layer_norm)
        self.out = nn.Linear(width, outputs)

    def encode(self, observation: Observation) -> Context:
        """The first layer's observation part."""
        return (self.observation(self.normaliser(_flat(observation))),)

    def forward(self, context: Context, inputs: Tensor | None = None, choice: Tensor | None = None) -> Tensor:
        """See `Conditional`."""
        first = context[0]
        if self.inputs is not None:
            first = first + self.inputs(inputs)
        if self.choice is not None:
            first = first + self.choice(choice)
        outputs: Tensor = self.out(self.hidden(first))
        return outputs


def choice_output(raw: Tensor) -> ChoiceActorOutput:
    """[logit, mean before tanh, log deviation before its bounds] of each choice, (B, D, 1 + 2 C), as a distribution."""
    continuous = raw.shape[-1] // 2
    logits, mean, log_std = raw.split([1, continuous, continuous], dim=-1)
    return ChoiceActorOutput(torch.tanh(mean), bounded_log_std(log_std), logits.squeeze(-1))


def bounded_log_std(raw: Tensor) -> Tensor:
    """Any real number to LOG_STD_RANGE, smoothly."""
    low, high = LOG_STD_RANGE
    return low + (high - low) * functional.sigmoid(raw)
