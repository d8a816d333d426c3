from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.experiments.rows import row
from uavrl.cli import main
from uavrl.experiments import flights
from uavrl.experiments.paper import SCALES, wanted


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["figure-9"], "figure 'figure-9' does not exist, allowed: comparison, "),
        (["--workers", "0"], "--workers 0, allowed: 1 or more"),
        (["--scale", "huge"], "huge"),
    ],
)
def test_wrong_words_are_refused_in_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reproduce", *words, "--out", str(tmp_path / "a")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a").exists()


def test_a_plan_computes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "online", "--scale", "standard", "--plan", "--out", str(tmp_path / "a")]) == 0
    assert "7 runs, 0 done; about" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_finished_runs_are_drawn_and_judged_and_the_rest_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def computes(*_: Any) -> None:
        raise AssertionError("computed")

    monkeypatch.setattr(flights, "measure", computes)
    runs = wanted(SCALES["smoke"], ("comparison",))["comparison"]
    (tmp_path / "smoke.jsonl").write_text("".join(json.dumps(row(run)) + "\n" for run in runs))
    assert main(["reproduce", "comparison", "rates", "online", "--draw", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "online: 6 of 6 runs are missing, not drawn" in said
    place = tmp_path / "smoke"
    assert {path.name for path in place.glob("*.png")} == {"comparison.png", "rates.png"}
    page = (place / "comparison.md").read_text()
    assert "| Diffusion-SAC | 2 |" in page
    assert "training seeds 0, 1; updates 10; 4 environments x 1 fading seeds, seed 1,000,000" in page
    assert "a core, commit 012345678." in page
    claims = (place / "CLAIMS.md").read_text()
    assert "| not measured yet |" in claims
    assert main(["reproduce", "online", "--draw", "--out", str(tmp_path)]) == 0
    assert (place / "CLAIMS.md").read_text() == claims  # whichever figures are drawn, all that is there is judged


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_smallest_scale_from_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "--scale", "smoke", "--out", str(tmp_path)]) == 0
    assert "not drawn" not in capsys.readouterr().out
    text = (tmp_path / "smoke" / "CLAIMS.md").read_text()
    assert "not measured yet" not in text
