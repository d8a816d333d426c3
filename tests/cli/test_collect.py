from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from uavrl.cli import main
from uavrl.datasets import load_flat, read_minari
from uavrl.scenario import load_scenario
from uavrl.training.online import OnlineLearner
from uavrl.training.policy import load_policy

SCENARIO = load_scenario("released", devices=3, max_steps=5)
SMALL = ["--scenario", "short.toml", "--episodes", "3", "--set", "network.width=8", "--set", "batch_size=8"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current directory with a short scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.toml").write_text(SCENARIO.to_toml())
    return tmp_path


def collect(*words: str) -> int:
    return main(["collect", *words])


def test_flights_are_logged_to_a_file_and_to_minari(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    assert collect("--out", "run", *SMALL, "--layouts", "random", "--minari", "mine/log-v0") == 0
    captured = capsys.readouterr()
    assert "Minari dataset mine/log-v0" in captured.out
    assert "next: uavrl data show run/flights.parquet" in captured.out
    assert len(captured.err.splitlines()) <= 1
    log = load_flat(folder / "run/flights.parquet", SCENARIO)
    assert len(log) == 15
    back, scenario = read_minari("mine/log-v0")
    assert back.digest() == log.digest()
    assert scenario == SCENARIO
    assert load_policy(folder / "run", SCENARIO).name == "sac"


def test_interrupted_it_goes_on_where_it_was(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert collect("--out", "whole", *SMALL, "--network", "mlp") == 0
    real, calls = OnlineLearner._fly, 0

    def fly(self: OnlineLearner) -> Any:
        nonlocal calls
        calls += 1
        if calls == 2:
            signal.raise_signal(signal.SIGINT)  # Ctrl-C in the middle of a step
        return real(self)

    monkeypatch.setattr(OnlineLearner, "_fly", fly)
    assert collect("--out", "broken", *SMALL, "--network", "mlp") == 130
    assert not (folder / "broken/flights.parquet").exists()
    capsys.readouterr()
    assert collect("--out", "broken", *SMALL, "--network", "mlp") == 0
    assert "going on from step" in capsys.readouterr().err
    whole, broken = (load_flat(folder / run / "flights.parquet", SCENARIO) for run in ("whole", "broken"))
    assert whole.digest() == broken.digest()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ([], ["--out"]),
        (["--out", "o", "--scenario", "mars"], ["'mars'"]),
        (["--out", "o", "--episodes", "0"], ["episodes", "0"]),
        (["--out", "o", "--steps-per-update", "0"], ["steps_per_update", "0"]),
        (["--out", "o", "--seed", "1000000"], ["seed", "1000000"]),
        (["--out", "o", "--layouts", "moving"], ["moving", "fixed"]),
        (["--out", "o", "--minari", "no version"], ["dataset id 'no version'", "name-v0"]),
        (["--out", "o", "--set", "discount=1"], ["discount", "1", "less than 1"]),
        (["--out", "o", "--set", "gamma=0.9"], ["'gamma' does not exist", "discount"]),
        (["--out", "o", "--set", "reward.transform=zscore"], ["zscore", "centred"]),
        (["--out", "short.toml"], ["--out", "short.toml", "directory"]),
    ],
)
def test_wrong_input_is_one_line_and_code_2(
    folder: Path, words: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert collect(*words) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert all(part in line for part in parts), line
    assert captured.out == ""


def test_a_directory_of_another_run_is_left_alone(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert collect("--out", "run", *SMALL) == 0
    assert collect("--out", "run", *SMALL, "--seed", "1") == 2
    assert collect("--out", "run", *SMALL, "--steps-per-update", "4") == 2
    seed, steps = capsys.readouterr().err.splitlines()[-2:]
    assert seed.endswith("holds a run of other settings, give another directory or the same ones: seed=0")
    assert steps.endswith(": steps_per_update=8")


def test_tensorboard_that_is_not_installed_is_one_line_before_anything_flies(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    assert collect("--out", "run", *SMALL, "--tensorboard") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert "extra 'tracking'" in line
    assert not (folder / "run").exists()


def test_the_log_is_written_for_tensorboard_too(folder: Path) -> None:
    pytest.importorskip("tensorboard")
    assert collect("--out", "run", *SMALL, "--tensorboard") == 0
    assert list((folder / "run/tensorboard").glob("events.out.tfevents.*"))
