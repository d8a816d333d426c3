"""The examples run, in seconds, and show what they say."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch

from uavrl.agents.gaussian_bc import GaussianBcConfig
from uavrl.agents.registry import PRESETS, make_agent
from uavrl.deployment.export import export
from uavrl.networks import NetworkConfig
from uavrl.scenario import load_scenario
from uavrl.training.batches import spaces_of

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def _weights_are_drawn_in_the_example_alone() -> object:
    with torch.random.fork_rng(devices=[]):
        yield


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_has_a_test() -> None:
    assert [path.stem for path in sorted(EXAMPLES.glob("*.py"))] == ["fly_exported", "own_environment"]


def test_an_agent_learns_an_environment_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    random, learned = load("own_environment").main()
    assert random < -0.3
    assert learned > 0.4
    assert capsys.readouterr().out.startswith("reward a step: -0.")  # of random actions


@pytest.mark.slow  # some seconds each
@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_agent_learns_it_but_for_clones_which_act_as_what_was_logged(name: str) -> None:
    learned = load("own_environment").main(name)[1]
    assert (learned < 0.1) if "bc" in name.split("_") else (learned > 0.2)


def test_the_example_names_every_agent_and_knows_nothing_of_uavs() -> None:
    text = (EXAMPLES / "own_environment.py").read_text()
    assert f"[{'|'.join(sorted(PRESETS))}]" in text
    for room in ("scenario", "physics", "simulation", "datasets", "evaluation"):
        assert f"uavrl.{room}" not in text


def test_an_exported_policy_flies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.onnx"
    network = NetworkConfig(kind="mlp", width=8, depth=1)
    scenario = load_scenario("released")
    agent = make_agent(spaces_of(scenario, "mlp"), GaussianBcConfig(network=network))
    export(agent, scenario, path)
    total = load("fly_exported").main(str(path))
    assert -1e5 < total < 0
    assert capsys.readouterr().out == f"Policy('gaussian_bc', scenario='released', K = 10): return {total:.1f}\n"
