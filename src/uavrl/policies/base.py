"""What `evaluate` can fly: a policy sees a batch of flights and answers with a batch of actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from uavrl.scenario import Scenario
from uavrl.simulation.state import FlightAction, SimState


@dataclass(frozen=True)
class SimulatorView:
    """The simulator's own state, for a policy that declares `needs = "state"`."""

    scenario: Scenario
    layout_m: NDArray[np.float64]  # (N, K, 2) device positions
    state: SimState


class Policy(Protocol):
    """Flies N flights that step together; it never loops over them.

    name: what a table calls it.
    needs: what `act` is given: the array (N, K + 3) of "paper", the arrays of "devices", or for "state" a
        `SimulatorView`.
    """

    name: str
    needs: Literal["paper", "devices", "state"]

    def reset(self, count: int) -> None:
        """`count` new flights begin: forget the old ones."""

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        """Displacements (N, 2) in metres and devices (N,), 0 being idle.

        The caller ignores the rows of flights that have ended. Randomness comes from `generator` alone;
        `deterministic` asks for the most likely action of a policy that has one.
        """
