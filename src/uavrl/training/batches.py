"""From logged transitions, in metres and seconds, to what agents learn from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from uavrl.actions import HybridAction
from uavrl.agents.base import AgentConfig, Batch
from uavrl.datasets.mapped import MappedTransitions
from uavrl.datasets.transitions import Transitions
from uavrl.networks import Observation, Spaces
from uavrl.scenario import Scenario
from uavrl.simulation.observations import ObservationKind

ROBUST_UNIT = 10.0  # median absolute deviations: that of the built-in logs' rewards in `released` is .1

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


class RewardTransform(NamedTuple):
    """From logged rewards to what an agent learns from: factor (r - level T), held within clip T of 0.

    T is 1 where the agent discounts by steps, and a step's duration (s) where it discounts by seconds: only then do the
    level, which each flight of a fixed time loses as often, and the clip prefer neither short steps nor long ones.
    """

    level: float  # a step, or a second
    factor: float
    clip: float | None
    per_second: bool

    @classmethod
    def fitted(
        cls, reward: NDArray[Any], duration_s: NDArray[Any], config: AgentConfig, terminates: bool
    ) -> RewardTransform:
        """For rewards and durations (n,) of logged steps.

        "centred" and "robust" subtract the median, "zscore" the mean; where an episode can terminate, a level would
        pay or punish ending it, so it is 0.
        """
        how, per_second = config.reward, config.discount_per == "second"
        values = np.asarray(reward, dtype=np.float64)
        time = np.asarray(duration_s, dtype=np.float64) if per_second else np.ones_like(values)
        middle = np.mean if how.transform == "zscore" else np.median
        level, factor = float(middle(values / time)), how.scale
        moved = values - level * time
        if how.transform == "zscore":
            factor /= float(moved.std()) + 1e-6
        elif how.transform == "robust":
            spread = float(np.median(np.abs(moved)))
            if spread <= 1e-6 * np.abs(values).max():  # half of the rewards, or all, are equal
                spread = float(np.abs(moved).mean()) or 1.0
            factor /= ROBUST_UNIT * spread
        return cls(0.0 if terminates or how.transform == "none" else level, factor, how.clip, per_second)

    def __call__(self, reward: torch.Tensor, duration_s: torch.Tensor) -> torch.Tensor:
        """What the agent sees of rewards and durations (n,)."""
        time = duration_s if self.per_second else torch.ones_like(reward)
        moved = self.factor * (reward - self.level * time)
        return moved if self.clip is None else moved.clamp(-self.clip * time, self.clip * time)
