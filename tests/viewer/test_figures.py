"""Figures draw the numbers that they were given, whatever their count, and nothing of them leaves the picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from tests.viewer.flights import flight, written_by_hand
from uavrl.errors import ConfigError
from uavrl.viewer import figures


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved, for a look at what they hold."""
    kept: list[Figure] = []
    save = figures._save

    def keep(figure: Figure, out: Path) -> None:
        kept.append(figure)
        save(figure, out)

    monkeypatch.setattr(figures, "_save", keep)
    return kept


def overlapping(figure: Figure) -> list[tuple[str, str]]:
    """Pairs of texts in the picture that touch."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]  # matplotlib leaves it untyped
    found = [(text.get_text(), text.get_window_extent()) for text in texts(figure)]
    inside = [(text, box) for text, box in found if box.width > 0 and canvas.figure.bbox.padded(1).overlaps(box)]
    return [
        (one[0], two[0])
        for index, one in enumerate(inside)
        for two in inside[index + 1 :]
        if one[1].shrunk(0.98, 0.9).overlaps(two[1].shrunk(0.98, 0.9))
    ]


def texts(figure: Figure) -> list[Text]:
    """What is written in the picture; an axis keeps labels of ticks that lie out of its range and are not drawn."""
    out_of_range = {
        tick.label1
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
    }
    found: list[Any] = figure.findobj(Text)
    return [text for text in found if text.get_visible() and text.get_text() and text not in out_of_range]


def report(**returns: float) -> dict[str, Any]:
    return {
        "policies": {
            name: {
                "return": {"mean": value, "low": value - 10, "high": value + 20},
                "excess_cost": {"mean": -value / 200 - 1, "low": -value / 200 - 1.1, "high": -value / 200 - 0.9},
                "age_per_second_s": {"mean": -value / 100, "low": -value / 110, "high": -value / 90},
            }
            for name, value in returns.items()
        }
    }


def test_bars_have_their_lengths_intervals_and_numbers(drawn: list[Figure], tmp_path: Path) -> None:
    figures.objective_bars(report(tdm=-300.0, planner=-200.0), tmp_path / "bars.png")
    left, right = drawn[0].axes
    assert [bar.get_width() for bar in left.patches] == [-300.0, -200.0]  # type: ignore[attr-defined]  # they are rectangles
    assert [bar.get_width() for bar in right.patches] == pytest.approx([50.0, 0.0])  # type: ignore[attr-defined]  # as above
    assert [text.get_text() for text in left.texts] == ["-300 [-310, -280]", "-200 [-210, -180]"]
    assert right.texts[0].get_text() == "50.0 [40.0, 60.0]"
    assert [label.get_text() for label in left.get_yticklabels()] == ["tdm", "planner"]
    whiskers = left.collections[0]
    assert isinstance(whiskers, LineCollection)
    assert whiskers.get_segments()[0][:, 0].tolist() == [-310.0, -280.0]
    assert left.get_ylim()[0] > left.get_ylim()[1]  # the first on top


def test_an_outlier_is_cut_and_does_not_hide_the_others(drawn: list[Figure], tmp_path: Path) -> None:
    figures.objective_bars(report(hover=-200.0, tdm=-250.0, bc=-260.0, saver=-5000.0), tmp_path / "bars.png")
    axes = drawn[0].axes[0]
    assert axes.get_xlim()[0] > -350
    assert [bar.get_hatch() is not None for bar in axes.patches] == [False, False, False, True]
    assert axes.texts[3].get_text() == "-5000 [-5010, -4980]"
    assert "the bar is cut" in axes.get_xlabel()


@pytest.mark.parametrize("count", [2, 20])
def test_no_texts_touch_with_few_or_many_policies(count: int, drawn: list[Figure], tmp_path: Path) -> None:
    names = {f"a_policy_of_a_rather_long_name_{'x' * i}": -200.0 - 137.0 * i for i in range(count)}
    figures.objective_bars(report(**names), tmp_path / "bars.png")
    figures.age_bars(report(**names), tmp_path / "ages.png")
    assert [overlapping(figure) for figure in drawn] == [[], []]


def test_a_metric_that_does_not_exist_is_a_dash(drawn: list[Figure], tmp_path: Path) -> None:
    made = report(tdm=-300.0, data=-250.0)
    made["policies"]["data"]["return"] = {"mean": None, "low": None, "high": None}
    del made["policies"]["data"]["excess_cost"]
    figures.objective_bars(made, tmp_path / "bars.png")
    assert [axes.texts[1].get_text() for axes in drawn[0].axes] == ["-", "-"]
    with pytest.raises(ConfigError, match="holds none of: return, excess_cost"):
        figures.objective_bars({"policies": {"tdm": {}}}, tmp_path / "none.png")


def test_curves_are_the_rows_of_the_log(drawn: list[Figure], tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [{"step": 10 * i, "critic_loss": 5.0 / i, "bc_loss": None} for i in range(1, 101)]
    rows += [{"step": 500, "return": -300.0}, {"step": 1000, "return": -200.0, "bc_loss": 1.0}]
    log = tmp_path / "metrics.jsonl"
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    figures.training_curves({"one": log, "two": log}, tmp_path / "curves.png")
    by_title = {axes.get_title(): axes for axes in drawn[0].axes}
    assert list(by_title) == ["return of the trial flights", "bc loss", "critic loss", ""]
    line = by_title["return of the trial flights"].get_lines()[0]
    assert np.asarray(line.get_xdata()).tolist() == [500, 1000]
    assert np.asarray(line.get_ydata()).tolist() == [-300.0, -200.0]
    faint, smooth = by_title["critic loss"].get_lines()[:2]
    values = np.array([5.0 / i for i in range(1, 101)])
    assert np.asarray(faint.get_ydata()) == pytest.approx(values)
    assert np.asarray(smooth.get_ydata())[50] == pytest.approx(values[48:53].mean())
    assert by_title["critic loss"].get_yscale() == "log"
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["one", "two"]
    assert overlapping(drawn[0]) == []


def test_a_log_that_cannot_be_drawn_is_told(tmp_path: Path) -> None:
    log = tmp_path / "metrics.jsonl"
    with pytest.raises(ConfigError, match="cannot be read"):
        figures.training_curves({"run": log}, tmp_path / "out.png")
    log.write_text('{"step": 1, "rate": 3}\n')
    with pytest.raises(ConfigError, match=r"holds no 'return', 'q' or '\.\.\._loss'"):
        figures.training_curves({"run": log}, tmp_path / "out.png")
    log.write_text('{"step": 1}\n{"st')
    with pytest.raises(ConfigError, match="line 2"):
        figures.training_curves({"run": log}, tmp_path / "out.png")


def test_trajectories_are_those_of_the_flights_on_one_clock(drawn: list[Figure], tmp_path: Path) -> None:
    slow, fast = written_by_hand(), flight("hover", max_steps=20)
    figures.trajectories([slow, fast], tmp_path / "paths.png")
    panels = drawn[0].axes[:2]
    paths = [next(c for c in axes.collections if isinstance(c, LineCollection)) for axes in panels]
    for path, episode in zip(paths, (slow, fast), strict=True):
        ends = np.array([segment[-1] for segment in path.get_segments()])
        assert ends == pytest.approx(episode.position_m[1:])
        assert path.norm.vmax == max(slow.time_s[-1], fast.time_s[-1])
    assert "return -7" in panels[0].get_title()
    assert panels[0].get_xlim() == panels[1].get_xlim()
    assert drawn[0].axes[2].get_ylabel() == "time (s)"


@pytest.mark.parametrize("devices", [1, 10, 100])
def test_the_hero_shows_ages_over_time_at_a_readable_size(devices: int, drawn: list[Figure], tmp_path: Path) -> None:
    episode = flight("hover", devices=devices, max_steps=60)
    figures.hero(episode, tmp_path / "hero.png")
    mesh = next(c for axes in drawn[0].axes for c in axes.collections if isinstance(c, QuadMesh))
    assert np.asarray(mesh.get_array()).shape == (devices, 60)
    assert np.asarray(mesh.get_array())[:, -1] == pytest.approx(episode.age_s[-1])
    assert min(float(text.get_fontsize()) for text in texts(drawn[0])) >= 8  # at half its size: 800 pixels wide
    with Image.open(tmp_path / "hero.png") as image:
        assert 1500 < image.width < 1750


def test_nothing_is_clipped_at_the_edge_of_a_file(tmp_path: Path) -> None:
    figures.trajectories([flight("hover", devices=30, width_m=4000.0, max_steps=5)] * 2, tmp_path / "paths.png")
    figures.objective_bars(report(a_policy_of_a_rather_long_name=-30_000.0, planner=-2000.0), tmp_path / "bars.png")
    for name in ("paths.png", "bars.png"):
        with Image.open(tmp_path / name) as image:
            pixels = np.asarray(image.convert("RGB"))
        rows, columns = (
            np.concatenate([pixels[:3], pixels[-3:]]),
            np.concatenate([pixels[:, :3], pixels[:, -3:]], axis=1),
        )
        assert (rows == 255).all()
        assert (columns == 255).all()


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        figures.hero(written_by_hand(), tmp_path / "none" / "hero.png")


def test_step_times_are_drawn_over_what_varied(tmp_path: Path, drawn: list[Figure]) -> None:
    rows = [
        {"environments": count, "devices": devices, "step_s": 1e-3 * count * devices}
        for count, devices in ((1, 10), (8, 10), (4, 10), (4, 1), (4, 100))
    ]
    figures.step_times(rows, tmp_path / "a.png")
    (figure,) = drawn
    counts, devices = (np.asarray(axes.get_lines()[0].get_xydata(), dtype=float) for axes in figure.axes)
    np.testing.assert_allclose(counts, [(1, 10), (4, 40), (8, 80)])
    np.testing.assert_allclose(devices, [(1, 4), (10, 40), (100, 400)])
    for axes in figure.axes:  # these are proportional, so the line of slope 1 lies on them
        measured, proportional = (np.asarray(line.get_xydata(), dtype=float) for line in axes.get_lines())
        np.testing.assert_allclose(proportional, measured)
    assert "10 devices" in figure.axes[0].get_xlabel()
