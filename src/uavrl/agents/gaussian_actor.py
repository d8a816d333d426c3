"""The Gaussian-categorical policy whose displacement depends on its choice: log pi(d|s) + log pi(w|s, d).

The Gaussian is not squashed: logged displacements lie on the edge of the box, where the density of a tanh-Normal has no
bound. Its mean passes a tanh instead, and its samples are clipped.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from uavrl.actions import HybridAction
from uavrl.networks import ChoiceActor, Observation
from uavrl.networks.interfaces import ChoiceActorOutput


def of_choice(output: ChoiceActorOutput, choice: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log deviation (B, C) of the Gaussian that belongs to each row's choice (B,)."""
    rows = torch.arange(choice.shape[0], device=choice.device)
    return output.mean[rows, choice], output.log_std[rows, choice]


def log_likelihood(output: ChoiceActorOutput, action: HybridAction) -> tuple[Tensor, Tensor]:
    """log pi(d|s) and log pi(w|s, d), each (B,)."""
    log_choice = output.logits.log_softmax(dim=-1).gather(1, action.choice[:, None]).squeeze(1)
    mean, log_std = of_choice(output, action.choice)
    error = (action.continuous - mean) * torch.exp(-log_std)
    normal = -0.5 * error.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    return log_choice, normal.sum(dim=-1)


@torch.no_grad()
def gaussian_action(
    actor: ChoiceActor, observation: Observation, generator: torch.Generator, deterministic: bool
) -> HybridAction:
    """A sample, w clipped to the box; or the likeliest choice and its mean."""
    if deterministic:
        return gaussian_decision(actor, observation, None)
    output = actor(observation)
    choice = torch.multinomial(output.logits.softmax(dim=-1), 1, generator=generator).squeeze(-1)
    mean, log_std = of_choice(output, choice)
    noise = torch.randn(mean.shape, generator=generator, device=generator.device)
    return HybridAction((mean + log_std.exp() * noise).clamp(-1.0, 1.0), choice)


@torch.no_grad()
def gaussian_decision(actor: ChoiceActor, observation: Observation, noise: Tensor | None) -> HybridAction:
    """The same with noise (B, 1, C + D) given, that of w and that of d; without: the likeliest choice and its mean."""
    output = actor(observation)
    if noise is None:
        choice = output.logits.argmax(dim=-1)
        return HybridAction(of_choice(output, choice)[0], choice)
    continuous = output.mean.shape[-1]
    choice = drawn_choice(output.logits, noise[:, 0, continuous:])
    mean, log_std = of_choice(output, choice)
    return HybridAction((mean + log_std.exp() * noise[:, 0, :continuous]).clamp(-1.0, 1.0), choice)


def drawn_choice(logits: Tensor, noise: Tensor) -> Tensor:
    """A sample (B,) of softmax(logits), (B, D), from standard normal noise (B, D).

    As torch.multinomial draws it: the first of D clocks, exponential by -log(1 - Phi(noise)), at rates softmax(logits).
    """
    left = 0.5 * (1.0 + torch.erf(noise * -math.sqrt(0.5)))
    clock = -torch.log(left.clamp(1e-30, 1.0 - 2.0**-24))  # finite: a padded device must not win
    return (logits - torch.log(clock)).argmax(dim=-1)
