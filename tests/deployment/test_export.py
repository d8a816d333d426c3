"""An exported file decides as the agent that it came from."""

from __future__ import annotations

import json
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

import uavrl
from tests.agents.problems import KINDS, NAMES, Kind, agent, disturb, noise, observation
from tests.deployment.conftest import Exported
from uavrl.agents.base import Agent
from uavrl.agents.diffusion_actor import ChainNoise, Solver
from uavrl.agents.diffusion_sac import DiffusionSac
from uavrl.datasets import load_builtin
from uavrl.deployment import Policy
from uavrl.deployment.export import export
from uavrl.errors import ConfigError
from uavrl.networks import Observation
from uavrl.scenario import load_scenario
from uavrl.training.batches import OBSERVATION_OF

RELEASED = load_scenario("released")
REACH_M = RELEASED.airframe.max_displacement_m
ROWS = 10_000  # half of them logged, half random
FAST = [("gaussian_bc", "mlp"), ("gaussian_bc", "devices")]  # the others take up to a minute each to export


def cases() -> list[Any]:
    every = [(name, kind) for name in NAMES for kind in KINDS]
    return [pytest.param(*case, marks=[] if case in FAST else pytest.mark.slow) for case in every]


def arrays(seen: Observation) -> Any:
    return {key: value.numpy() for key, value in seen.items()} if isinstance(seen, dict) else seen.numpy()


