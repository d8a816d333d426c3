"""A step concerns the link of the device that it serves: it is a step of any layout in which the others lie elsewhere.

Time passes for all devices alike, so ages, energy and reward of a logged step stay what they are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from uavrl.agents.base import Batch
from uavrl.networks import Observation
from uavrl.scenario import Area


class Relocation(NamedTuple):
    """Where the devices of each of B rows lie instead."""

    place_m: Tensor  # (B, K, 2)
    moved: Tensor  # (B, 1) bool: whether this row's devices are moved

    @classmethod
    def draw(cls, count: int, devices: int, area: Area, share: float, generator: torch.Generator) -> Relocation:
        """For `count` rows of K = `devices`: uniform places in the area, taken by `share` of the rows in the mean."""
        size = torch.tensor([area.width_m, area.depth_m], device=generator.device)
        place_m = torch.rand((count, devices, 2), generator=generator, device=generator.device) * size
        return cls(place_m, torch.rand((count, 1), generator=generator, device=generator.device) < share)


def relocated(batch: Batch, relocation: Relocation) -> Batch:
    """The same transitions (B) with all devices moved but the one that each serves; see `DevicesObservation`."""
    devices = torch.arange(1, relocation.place_m.shape[1] + 1, device=relocation.place_m.device)
    moved = (relocation.moved & (devices != batch.action.choice[:, None]))[..., None]

    def seen(observation: Observation) -> Observation:
        if not isinstance(observation, dict):
            raise TypeError("only an observation of where the devices are can have them moved")
        there = observation["devices"]
        elsewhere = relocation.place_m - observation["uav"][:, None, :2]
        return observation | {
            "devices": torch.cat([torch.where(moved, elsewhere, there[..., :2]), there[..., 2:]], dim=2)
        }

    return replace(batch, observation=seen(batch.observation), next_observation=seen(batch.next_observation))
