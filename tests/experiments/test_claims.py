from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.experiments.rows import cost_of, finished_figures, row
from uavrl.experiments.claims import CLAIMS, counted, judged, table
from uavrl.experiments.judges import FAILS, HOLDS, MISSING, OPEN, READING, Results, under_readings
from uavrl.experiments.paper import FIGURES, OURS, PROTOCOLS
from uavrl.experiments.runner import Run

Figures = dict[str, list[dict[str, Any]]]


@pytest.fixture(scope="module")
def figures() -> Figures:
    return finished_figures()


def verdict(figures: Figures, text: str) -> str:
    (found,) = [finding for claim, finding in judged(Results(figures)) if claim.text.startswith(text)]
    return found.verdict


def changed(figures: Figures, names: tuple[str, ...], costs: dict[str, float]) -> Figures:
    """The figures with other costs of some variants, by the first word that a variant begins with."""

    def again(one: dict[str, Any]) -> dict[str, Any]:
        run = Run(**{name: one[name] for name in Run.model_fields})
        return row(
            run, next((cost for name, cost in costs.items() if run.variant.startswith(name)), cost_of(run.variant))
        )

    return figures | {name: [again(one) for one in figures[name]] for name in names}


def test_there_are_twenty_claims_or_more_and_each_is_said_once() -> None:
    assert len(CLAIMS) >= 20
    assert len({claim.text + claim.where for claim in CLAIMS}) == len(CLAIMS)
    assert all(claim.why for claim in CLAIMS)


def test_every_file_that_a_reason_names_is_there() -> None:
    root = Path(__file__).parents[2]
    named = {path for claim in CLAIMS for path in re.findall(r"(?:docs|results)/[\w.-]*\w", claim.why)}
    assert len(named) >= 4
    assert all((root / path).exists() for path in named)


def test_each_reading_has_its_line(figures: Figures) -> None:
    (found,) = [finding for claim, finding in judged(Results(figures)) if claim.text.startswith("BCQ < IQL")]
    lines = found.measured.split("\n")
    assert [line.partition(":")[0] for line in lines] == [
        PROTOCOLS[name].name for name in ("layouts", "published", "paper-objective", "realistic")
    ]


def test_a_world_as_the_paper_has_it(figures: Figures) -> None:
    for text in (
        "Online SAC significantly",
        "Diffusion-SAC achieves the highest return",
        "Diffusion-SAC has the lowest age",
        "BCQ < IQL, CQL < Diffusion-SAC",
        "IQL and CQL perform comparably",
        "alpha = 0, eta = .5 is the best",
        "CQL over-constrains",
        "Cloning alone",
        "10 k rows are as good",
        "More than 20 steps",
        "lambda does not change",
        "Fairness",
    ):
        assert verdict(figures, text) == HOLDS, text
    for text in ("35 % more", "0.15 s to send", "Fewer than 10", "CQL, IQL and BCQ degrade", "A severely biased"):
        assert verdict(figures, text) == FAILS, text
    assert verdict(figures, "More than 0.65 GB") == READING


def test_a_verdict_turns_with_what_was_measured(figures: Figures) -> None:
    comparisons = ("comparison", "comparison-published", "comparison-paper", "comparison-realistic")
    worse = changed(figures, comparisons, {"CQL": 190.0})
    assert verdict(worse, "Diffusion-SAC achieves the highest return") == FAILS
    one_protocol = changed(figures, comparisons[:1], {"CQL": 190.0})
    assert verdict(one_protocol, "Diffusion-SAC achieves the highest return") == READING
    level = changed(figures, comparisons, {"CQL": 210.0})
    assert verdict(level, "Diffusion-SAC achieves the highest return") == OPEN
    fast = changed(figures, comparisons, {"CQL": 400.0, "IQL": 400.0, "BCQ": 400.0})
    assert verdict(fast, "35 % more") == HOLDS
    free = changed(figures, ("variants", "variants-published"), {"alpha = 1": 190.0})
    assert verdict(free, "CQL over-constrains") == FAILS
    few = changed(figures, ("denoising",), {"linear @ 2": 400.0, "vp @ 2": 400.0})
    assert verdict(few, "Fewer than 10") == HOLDS
    starved = changed(figures, ("biased",), {"Diffusion-SAC @ two": 400.0})
    assert verdict(starved, "A severely biased") == HOLDS


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [
        ([HOLDS, HOLDS, MISSING], HOLDS),
        ([HOLDS, OPEN], READING),
        ([HOLDS, FAILS], READING),
        ([OPEN, FAILS, FAILS], FAILS),
        ([OPEN, OPEN], OPEN),
        ([MISSING], MISSING),
    ],
)
def test_a_claim_depends_on_the_reading_where_it_holds_under_some(verdicts: list[str], expected: str) -> None:
    assert under_readings(verdicts) == expected


def test_a_figure_that_is_not_computed_leaves_its_claims_unsaid(figures: Figures) -> None:
    some = {"comparison": figures["comparison"]}
    assert verdict(some, "Online SAC significantly") == MISSING
    assert verdict(some, "Diffusion-SAC achieves the highest return") == HOLDS
    assert {finding.verdict for _, finding in judged(Results({}))} == {MISSING}


def test_the_table_is_numbered_and_the_verdicts_counted(figures: Figures) -> None:
    found = judged(Results(figures))
    lines = table(found)
    assert [line[0] for line in lines[1:]] == [str(number) for number in range(1, len(CLAIMS) + 1)]
    assert all(len(line) == 6 and "|" not in "".join(line) for line in lines)
    assert sum(int(part.split(": ")[1]) for part in counted(found).split(", ")) == len(CLAIMS)
    assert set(figures) == set(FIGURES)


def scattered(figures: Figures, spreads: dict[str, float]) -> Figures:
    """The comparison with three seeds of each algorithm, whose mean returns deviate as told."""
    rows = []
    for one in figures["comparison"]:
        if one["variant"] not in spreads:
            rows.append(one)
        for seed in range(3) if one["variant"] in spreads and one["seed"] == 0 else ():
            flown = one["scores"]["flown"]
            moved = np.asarray(flown["return"]) + spreads[one["variant"]] * (seed - 1)
            scores = {**one["scores"], "flown": {**flown, "return": moved.tolist()}}
            rows.append({**one, "seed": seed, "scores": scores})
    return {**figures, "comparison": rows}


def test_a_spread_is_judged_by_the_ratio_of_two(figures: Figures) -> None:
    others = {"CQL": 10.0, "IQL": 10.0, "BCQ": 10.0}
    for spread, expected in ((0.5, HOLDS), (5.0, OPEN), (20.0, OPEN), (100.0, FAILS)):  # F(2, 2) has 39 at 97.5 %
        assert verdict(scattered(figures, {OURS: spread} | others), "More stable") == expected, spread


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"), [(102.0, 130.0, HOLDS), (120.0, 130.0, FAILS), (102.0, 101.0, FAILS)]
)
def test_whoever_falls_short_of_the_planner(figures: Figures, ours: float, theirs: float, expected: str) -> None:
    costs = {"planner": 100.0, OURS: ours, "IQL": theirs, "CQL": theirs}
    found = changed(figures, ("comparison",), costs)
    assert verdict(found, "IQL and CQL fall short") == expected
