"""One flight as one HTML file: a map that plays, beside it ages and energy. No server, no network."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import plotly.io
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from uavrl.errors import ConfigError
from uavrl.evaluation.episode import Episode
from uavrl.evaluation.report import write_text
from uavrl.physics.age import age_integral_s2
from uavrl.simulation.rendering import AGE_COLOURS, BLUE, INK, MARGIN, VERMILION, numbered

Float = NDArray[np.float64]

FRAMES = 150  # what a page holds at most by default: plays in about 15 s
_FRAME_MS = 100
_CORNERS = 400  # of the drawn trajectory; a longer flight's is thinned, or its frames would outgrow the page
_DARK = 0.6  # share of the colour scale from which a number on it must be white
_GREY = "#8a8a8a"
_MAP, _AGES, _MEANS, _ENERGY = (1, 1), (1, 2), (2, 2), (3, 2)  # (row, column) of the subplots

Placed = tuple[tuple[int, int], dict[str, Any]]  # a subplot and a trace in it


def shown_steps(steps: int, frames: int = FRAMES) -> NDArray[np.int64]:
    """The states that are shown, ascending from 0 to `steps` in equal strides; the last stride may be shorter."""
    stride = max(1, -(-steps // max(frames - 1, 1)))
    return np.unique(np.append(np.arange(0, steps, stride), steps)).astype(np.int64)


def mean_ages_s(episode: Episode) -> tuple[Float, Float]:
    """Age averaged over the devices by priority: at each state, and over the time flown until then, each (T + 1,) (s).

    The second is exact: ages grow within a step. Its last value is the flight's `age_per_second_s`.
    """
    priority = np.array(episode.scenario.traffic.priority_each)
    weight = priority / priority.sum()
    duration_s = np.diff(episode.time_s)
    limit_s = episode.scenario.traffic.max_age_s
    integral = np.cumsum(age_integral_s2(episode.age_s[:-1], duration_s, limit_s) @ weight)
    return episode.age_s @ weight, np.concatenate([[0.0], integral / episode.time_s[1:]])


def episode_figure(episode: Episode, frames: int = FRAMES) -> dict[str, Any]:
    """The flight as an animated plotly figure, {"data", "layout", "frames"}, of at most `frames` frames, `frames` >= 2.

    Map, ages as bars, mean age over time and energy over time; play and pause buttons and a slider.
    """
    shown = shown_steps(episode.steps, frames)
    scene = _Scene(episode, shown)
    still, moving = scene.still(), [scene.moving(step) for step in shown.tolist()]
    figure = make_subplots(
        rows=3,
        cols=2,
        specs=[[{"rowspan": 3}, {}], [None, {}], [None, {}]],
        column_widths=[0.56, 0.44],
        row_heights=[0.4, 0.3, 0.3],
        horizontal_spacing=0.15,
        vertical_spacing=0.13,
    )
    for traces in (still, moving[0]):
        for (row, column), trace in traces:
            figure.add_trace(trace, row=row, col=column)
    figure.update_layout(**scene.layout())
    scene.axes(figure)
    figure.update_xaxes(title_font_size=13, title_standoff=6)
    figure.update_yaxes(title_font_size=13, title_standoff=8)
    # as plain data: plotly would spend seconds on validating every frame as it has the first
    changing = list(range(len(still), len(still) + len(moving[0])))
    played = [
        {"name": str(step), "data": [trace for _, trace in traces], "traces": changing}
        for step, traces in zip(shown.tolist(), moving, strict=True)
    ]
    return {**figure.to_plotly_json(), "frames": played}


def _dots(points: Float, mode: str = "markers", **style: Any) -> dict[str, Any]:
    return {"type": "scatter", "x": points[:, 0].tolist(), "y": points[:, 1].tolist(), "mode": mode, **style}


def _line(points: Float, line: dict[str, Any], **style: Any) -> dict[str, Any]:
    return _dots(points, mode="lines", line=line, hoverinfo="skip", **style)


class _Scene:
    """The traces of a flight's frames, each with its subplot (row, column)."""

    def __init__(self, episode: Episode, shown: NDArray[np.int64]) -> None:
        self.episode, self.shown = episode, shown
        self.mean_age_s, self.running_age_s = mean_ages_s(episode)
        self.used_j = np.concatenate([[0.0], np.cumsum(episode.energy_j)])
        self.total_reward = np.concatenate([[0.0], np.cumsum(episode.reward)])
        self.corners = np.arange(0, episode.steps + 1, max(1, episode.steps // _CORNERS))
        # a rare deep fade would leave all other ages one colour; the bars show its age in full
        self.oldest_s = _nice(float(np.percentile(episode.age_s[shown], 98)))
        area = episode.scenario.area
        self.side_m = max(area.width_m, area.depth_m)
        devices = len(episode.layout_m)
        self.dot_px = float(np.clip(140.0 / np.sqrt(devices), 7.0, 22.0))
        labelled = numbered(episode.layout_m, 0.85 * self.dot_px * self.side_m / 500.0)  # a map of about 500 px
        self.numbers = [str(k + 1) if k in labelled else "" for k in range(devices)]

    def still(self) -> list[Placed]:
        """What does not change: the start, and the curves over time."""
        joules, unit = self.joules
        return [
            (
                _MAP,
                _dots(
                    self.episode.position_m[:1].round(1),
                    marker={"symbol": "square-open", "size": 11, "color": BLUE, "line": {"width": 2}},
                    hovertemplate="start<br>%{x} m, %{y} m<extra></extra>",
                ),
            ),
            (_MEANS, self._curve(self.mean_age_s, "now", "s", _GREY)),
            (_MEANS, self._curve(self.running_age_s, "mean since the start", "s", BLUE)),
            (_ENERGY, self._curve(self.used_j / joules, "energy used", unit, BLUE)),
        ]

    def moving(self, step: int) -> list[Placed]:
        """What changes, as after `step` steps: path, link, devices, aircraft, bars, and a dot on each curve."""
        episode = self.episode
        here, ages = episode.position_m[step : step + 1].round(1), episode.age_s[step].round(2)
        path = episode.position_m[np.append(self.corners[self.corners < step], step)].round(1)
        device = int(episode.device[step - 1]) if step > 0 else 0
        link = np.concatenate([here, episode.layout_m[device - 1 : device].round(1)]) if device > 0 else here[:0]
        arrived = step > 0 and bool(episode.served[step - 1])
        dash = "solid" if arrived else "dot"  # a frame must say both: what it leaves out stays as it was
        devices = np.arange(1, len(ages) + 1)
        colours = {"color": ages.tolist(), "coloraxis": "coloraxis"}
        outlines = np.where(devices == device, 3.0, 1.0).tolist()
        inks = np.where(ages > _DARK * self.oldest_s, "white", INK).tolist()
        return [
            (_MAP, _line(path, {"color": BLUE, "width": 2.2}, opacity=0.75)),
            (_MAP, _line(link, {"color": INK if arrived else VERMILION, "width": 2.4, "dash": dash})),
            (
                _MAP,
                _dots(
                    episode.layout_m.round(1),
                    mode="markers+text",
                    marker=colours | {"size": self.dot_px, "opacity": 1.0, "line": {"color": INK, "width": outlines}},
                    text=self.numbers,
                    textfont={"size": 11, "color": inks},
                    customdata=devices.tolist(),
                    hovertemplate="device %{customdata}<br>%{x} m, %{y} m<br>age %{marker.color} s<extra></extra>",
                ),
            ),
            (
                _MAP,
                _dots(
                    here,
                    marker={"symbol": "x", "size": 15, "color": BLUE, "line": {"color": "white", "width": 1.5}},
                    hovertemplate="aircraft<br>%{x} m, %{y} m<extra></extra>",
                ),
            ),
            (
                _AGES,
                {
                    "type": "bar",
                    "x": devices.tolist(),
                    "y": ages.tolist(),
                    "marker": colours | {"line": {"color": INK, "width": 0.6 if len(ages) <= 40 else 0.0}},
                    "hovertemplate": "device %{x}: %{y} s<extra></extra>",
                },
            ),
            (_MEANS, self._now(step, self.mean_age_s, _GREY)),
            (_MEANS, self._now(step, self.running_age_s, BLUE)),
            (_ENERGY, self._now(step, self.used_j / self.joules[0], BLUE)),
        ]

    def _curve(self, values: Float, name: str, unit: str, colour: str) -> dict[str, Any]:
        points = np.stack([self.episode.time_s[self.shown].round(2), values[self.shown].round(4)], axis=1)
        shape = {"color": colour, "width": 1.6}
        label = f"%{{x}} s: %{{y:.3g}} {unit}<extra>{name}</extra>"
        return _line(points, shape) | {"hoverinfo": "x+y", "hovertemplate": label}

    def _now(self, step: int, values: Float, colour: str) -> dict[str, Any]:
        point = np.array([[self.episode.time_s[step].round(2), values[step].round(4)]])
        marker = {"size": 9, "color": colour, "line": {"color": "white", "width": 1.5}}
        return _dots(point, marker=marker, hoverinfo="skip")

    @property
    def joules(self) -> tuple[float, str]:
        """Divisor and unit in which the flight's energy reads well."""
        return (1000.0, "kJ") if self.used_j[-1] >= 10_000 else (1.0, "J")

    def readout(self, step: int) -> str:
        """The moment in words, for the line above the slider."""
        device = int(self.episode.device[step - 1]) if step > 0 else 0
        lost = device > 0 and not self.episode.served[step - 1]
        serves = f"device {device}{', packet lost' if lost else ''}" if device > 0 else "no device"
        return (
            f"step {step} of {self.episode.steps}  |  {self.episode.time_s[step]:.1f} s  |  {serves}  |  "
            f"mean age {self.mean_age_s[step]:.2f} s, since the start {self.running_age_s[step]:.2f} s  |  "
            f"{_number(self.used_j[step] / self.joules[0])} {self.joules[1]}  |  "
            f"return {_number(self.total_reward[step])}"
        )

    def layout(self) -> dict[str, Any]:
        """Colours of the ages, buttons and slider."""
        play = {"frame": {"duration": _FRAME_MS, "redraw": True}, "transition": {"duration": 0}, "fromcurrent": True}
        jump = {"frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}, "mode": "immediate"}
        return {
            "template": "plotly_white",
            "font": {"family": "Helvetica, Arial, sans-serif", "size": 13, "color": INK},
            "margin": {"l": 70, "r": 20, "t": 20, "b": 20},
            "showlegend": False,
            "bargap": 0.25 if len(self.episode.layout_m) <= 40 else 0.0,
            "coloraxis": {
                "colorscale": AGE_COLOURS,
                "cmin": 0.0,
                "cmax": self.oldest_s,
                "colorbar": {
                    "title": {"text": "age (s)", "side": "right", "font": {"size": 13}},
                    "thickness": 14,
                    "x": 0.475,
                    "xanchor": "left",
                    "len": 0.9,
                    "outlinewidth": 0,
                },
            },
            "updatemenus": [
                {
                    "type": "buttons",
                    "direction": "right",
                    "x": 0.0,
                    "xanchor": "left",
                    "y": 0.0,
                    "yanchor": "top",
                    "pad": {"t": 84, "r": 10},
                    "showactive": False,
                    "buttons": [
                        {"label": "&#9654; Play", "method": "animate", "args": [None, play]},
                        {"label": "&#10074;&#10074; Pause", "method": "animate", "args": [[None], jump]},
                    ],
                }
            ],
            "sliders": [
                {
                    "active": 0,
                    "x": 0.17,
                    "len": 0.83,
                    "y": 0.0,
                    "yanchor": "top",
                    "pad": {"t": 56, "b": 6},
                    "ticklen": 0,
                    "minorticklen": 0,
                    "font": {"color": "rgba(0,0,0,0)", "size": 1},  # a label a step would overlap: the readout has it
                    "currentvalue": {"xanchor": "left", "font": {"size": 14, "color": INK}},
                    "steps": [
                        {"label": self.readout(step), "method": "animate", "args": [[str(step)], jump]}
                        for step in self.shown.tolist()
                    ],
                }
            ],
        }

    def axes(self, figure: go.Figure) -> None:
        """Titles, units and ranges that hold for all frames."""
        area, margin_m = self.episode.scenario.area, MARGIN * self.side_m
        devices = len(self.episode.layout_m)
        figure.update_xaxes(
            title="x (m)", range=[-margin_m, area.width_m + margin_m], constrain="domain", zeroline=False, row=1, col=1
        )
        figure.update_yaxes(
            title="y (m)",
            range=[-margin_m, area.depth_m + margin_m],
            scaleanchor="x",
            constrain="domain",
            zeroline=False,
            row=1,
            col=1,
        )
        figure.add_shape(
            type="rect", x0=0, y0=0, x1=area.width_m, y1=area.depth_m, line={"color": "#9a9a9a", "width": 1},
            layer="below", row=1, col=1,
        )  # fmt: skip
        ticks = {"dtick": 1} if devices <= 20 else {}
        figure.update_xaxes(title="device", range=[0.4, devices + 0.6], showgrid=False, row=1, col=2, **ticks)
        oldest = 1.05 * float(self.episode.age_s[self.shown].max())
        figure.update_yaxes(title="age (s)", range=[0.0, oldest], row=1, col=2)
        figure.update_yaxes(title="mean age (s)", rangemode="tozero", row=2, col=2)
        figure.update_yaxes(title=f"energy used ({self.joules[1]})", rangemode="tozero", row=3, col=2)
        figure.update_xaxes(title="time (s)", rangemode="tozero", row=3, col=2)
        figure.update_xaxes(rangemode="tozero", matches="x4", showticklabels=True, row=2, col=2)
        for text, colour, x in (("now", _GREY, 0.0), ("mean since the start", BLUE, 0.12)):
            figure.add_annotation(
                text=f"<b>{text}</b>", font={"color": colour, "size": 12}, showarrow=False,
                x=x, y=1.0, xref="x3 domain", yref="y3 domain", xanchor="left", yanchor="bottom",
            )  # fmt: skip


def _nice(value: float) -> float:
    """The next of 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 x 10^n: a scale's end that is easy to read. 1 for zero."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        next(
            mark * power
            for mark in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
            if mark * power >= value * 0.999
        )
    )


def _number(value: float) -> str:
    """Four significant digits, or all of a larger whole, without an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
  body {{ margin: 0; padding: 14px 22px; color: #222; background: #fff; font-family: Helvetica, Arial, sans-serif; }}
  main {{ min-width: 940px; max-width: 1500px; margin: 0 auto; }}
  h1 {{ font-size: 22px; margin: 0 0 4px; overflow-wrap: anywhere; }}
  p {{ font-size: 14px; line-height: 1.45; margin: 0 0 6px; color: #444; }}
  .flight {{ height: max(620px, calc(100vh - 150px)); max-height: 900px; }}
</style>
</head>
<body>
<main>
<h1>{heading}</h1>
<p>{summary}</p>
<div class="flight">{figure}</div>
<p>{legend}</p>
</main>
</body>
</html>
"""


def episode_page(episode: Episode, frames: int = FRAMES) -> str:
    """The flight as a self-contained HTML page of at most `frames` frames; about 5 MB, most of it plotly's own code.

    Raises:
        ConfigError: fewer than 2 frames, or a flight without a step.
    """
    if frames < 2:
        raise ConfigError(f"frames = {frames}, allowed: 2 or more")
    if episode.steps == 0:
        raise ConfigError(f"the flight of '{episode.policy}' has no step to show")
    figure = episode_figure(episode, frames)
    oldest_s = figure["layout"]["coloraxis"]["cmax"]
    stride = int(np.diff(shown_steps(episode.steps, frames)).max())
    mean, running = mean_ages_s(episode)
    packets = int((episode.device > 0).sum())
    lost = packets - int(episode.served.sum())
    each = "every step is shown" if stride == 1 else f"one step in {stride} is shown"
    name, scenario = escape(episode.policy), escape(episode.scenario.name)
    return _PAGE.format(
        title=f"{name}: a flight in scenario {scenario}",
        heading=f"{name}: return {_number(episode.total_reward)}",
        summary=(
            f"One flight in scenario <b>{scenario}</b>, {len(episode.layout_m)} devices: "
            f"{episode.steps} steps in {episode.time_s[-1]:.1f} s, {each}. "
            f"{packets} packets sent, {lost} lost; mean age {running[-1]:.3g} s over time and {mean[1:].mean():.3g} s "
            f"over steps; {_number(episode.energy_j.sum())} J used."
        ),
        legend=(
            f"Dots are devices, coloured by the age of their information (darkest: {oldest_s:g} s or more). "
            "Cross: the aircraft; square: its start; blue line: where it has been. "
            "Black line: the device that it has just served; dotted: a packet that was lost."
        ),
        figure=plotly.io.to_html(
            figure,
            validate=False,
            full_html=False,
            include_plotlyjs=True,
            auto_play=False,
            default_height="100%",
            config={"responsive": True, "displaylogo": False, "modeBarButtonsToRemove": ["select2d", "lasso2d"]},
        ),
    )


def write_page(episode: Episode, path: Path, frames: int = FRAMES) -> None:
    """Write `episode_page` to a file.

    Raises:
        ConfigError: as `episode_page`, or the file cannot be written.
    """
    write_text(path, episode_page(episode, frames))