def logged_and_random(kind: Kind) -> Observation:
    logged, _ = load_builtin("layouts").observations(OBSERVATION_OF[kind], RELEASED)
    random = observation(kind, ROWS // 2, seed=5, devices=10)
    if isinstance(random, dict):
        return {key: torch.cat([torch.from_numpy(logged[key][: ROWS // 2]), random[key]]) for key in random}
    return torch.cat([torch.from_numpy(logged[: ROWS // 2]), random])


def agree(expected: Any, found: Any, reach_m: float = 25.0, ties: int = 5) -> None:
    """Equal choices, and displacements to a tenth of a millimetre, but for ties.

    A tie is broken another way by another rounding: another choice, or another candidate. One displacement in a
    hundred may be further apart: through weights as wild as these, torch's own float32 is as far from float64.
    """
    apart_m = np.abs(expected.continuous.numpy() * reach_m - found.displacement_m).max(axis=1)
    tied = (expected.choice.numpy() != found.device) | (apart_m > 0.01)
    assert tied.sum() <= ties, f"{tied.sum()} other decisions"
    assert np.quantile(apart_m, 0.99) < 1e-4
    assert len(np.unique(found.device)) > 1  # a constant would agree with little


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "kind"), cases())
def test_parity_of_the_deterministic_action(name: str, kind: Kind, exported: Exported) -> None:
    made, path = exported(name, kind, False, 10)
    seen = logged_and_random(kind)
    expected = made.act(seen, generator=torch.Generator(), deterministic=True)
    agree(expected, Policy(path).decide(arrays(seen)))


def noise_of_act(made: Agent, name: str, rows: int, seed: int) -> Tensor:
    """What `act` draws from a generator of this seed, as the exported file takes it."""
    generator = torch.Generator().manual_seed(seed)
    choices = made.spaces.choices
    shape = (rows, *made.noise_shape(choices))
    if name in ("bc", "diffusion_sac"):
        steps = made.config.diffusion.steps  # type: ignore[attr-defined]  # theirs
        chains = rows * shape[1] // (steps + 1)
        chain = ChainNoise.draw(chains, shape[2], steps, generator)
        return torch.cat([chain.start[None], chain.steps]).transpose(0, 1).reshape(shape)
    if name in ("bcq", "one_step"):
        return torch.randn(shape, generator=generator)
    w = torch.randn((rows, 2), generator=generator) if name in ("sac", "cql") else None
    clock = torch.empty((rows, choices)).exponential_(generator=generator).double()  # as torch.multinomial
    w = torch.randn((rows, 2), generator=generator) if w is None else w
    return torch.cat([w, -torch.special.ndtri(torch.exp(-clock)).float()], dim=1)[:, None]


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "kind"), cases())
def test_parity_of_samples(name: str, kind: Kind, exported: Exported) -> None:
    made, path = exported(name, kind, True, 10)
    seen = logged_and_random(kind)
    expected = made.act(seen, generator=torch.Generator().manual_seed(9))
    drawn = noise_of_act(made, name, ROWS, 9)
    policy = Policy(path)
    assert policy.noise_shape(ROWS, 10) == tuple(drawn.shape)
    agree(expected, policy.decide(arrays(seen), drawn.numpy()))


@pytest.mark.parametrize("name", ["diffusion_sac", "cql"])
def test_an_exported_policy_holds_the_moves_that_the_flown_one_holds(name: str, tmp_path: Path) -> None:
    made, seen = agent(name, "devices"), observation("devices", 500)
    disturb(made.networks, 7, 0.2)
    decided = made.act(seen, generator=torch.Generator(), deterministic=True)
    length = decided.continuous.norm(dim=1).unique()
    gap = length.diff().argmax()
    middle = float(length[gap : gap + 2].mean())  # between two lengths: rounding moves none over it
    made.config = made.config.model_copy(update={"shortest_move": middle})
    export(made, RELEASED, tmp_path / "policy.onnx")
    flown = made.to_fly(decided)
    held = (flown.continuous == 0).all(dim=1) & (decided.continuous != 0).any(dim=1)
    assert 0 < held.sum() < 500
    found = Policy(tmp_path / "policy.onnx").decide(arrays(seen))
    np.testing.assert_allclose(found.displacement_m, REACH_M * flown.continuous.numpy(), atol=1e-3)


def test_parity_of_a_student_that_chooses(tmp_path: Path) -> None:
    teacher = agent("diffusion_sac", "devices", null_candidate=True).config
    made = agent("one_step", "devices", teacher=teacher, width=16, choice="student")
    disturb(made.networks, 7)
    export(made, RELEASED, tmp_path / "policy.onnx")
    seen = observation("devices", 500)
    expected = made.act(seen, generator=torch.Generator(), deterministic=True)
    assert 0 < (expected.choice == 0).sum() < 500
    agree(expected, Policy(tmp_path / "policy.onnx").decide(arrays(seen)))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_parity_of_candidates_that_are_re_ranked(tmp_path: Path) -> None:
    made = agent("diffusion_sac", "devices", candidates=4)
    export(made, RELEASED, tmp_path / "policy.onnx", sampled=True)
    seen = observation("devices", 500)
    expected = made.act(seen, generator=torch.Generator().manual_seed(2))
    drawn = noise_of_act(made, "diffusion_sac", 500, 2)
    assert drawn.shape == (500, 4 * 6, 7)
    agree(expected, Policy(tmp_path / "policy.onnx").decide(arrays(seen), drawn.numpy()))


@pytest.mark.parametrize("settings", [{}, {"choice_prior": 1.0}, {"greedy_choice": False}])
def test_parity_of_the_null_action(settings: dict[str, Any], tmp_path: Path) -> None:
    made = agent("diffusion_sac", "devices", null_candidate=True, **settings)
    assert isinstance(made, DiffusionSac)
    disturb(made.critic, 2, 0.1)
    disturb(made.actor.average, 7, 0.2)
    export(made, RELEASED, tmp_path / "policy.onnx")
    seen = observation("devices", 500)
    expected = made.act(seen, generator=torch.Generator(), deterministic=True)
    held = ((expected.continuous == 0).all(dim=1) & (expected.choice == 0)).float().mean()
    assert 0 < held < 1
    agree(expected, Policy(tmp_path / "policy.onnx").decide(arrays(seen)))


@pytest.mark.parametrize("sampled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_parity_of_a_solver_with_fewer_steps(sampled: bool, tmp_path: Path) -> None:
    made = agent("diffusion_sac", "devices")
    assert isinstance(made, DiffusionSac)
    made.actor.use(Solver("dpm", 3))
    info = export(made, RELEASED, tmp_path / "policy.onnx", sampled=sampled)
    seen, policy = observation("devices", 500), Policy(tmp_path / "policy.onnx")
    if sampled:
        assert info["noise"]["rows"] == 1
        start = noise(1, 500, 1, 7)
        agree(made.decide(seen, start), policy.decide(arrays(seen), start.numpy()))
    else:
        agree(made.decide(seen, None), policy.decide(arrays(seen)))


@pytest.mark.parametrize("kind", KINDS)
def test_the_decision_without_noise_is_the_deterministic_action_of_every_agent(kind: Kind) -> None:
    seen = observation(kind, 6)
    for name in NAMES:
        made = agent(name, kind)
        expected = made.act(seen, generator=torch.Generator(), deterministic=True)
        found = made.decide(seen, None)
        assert torch.equal(found.continuous, expected.continuous), name
        assert torch.equal(found.choice, expected.choice), name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_decision_with_the_noise_of_act_is_the_action_of_act(name: str, kind: Kind) -> None:
    made, seen = agent(name, kind), observation(kind, 200)
    expected = made.act(seen, generator=torch.Generator().manual_seed(4))
    found = made.decide(seen, noise_of_act(made, name, 200, 4))
    assert (found.choice != expected.choice).sum() <= 1
    same = found.choice == expected.choice
    torch.testing.assert_close(found.continuous[same], expected.continuous[same])


@pytest.mark.parametrize("devices", [1, 3, 4, 25])
def test_the_set_network_decides_for_any_number_of_devices(devices: int, exported: Exported) -> None:
    made, path = exported("gaussian_bc", "devices", False, 10)
    seen = observation("devices", 300, devices=devices)
    expected = made.act(seen, generator=torch.Generator(), deterministic=True)
    found = Policy(path).decide(arrays(seen))
    assert (found.device == expected.choice.numpy()).all()
    assert np.abs(found.displacement_m - 25.0 * expected.continuous.numpy()).max() < 1e-4


def test_the_metadata_say_what_it_is_and_nothing_of_the_machine_that_made_it(exported: Exported) -> None:
    _, path = exported("gaussian_bc", "devices", False, 10)
    session = onnxruntime.InferenceSession(str(path))
    info = json.loads(session.get_modelmeta().custom_metadata_map["uavrl"])
    assert (info["uavrl"], info["devices"], info["seed"]) == (uavrl.__version__, 10, 3)
    assert info["scenario"]["limits"]["max_steps"] == 20
    assert info["inputs"]["uav"]["entries"] == ["x_m", "y_m", "energy_j", "energy_left"]
    assert [one.name for one in session.get_inputs()] == ["uav", "devices"]
    assert [one.shape for one in session.get_inputs()] == [["batch", 4], ["batch", "devices", 6]]
    assert [one.name for one in session.get_outputs()] == ["displacement_m", "device"]
    content = path.read_bytes()
    assert str(Path(uavrl.__file__).parent).encode() not in content
    assert b"site-packages" not in content


def test_a_missing_extra_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = util.find_spec
    monkeypatch.setattr("uavrl.deployment.export.find_spec", lambda name: None if name == "onnxscript" else found(name))
    with pytest.raises(ConfigError, match=r"export needs onnxscript, install .* 'uavrl\[export\]'"):
        export(agent("gaussian_bc", "mlp"), RELEASED, tmp_path / "policy.onnx")
    assert not [*tmp_path.iterdir()]
