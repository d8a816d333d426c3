from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import seeds
from uavrl.errors import ConfigError
from uavrl.experiments.paper import OURS, ROUND_ROBIN, YARDSTICK

RESULTS = Path(__file__).parents[2] / "results"


def row(variant: str, returned: list[float], seed: int = 0) -> dict[str, Any]:
    flown = {"return": returned, "age_per_step_s": [1.0] * len(returned)}
    return {"variant": variant, "seed": seed, "problem": "offline", "scores": {"flown": flown}}


def test_a_seed_is_paired_over_the_environments() -> None:
    base = np.linspace(-300.0, -200.0, 20)
    rows = [row(YARDSTICK, [*base]), row("index at best hover", [*base - 5]), row(ROUND_ROBIN, [*base - 50])]
    rows += [row(OURS, [*base - 20], seed=1), row(OURS, [*base - 10], seed=0)]
    header, *lines = seeds.lines(rows, OURS)
    assert [line[0] for line in lines[3:]] == [f"{OURS}, seed 0", f"{OURS}, seed 1", "2 seeds"]
    told = dict(zip(header, lines[3], strict=True))
    assert told["return"].startswith("-260.0 [")
    assert told["over the planner, %"].startswith("4.0 [")
    assert told["paired to planner"] == "-10.0 [-10.0, -10.0]"
    assert told["paired to TDM"] == "+40.0 [40.0, 40.0]"
    low, high = (float(end) for end in lines[5][3].removeprefix("-15.0 [").removesuffix("]").split(", "))
    assert low < -20.0 < -10.0 < high  # each environment alike, so all of it is the seeds' spread


@pytest.mark.parametrize(
    ("place", "figure", "variant"), [("layouts", "comparison", OURS), ("fixed", "biased", f"{OURS} @ whole log")]
)
def test_the_tables_shown_are_those_of_the_committed_rows(
    place: str, figure: str, variant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    seeds.main(RESULTS / "paper" / "full.jsonl", figure, variant)
    assert capsys.readouterr().out.strip() in (RESULTS / place / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("store", "figure", "variant", "part"),
    [
        ("gone/full.jsonl", "comparison", OURS, "gone/full.jsonl"),
        ("empty/full.jsonl", "nothing", OURS, "figure 'nothing' does not exist"),
        ("empty/full.jsonl", "comparison", OURS, "'planner' has no rows"),
        ("empty/rows.jsonl", "comparison", OURS, "full.jsonl"),
    ],
)
def test_what_is_not_there_is_named(store: str, figure: str, variant: str, part: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("full", "rows"):
        (tmp_path / "empty" / f"{name}.jsonl").touch()
    with pytest.raises(ConfigError, match=part):
        seeds.main(tmp_path / store, figure, variant)
