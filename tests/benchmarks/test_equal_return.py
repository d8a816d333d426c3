from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import equal_return
from benchmarks.equal_return import DEFAULT, PAPER, Curves
from uavrl.errors import ConfigError
from uavrl.experiments.paper import PROTOCOLS, SCALES, Plan


def test_the_papers_runs_are_those_of_the_comparison() -> None:
    wanted = equal_return.runs()
    compared = {run.key for run in Plan(SCALES["standard"]).comparison(PROTOCOLS["published"])}
    paper = [run for run in wanted if run.variant == PAPER]
    assert len(paper) == 5
    assert {run.key for run in paper} <= compared
    ours = [run for run in wanted if run.variant == DEFAULT]
    assert [run.seed for run in ours] == [run.seed for run in paper]
    assert all(run.updates == equal_return.UPDATES for run in ours)
    assert {run.settings["network"]["kind"] for run in ours} == {"devices"}
    assert {run.settings["network"]["kind"] for run in paper} == {"mlp"}


def test_asked_for_is_a_share_of_the_gain_and_without_one_the_end() -> None:
    paper = Curves(np.array([50.0, 100.0]), np.array([[-400.0, -220.0], [-300.0, -180.0]]))
    assert equal_return.asked_for(paper, tdm=-300.0) == pytest.approx(-300 + 0.95 * 100)
    assert equal_return.asked_for(paper, tdm=-150.0) == -200.0


def test_a_seed_is_there_where_it_stays() -> None:
    returned = np.array(
        [
            [-500.0, -204.0, -150.0, -150.0],  # at once above -205, at 2 s
            [-100.0, -400.0, -400.0, -150.0],  # lucky once, above for good from 4 s on
            [-500.0, -500.0, -500.0, -206.0],  # never
        ]
    )
    found = equal_return.seconds_to(Curves(np.arange(1.0, 5.0), returned), -205.0)
    np.testing.assert_allclose(found, [2.0, 4.0, np.inf])


def test_the_table_says_how_long_each_seed_takes(tmp_path: Path) -> None:
    def row(variant: str, updates: int, returned: list[float], seed: int = 0) -> dict[str, Any]:
        scores = {"curve": {"at": [updates / 2, updates], "return": returned}, "flown": {"return": returned}}
        return {"variant": variant, "updates": updates, "seed": seed, "scores": scores}

    rows = [row("TDM", 0, [-300.0, -300.0]), row("planner", 0, [-100.0, -100.0])]
    rows += [row(PAPER, 4000, [-300.0, -200.0]), row(DEFAULT, 1000, [-190.0, -150.0])]
    rates = {"paper_updates_per_s": 8.0, "default_updates_per_s": 10.0}
    rates |= {"paper_updates_floor_per_s": 16.0, "default_updates_floor_per_s": 40.0}
    equal_return.report(rows, rates, tmp_path)
    text = (tmp_path / "equal-return.md").read_text()
    assert "| the paper's configuration | 1 | 4,000 | 500 | 8 | 50 | -200 [-200, -200] |" in text
    assert "| our default | 1 | 1,000 | 100 | 10 | 25 | -150 [-150, -150] |" in text
    assert "Asked for: -205, 95%" in text
    assert "our default 50; the paper's configuration 500, and 500 for all" in text
    diverged = row(PAPER, 4000, [-300.0], seed=1)
    diverged["scores"]["diverged"] = "at 2,000"
    equal_return.report([*rows[:2], row(PAPER, 4000, [-400.0, -350.0]), diverged, *rows[3:]], rates, tmp_path)
    text = (tmp_path / "equal-return.md").read_text()
    assert "Asked for: -350, what the paper's configuration, below TDM," in text
    never = row(DEFAULT, 1000, [-400.0, -400.0])
    equal_return.report([*rows[:3], never], rates, tmp_path)
    assert "our default not reached;" in (tmp_path / "equal-return.md").read_text()
    assert (tmp_path / "equal-return.png").stat().st_size > 10_000


@pytest.mark.parametrize("text", ["no JSON", "[]", '{"paper_updates_per_s": 3.0}', '{"paper_updates_per_s": null}'])
def test_rates_of_another_command_are_refused_before_anything_is_learned(text: str, tmp_path: Path) -> None:
    rates = tmp_path / "rates.json"
    rates.write_text(text)
    with pytest.raises(ConfigError, match=r"rates = '.*rates.json', allowed: a file of `uavrl bench train --json`"):
        equal_return.main(tmp_path / "out", rates)
    assert not (tmp_path / "out").exists()
