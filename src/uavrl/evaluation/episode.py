"""One recorded flight, step by step: what a picture or a page of it needs, and nothing of the policy that flew it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavrl.scenario import Scenario

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """T steps over K devices, cut where the flight ended. Row t of a state is before step t, row T after the last."""

    policy: str
    scenario: Scenario
    layout_m: Float  # (K, 2)
    position_m: Float  # (T + 1, 2)
    age_s: Float  # (T + 1, K)
    time_s: Float  # (T + 1,), starting at 0
    device: NDArray[np.int64]  # (T,) commanded, 0 = idle, k = device k
    served: NDArray[np.bool_]  # (T,) a packet arrived; False with a device commanded is an outage
    energy_j: Float  # (T,) of each step
    reward: Float  # (T,)

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong to one flight.

        Raises:
            ValueError: a shape that does not fit T = len(device) and K = len(layout_m).
        """
        steps, devices = len(self.device), len(self.layout_m)
        shapes = {
            "layout_m": (devices, 2),
            "position_m": (steps + 1, 2),
            "age_s": (steps + 1, devices),
            "time_s": (steps + 1,),
            "device": (steps,),
            "served": (steps,),
            "energy_j": (steps,),
            "reward": (steps,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"episode {name} has shape {getattr(self, name).shape}, needed: {shape}")

    def __repr__(self) -> str:
        """Sizes and totals, not the arrays."""
        return (
            f"Episode({self.policy!r}, scenario={self.scenario.name!r}, devices={len(self.layout_m)}, "
            f"steps={self.steps}, seconds={self.time_s[-1]:.1f}, total_reward={self.total_reward:.1f})"
        )

    @property
    def steps(self) -> int:
        """T."""
        return len(self.device)

    @property
    def total_reward(self) -> float:
        """The undiscounted return."""
        return float(self.reward.sum())
