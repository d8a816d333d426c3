"""The demo, small, and which flight it shows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from uavrl.cli import main
from uavrl.cli.demo import typical_flight


@dataclass
class Ends:
    """What `typical_flight` looks at."""

    position_m: NDArray[np.float64]
    steps: NDArray[np.int64]


def flights(ends_m: list[float], steps: list[int]) -> Any:
    """Flights from 0 along x that pass 1 km away after their end, which is not to count."""
    position = np.zeros((4, len(ends_m), 2))
    for flight, (end, count) in enumerate(zip(ends_m, steps, strict=True)):
        position[count:, flight, 0] = 1000.0
        position[count, flight, 0] = end
    return cast(Any, Ends(position, np.array(steps)))


def test_the_flight_shown_ends_as_far_from_its_start_as_the_median() -> None:
    assert typical_flight(flights([5.0, 300.0, 90.0], [3, 2, 1])) == 2
    assert typical_flight(flights([5.0, 300.0, -90.0, 100.0], [3, 2, 1, 2])) == 3


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--updates", "0"], "field 'updates' = 0: input should be greater than or equal to 1"),
        (["--seed", "-1"], "field 'seed' = -1"),
        (["--episodes", "1"], "--episodes 1, allowed: 2 or more"),
        (["--out", "file"], "file"),
    ],
)
def test_wrong_words_are_refused_before_anything_is_flown(
    words: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    monkeypatch.setattr("uavrl.datasets.load_builtin", lambda _: pytest.fail("begun"))
    assert main(["demo", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert told in line


@pytest.mark.slow  # learns, and the planner flies: a minute
def test_a_small_demo_leaves_all_that_it_promises(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "uavrl", "demo", "--updates", "60", "--episodes", "4", "--out", str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, "COLUMNS": "200"}, capture_output=True, text=True, check=True)
    assert "From logged flights alone, Diffusion-SAC learned a policy with a return of -" in done.stdout
    report = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert {"tdm", "planner", "hover", "bc", "diffusion_sac", "data"} <= set(report["policies"])
    assert {"tdm", "bc", "data", "planner"} == set(report["paired"]["diffusion_sac"])
    for name in ("table.md", "flight.html", "age.png", "return.png", "training.png", "trajectory.png", "flight.png"):
        assert (tmp_path / name).stat().st_size > 1000, name
    assert (tmp_path / "policy" / "checkpoint").is_dir()
