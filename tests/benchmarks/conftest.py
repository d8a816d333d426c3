from __future__ import annotations

import pytest
import torch

from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig
from uavrl.networks import NetworkConfig
from uavrl.scenario import load_scenario
from uavrl.training.batches import spaces_of
from uavrl.training.policy import AgentPolicy


@pytest.fixture
def learned() -> AgentPolicy:
    """An untrained policy for devices as a set, in flights of 12 steps."""
    torch.manual_seed(0)
    scenario = load_scenario("released", max_steps=12)
    config = DiffusionSacConfig(network=NetworkConfig(kind="devices", width=8))
    return AgentPolicy("untrained", DiffusionSac(spaces_of(scenario, "devices"), config), scenario)
