"""Small agents and batches for tests."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor, nn

from uavrl.actions import HybridAction
from uavrl.agents.base import Agent, Batch
from uavrl.agents.diffusion_actor import DiffusionConfig
from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig
from uavrl.agents.one_step import OneStepConfig
from uavrl.agents.registry import PRESETS, make_agent
from uavrl.agents.sac import SacConfig
from uavrl.networks import NetworkConfig, Observation, Spaces, fit_normalisers

Kind = Literal["mlp", "devices"]
KINDS: tuple[Kind, ...] = ("mlp", "devices")
NAMES = ("sac", "diffusion_sac", "cql", "iql", "bcq", "bc", "gaussian_bc", "one_step")
CONFIGS: dict[str, Any] = {"sac": SacConfig, "one_step": OneStepConfig} | {
    name: type(presets["default"]) for name, presets in PRESETS.items()
}
DEVICES = 4


def noise(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def spaces(kind: Kind, devices: int = DEVICES) -> Spaces:
    return Spaces(observation=devices + 3 if kind == "mlp" else None, continuous=2, choices=devices + 1)


def network(kind: Kind, **changes: Any) -> NetworkConfig:
    return NetworkConfig(kind=kind, **{"width": 12, "depth": 2, **changes})


def observation(kind: Kind, rows: int, seed: int = 0, devices: int = DEVICES) -> Observation:
    """Positions in a square kilometre, ages of up to a minute, unequal priorities and packets."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    position, age, energy = 1000 * uniform(rows, 2), 60 * uniform(rows, devices), 20 * uniform(rows, 1)
    if kind == "mlp":
        return torch.cat([position, age, energy], dim=1)
    offset = 1000 * uniform(rows, devices, 2) - position[:, None]
    rest = torch.stack([age, 2 * uniform(rows, devices), 1 + uniform(rows, devices), torch.ones_like(age)], dim=2)
    return {
        "uav": torch.cat([position, energy, uniform(rows, 1)], dim=1),
        "devices": torch.cat([offset, rest], dim=2),
    }


def batch(kind: Kind, rows: int, seed: int = 0, devices: int = DEVICES) -> Batch:
    generator = torch.Generator().manual_seed(1000 + seed)
    return Batch(
        observation=observation(kind, rows, 2 * seed, devices),
        action=HybridAction(
            2 * torch.rand((rows, 2), generator=generator) - 1,
            torch.randint(0, devices + 1, (rows,), generator=generator),
        ),
        reward=torch.randn(rows, generator=generator),
        duration_s=0.1 + torch.rand(rows, generator=generator),
        terminated=(torch.rand(rows, generator=generator) < 0.3).float(),
        next_observation=observation(kind, rows, 2 * seed + 1, devices),
    )


def agent(name: str, kind: Kind, *, seed: int = 0, devices: int = DEVICES, **changes: Any) -> Agent:
    shape = network(kind, **changes.pop("network", {}))
    if name == "one_step":
        changes = {"teacher": DiffusionSacConfig(network=shape, diffusion=DiffusionConfig(steps=3))} | changes
        shape = changes["teacher"].network
        width = changes.pop("width", None)
        if width is not None:  # a student may be narrower than its teacher
            shape = shape.model_copy(update={"width": width})
    config = CONFIGS[name](network=shape, **changes)
    torch.manual_seed(seed)
    made = make_agent(spaces(kind, devices), config)
    fit_normalisers(made.networks, observation(kind, 64, 77, devices))
    return made


def diffusion_sac(
    kind: Kind, *, steps: int = 3, diffusion: dict[str, Any] | None = None, **changes: Any
) -> DiffusionSac:
    made = agent("diffusion_sac", kind, diffusion=DiffusionConfig(steps=steps, **(diffusion or {})), **changes)
    assert isinstance(made, DiffusionSac)
    return made


def disturb(module: nn.Module, seed: int, scale: float = 0.3) -> None:
    """Move every weight, so that a network and its target differ."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))


def copies(module: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def equal(first: dict[str, Tensor], second: dict[str, Tensor]) -> bool:
    """Bit for bit."""
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)
