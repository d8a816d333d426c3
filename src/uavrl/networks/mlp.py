"""Perceptrons over a flat observation: the paper's networks (three hidden layers of 256)."""

from __future__ import annotations

import inspect
import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from uavrl.networks.activations import ACTIVATIONS, Activation, ActivationName
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


class _Layers(torch.autograd.Function):
    """Activation and linear layer in turn, with the gradient written out.

    A chain of M passes over small layers is mostly administration otherwise: one node in the graph takes the place of
    four a layer. What the gradient needs is returned beside the result, as `torch.vmap` wants it; under that, inputs
    and weights are stacks of S.
    """

    @staticmethod
    def forward(activation: Activation, first: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
        """From (B, width) before the first activation; weights W_1, b_1, W_2, b_2, ... as in nn.Linear."""
        kept: list[Tensor] = []
        for matrix, bias in zip(weights[::2], weights[1::2], strict=True):
            hidden, slope = activation(first, True)
            assert slope is not None  # noqa: S101  # for the type checker: it was asked for
            kept += [hidden, slope]
            if matrix.dim() == 2:
                first = torch.addmm(bias, hidden, matrix.T)
            else:
                first = torch.baddbmm(bias[:, None], hidden, matrix.mT)
        return first, *kept

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*output[1:], *inputs[2::2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        layers = len(ctx.saved_tensors) // 3
        if gradient is None:
            return (None,) * (2 + 2 * layers)
        kept, matrices = ctx.saved_tensors[: 2 * layers], ctx.saved_tensors[2 * layers :]
        found: list[Tensor | None] = []
        for layer in reversed(range(layers)):
            trains_matrix, trains_bias = ctx.needs_input_grad[2 + 2 * layer : 4 + 2 * layer]
            found = [
                gradient.mT @ kept[2 * layer] if trains_matrix else None,
                gradient.sum(dim=-2) if trains_bias else None,
                *found,
            ]
            gradient = (gradient @ matrices[layer]).mul_(kept[2 * layer + 1])
        return None, gradient, *found

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], activation: Activation, *tensors: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """The same of stacks, S first."""
        stacks = [
            tensor.expand(info.batch_size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
            for tensor, dim in zip(tensors, in_dims[1:], strict=True)
        ]
        out: tuple[Tensor, ...] = _Layers.apply(activation, *stacks)  # type: ignore[no-untyped-call]  # torch's own
        return out, (0,) * len(out)


_Layers.forward.__signature__ = inspect.signature(_Layers.forward)  # type: ignore[attr-defined]  # torch works it out at each use


class Layers(nn.Module):
    """What follows a perceptron's first linear layer: its activation, depth - 1 hidden layers, and the output layer."""

    def __init__(self, width: int, depth: int, outputs: int, activation: ActivationName, layer_norm: bool) -> None:
        super().__init__()
        self.activation = ACTIVATIONS[activation]
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(depth - 1))
        self.out = nn.Linear(width, outputs)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(depth)) if layer_norm else None

    def forward(self, first: Tensor) -> Tensor:
        """(B, width) as the first linear layer gives it -> (B, outputs)."""
        weights = [part for linear in (*self.hidden, self.out) for part in (linear.weight, linear.bias)]
        if self.norms is None:
            return self._run(first, *weights)
        for norm, matrix, bias in zip(self.norms, weights[::2], weights[1::2], strict=True):
            first = self._run(norm(first), matrix, bias)
        return first

    def _run(self, first: Tensor, *weights: Any) -> Tensor:
        if torch.is_grad_enabled():
            out: Tensor = _Layers.apply(self.activation, first, *weights)[0]  # type: ignore[no-untyped-call]  # torch's own
            return out
        for matrix, bias in zip(weights[::2], weights[1::2], strict=True):
            first = torch.addmm(bias, self.activation(first, False)[0], matrix.T)
        return first


