"""Pictures of training, of a judgement and of flights, as PNG files. Drawn without pyplot, so no global state."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from uavrl.errors import ConfigError
from uavrl.evaluation.episode import Episode
from uavrl.evaluation.statistics import decimals
from uavrl.physics.age import age_integral_s2
from uavrl.simulation.rendering import AGE_COLOURS, BLUE, INK, draw_area, numbered

Float = NDArray[np.float64]

TIME_COLOURS = "viridis"  # safe for colour-blind readers, as the palette below (Okabe & Ito 2008)
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#222222")
_DPI = 150
_IN_A_ROW = 4  # flights of a figure of several
_CUT = 5.0  # a bar this many times as long as the lower quartile is cut, or the others could not be compared
_SMOOTH = 0.05  # share of a noisy curve that its running mean spans

AGE_METRICS = {
    "age_per_second_s": "mean age over time (s)",
    "worst_device_age_s": "mean age of the worst device (s)",
    "age_p95_s": "95th percentile of the age (s)",
}
OBJECTIVE_METRICS = {"return": "return", "excess_cost": "excess cost over the planner (%)"}
_SCALE = {"excess_cost": 100.0}  # fractions shown in per cent


def training_curves(logs: Mapping[str, Path], out: Path) -> None:
    """Return of the trial flights and each loss against the step, one curve a run.

    Args:
        logs: run's name -> its metrics.jsonl: rows with "step" and any of "return", "q" and "..._loss".
        out: PNG file.

    Raises:
        ConfigError: a log cannot be read or holds none of these, or `out` cannot be written.
    """
    runs = {name: _read_log(path) for name, path in logs.items()}
    if not runs:
        raise ConfigError("logs is empty, needed: 1 or more")
    found = {key for rows in runs.values() for row in rows for key in row}
    keys = [key for key in ("return", "q") if key in found] + sorted(key for key in found if key.endswith("_loss"))
    if not keys:
        raise ConfigError(f"log '{next(iter(logs.values()))}' holds no 'return', 'q' or '..._loss' to draw")
    last = max(row["step"] for rows in runs.values() for row in rows)
    columns = min(2, len(keys))
    lines = -(-len(keys) // columns)
    figure = Figure(figsize=(5.2 * columns, 2.8 * lines + 0.5), dpi=_DPI, layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, key in zip(grid, keys, strict=False):
        values = [
            _curve(axes, rows, key, PALETTE[i % len(PALETTE)], name) for i, (name, rows) in enumerate(runs.items())
        ]
        axes.set_title(
            {"return": "return of the trial flights", "q": "Q, mean over the batch"}.get(key, key.replace("_", " "))
        )
        axes.set_xlabel("step")
        axes.grid(color="#ececec", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(0, 1.02 * last)
        every = np.concatenate(values)
        if key.endswith("_loss") and every.size and every.min() > 0 and every.max() > 30 * every.min():
            axes.set_yscale("log")
    for axes in grid[len(keys) :]:
        axes.set_visible(False)
    handles = {line.get_label(): line for axes in grid for line in axes.get_lines() if line.get_label()[0] != "_"}
    if len(runs) > 1:
        figure.legend(
            handles.values(), [str(label) for label in handles], loc="outside upper center", ncols=4, frameon=False
        )
    _save(figure, out)


def _read_log(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"log '{path}' cannot be read: {error.strerror}") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            row = json.loads(line)
            rows.append({key: value for key, value in row.items() if value is not None} | {"step": int(row["step"])})
        except (ValueError, KeyError, TypeError, AttributeError):
            raise ConfigError(f"log '{path}', line {number}: no JSON object with an integer 'step'") from None
    return rows


def _curve(axes: Axes, rows: Sequence[Mapping[str, Any]], key: str, colour: str, name: str) -> Float:
    """Draw one run's values of a key, a long series faint under its running mean. Returns the values."""
    chosen = [row for row in rows if key in row]
    steps, values = np.array([row["step"] for row in chosen]), np.array([row[key] for row in chosen], dtype=np.float64)
    if len(values) <= 40:
        axes.plot(steps, values, color=colour, linewidth=1.8, marker="o", markersize=4, label=name)
        return values
    axes.plot(steps, values, color=colour, linewidth=0.8, alpha=0.25)
    half = max(1, int(0.5 * _SMOOTH * len(values)))
    total, index = np.concatenate([[0.0], np.cumsum(values)]), np.arange(len(values))
    first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    axes.plot(steps, (total[last] - total[first]) / (last - first), color=colour, linewidth=1.8, label=name)
    return values


