from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.experiments.rows import PLAN, row
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.experiments.paper import FIGURES, PROTOCOLS
from uavrl.experiments.report import about, finished_figures, report_page, seeds_of, write_results
from uavrl.policies import make_policy
from uavrl.scenario import load_scenario

RUNS = PLAN.comparison(PROTOCOLS["layouts"])


def test_a_figure_is_drawn_from_the_seeds_that_every_variant_has_finished() -> None:
    rows = {run.key: row(run) for run in RUNS if not (run.variant == "CQL" and run.seed == 1)}
    chosen, seeds = seeds_of(RUNS, rows)
    assert seeds == {0}
    assert {one["seed"] for one in chosen} == {0}
    assert {one["variant"] for one in chosen} == {run.variant for run in RUNS}
    none = {key: one for key, one in rows.items() if one["variant"] != "CQL"}
    assert seeds_of(RUNS, none) == ([], set())
    unflown = {key: one for key, one in rows.items() if one["variant"] != "planner"}
    assert seeds_of(RUNS, unflown)[0] == []


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    rows = {run.key: row(run) for run in RUNS if run.seed == 0}
    said = write_results({"comparison": RUNS, "rates": RUNS[:3]}, rows, tmp_path, "standard")
    assert "5 of 15 runs are missing" in said[0]
    text = (tmp_path / "comparison.md").read_text()
    assert "Scenario released; unseen layouts; set network; training seeds 0; updates 10;" in text
    assert "5 runs of this scale are missing." in text
    assert "says nothing" not in (tmp_path / "CLAIMS.md").read_text()
    assert "of the paper it says nothing" in about("smoke")


class Page(HTMLParser):
    """Headings, links within the page, pictures and what it would load from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.pictures: list[str] = []
        self.loaded: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        if tag == "h2":
            self.anchors.add(found["id"])
        if tag == "a" and found["href"].startswith("#"):
            self.links.append(found["href"][1:])
        if tag == "img":
            self.pictures.append(found["src"])
        if tag in ("script", "link") and (found.get("src") or found.get("href")):
            self.loaded.append(tag)
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.parametrize("episodes", [0, 2])
def test_the_page_holds_all_of_it_and_loads_nothing(episodes: int, tmp_path: Path) -> None:
    rows = {run.key: row(run) for run in RUNS}
    figures = {"comparison": RUNS, "online": PLAN.online()}
    write_results(figures, rows, tmp_path, "smoke")
    tests = evaluation_set(load_scenario("released", max_steps=8), "random", 1)
    flights = [fly(make_policy(name), tests).episode(0) for name in ("tdm", "hover")[:episodes]]
    text = report_page(figures, rows, tmp_path, "smoke", flights)
    page = Page(text)
    assert page.open == []
    assert page.loaded == []
    assert "(not measured yet)<br>comparison-paper: not computed" in text
    assert set(page.links) == page.anchors
    assert len(page.pictures) == 1
    assert page.pictures[0].startswith("data:image/png;base64,")
    assert "offline-algorithms--unseen-layouts" in page.anchors
    assert text.count("Plotly.newPlot(") >= episodes
    assert set(finished_figures(figures, rows)) == {"comparison"}
    assert FIGURES["online"].title not in text
