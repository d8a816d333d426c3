from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.one_step import OneStepConfig
from uavrl.benchmarks import decide, simulate, train
from uavrl.cli import main
from uavrl.networks import NetworkConfig


@pytest.fixture(autouse=True)
def _threads() -> object:
    """The command sets torch's threads for its own process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_simulation_is_measured_beside_its_floors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulate, "BATCH", 64)
    monkeypatch.setattr(simulate, "SINGLE_ACTIONS", 4)
    monkeypatch.setattr(simulate, "SCALED_ENVIRONMENTS", (1, 10))
    monkeypatch.setattr(simulate, "SCALED_DEVICES", (1, 10))
    file, plot = tmp_path / "a.json", tmp_path / "a.png"
    assert main(["bench", "simulate", "--seconds", "0.02", "--json", str(file), "--plot", str(plot)]) == 0
    found = json.loads(file.read_text())
    for name in ("batch_steps", "vector_steps", "single_steps"):
        assert found[f"{name}_slowest_per_s"] <= found[f"{name}_per_s"] <= found[f"{name}_fastest_per_s"]
        assert 0 < found[f"{name}_per_s"] < found[f"{name}_floor_per_s"]
    sizes = [(row["environments"], row["devices"]) for row in found["scaling"]]
    assert sizes == [(1, 10), (10, 10), (1000, 1), (1000, 10)]
    assert plot.read_bytes()[:4] == b"\x89PNG"


def test_training_is_measured_beside_its_products(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train, "PRESETS", {"default": "layouts"})
    file = tmp_path / "a.json"
    assert main(["bench", "train", "--seconds", "0.02", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert 0 < found["default_updates_per_s"] < found["default_updates_floor_per_s"]
    assert found["default_gflop_per_update"] == pytest.approx(1.24, abs=0.02)
    assert found["machine"]["threads"] == 1
    share = 100 * found["default_updates_per_s"] / found["default_updates_floor_per_s"]
    assert f"{share:.1f}% of the" in capsys.readouterr().out


def test_decisions_are_measured_beside_their_products(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = NetworkConfig(kind="mlp", width=32, depth=1)
    whole = decide.settings
    monkeypatch.setattr(decide, "settings", lambda case: whole(case).model_copy(update={"network": small}))
    monkeypatch.setattr(decide, "CASES", {"five_step": decide.Case("paper", 2)})
    file = tmp_path / "a.json"
    assert main(["bench", "decide", "--seconds", "0.05", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert 0 < found["five_step_floor_ms"] < found["five_step_ms"] <= found["five_step_p99_ms"]
    assert found["five_step_batch_decisions_per_s"] > 1e3 / found["five_step_ms"]  # or a batch would be no use
    assert f"{found['five_step_ms']:.3g} ms in the median" in capsys.readouterr().out


def test_the_decisions_measured_are_of_students_and_of_five_and_fifty_steps() -> None:
    found: dict[str, tuple[str, int, bool]] = {}
    for name, case in decide.CASES.items():
        config = decide.settings(case)
        assert isinstance(config, OneStepConfig if "one_step" in name else DiffusionSacConfig)
        if isinstance(config, OneStepConfig):
            found[name] = (config.network.kind, 1, config.choice == "critic")
        else:
            found[name] = (config.network.kind, config.diffusion.steps, config.greedy_choice)
    assert found == {
        "one_step": ("devices", 1, False),
        "five_step": ("devices", 5, False),
        "fifty_step": ("devices", 50, False),
        "one_step_critic": ("devices", 1, True),
        "five_step_critic": ("devices", 5, True),
        "paper_one_step": ("mlp", 1, False),
        "paper_five_step": ("mlp", 5, False),
        "paper_fifty_step": ("mlp", 50, False),
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seconds", "0"], "--seconds 0.0, allowed: 0.01 to 3600"),
        (["--threads", "0"], "--threads 0, allowed: 1 or more"),
        (["--json", "nowhere/a.json"], "the directory 'nowhere' does not exist"),
        (["--json", "."], "is a directory, allowed: a file to write"),
    ],
)
def test_wrong_words_are_refused_in_one_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "train", *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
