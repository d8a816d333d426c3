"""Minibatches, and the shortest loop over them: any agent, any environment, no files.

    agent = make_agent(Spaces(observation=4, continuous=1, choices=3), config)
    fit(agent, batch, 1_000, torch.Generator().manual_seed(0))

The loop of `uavrl.training.offline` has checkpoints, a log and trial flights beside it.
"""

from __future__ import annotations

from typing import Protocol

import torch

from uavrl.agents.base import Agent, Batch, Metrics
from uavrl.networks import fit_normalisers


class Rows(Protocol):
    """What minibatches are drawn from: a `Batch` in memory, or `uavrl.training.batches.MappedRows`."""

    def __len__(self) -> int: ...

    def take(self, rows: torch.Tensor) -> Batch:
        """Rows by their numbers (B,), in this order and as often as they are named, on the device of `rows`."""
        ...


def draw_rows(data: Rows, count: int, generator: torch.Generator) -> torch.Tensor:
    """Numbers (count,) of the rows of a minibatch, drawn with replacement."""
    return torch.randint(0, len(data), (count,), generator=generator, device=generator.device)


def learn_once(agent: Agent, data: Rows, generator: torch.Generator) -> Metrics:
    """One update on a fresh minibatch."""
    return agent.update(data.take(draw_rows(data, agent.config.batch_size, generator)), generator)


def fit(agent: Agent, data: Batch, updates: int, generator: torch.Generator) -> dict[str, float]:
    """Set the normalisers from `data`, then update on minibatches of it; the last update's metrics.

    What falls over a training (`Agent.progress`) falls over these updates, so make them one call. Rewards are learned
    from as they stand: centre them (minus their median) where episodes are only cut by time, or Q
    starts far from where it has to go.
    """
    fit_normalisers(agent.networks, data.observation)
    metrics: Metrics = {}
    for done in range(updates):
        agent.progress = done / updates
        metrics = learn_once(agent, data, generator)
    return {name: float(value) for name, value in metrics.items()}
