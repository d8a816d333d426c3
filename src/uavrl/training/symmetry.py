"""The physics knows distances alone: a flight that is mirrored in the area, or turned in it, is a flight, too."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from uavrl.agents.base import Batch
from uavrl.networks import Observation
from uavrl.scenario import Area


class Turn(NamedTuple):
    """One of the rectangle's symmetries, or of the square's, for each of B rows."""

    sign: Tensor  # (B, 2) -1 where x, y is mirrored in the area's middle, else 1
    swap: Tensor  # (B, 1) bool: x and y change places, afterwards

    @classmethod
    def draw(cls, count: int, area: Area, generator: torch.Generator) -> Turn:
        """Each symmetry as likely: four of a rectangle, eight of a square."""
        drawn = torch.randint(0, 2, (count, 3), generator=generator, device=generator.device)
        return cls(1.0 - 2.0 * drawn[:, :2], (drawn[:, 2:] > 0) & (area.width_m == area.depth_m))


def turned(batch: Batch, turn: Turn, area: Area) -> Batch:
    """The same transitions (B) in a mirrored or turned area; of set observations, see `DevicesObservation`."""

    def vectors(values: Tensor) -> Tensor:  # (B, ..., 2)
        shape = (len(values),) + (1,) * (values.dim() - 2)
        mirrored = values * turn.sign.view(*shape, 2)
        return torch.where(turn.swap.view(*shape, 1), mirrored.flip(-1), mirrored)

    middle = torch.tensor([area.width_m, area.depth_m], device=turn.sign.device) / 2.0

    def seen(observation: Observation) -> Observation:
        if not isinstance(observation, dict):
            raise TypeError("only an observation of where the devices are can be turned")
        uav, devices = observation["uav"], observation["devices"]
        return {
            "uav": torch.cat([vectors(uav[:, :2] - middle) + middle, uav[:, 2:]], dim=1),
            "devices": torch.cat([vectors(devices[..., :2]), devices[..., 2:]], dim=-1),
        }

    return replace(
        batch,
        observation=seen(batch.observation),
        next_observation=seen(batch.next_observation),
        action=batch.action._replace(continuous=vectors(batch.action.continuous)),
    )
