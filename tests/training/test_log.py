from __future__ import annotations

import json
from pathlib import Path

import pytest

from uavrl.training.log import MetricsLog, progress


def rows(path: Path) -> list[dict[str, float | None]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_rows_are_json_and_what_is_not_finite_is_null(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path / "new" / "metrics.jsonl")
    log.write({"step": 1, "q": float("nan"), "loss": float("-inf")})
    log.write({"step": 2, "q": 0.5, "text": "a"})
    assert rows(log.path) == [{"step": 1, "q": None, "loss": None}, {"step": 2, "q": 0.5, "text": "a"}]


def test_cut_drops_what_came_after_the_checkpoint_and_a_line_cut_short(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path / "metrics.jsonl")
    for step in (1, 2, 2, 3, 4):
        log.write({"step": step})
    with log.path.open("a") as file:
        file.write('{"step": 2, "q": 0.')  # the process was killed within this line
    log.cut(2)
    log.write({"step": 5})
    assert [row["step"] for row in rows(log.path)] == [1, 2, 2, 5]
    log.cut(0)
    assert log.path.read_text() == ""


def test_cut_without_a_file_makes_none(tmp_path: Path) -> None:
    MetricsLog(tmp_path / "metrics.jsonl").cut(3)
    assert not (tmp_path / "metrics.jsonl").exists()


def test_progress_off_a_terminal_is_a_line_every_half_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("uavrl.training.log.time.monotonic", lambda: now)
    with progress("train bc", 700, "update") as report:
        for done in range(101, 701):  # goes on from 100; a tenth of a second each
            now += 0.1
            report(done, f"q {done}")
    captured = capsys.readouterr()
    assert captured.out == ""
    first, *_, last = captured.err.splitlines()
    assert len(captured.err.splitlines()) in (2, 3)
    assert first.startswith("train bc: 4")
    assert "/700 update, 10/s" in first
    assert " s left" in first
    assert last.startswith("train bc: 700/700 update")
    assert last.endswith("0 s left  q 700")


def test_progress_that_ends_at_once_says_little(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("train bc", 3, "update") as report:
        for done in (1, 2, 3):
            report(done, "")
    assert len(capsys.readouterr().err.splitlines()) <= 1
