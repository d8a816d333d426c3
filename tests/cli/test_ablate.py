from __future__ import annotations

from pathlib import Path

import pytest

from uavrl.cli import main


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["bandits"], "bandit"),
        (["bandit", "--seeds", "0"], "--seeds 0, allowed: 1 or more"),
        (["bandit", "--variant", "nothing"], "--variant 'nothing', allowed: base"),
    ],
)
def test_wrong_words_are_refused_in_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ablate", *words, "--out", str(tmp_path / "a")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a").exists()


def test_rows_and_table_are_written_and_not_computed_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from uavrl.experiments import ablation

    monkeypatch.setitem(ablation.UPDATES, "bandit", 1)
    command = ["ablate", "bandit", "--out", str(tmp_path), "--seeds", "1", "--workers", "1", "--variant", "base"]
    assert main(command) == 0
    assert "1 runs, 0 of them done already" in capsys.readouterr().out
    assert "| base | 1 |" in (tmp_path / "bandit.md").read_text()
    assert main(command) == 0
    assert "1 runs, 1 of them done already" in capsys.readouterr().out
    assert len((tmp_path / "bandit.jsonl").read_text().splitlines()) == 1
