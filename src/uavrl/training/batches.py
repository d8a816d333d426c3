"""From logged transitions, in metres and seconds, to what agents learn from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from uavrl.actions import HybridAction
from uavrl.agents.base import Batch, RewardConfig
from uavrl.datasets.mapped import MappedTransitions
from uavrl.datasets.transitions import Transitions
from uavrl.networks import Observation, Spaces
from uavrl.scenario import Scenario
from uavrl.simulation.observations import ObservationKind

OBSERVATION_OF: dict[str, ObservationKind] = {"mlp": "paper", "devices": "devices"}


def spaces_of(scenario: Scenario, network_kind: str) -> Spaces:
    """The spaces of a scenario: K + 3 entries for a perceptron, the set of devices else; two displacements, K + 1."""
    devices = scenario.traffic.devices
    flat = devices + 3 if OBSERVATION_OF[network_kind] == "paper" else None
    return Spaces(observation=flat, continuous=2, choices=devices + 1)


def to_tensors(observation: Any, device: torch.device | str = "cpu") -> Observation:
    """A NumPy observation of the simulator as float32 tensors."""
    if isinstance(observation, dict):
        return {key: torch.from_numpy(np.ascontiguousarray(value)).to(device) for key, value in observation.items()}
    return torch.from_numpy(np.ascontiguousarray(observation)).to(device)


def to_batch(transitions: Transitions, kind: ObservationKind, scenario: Scenario) -> Batch:
    """Rows as a batch with raw rewards. The displacement is the executed one.

    A move that the border cancelled is then a hover, as it was in the air; learned as commanded, flying against the
    border would look like the one place where moving is free.
    """
    before, after = transitions.observations(kind, scenario)
    continuous = np.clip(transitions.executed_displacement_m / scenario.airframe.max_displacement_m, -1.0, 1.0)
    return Batch(
        observation=to_tensors(before),
        action=HybridAction(
            torch.from_numpy(continuous.astype(np.float32)), torch.from_numpy(transitions.device.astype(np.int64))
        ),
        reward=torch.from_numpy(transitions.reward.astype(np.float32)),
        duration_s=torch.from_numpy(transitions.duration_s.astype(np.float32)),
        terminated=torch.from_numpy(transitions.terminated.astype(np.float32)),
        next_observation=to_tensors(after),
    )


class MappedRows:
    """Transitions that stay on disk: a minibatch's rows are read and encoded when it is drawn.

    Whatever `take` answers is equal, bit for bit, to what it would take from all rows encoded at once.

    Args:
        transitions: n rows.
        encode: from rows in memory to the batch an agent sees, each row by itself.
    """

    def __init__(self, transitions: MappedTransitions, encode: Callable[[Transitions], Batch]) -> None:
        transitions.expect_random_rows()
        self.transitions = transitions
        self.encode = encode

    def __len__(self) -> int:
        return len(self.transitions)

    def take(self, rows: torch.Tensor) -> Batch:
        """As of `uavrl.training.fit.Rows`; read in the order of the files, each row once."""
        ascending, places = torch.unique(rows.cpu(), return_inverse=True)
        return self.encode(self.transitions.take(ascending.numpy())).take(places).to(rows.device)


def reward_transform(reward: NDArray[Any], config: RewardConfig, terminates: bool) -> tuple[float, float]:
    """(shift, factor) so that the agent sees clip(factor (r - shift)).

    "centred" subtracts the median; where an episode can terminate, a shift would pay or punish ending it, so it is 0.
    """
    values = np.asarray(reward, dtype=np.float64)
    if config.transform == "zscore":
        return float(values.mean()), config.scale / (float(values.std()) + 1e-6)
    if config.transform == "centred":
        return (0.0 if terminates else float(np.median(values))), config.scale
    return 0.0, config.scale


def transformed(reward: torch.Tensor, shift: float, factor: float, config: RewardConfig) -> torch.Tensor:
    """clip(factor (r - shift))."""
    moved = factor * (reward - shift)
    return moved if config.clip is None else moved.clamp(-config.clip, config.clip)
