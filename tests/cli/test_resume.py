"""Interrupted, and gone on with in a new process, a run ends as one that was not: every agent, by the command line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.agents.problems import equal
from tests.datasets.flights import fly, small_scenario
from uavrl.agents.registry import PRESETS
from uavrl.cli import main
from uavrl.datasets import save_flat
from uavrl.training.checkpoint import load_checkpoint
from uavrl.training.offline import OfflineLearner

ROOT = Path(__file__).parents[2]
UPDATES = 6

GO_ON = """
import json, sys
import torch
from uavrl.cli import main
torch.set_num_threads(int(sys.argv[1]))
for words in json.loads(sys.argv[2]):
    code = main([*words, "--resume"])
    if code:
        sys.exit(code)
"""


def words(name: str, out: str, updates: int = UPDATES, *more: str) -> list[str]:
    small = ["network.width=8", "network.depth=2", "batch_size=8", "discount=0.9"]
    small += ["diffusion.steps=2"] if hasattr(PRESETS[name]["default"], "diffusion") else []
    settings = [word for setting in small for word in ("--set", setting)]
    run = ["train", name, "--out", out, "--data", "log.parquet", "--updates", str(updates), "--seed", "7"]
    return [*run, *settings, *more]


def write_log(folder: Path) -> None:
    scenario = small_scenario()
    save_flat(folder / "log.parquet", fly(scenario, steps=20), scenario)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of every agent a run straight through, and one interrupted in the middle and resumed by a new process."""
    folder = tmp_path_factory.mktemp("resume")
    write_log(folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a module's fixtures come before those of a test
    step = OfflineLearner.step

    def interrupted(self: OfflineLearner) -> dict[str, torch.Tensor]:
        if self.updates == UPDATES // 2 - 1:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in PRESETS:
            trials = ("--evaluate-every", "2") if name == "bc" else ()
            assert main(words(name, f"{name} straight", UPDATES, *trials)) == 0
            with pytest.MonkeyPatch.context() as inner:
                inner.setattr(OfflineLearner, "step", interrupted)
                assert main(words(name, f"{name} broken", UPDATES, *trials)) == 130
            document = load_checkpoint(folder / f"{name} broken/checkpoint").document
            assert document["step"] == UPDATES // 2
        lines = [words(n, f"{n} broken", UPDATES, *(("--evaluate-every", "2") if n == "bc" else ())) for n in PRESETS]
        command = [sys.executable, "-c", GO_ON, str(torch.get_num_threads()), json.dumps(lines)]
        subprocess.run(command, check=True, cwd=folder)
    return folder


def same_end(straight: Path, broken: Path) -> dict[str, Any]:
    """Weights, optimisers, generator and log, bit for bit."""
    first, second = (load_checkpoint(run / "checkpoint") for run in (straight, broken))
    assert first.document == second.document
    assert first.tensors.keys() == second.tensors.keys() == {"networks", "optimisers", "loop"}
    for file, tensors in first.tensors.items():
        assert tensors
        assert equal(tensors, second.tensors[file]), file
    assert (straight / "metrics.jsonl").read_text() == (broken / "metrics.jsonl").read_text()
    return first.document


@pytest.mark.parametrize("name", PRESETS)
def test_a_new_process_goes_on_bit_for_bit(folder: Path, name: str) -> None:
    document = same_end(folder / f"{name} straight", folder / f"{name} broken")
    assert (document["agent"], document["step"]) == (name, UPDATES)
    rows = [json.loads(line) for line in (folder / f"{name} broken/metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "actor_gradient" in row] == list(range(1, UPDATES + 1))
    assert [row["step"] for row in rows if "return" in row] == ([2, 4, 6] if name == "bc" else [])


@pytest.mark.slow  # three processes import torch one after the other
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_a_process_that_is_stopped_from_outside_goes_on_bit_for_bit(tmp_path: Path, stop: signal.Signals) -> None:
    """Ctrl-C anywhere; or killed anywhere, after which it goes on from the last time it saved, or begins anew."""
    write_log(tmp_path)

    def command(out: str, *more: str) -> list[str]:
        return [sys.executable, "-m", "uavrl", *words("bc", out, 300, *more)]

    subprocess.run(command("straight"), cwd=tmp_path, check=True)
    log = tmp_path / "broken/metrics.jsonl"
    with subprocess.Popen(command("broken"), cwd=tmp_path, stderr=subprocess.PIPE, text=True) as broken:
        while not log.exists() or log.read_text().count("\n") < 12:
            assert broken.poll() is None
            time.sleep(0.01)
        broken.send_signal(stop)
        error = broken.communicate()[1]
    assert broken.returncode == (130 if stop == signal.SIGINT else -signal.SIGKILL)
    if stop == signal.SIGINT:
        step = load_checkpoint(tmp_path / "broken/checkpoint").document["step"]
        assert 72 <= step < 300
        assert f"saved update {step}; the same command with --resume goes on" in error
    saved = (tmp_path / "broken/checkpoint").exists()
    subprocess.run(command("broken", *(["--resume"] if saved else [])), cwd=tmp_path, check=True)
    same_end(tmp_path / "straight", tmp_path / "broken")
