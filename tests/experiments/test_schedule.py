from __future__ import annotations

import pytest

from tests.experiments.rows import row
from uavrl.experiments.paper import SCALES, wanted
from uavrl.experiments.schedule import estimated_s, schedule


def test_every_run_once_and_what_is_done_is_not_left() -> None:
    figures = wanted(SCALES["smoke"], ("comparison", "rates"))
    table, runs = schedule(figures, {}, 2)
    assert [run.key for run in runs] == [run.key for run in figures["comparison"]]
    assert str(table.caption).startswith("15 runs, 0 done")
    done = {run.key: row(run) for run in runs}
    table, _ = schedule(figures, done, 2)
    assert str(table.caption) == "15 runs, 15 done; about 0.0 core-hours left, 0.0 hours with 2 workers"


def test_what_is_left_is_estimated_from_finished_runs_of_its_kind() -> None:
    figures = wanted(SCALES["standard"], ("comparison",))
    runs = [run for run in figures["comparison"] if run.variant == "CQL"]
    known = {runs[0].key: row(runs[0]) | {"seconds": 3_600.0}}
    table, _ = schedule({"comparison": runs}, known, 2)
    assert "about 4.0 core-hours left, 2.0 hours with 2 workers" in str(table.caption)
    assert estimated_s(runs[0]) == pytest.approx(4_000 * 0.14 + 100 * (3 + 8 + 1) * 0.06)  # and flights of 400 steps


def test_flights_of_a_time_are_estimated_from_their_likely_steps() -> None:
    figures = wanted(SCALES["standard"], ("comparison", "comparison-realistic"))
    steps, time = (next(run for run in runs if run.variant == "TDM") for runs in figures.values())
    assert estimated_s(time) == pytest.approx(2.5 * estimated_s(steps))  # 400 s of .4 s
