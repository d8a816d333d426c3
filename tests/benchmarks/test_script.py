from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from benchmarks import script

SCRIPTS = ("approach", "equal_return", "parts", "paths", "profile", "seeds", "slopes", "ten_million", "tuning")


def code(monkeypatch: pytest.MonkeyPatch, name: str, *words: str) -> int:
    """What `python -m benchmarks.NAME WORDS` exits with."""
    main = importlib.import_module(f"benchmarks.{name}").main
    monkeypatch.setattr(sys, "argv", [name, *words])
    with pytest.raises(SystemExit) as stop:
        script.run(main, f"benchmarks.{name}")
    assert isinstance(stop.value.code, int)
    return stop.value.code


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_says_what_it_takes(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code(monkeypatch, name, "--help") == 0
    assert f"usage: python -m benchmarks.{name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "words", "part"),
    [
        ("approach", ("round",), "'round'"),
        ("approach", ("fixed",), "POLICY is missing, needed: 1 or more"),
        ("parts", ("--planner",), "RUN is missing, needed: 1 or more"),
        ("slopes", (), "RUN is missing, needed: 1 or more"),
        ("approach", ("fixed", "pretrained:gone"), "gone"),
        ("parts", ("nowhere",), "nowhere"),
        ("equal_return", ("out", "nowhere.json"), "rates = 'nowhere.json', allowed: a file of `uavrl bench train"),
        ("parts", ("pretrained:realistic",), "trained in preset 'released'"),
        ("parts", ("--held=few", "pretrained:layouts"), "few"),
        ("paths", ("tdm",), "OUT.png"),
        ("paths", ("tdm", "gone/out.png"), "'gone' does not exist"),
        ("profile", ("large",), "'large'"),
        ("slopes", ("--deep",), "--deep"),
        ("ten_million", ("folder", "--rows", "many"), "many"),
        ("tuning", ("out", "PPO"), "'PPO'"),
    ],
)
def test_wrong_words_are_one_line_and_code_2(
    name: str,
    words: tuple[str, ...],
    part: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert code(monkeypatch, name, *words) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert part in line
    assert captured.out == ""
    assert not any(tmp_path.iterdir())
