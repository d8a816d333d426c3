from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.datasets.flights import fly, small_scenario
from uavrl.cli import main
from uavrl.datasets import Transitions, load_flat, load_source, save_flat, select
from uavrl.scenario import Scenario


@pytest.fixture
def flown(tmp_path: Path) -> tuple[Path, Transitions, Scenario]:
    scenario = small_scenario()
    log = fly(scenario)
    save_flat(tmp_path / "log.parquet", log, scenario)
    return tmp_path / "log.parquet", log, scenario


def test_show_reports_and_writes_figures(
    flown: tuple[Path, Transitions, Scenario], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["data", "show", str(flown[0]), "--json", str(tmp_path / "out" / "figures.json")]) == 0
    assert "12, of which complete 9" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "figures.json").read_text())["rows"] == 120


def test_select_writes_the_selection(flown: tuple[Path, Transitions, Scenario], tmp_path: Path) -> None:
    path, log, scenario = flown
    words = ["data", "select", str(path), "--size", "40", "--quality", "bad", "--seed", "7", "--out"]
    assert main([*words, str(tmp_path / "bad.npz")]) == 0
    assert load_flat(tmp_path / "bad.npz", scenario).digest() == select(log, 40, "bad", 7).digest()


def test_convert_goes_to_minari_and_back(
    flown: tuple[Path, Transitions, Scenario], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    assert main(["data", "convert", str(flown[0]), "mine/log-v0", "--observation", "paper"]) == 0
    assert main(["data", "convert", "mine/log-v0", str(tmp_path / "back.npz")]) == 0
    back, scenario = load_source(tmp_path / "back.npz")
    assert back.digest() == flown[1].digest()
    assert scenario == flown[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show", "nothing"], "data 'nothing' is no built-in data"),
        (["show", "LOG", "--scenario", "released"], "allowed: "),
        (["select", "LOG", "--size", "121", "--out", "out.npz"], "size = 121, allowed: 1 to 120"),
        (["select", "LOG", "--size", "10", "--out", "out.csv"], "suffix '.csv', allowed: .parquet, .npz"),
        (["convert", "LOG", "no version"], "dataset id 'no version', allowed"),
        (["show", "LOG", "--json", "LOG/figures.json"], "figures.json"),
    ],
)
def test_wrong_input_gets_one_line_and_code_2(
    flown: tuple[Path, Transitions, Scenario], words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["data", *(word.replace("LOG", str(flown[0])) for word in words)]) == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
