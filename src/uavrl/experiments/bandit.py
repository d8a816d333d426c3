"""Hybrid bandit: one state, eleven choices, each logged with a displacement of its own; the best action is known.

What it asks is what the flight asks of an offline learner, in seconds: to find the best choice, and with it the
displacement that the data hold beside it, though nothing in the rewards says what other displacements are worth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from uavrl.actions import HybridAction
from uavrl.agents.base import Agent, Batch
from uavrl.networks import Spaces
from uavrl.training.fit import learn_once

CHOICES = 11
ACTIONS = 10_000
SIGMA = 0.05  # of the displacement around its mode
NOISE = 0.5  # of the reward; mean rewards are 0.5 apart
NEAR = 0.2  # of a mode

SPACES = Spaces(observation=1, continuous=2, choices=CHOICES)


@dataclass(frozen=True)
class HybridBandit:
    """Logged actions of one bandit, drawn by a seed."""

    modes: Tensor  # (11, 2) displacement of each choice, on a circle of .8
    worth: Tensor  # (11,) mean reward of each choice: 0, .5, ..., 5 in an order of the seed's
    action: HybridAction  # (10000, 2), (10000,)
    reward: Tensor  # (10000,)

    @classmethod
    def draw(cls, seed: int) -> HybridBandit:
        """All choices equally often."""
        generator = torch.Generator().manual_seed(seed)
        angle = torch.arange(CHOICES) * 2 * math.pi / CHOICES
        modes = 0.8 * torch.stack([angle.cos(), angle.sin()], dim=1)
        worth = torch.linspace(0, 5, CHOICES)[torch.randperm(CHOICES, generator=generator)]
        choice = torch.randint(0, CHOICES, (ACTIONS,), generator=generator)
        w = (modes[choice] + SIGMA * torch.randn((ACTIONS, 2), generator=generator)).clamp(-1, 1)
        reward = worth[choice] + NOISE * torch.randn(ACTIONS, generator=generator)
        return cls(modes, worth, HybridAction(w, choice), reward)

    def batch(self, shift: float) -> Batch:
        """The log as episodes of one step, rewards less `shift`."""
        state, one = torch.zeros(ACTIONS, 1), torch.ones(ACTIONS)
        return Batch(state, self.action, self.reward - shift, one, one, state)

    def score(self, action: HybridAction) -> dict[str, float]:
        """Shares of actions with the best choice, with a displacement near its mode, and with both."""
        best = int(self.worth.argmax())
        right = action.choice == best
        near = (action.continuous - self.modes[best]).norm(dim=1) < NEAR
        shares = {"right_choice": right, "near_mode": near, "both": right & near}
        return {name: float(share.float().mean()) for name, share in shares.items()}


def fit_bandit(agent: Agent, bandit: HybridBandit, updates: int, seed: int) -> None:
    """Learn from the log, its median reward taken off where the agent's settings centre rewards, rate falling to 0."""
    generator = torch.Generator().manual_seed(seed)
    data = bandit.batch(float(bandit.reward.median()) if agent.config.reward.transform == "centred" else 0.0)
    for update in range(updates):
        agent.progress = update / updates
        for optimiser in agent.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = agent.config.learning_rate * 0.5 * (1 + math.cos(math.pi * update / updates))
        learn_once(agent, data, generator)


def samples(agent: Agent, seed: int, count: int = 2_000) -> HybridAction:
    """Actions of the learned policy, one candidate each unless its settings say otherwise."""
    return agent.act(torch.zeros(count, 1), generator=torch.Generator().manual_seed(seed))
