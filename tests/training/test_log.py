from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from uavrl.errors import ConfigError
from uavrl.training.log import MetricsLog, progress, read_metrics


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


def test_cut_that_is_killed_loses_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = MetricsLog(tmp_path / "metrics.jsonl")
    log.write({"step": 1, "text": "}"})
    log.write({"step": 2})

    def killed(*_: object) -> None:
        raise RuntimeError("killed")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr(Path, "replace", killed)
        log.cut(1)
    assert [row["step"] for row in rows(log.path)] == [1, 2]
    log.cut(1)
    assert rows(log.path) == [{"step": 1, "text": "}"}]
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_a_log_cut_at_any_byte_is_read_but_for_that_line(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path / "metrics.jsonl")
    for step in (1, 2):
        log.write({"step": step, "q": 0.5, "text": "a}"})
    whole = log.path.read_bytes()
    first = whole.index(b"\n")
    for length in range(len(whole) + 1):
        log.path.write_bytes(whole[:length])
        count = (length >= first) + (length >= len(whole) - 1)
        assert [row["step"] for row in read_metrics(log.path)] == [1, 2][:count]


def test_tensorboard_shows_the_same_numbers_and_forgets_what_a_killed_run_wrote_too_far(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = tmp_path / "board"
    for first, last in ((1, 4), (3, 6)):  # killed at 4, goes on from the checkpoint of 2
        log = MetricsLog(tmp_path / "metrics.jsonl", board)
        log.cut(first - 1)
        for step in range(first, last + 1):
            log.write({"step": step, "q": 10.0 * first + step, "loss": float("nan"), "text": "a"})
        log.close()
    events = EventAccumulator(str(board))
    events.Reload()
    assert events.Tags()["scalars"] == ["q"]
    shown = [(event.step, event.value) for event in events.Scalars("q")]
    assert shown == [(row["step"], row["q"]) for row in rows(tmp_path / "metrics.jsonl")]
    assert shown == [(1, 11.0), (2, 12.0), (3, 33.0), (4, 34.0), (5, 35.0), (6, 36.0)]


def test_tensorboard_that_is_not_installed_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ConfigError, match=r"extra 'tracking', which is not installed: pip install 'uavrl\[tracking\]'"):
        MetricsLog(tmp_path / "metrics.jsonl", tmp_path / "board")
    MetricsLog(tmp_path / "metrics.jsonl").write({"step": 1})


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
