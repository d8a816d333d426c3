from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.agents.problems import KINDS, NAMES, Kind, agent, observation
from uavrl.errors import CheckpointError, ConfigError
from uavrl.scenario import Scenario, load_scenario
from uavrl.training.checkpoint import agent_tensors, save_checkpoint
from uavrl.training.policy import AgentPolicy, Decision, load_policy, trained_scenario

SCENARIO = load_scenario("released", devices=4, max_steps=5)


def saved(path: Path, name: str, kind: Kind, scenario: Scenario = SCENARIO, **changes: Any) -> AgentPolicy:
    made = agent(name, kind, devices=scenario.traffic.devices, **changes)
    document = {
        "agent": name,
        "config": made.config.model_dump(mode="json"),
        "spaces": made.spaces.model_dump(),
        "scenario": scenario.model_dump(mode="json"),
    }
    save_checkpoint(path / "checkpoint", document, agent_tensors(made))
    return AgentPolicy(name, made, scenario)


def seen(kind: Kind, rows: int = 6, devices: int = 4) -> object:
    found = observation(kind, rows, devices=devices)
    return found.numpy() if isinstance(found, torch.Tensor) else {key: value.numpy() for key, value in found.items()}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_loaded_policy_flies_as_the_one_that_was_saved(tmp_path: Path, name: str, kind: Kind) -> None:
    policy = saved(tmp_path, name, kind)
    expected = policy.act(seen(kind), generator=np.random.default_rng(1))
    assert expected.displacement_m.shape == (6, 2)
    assert np.abs(expected.displacement_m).max() <= SCENARIO.airframe.max_displacement_m
    assert np.abs(expected.displacement_m).max() > 1.0  # metres, not shares of the reach
    for path in (tmp_path, tmp_path / "checkpoint"):
        loaded = load_policy(path, SCENARIO)
        assert (loaded.name, loaded.needs) == (name, "paper" if kind == "mlp" else "devices")
        found = loaded.act(seen(kind), generator=np.random.default_rng(1))
        assert (found.displacement_m == expected.displacement_m).all()
        assert (found.device == expected.device).all()
    other = load_policy(tmp_path, SCENARIO).act(seen(kind), generator=np.random.default_rng(2))
    assert (other.displacement_m != expected.displacement_m).any()
    assert trained_scenario(tmp_path) == SCENARIO


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_does_not_fly_what_is_shorter_than_its_shortest_move(tmp_path: Path, name: str) -> None:
    policy, given = saved(tmp_path, name, "devices"), seen("devices", 200)
    every = policy.act(given, generator=np.random.default_rng(1)).displacement_m
    length = np.linalg.norm(every, axis=1)
    middle_m = np.sort(length)[99:101].mean()
    share = middle_m / SCENARIO.airframe.max_displacement_m
    policy.agent.config = policy.agent.config.model_copy(update={"shortest_move": share})
    found = policy.act(given, generator=np.random.default_rng(1)).displacement_m
    assert (found == np.where((length > middle_m)[:, None], every, 0.0)).all()
    assert (found == 0).all(axis=1).sum() >= 50


def test_a_displacement_keeps_its_metres_wherever_it_is_flown(tmp_path: Path) -> None:
    far = SCENARIO.replace(max_displacement_m=50.0)
    policy = saved(tmp_path, "gaussian_bc", "devices", far)
    expected = policy.act(seen("devices"), generator=np.random.default_rng(1)).displacement_m
    found = load_policy(tmp_path, SCENARIO).act(seen("devices"), generator=np.random.default_rng(1)).displacement_m
    assert (found == expected).all()


def test_a_perceptron_for_another_number_of_devices_is_refused_and_a_set_network_is_not(tmp_path: Path) -> None:
    larger = load_scenario("released", devices=7)
    saved(tmp_path / "mlp", "bc", "mlp")
    with pytest.raises(CheckpointError, match="perceptron for devices = 4, the scenario has 7"):
        load_policy(tmp_path / "mlp", larger)
    saved(tmp_path / "set", "bc", "devices")
    action = load_policy(tmp_path / "set", larger).act(seen("devices", 99, 7), generator=np.random.default_rng(1))
    assert action.device.max() > 4


def test_a_decision_is_changed_at_loading_where_the_agent_can(tmp_path: Path) -> None:
    saved(tmp_path / "sac", "diffusion_sac", "devices")
    agent = load_policy(tmp_path / "sac", SCENARIO, Decision(candidates=4, solver="dpm", steps=3)).agent
    assert agent.noise_shape(5) == (4, 7)
    assert load_policy(tmp_path / "sac", SCENARIO).agent.noise_shape(5) == (6, 7)
    assert load_policy(tmp_path / "sac", SCENARIO, Decision(solver="ddim")).agent.noise_shape(5) == (1, 7)
    with pytest.raises(ConfigError, match="steps = 6, allowed: 1 to 5, those of the chain as it was trained"):
        load_policy(tmp_path / "sac", SCENARIO, Decision(solver="dpm", steps=6))
    held = load_policy(tmp_path / "sac", SCENARIO, Decision(null_candidate=True)).agent
    assert held.config.null_candidate  # type: ignore[attr-defined]  # of this agent
    alone = load_policy(tmp_path / "sac", SCENARIO, Decision(greedy_choice=False)).agent
    assert not alone.config.greedy_choice  # type: ignore[attr-defined]  # as above
    far = load_policy(tmp_path / "sac", SCENARIO, Decision(shortest_move=0.3)).agent
    assert far.config.shortest_move == 0.3
    saved(tmp_path / "iql", "iql", "devices")
    with pytest.raises(ConfigError, match="candidates = 4, allowed for agents that re-rank; not for iql"):
        load_policy(tmp_path / "iql", SCENARIO, Decision(candidates=4))
    saved(tmp_path / "student", "one_step", "devices", choice="student")
    with pytest.raises(ConfigError, match="candidates = 4 needs choice = 'critic'"):
        load_policy(tmp_path / "student", SCENARIO, Decision(candidates=4))
    with pytest.raises(ConfigError, match="null_candidate = False, allowed for Diffusion-SAC; not for iql"):
        load_policy(tmp_path / "iql", SCENARIO, Decision(null_candidate=False))
    with pytest.raises(ConfigError, match="solver = 'ddim', allowed for agents with a chain; iql has none"):
        load_policy(tmp_path / "iql", SCENARIO, Decision(solver="ddim"))


def test_a_checkpoint_of_something_else_is_refused_in_one_line(tmp_path: Path) -> None:
    tensors = agent_tensors(agent("bc", "mlp"))
    config = agent("bc", "mlp").config.model_dump(mode="json")
    spaces = {"observation": 7, "continuous": 2, "choices": 5}
    documents: list[dict[str, Any]] = [
        {},
        {"config": config},
        {"config": {**config, "name": "td3"}, "spaces": spaces},
        {"config": config, "spaces": 3},
    ]
    for number, document in enumerate(documents):
        save_checkpoint(tmp_path / str(number), document, tensors)
        with pytest.raises(CheckpointError, match="no agent of this version"):
            load_policy(tmp_path / str(number), SCENARIO)
    save_checkpoint(tmp_path / "wide", {"config": config, "spaces": {**spaces, "observation": 8}}, tensors)
    with pytest.raises(CheckpointError):
        load_policy(tmp_path / "wide", SCENARIO)