def age_bars(report: Mapping[str, Any], out: Path) -> None:
    """Ages of the policies of an evaluation with 95 % intervals; `report` is the JSON of `uavrl evaluate`.

    Raises:
        ConfigError: the report holds none of the metrics, or `out` cannot be written.
    """
    metric_bars(report, AGE_METRICS, out)


def objective_bars(report: Mapping[str, Any], out: Path) -> None:
    """Return and excess cost of the policies of an evaluation with 95 % intervals; as `age_bars`."""
    metric_bars(report, OBJECTIVE_METRICS, out)


def metric_bars(report: Mapping[str, Any], metrics: Mapping[str, str], out: Path) -> None:
    """A panel a metric, a bar a policy with its 95 % interval, the numbers beside it.

    Bars of more than five times the lower quartile of the lengths are cut and hatched: their numbers stand beside.

    Args:
        report: JSON of an evaluation, `policies.<name>.<metric>.{mean,low,high}`.
        metrics: metric -> what its panel is called, with the unit.
        out: PNG file.

    Raises:
        ConfigError: no policy has any of the metrics, or `out` cannot be written.
    """
    policies = report["policies"]
    shown = [metric for metric in metrics if any(_interval(row.get(metric)) for row in policies.values())]
    if not shown:
        raise ConfigError(f"the report holds none of: {', '.join(metrics)}")
    longest = max(len(name) for name in policies)
    left_in, panel_in, height_in = 0.35 + 0.085 * min(longest, 40), 4.3, 0.27 * len(policies)
    width_in = left_in + panel_in * len(shown)
    figure = Figure(figsize=(width_in, height_in + 1.0), dpi=_DPI)
    cut = False
    for index, metric in enumerate(shown):
        bottom = 0.35 / (height_in + 1.0)
        place = (left_in + panel_in * index) / width_in, bottom, 2.6 / width_in, height_in / (height_in + 1.0)
        axes = figure.add_axes(place)
        rows = [_interval(row.get(metric)) for row in policies.values()]
        cut = _bars(axes, rows, _SCALE.get(metric, 1.0)) or cut
        axes.set_title(metrics[metric], fontsize=11, loc="left", pad=8)
        axes.set_yticks(range(len(policies)), [_short(name) for name in policies] if index == 0 else [])
    note = "whiskers and brackets: 95 % interval" + ("; hatched: the bar is cut" if cut else "")
    figure.axes[0].set_xlabel(note, fontsize=8, color="#707070", loc="left")
    _save(figure, out)


def _interval(value: Mapping[str, float | None] | None) -> tuple[float, float, float] | None:
    """(mean, low, high), or None where the metric does not exist."""
    if value is None:
        return None
    numbers = [value[key] for key in ("mean", "low", "high")]
    present = [float(number) for number in numbers if number is not None]
    return (present[0], present[1], present[2]) if len(present) == 3 else None


