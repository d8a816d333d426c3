from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from uavrl.cli import main
from uavrl.cli.policies import resolve, resolve_all
from uavrl.errors import ConfigError
from uavrl.scenario import load_scenario

MINE = """
import numpy as np
from uavrl.simulation.state import FlightAction

class Hummingbird:
    name = "hummingbird"
    needs = "devices"
    def __init__(self, scenario):
        self.devices = scenario.traffic.devices
    def reset(self, count):
        self.count = count
    def act(self, observation, *, generator, deterministic=False):
        return FlightAction(np.zeros((self.count, 2)), np.full(self.count, self.devices))

class Plain(Hummingbird):
    def __init__(self):
        self.devices = 1

class Nameless:
    needs = "paper"

class Angry:
    def __init__(self):
        raise ValueError("not today")
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current directory with a short scenario and a module of a user's own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "birds", raising=False)
    (tmp_path / "birds.py").write_text(MINE)
    (tmp_path / "short.toml").write_text(load_scenario("released", max_steps=8).to_toml())
    return tmp_path


def test_another_scenario_than_a_policy_learned_in_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", "--scenario", "short.toml", "--episodes", "2", "--deterministic"]
    assert main([*words, "--policy", "tdm", "--policy", "pretrained:realistic"]) == 0
    told = capsys.readouterr().err
    assert "pretrained:realistic learned in another scenario; channel." in told
    assert " more differ" in told
    assert main([*words, "--policy", "pretrained:layouts@choice_prior=0"]) == 0
    assert "learned in" not in capsys.readouterr().err
    (folder / "far.toml").write_text(load_scenario("released", max_steps=8, max_displacement_m=50.0).to_toml())
    assert main([*words, "--policy", "pretrained:layouts", "--scenario", "far.toml"]) == 0
    assert "layouts learned in another scenario; airframe.max_displacement_m differ" in capsys.readouterr().err


def test_a_report_is_written_and_shown(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "evaluate --policy tdm --policy birds:Hummingbird --policy tdm --scenario short.toml --episodes 3"
    assert main([*words.split(), "--baseline", "tdm", "--json", "out.json", "--markdown", "out.md"]) == 0
    report = json.loads((folder / "out.json").read_text())
    assert [*report["policies"]] == ["tdm", "hummingbird", "tdm-2"]
    assert [*report["paired"]["hummingbird"]] == ["tdm"]
    assert report["paired"]["tdm-2"]["tdm"]["return"] == {"mean": 0, "low": 0, "high": 0}
    assert report["scenario"]["limits"]["max_steps"] == 8
    captured = capsys.readouterr()
    assert "hummingbird" in captured.out
    assert captured.err == ""  # no terminal, no progress bar
    assert "| hummingbird |" in (folder / "out.md").read_text()


def test_seed_episodes_layouts_and_repeats_reach_the_flights(folder: Path) -> None:
    layouts = [[[float(10 * k + i), 5.0] for k in range(10)] for i in range(2)]
    (folder / "two.json").write_text(json.dumps(layouts))
    words = "evaluate --policy tdm --scenario short.toml --layouts two.json --episodes 4 --seed 9 --fading-seeds 2"
    assert main([*words.split(), "--json", "out.json"]) == 0
    report = json.loads((folder / "out.json").read_text())
    assert (report["layouts"], report["episodes"], report["seed"], report["fading_seeds"]) == ("two.json", 4, 9, 2)
    assert report["bootstrap"]["units"] == 2


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("--policy tdm --scenario nowhere", ["'nowhere'", "paper, released, realistic"]),
        ("--policy tdm --episodes 0", ["episodes = 0", "1 or more"]),
        ("--policy tdm --layouts flat.json", ["flat.json", "(10, 3)", "(10, 2)"]),
        ("--policy tdm --layouts cut.json", ["cut.json", "not valid JSON"]),
        ("--policy tdm --layouts gone.json", ["gone.json", "No such file"]),
        ("--policy tdm --baseline planner", ["baseline 'planner'", "tdm"]),
        ("--policy tdn", ["'tdn' does not exist", "tdm", "module:Class"]),
        ("--policy birds:Nameless", ["birds:Nameless", "no 'name'"]),
        ("--policy birds:Angry", ["birds:Angry", "ValueError: not today"]),
        ("--policy birds:Gone", ["birds:Gone", "AttributeError"]),
        ("--policy bees:Queen", ["bees:Queen", "No module named 'bees'"]),
        ("--policy tdm --json gone/out.json", ["gone/out.json", "does not exist"]),
        ("--policy tdm --json .", ["is a directory"]),
        ("--policy tdm --data gone.parquet", ["gone.parquet"]),
        ("--episodes 3", ["--policy"]),
        ("--policy", ["--policy"]),
        ("--policy tdm --layout fixed", ["--layout"]),
        ("--policy tdm --policy pretrained:layouts@candidates=3 --deterministic", ["@candidates=3", "--deterministic"]),
        ("--policy short", ["short"]),
    ],
)
def test_wrong_input_is_one_line_and_code_2_and_no_report_is_lost(
    words: str, parts: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "flat.json").write_text(json.dumps([[[1, 2, 3]] * 10]))
    (folder / "cut.json").write_text("[[[1, 2], [3")
    (folder / "old.json").write_text("old")
    given = words.split()
    target = [] if "--json" in given else ["--json", "old.json"]
    scenario = [] if "--scenario" in given else ["--scenario", "short.toml"]
    assert main(["evaluate", *given, *target, *scenario]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert all(part in line for part in parts), line
    assert captured.out == ""
    assert (folder / "old.json").read_text() == "old"


def test_a_policy_of_ones_own_is_given_the_scenario_if_it_takes_one(folder: Path) -> None:
    scenario = load_scenario("released", devices=7)
    assert resolve("birds:Hummingbird", scenario).devices == 7  # type: ignore[attr-defined]  # the user's own
    assert resolve("birds:Plain", scenario).devices == 1  # type: ignore[attr-defined]  # the user's own


def test_equal_names_are_numbered() -> None:
    policies = resolve_all(["tdm", "saver", "tdm", "tdm"], load_scenario("released"))
    assert [*policies] == ["tdm", "saver", "tdm-2", "tdm-3"]
    assert policies["tdm"] is not policies["tdm-2"]


def test_a_checkpoint_that_is_none_is_refused(tmp_path: Path) -> None:
    from uavrl.errors import CheckpointError

    with pytest.raises((CheckpointError, ConfigError), match=tmp_path.name):
        resolve(str(tmp_path), load_scenario("released"))
