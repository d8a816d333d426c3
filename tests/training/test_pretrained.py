from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uavrl.agents.registry import preset
from uavrl.cli import main
from uavrl.datasets import load_builtin
from uavrl.errors import CheckpointError
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario
from uavrl.training.checkpoint import checkpoint_in, load_checkpoint, pretrained, pretrained_names
from uavrl.training.offline import OfflineLearner, TrainConfig
from uavrl.training.policy import load_policy, ship, trained_scenario

SCENARIO = load_scenario("released", max_steps=30)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    config = TrainConfig(scenario=load_scenario("released"), agent=preset("diffusion_sac", "default"), updates=3)
    OfflineLearner(config, load_builtin("layouts", 500)).run(directory, lambda done, text: None)
    return directory


def test_what_is_shipped_decides_as_its_run_does_in_half_the_bytes(run: Path, tmp_path: Path) -> None:
    ship(run, tmp_path / "shipped")
    tests = evaluation_set(SCENARIO, "random", 3)
    for deterministic in (True, False):
        own, shipped = (
            fly(load_policy(path, SCENARIO), tests, deterministic=deterministic) for path in (run, tmp_path / "shipped")
        )
        np.testing.assert_array_equal(own.position_m, shipped.position_m)
        np.testing.assert_array_equal(own.device, shipped.device)
    whole, part = (
        (path / "networks.safetensors").stat().st_size for path in (run / "checkpoint", tmp_path / "shipped")
    )
    assert part < 0.55 * whole
    assert set(load_checkpoint(tmp_path / "shipped").tensors) == {"networks"}


def test_no_training_goes_on_from_what_is_shipped(run: Path, tmp_path: Path) -> None:
    ship(run, tmp_path / "checkpoint")
    with pytest.raises(CheckpointError, match="is of kind 'policy', not 'offline'"):
        OfflineLearner.resume(tmp_path, load_builtin("layouts", 500))


@pytest.mark.parametrize("name", pretrained_names())
def test_an_installed_policy_is_small_has_a_card_and_beats_tdm_on_trial_flights(name: str) -> None:
    place = checkpoint_in(Path(f"pretrained:{name}"))
    assert place == pretrained(name)
    assert sum(path.stat().st_size for path in place.iterdir()) < 500_000
    card = (place / "README.md").read_text()
    for heading in ("Data", "Settings", "Results", "Limits"):
        assert f"## {heading}" in card
    scenario = trained_scenario(place)
    assert scenario == load_scenario("realistic" if name == "realistic" else "released")
    tests = evaluation_set(scenario, "fixed" if name == "fixed" else "random", 10, seed=500_000)
    flown = {
        policy.name: fly(policy, tests, deterministic=True)
        for policy in (load_policy(place, scenario), make_policy("tdm"))
    }
    # the median: one packet of minutes is most of a mean over ten flights
    returns = {key: float(np.median((one.reward * one.active).sum(axis=0))) for key, one in flown.items()}
    assert returns["diffusion_sac"] > returns["tdm"] + (10.0 if name == "realistic" else 20.0)


def test_three_policies_are_installed() -> None:
    assert pretrained_names() == ("fixed", "layouts", "realistic")


def test_a_name_that_is_not_installed_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--policy", "pretrained:nothing"]) == 2
    error = capsys.readouterr().err
    assert "pretrained policy 'nothing' does not exist" in error
    assert "allowed: pretrained:fixed, pretrained:layouts, pretrained:realistic" in error
    assert error.count("\n") == 1


def test_reports_call_it_by_the_name_that_was_typed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--policy", "pretrained:layouts", "--episodes", "1", "--deterministic"]) == 0
    assert "pretrained:layouts" in capsys.readouterr().out
