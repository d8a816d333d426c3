from __future__ import annotations

import dataclasses
import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import uavrl
from uavrl import cli
from uavrl.cli import COMMANDS, Command, main
from uavrl.errors import DatasetError


def install(monkeypatch: pytest.MonkeyPatch, run: Callable[[], None]) -> None:
    """Register the command `probe`, which calls `run`."""

    @dataclasses.dataclass(frozen=True)
    class Probe:
        """Probe."""

        count: int = 1
        """how many"""

        def run(self) -> None:
            run()

    monkeypatch.setattr(sys.modules[__name__], "Probe", Probe, raising=False)
    monkeypatch.setitem(COMMANDS, "probe", Command(f"{__name__}:Probe", "probe"))


def test_version_is_printed_without_heavy_imports() -> None:
    code = "import sys; from uavrl.cli import main; main(['--version']); "
    code += "print({'torch', 'scipy', 'tyro'} & {*sys.modules})"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == [f"uavrl {uavrl.__version__}", "set()"]


def test_usage_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {name} " in listed for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_a_frozen_dataclass_that_explains_itself(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module, _, attribute = COMMANDS[name].target.partition(":")
    kind: Any = getattr(importlib.import_module(module), attribute)
    assert kind.__dataclass_params__.frozen
    assert callable(kind.run)
    assert main([*name.split(), "--help"]) == 0
    assert f"usage: uavrl {name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["fly"], ["'fly' does not exist", "evaluate"]),
        (["scenario"], ["'scenario' needs one of: show, diff, check"]),
        (["scenario", "delete"], ["'scenario delete' does not exist", "show, diff, check"]),
        (["scenario", "show", "--fast"], ["Unrecognized options", "--fast"]),
        (["scenario", "diff", "paper"], ["Missing from uavrl scenario diff"]),
        (["evaluate", "--episodes", "many"], ["--episodes: 'many', allowed: a whole number (see"]),
        (["train", "cql", "--out", "x", "--size", "1e4"], ["--size: '1e4', allowed: INT (see"]),
        (["evaluate", "--nowhere", "a/" * 200 + " b"], ["a/" * 200 + " b"]),
        (["bench", "simulate", "--seconds", "few"], ["--seconds: 'few', allowed: a number (see"]),
    ],
)
def test_wrong_words_get_one_line_and_code_2(
    words: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert all(part in line for part in parts), line


def test_an_error_of_the_user_is_one_line_even_when_its_message_has_more(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise DatasetError("row 3,\n column 'reward' is nan")

    install(monkeypatch, fail)
    assert main(["probe"]) == 2
    assert capsys.readouterr().err == "uavrl: error: row 3, column 'reward' is nan\n"


def test_a_mistake_of_ours_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise KeyError("bug")

    install(monkeypatch, fail)
    with pytest.raises(KeyError):
        main(["probe"])


def test_an_interrupt_is_one_line_and_code_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    install(monkeypatch, stop)
    assert main(["probe"]) == 130
    assert capsys.readouterr().err == "uavrl: interrupted\n"


def test_a_closed_pipe_ends_quietly() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "uavrl", "scenario", "show"]
    process = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert process.returncode == 141
    assert process.stderr == ""


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_a_missing_word_is_named_whatever_the_output_can_show(encoding: str) -> None:
    command = [sys.executable, "-m", "uavrl", "scenario", "diff", "paper"]
    known = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=known)
    expected = "Required options: Missing from uavrl scenario diff: SECOND a preset or a TOML file (required)"
    assert done.stderr == f"uavrl: error: {expected} (see: uavrl scenario diff --help)\n"
    assert done.returncode == 2


def test_parse_fills_the_dataclass(tmp_path: Path) -> None:
    command = cli.parse("scenario check", [str(tmp_path / "a.toml")])
    assert command.file == tmp_path / "a.toml"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_output_that_cannot_be_written_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "uavrl", "--version"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr) == (2, "uavrl: error: No space left on device\n")