def _bars(axes: Axes, rows: Sequence[tuple[float, float, float] | None], scale: float) -> bool:
    """Draw a panel of bars, None where a policy has no value. Returns whether one was cut."""
    present = np.array([row for row in rows if row is not None]) * scale
    lengths = np.abs(present[:, 0])
    limit = _CUT * float(np.quantile(lengths[lengths > 0], 0.25)) if (lengths > 0).any() else 1.0
    kept = present[lengths <= limit]  # not empty: the shortest is among them
    low, high = min(0.0, float(kept.min())), max(0.0, float(kept.max()))
    pad = 0.06 * ((high - low) or 1.0)
    axes.set_xlim(low - pad if low < 0 else 0.0, high + pad if high > 0 else 0.0)
    for place, row in enumerate(rows):
        if row is None:
            text = "-"
        else:
            mean, below, above = (number * scale for number in row)
            over = abs(mean) > limit
            hatch: dict[str, Any] = {"hatch": "////", "edgecolor": "white", "linewidth": 0.0} if over else {}
            axes.barh(place, mean, 0.68, color=BLUE, alpha=0.4 if over else 0.8, **hatch)
            if not over:
                # a bootstrap interval of a skewed sample may leave out its own mean
                spread = [[max(mean - below, 0.0)], [max(above - mean, 0.0)]]
                axes.errorbar(mean, place, xerr=spread, color=INK, capsize=3, linewidth=1.2)
            text = f"{_digits(mean, limit)} [{_digits(below, limit)}, {_digits(above, limit)}]"
        axes.text(1.03, place, text, transform=axes.get_yaxis_transform(), va="center", fontsize=9, color=INK)
    axes.set_ylim(len(rows) - 0.4, -0.6)  # the first on top
    axes.locator_params(axis="x", nbins=5)
    axes.axvline(0.0, color=INK, linewidth=0.8)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="#ececec", linewidth=0.6)
    axes.set_axisbelow(True)
    return bool((lengths > limit).any())


def _digits(value: float, scale: float) -> str:
    """Three significant digits, none beyond a thousandth of `scale`, no exponent."""
    text = f"{value:.{min(decimals(value, 3), decimals(scale, 4))}f}"
    return text if float(text) else "0"


def _short(name: str) -> str:
    return name if len(name) <= 40 else f"{name[:18]}...{name[-19:]}"


def trajectories(episodes: Sequence[Episode], out: Path) -> None:
    """Flights side by side, four in a row: devices, start (square), end (cross), the path coloured by time.

    Raises:
        ConfigError: no episode, or `out` cannot be written.
    """
    if not episodes:
        raise ConfigError("episodes is empty, needed: 1 or more")
    count = len(episodes)
    tallest = max(episode.scenario.area.depth_m / episode.scenario.area.width_m for episode in episodes)
    columns = min(count, _IN_A_ROW)
    rows = -(-count // columns)
    height_in = 1.2 + 3.9 * min(tallest, 1.5)
    figure = Figure(figsize=(4.4 * columns + 0.9, height_in * rows), dpi=_DPI, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in panels[count:]:
        axes.set_visible(False)
    panels = panels[:count]
    norm = Normalize(0.0, max(float(episode.time_s[-1]) for episode in episodes))
    for index, (axes, episode) in enumerate(zip(panels, episodes, strict=True)):
        draw_area(axes, episode.scenario)
        _dots(axes, episode, ["white"] * len(episode.layout_m), INK, 4.4 * 0.75)
        _path(axes, episode, norm)
        axes.set_title(f"{_short(episode.policy)}\nreturn {episode.total_reward:.4g}", fontsize=11)
        if index % columns:
            axes.set_ylabel("")
        if index + columns < count:
            axes.set_xlabel("")
    figure.colorbar(ScalarMappable(norm, TIME_COLOURS), ax=list(panels), label="time (s)", shrink=0.85, pad=0.02)
    _save(figure, out)


def hero(episode: Episode, out: Path) -> None:
    """A flight at a glance, about 1600 pixels wide: its map, and every device's age over time.

    Raises:
        ConfigError: `out` cannot be written.
    """
    norm = Normalize(0.0, max(float(np.percentile(episode.age_s, 98)), 1e-9))
    colours = ScalarMappable(norm, AGE_COLOURS)
    mean_age_s = _device_ages_s(episode)
    figure = Figure(figsize=(8.0, 4.0), dpi=200, layout="constrained")
    figure.suptitle(f"{_short(episode.policy)}: return {episode.total_reward:.4g}", fontsize=11)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.15])
    draw_area(left, episode.scenario)
    inks = ["white" if norm(age) > 0.6 else INK for age in mean_age_s]
    _dots(left, episode, colours.to_rgba(mean_age_s), inks, 2.9)
    _path(left, episode)
    left.set_title("flight, and mean age of each device", fontsize=10)
    devices = len(episode.layout_m)
    rows = np.arange(devices + 1) + 0.5
    right.pcolormesh(episode.time_s, rows, episode.age_s[1:].T, norm=norm, cmap=AGE_COLOURS)
    right.set(xlabel="time (s)", ylabel="device")
    right.set_ylim(devices + 0.5, 0.5)
    if devices <= 20:
        right.set_yticks(range(1, devices + 1))
    right.set_title("age of information over time", fontsize=10)
    figure.colorbar(colours, ax=right, label="age (s)", extend="max", pad=0.02)
    _save(figure, out)


