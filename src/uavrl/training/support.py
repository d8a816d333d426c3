"""How far a policy's displacements are from those that were logged where it is."""

from __future__ import annotations

import torch
from torch import Tensor

from uavrl.agents.base import Agent, Batch
from uavrl.networks import Observation


class Support:
    """A fixed probe of logged rows, each with the displacements logged at its nearest observations.

    Near is Euclidean, over the flattened observation, each entry divided by its deviation in the data. A row's own
    displacement is among them. Rows are drawn from a generator of its own.

    Args:
        data: the logged rows.
        rows: rows of the probe, P.
        neighbours: logged displacements a row is compared with, k.
        pool: neighbours are looked for among as many rows.
        seed: of the draw.
    """

    def __init__(
        self, data: Batch, *, rows: int = 256, neighbours: int = 10, pool: int = 50_000, seed: int = 0
    ) -> None:
        logged = data.action.continuous
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randperm(len(logged), generator=generator)[:pool].to(logged.device)
        flat = _flat(data.take(drawn).observation)
        deviation, mean = torch.std_mean(flat, dim=0, correction=0)
        flat = (flat - mean) / torch.where(deviation > 1e-6, deviation, torch.ones_like(deviation))
        count = min(rows, len(drawn))
        apart = torch.cdist(flat[:count], flat)  # (P, pool)
        own = torch.arange(count, device=logged.device)
        apart[own, own] = -1.0  # first, whatever else was logged at the same observation
        nearest = apart.topk(min(neighbours, len(drawn)), largest=False).indices
        self.observation = data.take(drawn[:count]).observation
        self.logged = logged[drawn[nearest]]  # (P, k, C)

    def distance(self, agent: Agent, generator: torch.Generator) -> Tensor:
        """Mean over the probe of the distance from a sampled displacement to the nearest of its k logged ones.

        In units of the longest move along one axis: displacements lie in [-1, 1].
        """
        w: Tensor = agent.act(self.observation, generator=generator).continuous
        apart: Tensor = (w[:, None] - self.logged).square().sum(dim=-1).sqrt()  # (P, k)
        return apart.amin(dim=1).mean()


def _flat(observation: Observation) -> Tensor:
    parts = list(observation.values()) if isinstance(observation, dict) else [observation]
    return torch.cat([part.flatten(1) for part in parts], dim=1)
