from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.training.test_policy import SCENARIO, saved
from uavrl.cli import main
from uavrl.cli.policies import learned_in, resolve
from uavrl.deployment import Policy
from uavrl.deployment.flight import ExportedPolicy
from uavrl.deployment.verify import Verification
from uavrl.errors import ConfigError
from uavrl.scenario import load_scenario


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.toml").write_text(SCENARIO.to_toml())
    return tmp_path


def test_a_checkpoint_is_exported_verified_and_flown(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(folder / "run", "gaussian_bc", "mlp")
    assert main(["export", "run", "-o", "policy.onnx", "--verify", "--episodes", "7"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"policy\.onnx: gaussian_bc, K = 4, deterministic, \d+ kB", first)
    assert "returns over 7 flights" in second
    assert "7 flights equal" in second
    assert Policy(folder / "policy.onnx").info["devices"] == 4

    words = "evaluate --policy policy.onnx --policy run --scenario short.toml --episodes 5 --deterministic"
    assert main([*words.split(), "--json", "report.json"]) == 0
    found = json.loads((folder / "report.json").read_text())["policies"]
    assert found["gaussian_bc (exported)"]["return"]["mean"] == pytest.approx(found["gaussian_bc"]["return"]["mean"])
    assert learned_in("policy.onnx") == learned_in("run") == SCENARIO
    with pytest.raises(ConfigError, match="takes devices = 4 alone, the scenario has 10"):
        resolve("policy.onnx", load_scenario("released"))


def test_samples_follow_the_flights_generator(folder: Path) -> None:
    saved(folder / "run", "gaussian_bc", "mlp")
    assert main(["export", "run", "-o", "policy.onnx", "--sampled"]) == 0
    policy, seen = resolve("policy.onnx", SCENARIO), np.ones((6, 7))
    first, again, other = (policy.act(seen, generator=np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert (first.displacement_m == again.displacement_m).all()
    assert (first.displacement_m != other.displacement_m).any()
    with pytest.raises(ConfigError, match="exported with --sampled, allowed: without --deterministic"):
        policy.act(seen, generator=np.random.default_rng(1), deterministic=True)


def test_a_decision_is_changed_wherever_a_policy_is_flown_or_exported(folder: Path) -> None:
    saved(folder / "run", "diffusion_sac", "devices")
    saved(folder / "a@b", "diffusion_sac", "devices")
    specs = ["run", "run@solver=ddim,steps=2", "run@candidates=3", "a@b", "a@b@solver=ddim,steps=2"]
    policies = [resolve(spec, SCENARIO) for spec in specs]
    assert [policy.name for policy in policies] == [
        "diffusion_sac",
        "diffusion_sac@solver=ddim,steps=2",
        "diffusion_sac@candidates=3",
        "diffusion_sac",
        "diffusion_sac@solver=ddim,steps=2",
    ]
    seen = {"uav": np.ones((6, 4), np.float32), "devices": np.ones((6, 4, 6), np.float32)}
    whole, fewer, again, same = (
        policies[index].act(seen, generator=np.random.default_rng(1), deterministic=True) for index in (0, 1, 4, 3)
    )
    assert (whole.displacement_m == same.displacement_m).all()
    assert (fewer.displacement_m == again.displacement_m).all()
    assert (whole.displacement_m != fewer.displacement_m).any()
    with pytest.raises(ConfigError, match="candidates to choose from, allowed: without --deterministic"):
        policies[2].act(seen, generator=np.random.default_rng(1), deterministic=True)
    assert main(["export", "run@solver=ddim,steps=1", "-o", "policy.onnx"]) == 0
    exported = resolve("policy.onnx", SCENARIO)
    assert isinstance(exported, ExportedPolicy)
    assert exported.policy.info["decision"] == {"solver": "ddim", "steps": 1}
    one = resolve("run@solver=ddim,steps=1", SCENARIO).act(seen, generator=np.random.default_rng(1), deterministic=True)
    found = exported.act(seen, generator=np.random.default_rng(1), deterministic=True)
    np.testing.assert_allclose(found.displacement_m, one.displacement_m, atol=1e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("export nowhere", "checkpoint 'nowhere' does not exist"),
        ("export run -o gone/policy.onnx", "the directory 'gone' does not exist"),
        ("export run@candidates=3", "candidates = 3, allowed with --sampled"),
        ("export run@candidates=0 --sampled", "field 'candidates' = '0'"),
        ("export run@steps=3", "steps needs a solver: ddim or dpm"),
        ("export run@solver=euler", "field 'solver' = 'euler'"),
        ("export run@quick", "policy 'run@quick': 'quick', allowed: candidates=N, null_candidate=true|false, greedy_"),
        ("export run@kind=3", "'kind=3', allowed: candidates=N"),
        ("export run@solver=ddim,solver=dpm", "'solver=dpm', allowed: candidates=N"),
        ("export run --verify --episodes 0", "--episodes 0, allowed: 1 or more"),
        ("evaluate --policy gone.onnx --scenario short.toml", "policy file 'gone.onnx' does not exist"),
    ],
)
def test_wrong_words_are_one_line_and_code_2(
    words: str, message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(folder / "run", "gaussian_bc", "mlp")
    assert main(words.split()) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (folder / "policy.onnx").exists()


@pytest.mark.parametrize(
    ("name", "words"), [("onnx", "export run"), ("onnxruntime", "evaluate --policy policy.onnx --scenario short.toml")]
)
def test_a_missing_extra_is_one_line_and_code_2(
    name: str, words: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(folder / "run", "gaussian_bc", "mlp")
    for module in ("uavrl.deployment.export", "uavrl.cli.policies"):
        monkeypatch.setattr(f"{module}.find_spec", lambda asked: None if asked == name else object())
    assert main(words.split()) == 2
    assert f"needs {name}, install " in capsys.readouterr().err


def test_a_tie_agrees_and_a_wrong_graph_does_not() -> None:
    trained = -250.0 - np.arange(100.0)
    assert Verification(trained, trained).agrees
    tie = trained.copy()
    tie[3] += 40.0
    assert Verification(trained, tie).agrees
    assert Verification(trained, tie).equal == 99
    assert not Verification(trained, trained - 5.0 + np.sin(trained)).agrees
