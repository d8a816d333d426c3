"""Our side: `python -m benchmarks.peers.ours OUT [SEED ...]` writes the data, learns, and flies what it learned."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from torch import Tensor

from benchmarks.peers import point_mass, settings
from benchmarks.peers.point_mass import Array, Flights, Policy
from uavrl.actions import HybridAction
from uavrl.agents.base import Batch, RewardConfig
from uavrl.agents.cql import CqlConfig
from uavrl.agents.iql import IqlConfig
from uavrl.agents.registry import make_agent
from uavrl.networks import NetworkConfig, Spaces

SPACES = Spaces(observation=point_mass.OBSERVATION, continuous=point_mass.ACTION, choices=1)


def best_controller() -> Policy:
    """Linear-quadratic regulator, clipped to the box: optimal where the thrust suffices, for a horizon without end."""
    keep, dt = 1.0 - point_mass.DRAG * point_mass.DT_S, point_mass.DT_S
    a, b = np.array([[1.0, dt * keep], [0.0, keep]]), np.array([[dt * dt], [dt]])  # p, v of one axis
    q, r = np.diag([1.0, point_mass.SPEED_COST]), np.array([[point_mass.ACTION_COST]])
    p = solve_discrete_are(a, b, q, r)
    ((stiffness, damping),) = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)

    def act(observation: Array) -> Array:
        action: Array = -stiffness * observation[:, :2] - damping * observation[:, 2:]
        return action

    return act


def _shared() -> dict[str, Any]:
    """The shared settings in our names; what d3rlpy lacks is off."""
    network = NetworkConfig(kind="mlp", width=settings.WIDTH, depth=settings.DEPTH, activation="relu", log_inputs=False)
    return {
        "network": network,
        "reward": RewardConfig(transform="none", clip=None),
        "batch_size": settings.BATCH,
        "learning_rate": settings.LEARNING_RATE,
        "discount": settings.DISCOUNT,
        "polyak": settings.POLYAK,
        "huber": None,
        "gradient_clip": None,
    }


def cql_config() -> CqlConfig:
    """Our Bellman error counts half; so does the penalty."""
    return CqlConfig(
        **_shared(),
        cql_weight=settings.CQL_WEIGHT / 2,
        cql_samples=settings.CQL_SAMPLES,
        continuous_entropy=-point_mass.ACTION,
        initial_temperature=settings.INITIAL_TEMPERATURE,
    )


def iql_config() -> IqlConfig:
    """All of it has the same meaning on both sides."""
    return IqlConfig(
        **_shared(),
        expectile=settings.EXPECTILE,
        inverse_temperature=settings.INVERSE_TEMPERATURE,
        weight_limit=settings.WEIGHT_LIMIT,
    )


CONFIGS = {"cql": cql_config, "iql": iql_config}


def batch(data: dict[str, Tensor], rows: Tensor) -> Batch:
    """Rows of the log; no episode terminates, and there is one choice."""
    action = HybridAction(data["action"][rows], torch.zeros(len(rows), dtype=torch.int64))
    duration, terminated = torch.ones(len(rows)), torch.zeros(len(rows))
    return Batch(
        data["observation"][rows], action, data["reward"][rows], duration, terminated, data["next_observation"][rows]
    )


def learn(name: str, data: Flights, seed: int, updates: int) -> Policy:
    """The agent's policy, deterministic."""
    torch.manual_seed(seed)
    agent = make_agent(SPACES, CONFIGS[name]())
    generator = torch.Generator().manual_seed(seed)
    log = {key: torch.as_tensor(array, dtype=torch.float32) for key, array in point_mass.transitions(data).items()}
    for _ in range(updates):
        rows = torch.randint(0, len(log["reward"]), (settings.BATCH,), generator=generator)
        agent.update(batch(log, rows), generator)

    def act(observation: Array) -> Array:
        seen = torch.as_tensor(observation, dtype=torch.float32)
        action: Array = agent.act(seen, generator=generator, deterministic=True).continuous.double().numpy()
        return action

    return act


def main(out: Path, *seeds: str) -> None:
    """Data where there are none, then what is missing of the runs."""
    if not (out / settings.DATA).exists():
        point_mass.save(out / settings.DATA, point_mass.log(settings.EPISODES, settings.DATA_SEED))
    settings.compare("uavrl", learn, out, *seeds)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]), *sys.argv[2:])
