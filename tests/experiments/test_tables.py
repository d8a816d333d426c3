from __future__ import annotations

import numpy as np
import pytest

from tests.experiments.rows import COST, PLAN, row
from uavrl.evaluation.statistics import Interval
from uavrl.experiments.paper import OURS, PROTOCOLS
from uavrl.experiments.tables import compare, estimated, interval, markdown, scores, table

ROWS = [row(run) for run in PLAN.comparison(PROTOCOLS["layouts"])]


def test_differences_are_paired_over_environments() -> None:
    found = {one.name: one for one in compare(ROWS)}
    assert found["CQL"].ahead is not None
    # environments differ by a tenth of the cost, which a paired difference does not see
    assert found["CQL"].ahead.mean == pytest.approx(COST["CQL"] - COST[OURS], abs=1.0)
    assert found["CQL"].ahead.high - found["CQL"].ahead.low < 12.0
    assert found["CQL"].returned.high - found["CQL"].returned.low > 12.0
    assert found[OURS].ahead is None


def test_the_planner_is_the_yardstick_and_tdm_its_other_end() -> None:
    found = {one.name: one for one in compare(ROWS)}
    assert found["planner"].excess == Interval(0.0, 0.0, 0.0)
    assert found["TDM"].normalised == Interval(0.0, 0.0, 0.0)
    excess, normalised = found[OURS].excess, found[OURS].normalised
    assert excess is not None
    assert excess.mean == pytest.approx(0.05, abs=0.01)
    assert normalised is not None
    assert normalised.mean == pytest.approx(90.0, abs=2.0)


def test_seeds_widen_an_interval() -> None:
    numbers = np.random.default_rng(0)
    environments = np.linspace(-1.0, 1.0, 30)
    alike = np.tile(environments, (5, 1))
    apart = alike + numbers.standard_normal((5, 1))
    narrow, wide = estimated(alike).interval(), estimated(apart).interval()
    assert wide.high - wide.low > narrow.high - narrow.low
    assert estimated(alike[:1]).interval() == pytest.approx(narrow)


def test_what_a_flight_does_not_have_is_left_out_for_every_seed() -> None:
    values = np.array([[1.0, np.nan, 3.0], [1.0, 2.0, 3.0]])
    assert estimated(values).point == 2.0
    assert np.isnan(estimated(np.full((2, 3), np.nan)).point)


def test_the_table_has_a_line_a_policy_and_says_who_diverged() -> None:
    rows = [dict(one) for one in ROWS]
    rows[-1]["scores"] = rows[-1]["scores"] | {"diverged": "q"}
    text = markdown(table(rows))
    lines = [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines()[2:]]
    assert lines == list(dict.fromkeys(one["variant"] for one in rows))
    assert "| BC | 2 (1 diverged) |" in text
    assert scores([rows[0]], "return").shape == (1, 12)


def test_a_cell_of_two_lines_stays_one_line_of_the_table() -> None:
    assert markdown([["a", "b"], ["1\n2", "3"]]).splitlines()[-1] == "| 1<br>2 | 3 |"


def test_an_objective_a_second_is_shown_a_second() -> None:
    """Energy and age a step would tell who takes short steps."""
    rows = [row(run) for run in PLAN.comparison(PROTOCOLS["realistic"])]
    for one in rows:
        one["scores"]["flown"]["energy_per_episode_j"] = [7.5e4] * 12
    header, first, *_ = table(rows)
    assert "age per second, s" in header
    assert first[header.index("energy a flight, J")] == "7.5e+04"
    assert not {"age per step, s", "energy per step, J"} & set(header)
    assert "age per step, s" in table(ROWS)[0]


@pytest.mark.parametrize(("unit", "decimals"), [(1.0, 0), (0.01, 2)])
def test_small_returns_have_their_digits(unit: float, decimals: int) -> None:
    rows = [row(run) for run in PLAN.comparison(PROTOCOLS["paper-objective"])]
    for one in rows:
        scores = one["scores"]
        scores["flown"]["return"] = [unit * value for value in scores["flown"]["return"]]
    header, *lines = table(rows)
    for line in lines:
        point = line[header.index("return")].split(" ")[0]
        assert len(point.partition(".")[2]) == decimals


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (Interval(-247.26, -255.0, -240.0), "-247 [-255, -240]"),
        (Interval(12.345, 10.0, 14.0), "12.3 [10.0, 14.0]"),
        (Interval(0.12345, 0.1, 0.2), "0.123 [0.100, 0.200]"),
        (Interval(np.nan, np.nan, np.nan), ""),
        (None, ""),
    ],
)
def test_an_interval_has_three_digits(value: Interval | None, text: str) -> None:
    assert interval(value) == text