def step_embedding(step: Tensor, size: int) -> Tensor:
    """Sinusoidal embedding of denoising steps (n,) -> (n, size) (Vaswani et al. 2017)."""
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
        self,
        size: int,
        continuous: int,
        choices: int,
        heads: bool,
        width: int,
        depth: int,
        activation: ActivationName,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.observation = nn.Linear(size, width)
        self.continuous = nn.Linear(continuous, width, bias=False)
        self.choice = None if heads else nn.Linear(choices, width, bias=False)
        self.rest = Layers(width, depth, choices if heads else 1, activation, layer_norm)

    def all_choices(self, context: Tensor, continuous: Tensor) -> Tensor:
        first = context + self.continuous(continuous)
        if self.choice is None:
            q: Tensor = self.rest(first)
        else:
            rows = (first[:, None] + self.choice.weight.T).flatten(0, 1)
            q = self.rest(rows).view(first.shape[0], -1)
        return q

    def value(self, context: Tensor, continuous: Tensor, choice: Tensor) -> Tensor:
        first = context + self.continuous(continuous)
        if self.choice is None:
            q: Tensor = (self.rest(first) * choice).sum(dim=-1)
        else:
            q = self.rest(first + self.choice(choice)).squeeze(-1)
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
        activation: ActivationName,
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
            q.rest.out.bias.add_(amount)


class MlpDenoiser(Denoiser):
    """Perceptron over [s, a^i, embedding of i]."""

    def __init__(
        self, size: int, vector: int, *, log: bool, width: int, depth: int, activation: ActivationName, layer_norm: bool
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.vector = vector
        self.embedding_size = 16
        self.observation = nn.Linear(self.normaliser.size, width)
        self.action = nn.Linear(vector, width, bias=False)
        self.step = nn.Linear(self.embedding_size, width, bias=False)
        self.rest = Layers(width, depth, vector, activation, layer_norm)

    def encode(self, observation: Observation) -> Context:
        """The first layer's observation part."""
        return (self.observation(self.normaliser(_flat(observation))),)

    def steps(self, step: Tensor) -> Tensor:
        """The first layer's step part, (n, width)."""
        part: Tensor = self.step(step_embedding(step, self.embedding_size))
        return part

    def predict(self, context: Context, vector: Tensor | None, step: Tensor) -> Tensor:
        """See `Denoiser`."""
        first: Tensor = context[0] + step
        if vector is not None:
            first = torch.addmm(first, vector, self.action.weight.T)
        noise: Tensor = self.rest(first)
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
        activation: ActivationName,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.sizes = (continuous, continuous, choices)
        self.first = nn.Linear(self.normaliser.size, width)
        self.rest = Layers(width, depth, sum(self.sizes), activation, layer_norm)

    def forward(self, observation: Observation) -> ActorOutput:
        """See `Actor`."""
        raw = self.rest(self.first(self.normaliser(_flat(observation))))
        mean, log_std, logits = raw.split(self.sizes, dim=-1)
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
        activation: ActivationName,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.continuous = continuous
        self.first = nn.Linear(self.normaliser.size, width)
        self.rest = Layers(width, depth, choices * (1 + 2 * continuous), activation, layer_norm)

    def forward(self, observation: Observation) -> ChoiceActorOutput:
        """See `ChoiceActor`."""
        raw = self.rest(self.first(self.normaliser(_flat(observation))))
        return choice_output(raw.unflatten(-1, (-1, 1 + 2 * self.continuous)))


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
        activation: ActivationName,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self.normaliser = Normaliser(size, log)
        self.observation = nn.Linear(self.normaliser.size, width)
        self.inputs = nn.Linear(inputs, width, bias=False) if inputs else None
        self.choice = nn.Linear(choices, width, bias=False) if choices else None
        self.rest = Layers(width, depth, outputs, activation, layer_norm)

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
        outputs: Tensor = self.rest(first)
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
