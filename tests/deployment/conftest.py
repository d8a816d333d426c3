from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.agents.problems import Kind, agent
from uavrl.agents.base import Agent
from uavrl.deployment.export import export
from uavrl.scenario import load_scenario

Exported = Callable[[str, Kind, bool, int], tuple[Agent, Path]]


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """An untrained agent and its file, by name, network, whether it samples, and K; each is made once, in seconds."""
    made: dict[tuple[str, Kind, bool, int], tuple[Agent, Path]] = {}

    def of(name: str, kind: Kind, sampled: bool, devices: int) -> tuple[Agent, Path]:
        key = (name, kind, sampled, devices)
        if key not in made:
            one = agent(name, kind, devices=devices)
            path = tmp_path_factory.mktemp("exported") / "policy.onnx"
            scenario = load_scenario("released", devices=devices, max_steps=20)
            export(one, scenario, path, sampled=sampled, facts={"seed": 3})
            made[key] = one, path
        return made[key]

    return of
