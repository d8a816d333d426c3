from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.experiments.rows import row
from uavrl.cli import main
from uavrl.experiments.paper import SCALES, wanted


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "holds no smoke.jsonl; make it: uavrl reproduce --scale smoke"),
        (["--out", "nowhere/report.html"], "the directory 'nowhere' does not exist"),
        (["--policy", "nobody"], "holds no smoke.jsonl"),
    ],
)
def test_wrong_words_are_refused_in_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", "--results", str(tmp_path), *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_page_is_made_of_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = wanted(SCALES["smoke"], ("comparison",))["comparison"]
    (tmp_path / "smoke.jsonl").write_text("".join(json.dumps(row(run)) + "\n" for run in runs))
    out = tmp_path / "page.html"
    assert main(["report", "--results", str(tmp_path), "--policy", "tdm", "--out", str(out)]) == 0
    assert "open it in a browser" in capsys.readouterr().out
    text = out.read_text()
    assert "tdm: return" in text
    assert "Offline algorithms, unseen layouts" in text
