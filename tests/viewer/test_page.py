"""The page says what the flight did, moves, needs nothing from outside, and stays small."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest

from tests.viewer.flights import flight, written_by_hand
from uavrl.errors import ConfigError
from uavrl.evaluation.metrics import flight_metrics
from uavrl.evaluation.rollouts import evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.simulation.rendering import INK, VERMILION
from uavrl.viewer.page import episode_figure, episode_page, mean_ages_s, shown_steps, write_page

PATH, LINK, DEVICES, AIRCRAFT, BARS, AGE_NOW, AGE_MEAN, ENERGY = range(8)  # what changes, in a frame's order


def traces(figure: dict[str, Any], frame: int) -> list[dict[str, Any]]:
    data: list[dict[str, Any]] = figure["frames"][frame]["data"]
    return data


def test_every_frame_shows_its_own_moment() -> None:
    episode = written_by_hand()
    figure = episode_figure(episode)
    assert [frame["name"] for frame in figure["frames"]] == ["0", "1", "2", "3"]
    for step in range(4):
        shown = traces(figure, step)
        assert shown[PATH]["x"] == episode.position_m[: step + 1, 0].tolist()
        assert (shown[AIRCRAFT]["x"], shown[AIRCRAFT]["y"]) == ([episode.position_m[step, 0]], [0.0])
        assert shown[DEVICES]["marker"]["color"] == shown[BARS]["y"] == episode.age_s[step].tolist()
        assert shown[ENERGY]["x"] == [episode.time_s[step]]
        assert shown[ENERGY]["y"] == [episode.energy_j[:step].sum()]
        assert shown[AGE_NOW]["y"] == [episode.age_s[step].mean()]
    assert traces(figure, 3)[AGE_MEAN]["y"] == [2.0]  # ages run from 0 to 4: nothing was reset


def test_the_link_goes_to_the_device_just_served_and_tells_a_lost_packet() -> None:
    links = [traces(episode_figure(written_by_hand()), step)[LINK] for step in range(4)]
    assert (links[0]["x"], links[3]["x"]) == ([], [])
    assert (links[1]["x"], links[1]["y"]) == ([10.0, 100.0], [0.0, 200.0])
    assert (links[2]["x"], links[2]["y"]) == ([20.0, 900.0], [0.0, 800.0])
    assert (links[1]["line"]["color"], links[2]["line"]["color"]) == (INK, VERMILION)
    assert [link["line"]["dash"] for link in links] == ["dot", "solid", "dot", "dot"]  # each says it: frames only add


def test_the_slider_and_the_button_reach_the_frames() -> None:
    figure = episode_figure(written_by_hand())
    steps = figure["layout"]["sliders"][0]["steps"]
    assert [step["args"][0] for step in steps] == [[frame["name"]] for frame in figure["frames"]]
    assert steps[2]["label"] == (
        "step 2 of 3  |  3.0 s  |  device 2, packet lost  |  "
        "mean age 3.00 s, since the start 1.50 s  |  12 J  |  return -3"
    )
    play, pause = figure["layout"]["updatemenus"][0]["buttons"]
    assert play["args"][0] is None  # all frames
    assert play["args"][1]["frame"]["redraw"]  # bars and colours do not move without
    assert pause["args"][0] == [None]


def test_colours_and_axes_hold_for_all_frames() -> None:
    figure = episode_figure(flight("saver", max_steps=60))
    layout = figure["layout"]
    oldest = max(max(traces(figure, frame)[BARS]["y"]) for frame in range(len(figure["frames"])))
    assert layout["coloraxis"]["cmin"] == 0.0
    assert 0.5 * oldest < layout["coloraxis"]["cmax"] < 2.0 * oldest
    assert layout["yaxis2"]["range"][1] >= oldest
    assert all(trace["marker"]["coloraxis"] == "coloraxis" for trace in traces(figure, 5)[DEVICES : BARS + 1 : 2])
    titles = [
        layout[axis]["title"]["text"] for axis in layout if re.fullmatch(r"[xy]axis\d*", axis) and axis != "xaxis3"
    ]
    assert all(title == "device" or re.search(r"\((m|s|J|kJ)\)$", title) for title in titles)


def test_plotly_accepts_every_frame() -> None:
    figure = episode_figure(flight("saver", "realistic", max_steps=5))
    assert len(go.Figure(figure).frames) == 6  # raises on a property that plotly does not know


@pytest.mark.parametrize(("steps", "frames"), [(1, 150), (149, 150), (150, 150), (400, 150), (100_000, 150), (7, 2)])
def test_strides_are_equal_and_reach_from_start_to_end(steps: int, frames: int) -> None:
    shown = shown_steps(steps, frames)
    assert (shown[0], shown[-1]) == (0, steps)
    assert len(shown) <= frames
    assert len(set(np.diff(shown)[:-1])) <= 1
    assert steps >= frames or len(shown) == steps + 1


def test_the_mean_age_is_the_one_of_the_evaluation_with_priorities() -> None:
    environments = evaluation_set("realistic", "random", 1)
    scenario = environments.scenario.replace(priority=(1.0, 0.5, *[0.1] * 8), time_budget_s=30.0)
    flights = fly(make_policy("saver"), evaluation_set(scenario, "random", 1))
    now, running = mean_ages_s(flights.episode(0))
    metrics = flight_metrics(flights)
    assert running[-1] == pytest.approx(metrics["age_per_second_s"][0])
    assert now[1:].mean() == pytest.approx(metrics["age_per_step_s"][0])


def test_the_page_carries_all_it_needs_and_says_how_it_thins() -> None:
    episode = flight("hover", devices=100)
    page = episode_page(episode)
    assert len(page.encode()) < 8e6
    head, figure = page[: page.index("<script")], page[page.index("Plotly.newPlot(") :]

    class Sources(HTMLParser):
        found: list[str] = []  # noqa: RUF012  # one parser

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.found += [value or "" for name, value in attrs if name in ("src", "href")]

    Sources().feed(page)
    assert Sources.found == []
    assert f"return {episode.total_reward:,.0f}" in head
    assert "400 steps" in head
    assert "one step in 3 is shown" in head
    assert figure.count('"name":"') >= len(shown_steps(400))


def test_a_name_cannot_write_into_the_page() -> None:
    page = episode_page(written_by_hand())
    assert "&lt;b&gt;by hand&lt;/b&gt;&lt;/script&gt;: return -7" in page
    assert "<b>by hand" not in page


@pytest.mark.parametrize("devices", [1, 100])
def test_numbers_appear_while_they_can_be_read(devices: int) -> None:
    text = traces(episode_figure(flight("tdm", devices=devices, max_steps=3)), 0)[DEVICES]["text"]
    assert text == (["1"] if devices == 1 else [""] * 100)


def test_wrong_calls_are_told(tmp_path: Path) -> None:
    episode = written_by_hand()
    with pytest.raises(ConfigError, match="frames = 1, allowed: 2 or more"):
        episode_page(episode, 1)
    with pytest.raises(ConfigError, match="cannot be written: No such file"):
        write_page(episode, tmp_path / "none" / "page.html")
