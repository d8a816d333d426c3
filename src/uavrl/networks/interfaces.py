"""What agents ask of their networks. B rows, C continuous entries, D choices.

Every network first encodes the observation (`encode`), so that a chain of M denoising steps, or M candidate actions,
pays for that part once; `repeat` then copies an encoding for several actions a row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

Observation = Tensor | dict[str, Tensor]  # (B, entries), or {"uav": (B, 4), "devices": (B, K, 6)}
Context = tuple[Tensor, ...]  # an encoded observation, each entry batch first


def repeat(context: Context, times: int) -> Context:
    """Each row `times` times in a row, (B, ...) -> (B x times, ...)."""
    if times == 1:
        return context
    return tuple(entry.repeat_interleave(times, dim=0) for entry in context)


class ActorOutput(NamedTuple):
    """A Gaussian over the continuous part (before tanh) and a categorical over the choice, independent given s."""

    mean: Tensor  # (B, C)
    log_std: Tensor  # (B, C)
    logits: Tensor  # (B, D)


class ChoiceActorOutput(NamedTuple):
    """A categorical over the choice and, for each choice, a Gaussian over the continuous part, not squashed."""

    mean: Tensor  # (B, D, C) in (-1, 1)
    log_std: Tensor  # (B, D, C)
    logits: Tensor  # (B, D)


class Critic(nn.Module, ABC):
    """An ensemble of two Q functions of a hybrid action."""

    @abstractmethod
    def encode(self, observation: Observation) -> Context:
        """The observation's part."""

    @abstractmethod
    def all_choices(self, context: Context, continuous: Tensor) -> Tensor:
        """Q(s, w, d) for every d: (2, B, D) from w (B, C)."""

    @abstractmethod
    def value(self, context: Context, continuous: Tensor, choice: Tensor) -> Tensor:
        """Q(s, w, d), (2, B), for d as weights over the choices (B, D): a one-hot, or a relaxation of one."""

    @abstractmethod
    def shift(self, amount: float) -> None:
        """Add `amount` to every Q value: what a change of the reward's zero asks for."""


class Denoiser(nn.Module, ABC):
    """epsilon_theta(a^i, i, s) of eq. (reverse_QL)."""

    @abstractmethod
    def encode(self, observation: Observation) -> Context:
        """The observation's part."""

    @abstractmethod
    def steps(self, step: Tensor) -> Tensor:
        """The part of denoising steps 1..M (n,), first axis n; a chain computes it once for all of its steps."""

    @abstractmethod
    def predict(self, context: Context, vector: Tensor | None, step: Tensor) -> Tensor:
        """Predicted noise (B, C + D) of a noisy diffusion vector (B, C + D) from B rows of `steps`, or 1 for all.

        None is the zero vector, from which a deterministic decision sets out: its part costs nothing.
        """

    def forward(self, context: Context, vector: Tensor, step: Tensor) -> Tensor:
        """Predicted noise (B, C + D) of a noisy diffusion vector (B, C + D) at steps 1..M (B,)."""
        return self.predict(context, vector, self.steps(step))

    @abstractmethod
    def vector_size(self, context: Context) -> int:
        """C + D for this observation."""

    def possible(self, context: Context, vector: Tensor) -> Tensor:
        """A diffusion vector (B, C + D) with the entries of padded devices out of an argmax's reach."""
        return vector


class Actor(nn.Module, ABC):
    """pi(w, d | s) of the Gaussian-categorical agents."""

    @abstractmethod
    def forward(self, observation: Observation) -> ActorOutput:
        """Distribution of the hybrid action."""


class ChoiceActor(nn.Module, ABC):
    """pi(d | s) pi(w | s, d): the continuous part knows the choice. Without a continuous part, a classifier."""

    @abstractmethod
    def forward(self, observation: Observation) -> ChoiceActorOutput:
        """Distribution of the hybrid action."""


class Conditional(nn.Module, ABC):
    """O outputs, a function of s and, where it was made for them, of I further numbers and of a choice."""

    @abstractmethod
    def encode(self, observation: Observation) -> Context:
        """The observation's part."""

    @abstractmethod
    def forward(self, context: Context, inputs: Tensor | None = None, choice: Tensor | None = None) -> Tensor:
        """(B, O) of inputs (B, I) and a one-hot choice (B, D)."""