def _device_ages_s(episode: Episode) -> Float:
    """Time-averaged age of each device, (K,) (s)."""
    limit_s = episode.scenario.traffic.max_age_s
    integral: Float = age_integral_s2(episode.age_s[:-1], np.diff(episode.time_s), limit_s).sum(axis=0)
    mean: Float = integral / episode.time_s[-1]
    return mean


def _dots(axes: Axes, episode: Episode, faces: Any, inks: Any, side_in: float) -> None:
    """Devices as numbered dots on a map whose longer side is about `side_in` inches."""
    layout, area = episode.layout_m, episode.scenario.area
    side_m = max(area.width_m, area.depth_m)
    map_points = 72.0 * side_in * np.sqrt(area.width_m * area.depth_m) / side_m
    points = float(np.clip(0.3 * map_points / np.sqrt(len(layout)), 4.0, 15.0))
    axes.scatter(layout[:, 0], layout[:, 1], s=points**2, c=faces, edgecolors=INK, linewidths=0.8, zorder=3)
    for device in numbered(layout, 0.85 * points * side_m / (72.0 * side_in)):
        axes.text(
            layout[device, 0],
            layout[device, 1],
            str(device + 1),
            color=inks if isinstance(inks, str) else inks[device],
            fontsize=8,
            ha="center",
            va="center_baseline",
            zorder=4,
        )


def _path(axes: Axes, episode: Episode, norm: Normalize | None = None) -> None:
    """The trajectory, coloured by time if `norm` says how, with its start (square) and its end (cross)."""
    position, colours = episode.position_m, [BLUE, BLUE]
    if norm is None:
        axes.plot(position[:, 0], position[:, 1], color=BLUE, linewidth=2.2, zorder=5)
    else:
        pieces = list(np.stack([position[:-1], position[1:]], axis=1))
        lines = LineCollection(
            pieces, array=episode.time_s[:-1], cmap=TIME_COLOURS, norm=norm, linewidths=2.2, zorder=5
        )
        axes.add_collection(lines)
        colours = list(ScalarMappable(norm, TIME_COLOURS).to_rgba(episode.time_s[[0, -1]]))
    axes.plot(*position[0], marker="s", markersize=11, color="none", markeredgecolor=colours[0], mew=2.0, zorder=6)
    axes.plot(*position[-1], marker="X", markersize=10, color=colours[1], markeredgecolor=INK, mew=0.8, zorder=7)


def step_times(rows: Sequence[Mapping[str, float]], out: Path) -> None:
    """Seconds of a simulator's step over N and over K, with a line of slope 1 through the largest.

    Args:
        rows: of `uavrl.benchmarks.simulate.scaling`: "environments", "devices" and "step_s".
        out: PNG file.

    Raises:
        ConfigError: `out` cannot be written.
    """
    figure = Figure(figsize=(8.0, 3.4), dpi=_DPI, layout="constrained")
    panels = (("environments", "devices", "environments N"), ("devices", "environments", "devices K"))
    for axes, (varied, kept, title) in zip(figure.subplots(1, 2), panels, strict=True):
        values = [row[kept] for row in rows]
        common = max(set(values), key=values.count)
        points = sorted((row[varied], row["step_s"]) for row in rows if row[kept] == common)
        x, y = np.array(points).T
        axes.loglog(x, 1e3 * y, "o-", color=PALETTE[0], label="measured")
        axes.loglog(x, 1e3 * y[-1] * x / x[-1], "--", color="#999999", label="proportional")
        axes.set_xlabel(f"{title}, at {common:,.0f} {kept}")
        axes.set_ylabel("one step (ms)")
        axes.grid(color="#ececec", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False)
    _save(figure, out)


def _save(figure: Figure, out: Path) -> None:
    try:
        figure.savefig(out, format="png", bbox_inches="tight", pad_inches=0.1)
    except OSError as error:
        raise ConfigError(f"file '{out}' cannot be written: {error.strerror}") from None
