from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
import torch

from tests.datasets.flights import fly, small_scenario
from uavrl.agents.one_step import OneStep
from uavrl.cli import main
from uavrl.datasets import save_flat
from uavrl.training.checkpoint import load_checkpoint
from uavrl.training.offline import OfflineLearner
from uavrl.training.policy import load_policy

SMALL = [word for setting in ("network.width=8", "batch_size=8") for word in ("--set", setting)]
CHAIN = ["--set", "diffusion.steps=2"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 60 rows, and a teacher and a BC trained on it."""
    folder = tmp_path_factory.mktemp("runs")
    for name, devices in (("log", 4), ("wide", 5)):
        scenario = small_scenario().replace(devices=devices)
        save_flat(folder / f"{name}.parquet", fly(scenario, steps=20), scenario)
    for agent in ("diffusion_sac", "bc"):
        words = ["train", agent, "--out", str(folder / agent), "--data", str(folder / "log.parquet"), "--updates", "3"]
        assert main([*words, *SMALL, *CHAIN]) == 0
    return folder


def test_a_teacher_gets_a_student(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "student"
    words = ["--data", str(runs / "log.parquet"), "--updates", "20", "--set", "q_weight=0.01", "--evaluate-every", "10"]
    assert main(["distill", str(runs / "diffusion_sac"), "--out", str(out), *words]) == 0
    assert f"20 updates; policy of one step in {out}" in capsys.readouterr().out
    teacher, student = (load_policy(run, small_scenario()).agent for run in (runs / "diffusion_sac", out))
    assert isinstance(student, OneStep)
    assert student.config.shortest_move == teacher.config.shortest_move > 0
    kept, learned = teacher.networks.state_dict(), student.networks.state_dict()
    for name, value in learned.items():
        part, _, rest = name.partition(".")
        if part in ("teacher", "critic"):
            of = f"actor.average.{rest}" if part == "teacher" else name
            assert (value == kept[of]).all(), name
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert {"distance", "guided_q", "support_distance"} < set(rows[0])
    assert sum("return" in row for row in rows) == 2
    assert load_checkpoint(out / "checkpoint").document["config"]["q_weight"] == 0.01


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["BC"], "is of agent 'bc', allowed: diffusion_sac"),
        (["nowhere"], "nowhere"),
        (["TEACHER", "--data", "WIDE"], "has shape (60, 10), allowed: (60, 8)"),
        (["TEACHER", "--set", "q_weight=-1"], "'q_weight' = -1"),
        (["TEACHER", "--set", "teacher.network.width=9"], "teacher.network is set, allowed: as '"),
        (["TEACHER", "--set", "teacher.diffusion.steps=7"], "teacher.diffusion is set, allowed: as '"),
        (["TEACHER", "--set", "network.scale_m=9"], "network must be that of the teacher, but for its width"),
        (["TEACHER", "--set", "choice=student", "--set", "candidates=2"], "candidates = 2 needs choice = 'critic'"),
        (["TEACHER", "--updates", "0"], "'updates' = 0"),
    ],
)
def test_mistakes_get_one_line(
    runs: Path, tmp_path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"BC": "bc", "TEACHER": "diffusion_sac", "WIDE": "wide.parquet"}
    typed = [str(runs / places[word]) if word in places else word for word in words]
    data = [] if "--data" in words else ["--data", str(runs / "log.parquet")]
    capsys.readouterr()
    assert main(["distill", *typed, *data, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_run_that_is_there_is_left_alone(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--data", str(runs / "log.parquet"), "--out", str(runs / "bc")]
    assert main(["distill", str(runs / "diffusion_sac"), *words]) == 2
    assert "holds a run already; give --resume" in capsys.readouterr().err
    assert main(["distill", str(runs / "diffusion_sac"), *words, "--resume"]) == 2
    assert "bc' holds a run of agent 'bc', give another directory" in capsys.readouterr().err
    assert load_checkpoint(runs / "bc/checkpoint").document["agent"] == "bc"


def test_an_interrupted_run_goes_on_to_the_same_student(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def words(out: Path) -> list[str]:
        return ["distill", str(runs / "diffusion_sac"), "--out", str(out), "--data", str(runs / "log.parquet"),
                "--updates", "6"]  # fmt: skip

    assert main(words(tmp_path / "whole")) == 0
    out, step = tmp_path / "cut", OfflineLearner.step

    def interrupted(self: OfflineLearner) -> dict[str, torch.Tensor]:
        if self.updates == 3:
            signal.raise_signal(signal.SIGINT)
        return step(self)

    monkeypatch.setattr(OfflineLearner, "step", interrupted)
    assert main(words(out)) == 130
    assert "saved update 4; the same command with --resume goes on" in capsys.readouterr().err
    monkeypatch.undo()
    assert load_checkpoint(out / "checkpoint").document["step"] == 4
    assert main([*words(out), "--resume", "--seed", "1"]) == 2
    assert capsys.readouterr().err.endswith("give the same ones: seed=0\n")
    other = tmp_path / "other"
    learn = ["--out", str(other), "--data", str(runs / "log.parquet"), "--updates", "3", "--seed", "1", *SMALL, *CHAIN]
    assert main(["train", "diffusion_sac", *learn]) == 0
    assert main([word.replace(str(runs / "diffusion_sac"), str(other)) for word in words(out)] + ["--resume"]) == 2
    assert f"was started with another teacher than '{other}'" in capsys.readouterr().err
    assert main([*words(out), "--resume"]) == 0
    cut, whole = (load_checkpoint(place / "checkpoint") for place in (out, tmp_path / "whole"))
    assert cut.document["step"] == 6
    for name, value in whole.tensors["networks"].items():
        assert (cut.tensors["networks"][name] == value).all(), name
    assert main([*words(tmp_path / "none"), "--resume"]) == 2
    assert "holds no checkpoint" in capsys.readouterr().err
