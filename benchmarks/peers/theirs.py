"""The side of d3rlpy: `python -m benchmarks.peers.theirs OUT [SEED ...]`, in an environment that holds it."""

from __future__ import annotations

import sys
from pathlib import Path

import d3rlpy
import numpy as np
import torch
from d3rlpy.dataset import Episode, InfiniteBuffer, ReplayBuffer
from d3rlpy.logging import NoopAdapterFactory
from d3rlpy.models import VectorEncoderFactory

from benchmarks.peers import settings
from benchmarks.peers.point_mass import Array, Flights, Policy, cut_episodes


def config(name: str) -> d3rlpy.algos.CQLConfig | d3rlpy.algos.IQLConfig:
    """Nothing learns its weight: alpha's rate of 0 leaves out the Lagrange threshold."""
    encoder = VectorEncoderFactory([settings.WIDTH] * settings.DEPTH)
    shared = {
        "actor_learning_rate": settings.LEARNING_RATE,
        "critic_learning_rate": settings.LEARNING_RATE,
        "actor_encoder_factory": encoder,
        "critic_encoder_factory": encoder,
        "batch_size": settings.BATCH,
        "gamma": settings.DISCOUNT,
        "tau": settings.POLYAK,
    }
    if name == "cql":
        return d3rlpy.algos.CQLConfig(
            **shared,
            temp_learning_rate=settings.LEARNING_RATE,
            alpha_learning_rate=0.0,
            initial_alpha=1.0,
            conservative_weight=settings.CQL_WEIGHT,
            n_action_samples=settings.CQL_SAMPLES,
            initial_temperature=settings.INITIAL_TEMPERATURE,
        )
    return d3rlpy.algos.IQLConfig(
        **shared,
        value_encoder_factory=encoder,
        expectile=settings.EXPECTILE,
        weight_temp=settings.INVERSE_TEMPERATURE,
        max_weight=settings.WEIGHT_LIMIT,
    )


def learn(name: str, data: Flights, seed: int, updates: int) -> Policy:
    """Its policy, mean actions."""
    d3rlpy.seed(seed)
    episodes = [Episode(**episode, terminated=False) for episode in cut_episodes(data)]
    buffer = ReplayBuffer(InfiniteBuffer(), episodes=episodes)
    if buffer.transition_count != data.reward.size:
        raise RuntimeError(f"d3rlpy found {buffer.transition_count} transitions of {data.reward.size}")
    algorithm = config(name).create(device="cpu:0")
    algorithm.fit(
        buffer,
        n_steps=updates,
        n_steps_per_epoch=updates,
        logger_adapter=NoopAdapterFactory(),
        show_progress=False,
        save_interval=updates,
    )

    def act(observation: Array) -> Array:
        action: Array = algorithm.predict(observation.astype(np.float32)).astype(np.float64)
        return action

    return act


if __name__ == "__main__":
    torch.set_num_threads(1)
    settings.compare("d3rlpy", learn, Path(sys.argv[1]), *sys.argv[2:])
