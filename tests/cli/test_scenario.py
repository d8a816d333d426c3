from __future__ import annotations

from pathlib import Path

import pytest

from uavrl.cli import main
from uavrl.cli.scenario import annotated_toml
from uavrl.scenario import PRESETS, Scenario, load_scenario


@pytest.mark.parametrize("name", PRESETS)
def test_what_is_shown_reads_back_equal(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenario", "show", name]) == 0
    path = tmp_path / "copy.toml"
    path.write_text(capsys.readouterr().out)
    assert load_scenario(path) == PRESETS[name]


def test_odd_values_read_back_equal(tmp_path: Path) -> None:
    scenario = PRESETS["released"].replace(
        name='quoted "name"', devices=2, packet_bits=(1e6, 3.5e17), priority=(0.25, 1e-9), light_speed_mps=2.99792458e8
    )
    path = tmp_path / "odd.toml"
    path.write_text(annotated_toml(scenario))
    assert load_scenario(path) == scenario


def test_every_field_has_its_description_and_range_above_it() -> None:
    lines = annotated_toml(PRESETS["released"]).splitlines()
    for leaf in Scenario().flat():
        row = next(i for i, line in enumerate(lines) if line.startswith(f"{leaf.split('.')[1]} = "))
        assert lines[row - 1].startswith("# ")
    above = {line.split(" = ")[0]: lines[row - 1] for row, line in enumerate(lines)}
    assert above["age_weight"].endswith("; number >= 0 and <= 1")
    assert above["max_steps"].endswith('; whole number >= 1 or "none"')
    assert above["fading"].endswith('; one of "none", "rayleigh", "rician", "ergodic"')
    assert above["charge_idle_hover"].endswith("; true or false")
    assert above["packet_bits"].endswith("; number > 0 or a list of number > 0")


def test_diff_lists_exactly_what_differs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(PRESETS["released"].replace(fading="none", max_steps=None).to_toml())
    assert main(["scenario", "diff", "released", str(path)]) == 0
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["channel.fading", '"rayleigh"', "->", '"none"'],
        ["limits.max_steps", "400", "->", '"none"'],
    ]


def test_check_tells_good_from_bad(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    good.write_text(PRESETS["released"].replace(devices=7).to_toml())
    bad.write_text(good.read_text().replace("transmit_power_w = 0.1259", "transmit_power_w = -1.0"))
    assert main(["scenario", "check", str(good)]) == 0
    assert "7 devices" in capsys.readouterr().out
    assert main(["scenario", "check", str(bad)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "transmit_power_w" in line
    assert "-1.0" in line


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["show", "nothing"], "paper, released, realistic"),
        (["show", "missing.toml"], "cannot be read"),
        (["check", "released"], "no .toml file"),
    ],
)
def test_a_scenario_that_is_not_there_gets_one_line(
    words: list[str], part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scenario", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line
