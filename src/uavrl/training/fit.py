"""Minibatches, and the shortest loop over them: any agent, any environment, no files.

    agent = make_agent(Spaces(observation=4, continuous=1, choices=3), config)
    fit(agent, batch, 1_000, torch.Generator().manual_seed(0))

The loop of `uavrl.training.offline` has checkpoints, a log and trial flights beside it.
"""

from __future__ import annotations

import torch

from uavrl.actions import HybridAction
from uavrl.agents.base import Agent, Batch, Metrics
from uavrl.networks import Observation, fit_normalisers


def take_observation(observation: Observation, rows: torch.Tensor) -> Observation:
    """Rows of an observation."""
    if isinstance(observation, dict):
        return {key: value.index_select(0, rows) for key, value in observation.items()}
    return observation.index_select(0, rows)


def take(data: Batch, rows: torch.Tensor) -> Batch:
    """Rows of a batch."""
    return Batch(
        observation=take_observation(data.observation, rows),
        action=HybridAction(data.action.continuous.index_select(0, rows), data.action.choice.index_select(0, rows)),
        reward=data.reward.index_select(0, rows),
        duration_s=data.duration_s.index_select(0, rows),
        terminated=data.terminated.index_select(0, rows),
        next_observation=take_observation(data.next_observation, rows),
    )


def learn_once(agent: Agent, data: Batch, generator: torch.Generator) -> Metrics:
    """One update on a fresh minibatch, drawn with replacement."""
    shape = (agent.config.batch_size,)
    rows = torch.randint(0, len(data.reward), shape, generator=generator, device=generator.device)
    return agent.update(take(data, rows), generator)


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
