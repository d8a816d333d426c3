"""The paper's figures, for print: first the numbers that are drawn, as a CSV, then PNG and PDF of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import StrMethodFormatter

from uavrl.evaluation.report import write_text
from uavrl.evaluation.statistics import over_seeds
from uavrl.experiments.flights import SHOWN, flown
from uavrl.experiments.paper import ALGORITHMS, FIGURES, ONLINE, ROUND_ROBIN, YARDSTICK, Figure
from uavrl.experiments.runner import Row, grouped

Point = dict[str, Any]  # of the CSV

LABELS = {
    "return": "return",
    "age_per_step_s": "age per step (s)",
    "energy_per_step_j": "UAV energy per step (J)",
    "transmission_median_s": "transmission time,\nmedian (s)",
    "transmission_mean_s": "transmission time,\nmean (s)",
    "data_mb": "data per episode (MB)",
    "throughput_mbps": "throughput (Mbit/s)",
    "jain_age": "Jain's index of 1/age",
    "worst_device_age_s": "age of the worst\ndevice (s)",
    "decision_ms": "decision (ms)",
}
PANELS: dict[str, tuple[str, ...]] = {
    "curves": SHOWN,
    "lines": ("return",),
    "bars": ("return",),
    "front": ("age_per_step_s", "energy_per_step_j"),
    "fairness": ("jain_age", "worst_device_age_s"),
    "rates": ("transmission_median_s", "transmission_mean_s", "throughput_mbps", "data_mb"),
}
# Okabe and Ito's colours, which the colour-blind can tell apart
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_MARKERS = "osD^vPX"
_STYLE: Any = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}
_WIDTH_IN = 7.16  # two columns of the usual journals
_DPI = 220


def _metric(row: Row, name: str) -> float:
    if name == "decision_ms":
        return float(row["scores"]["decision_ms"])
    known = flown(row, name)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else float("nan")


def numbers(figure: Figure, rows: Sequence[Row]) -> list[Point]:
    """What a figure draws: of every variant and metric mean, low, high and seeds; of curves, at every point too."""
    metrics = PANELS[figure.kind] + (("decision_ms",) if "denoising" in figure.axis else ())
    points: list[Point] = []
    for variant, seeds in grouped(rows).items():
        name, _, at = variant.partition(" @ ")
        for metric in metrics:
            for place, values in _over_updates(seeds, metric) if figure.kind == "curves" else ():
                points.append(_point(name, place, metric, values, seeds))
            last = [_metric(row, metric) for row in seeds]
            points.append(_point(name, "final" if figure.kind == "curves" else at, metric, last, seeds))
    return points


def _over_updates(seeds: Sequence[Row], metric: str) -> Iterable[tuple[float, list[float]]]:
    """(updates, value of each seed) where every seed has one."""
    curves = [row["scores"].get("curve") for row in seeds]
    if any(curve is None for curve in curves):
        return
    for index in range(min(len(curve["at"]) for curve in curves if curve is not None)):
        yield curves[0]["at"][index], [curve[metric][index] for curve in curves if curve is not None]


def _point(name: str, at: Any, metric: str, values: list[float], seeds: Sequence[Row]) -> Point:
    learned = seeds[0]["problem"] != "policy"
    return {"name": name, "at": at, "metric": metric} | over_seeds(values)._asdict() | {"seeds": len(seeds) * learned}


def draw(name: str, rows: Sequence[Row], out: Path) -> list[Path]:
    """Write out/NAME.csv, .png and .pdf.

    Raises:
        ConfigError: a file cannot be written.
    """
    figure = FIGURES[name]
    points = numbers(figure, rows)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(points[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _short(value) for key, value in point.items()} for point in points)
    write_text(out / f"{name}.csv", text.getvalue())
    with matplotlib.rc_context(_STYLE):
        canvas = _DRAWN[figure.kind](figure, points)
        paths = [out / f"{name}.png", out / f"{name}.pdf"]
        # no date inside, so that the same numbers make the same file
        canvas.savefig(paths[0], dpi=_DPI, bbox_inches="tight", pad_inches=0.04, metadata={"Software": None})
        canvas.savefig(paths[1], bbox_inches="tight", pad_inches=0.04, metadata={"CreationDate": None})
    return [out / f"{name}.csv", *paths]


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def _panels(count: int, height_in: float = 2.3, width_in: float = _WIDTH_IN) -> tuple[Canvas, list[Axes]]:
    canvas = Canvas(figsize=(width_in, height_in), layout="constrained")
    every = list(canvas.subplots(1, count, squeeze=False)[0])
    for axes in every:
        axes.grid(color="#e6e6e6", linewidth=0.5)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return canvas, every


def _look(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """(colour, marker) of each name; an algorithm has the same in every figure."""
    own = {name: index for index, name in enumerate([*ALGORITHMS, ONLINE])}
    free = iter(index for index in range(99) if index not in {own.get(name) for name in names})
    chosen = {name: own[name] if name in own else next(free) for name in names}
    return {name: (_COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]) for name, index in chosen.items()}


def _learned(points: Sequence[Point]) -> list[str]:
    return list(dict.fromkeys(point["name"] for point in points if point["seeds"]))


def _chosen(points: Sequence[Point], **wanted: Any) -> list[Point]:
    return [point for point in points if all(point[key] == value for key, value in wanted.items())]


def _references(
    axes: Axes, points: Sequence[Point], metric: str, low: float, high: float, *, left: bool = False
) -> list[str]:
    """Dashed lines of what needs no learning, named at an end; those outside [low, high] are returned as text."""
    outside: list[str] = []
    close: list[list[Point]] = []  # lines, from above, whose names would cover each other
    for point in sorted(_chosen(points, metric=metric, seeds=0), key=lambda point: -point["mean"]):
        if not low <= point["mean"] <= high:
            shown = ",.0f" if abs(point["mean"]) >= 1000 else ".4g"
            outside.append(f"{point['name']} {point['mean']:{shown}}")
            continue
        axes.axhline(point["mean"], color="#777777", linestyle=(0, (4, 2)), linewidth=0.8, zorder=1)
        if close and close[-1][-1]["mean"] - point["mean"] < 0.07 * (high - low):
            close[-1].append(point)
        else:
            close.append([point])
    for group in close:
        names = ", ".join(point["name"] for point in group)
        place: Any = {"xycoords": axes.get_yaxis_transform(), "fontsize": 6, "color": "#555555", "va": "bottom"}
        axes.annotate(names, (0.005 if left else 0.995, group[0]["mean"]), ha="left" if left else "right", **place)
    return outside


def _limits(points: Sequence[Point], extra: Sequence[float]) -> tuple[float, float]:
    """A range that shows how what was learned ends, and `extra`, with some air."""
    values = [value for point in points for value in (point["low"], point["mean"], point["high"])] + list(extra)
    low, high = min(values), max(values)
    pad = 0.08 * ((high - low) or abs(high) or 1.0)
    return low - pad, high + pad


def _outside(axes: Axes, names: Sequence[str]) -> None:
    if names:
        lines = [", ".join(names[i : i + 2]) for i in range(0, len(names), 2)]  # a longer one pushes the panels apart
        text = "not shown: " + ",\n".join(lines)
        axes.text(0.02, 0.02, text, transform=axes.transAxes, fontsize=5.5, color="#777777")


_LAST = "its last policy, deterministic"


def _curves(figure: Figure, points: Sequence[Point]) -> Canvas:
    canvas, every = _panels(len(SHOWN))
    names = _learned(points)
    look = _look(names)
    for axes, metric in zip(every, SHOWN, strict=True):
        ends = [point for point in _chosen(points, metric=metric, at="final") if point["seeds"]]
        shown = _spanned(_chosen(points, metric=metric))
        late = [p for p in points if p["metric"] == metric and p["seeds"] and p["at"] != "final"]
        half = 0.4 * max((p["at"] for p in late), default=0)
        low, high = _limits([*ends, *(p for p in late if p["at"] > half)], shown)
        for name in names:
            line = [p for p in late if p["name"] == name]
            x = [p["at"] for p in line]
            colour, marker = look[name]
            label = name
            if name == ONLINE:  # it explores while it learns: what it ends at is judged apart
                label += ", while learning"
            axes.plot(x, [p["mean"] for p in line], color=colour, marker=marker, label=label, zorder=3)
            if name == ONLINE:
                (end,) = (p for p in ends if p["name"] == name)
                axes.plot(x[-1], end["mean"], color="black", marker="*", ms=8, ls="none", label=_LAST, zorder=4)
            axes.fill_between(x, [p["low"] for p in line], [p["high"] for p in line], color=colour, alpha=0.15, lw=0)
        _outside(axes, _references(axes, points, metric, low, high, left=names == [ONLINE]))
        axes.set_ylim(low, high)
        axes.set_title(LABELS[metric])
        axes.set_xlabel("flights" if names == [ONLINE] else "updates")
    _legend(canvas, every[0], len(names) + (ONLINE in names))
    return canvas


def _spanned(points: Sequence[Point]) -> list[float]:
    """Of what needs no learning, the means that an axis has room for in any case."""
    return [p["mean"] for p in points if not p["seeds"] and p["name"] in (ROUND_ROBIN, YARDSTICK)]


_LETTERS = 92  # of a legend's line across the page


def _legend(canvas: Canvas, axes: Axes, count: int) -> None:
    handles, labels = axes.get_legend_handles_labels()
    columns = min(count, max(1, _LETTERS // max(map(len, labels), default=1)))  # wider, it would shrink the panels
    canvas.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, handlelength=1.6)


def _lines(figure: Figure, points: Sequence[Point]) -> Canvas:
    metrics = list(dict.fromkeys(point["metric"] for point in points))
    canvas, every = _panels(len(metrics), width_in=_WIDTH_IN if len(metrics) > 1 else 0.62 * _WIDTH_IN)
    names = _learned(points)
    look = _look(names)
    for axes, metric in zip(every, metrics, strict=True):
        own = [point for point in points if point["metric"] == metric and point["seeds"]]
        swept = [point for point in own if point["at"]]
        references = _spanned(_chosen(points, metric=metric))
        low, high = _limits(own, references if metric == "return" else [0.0])
        for name in names:
            line = [point for point in swept if point["name"] == name]
            colour, marker = look[name]
            if not line:  # a baseline without the swept setting
                (point,) = _chosen(own, name=name)
                axes.axhline(point["mean"], color=colour, linestyle=":", label=name)
                continue
            x = [float(point["at"].replace(",", "")) for point in line]
            if metric == "decision_ms" and len(x) > 1:
                slope = f"{name}: {np.polyfit(x, [p['mean'] for p in line], 1)[0]:.3f} ms a step"
                height = 0.95 - 0.09 * len(axes.texts)  # in the corner that rising lines leave free
                axes.text(0.03, height, slope, transform=axes.transAxes, va="top", fontsize=6, color=colour)
            error = np.array([[p["mean"] - p["low"], p["high"] - p["mean"]] for p in line]).T
            axes.errorbar(
                x, [p["mean"] for p in line], yerr=np.maximum(error, 0), color=colour, marker=marker, capsize=2,
                label=name,
            )  # fmt: skip
        if metric == "return":
            _outside(axes, _references(axes, points, metric, low, high))
        axes.set_ylim(low, high)
        axes.set_title(LABELS[metric])
        axes.set_xlabel(figure.axis)
    _legend(canvas, every[0], len(names) if len(metrics) > 1 else 3)
    return canvas


def _bars(figure: Figure, points: Sequence[Point]) -> Canvas:
    canvas, (axes,) = _panels(1, width_in=0.62 * _WIDTH_IN)
    names = _learned(points)
    look = _look(names)
    own = [point for point in points if point["seeds"]]
    places = list(dict.fromkeys(point["at"] for point in own))
    references = _spanned(points)
    # the worst may be far below: what is compared are the others
    low, high = _limits([p for p in own if p["mean"] > 4 * max(q["mean"] for q in own)], references)
    width = 0.8 / len(names)
    for index, name in enumerate(names):
        line = [_chosen(own, name=name, at=at)[0] for at in places]
        x = np.arange(len(places)) + (index - (len(names) - 1) / 2) * width
        error = np.array([[p["mean"] - p["low"], p["high"] - p["mean"]] for p in line]).T
        axes.errorbar(
            x, [p["mean"] for p in line], yerr=np.maximum(error, 0), fmt=look[name][1], color=look[name][0], capsize=2,
            label=name,
        )  # fmt: skip
        for at, point in zip(x, line, strict=True):
            if point["mean"] < low:
                text: Any = {"ha": "center", "va": "bottom", "fontsize": 6, "color": look[name][0], "rotation": 90}
                text["bbox"] = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}  # a bar may come from there
                axes.annotate(f"{point['mean']:.0f}", (at, low), xytext=(0, 3), textcoords="offset points", **text)
    beyond = _references(axes, points, "return", low, high)
    if beyond:  # below the axes: within them stand the numbers of points that are too low
        axes.set_xlabel("not shown: " + ", ".join(beyond), fontsize=6, color="#777777", loc="left")
    axes.set_ylim(low, high)
    axes.set_xticks(range(len(places)), places)
    axes.set_xlim(-0.6, len(places) - 0.4)
    axes.set_title(LABELS["return"])
    _legend(canvas, axes, 3)
    return canvas


def _front(figure: Figure, points: Sequence[Point]) -> Canvas:
    canvas, (axes,) = _panels(1, height_in=3.6, width_in=0.75 * _WIDTH_IN)
    names = _learned(points)
    look = _look(names)
    corners = ((3, 3), (-3, 3), (3, -3), (-3, -3))  # of a point, a different one for each algorithm's labels
    for index, name in enumerate(names):
        age = _chosen(points, name=name, metric="age_per_step_s")
        energy = _chosen(points, name=name, metric="energy_per_step_j")
        colour, marker = look[name]
        axes.plot([p["mean"] for p in age], [p["mean"] for p in energy], color=colour, marker=marker, label=name)
        at: dict[tuple[float, float], list[str]] = {}  # who does not see lambda has one point for all of them
        for a, e in zip(age, energy, strict=True):
            at.setdefault((a["mean"], e["mean"]), []).append(a["at"])
        x, y = corners[index % len(corners)]
        place: Any = {"ha": "left" if x > 0 else "right", "va": "bottom" if y > 0 else "top"}
        for point, weights in at.items():
            axes.annotate(
                ", ".join(weights), point, xytext=(x, y), textcoords="offset points", fontsize=6, color=colour, **place
            )
    axes.set_xscale("log")
    for axis in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        axis(StrMethodFormatter("{x:g}"))
    axes.set_xlabel(LABELS["age_per_step_s"])
    axes.set_ylabel(LABELS["energy_per_step_j"])
    axes.set_title("the numbers at the points are lambda, the weight of the age")
    _legend(canvas, axes, 5)
    return canvas


def _columns(figure: Figure, points: Sequence[Point]) -> Canvas:
    """A panel a metric, a horizontal bar a policy."""
    metrics = PANELS[figure.kind]
    names = list(dict.fromkeys(point["name"] for point in points))
    canvas, every = _panels(len(metrics), height_in=0.5 + 0.2 * len(names))
    look = _look([name for name in names if name in ALGORITHMS])
    for index, (axes, metric) in enumerate(zip(every, metrics, strict=True)):
        chosen = [_chosen(points, name=name, metric=metric)[0] for name in names]
        ordered = sorted(point["mean"] for point in chosen if np.isfinite(point["mean"]))
        limit = 3.0 * ordered[len(ordered) // 2] if ordered else 1.0
        for place, point in enumerate(chosen):
            colour = look[point["name"]][0] if point["name"] in look else "#999999"
            cut: Any = {"hatch": "////", "edgecolor": "white", "linewidth": 0.0} if point["mean"] > limit else {}
            axes.barh(place, min(point["mean"], limit), color=colour, height=0.7, **cut)
            error = [[max(point["mean"] - point["low"], 0.0)], [max(point["high"] - point["mean"], 0.0)]]
            if point["seeds"] and point["mean"] <= limit:
                axes.errorbar(point["mean"], place, xerr=error, color="black", capsize=1.5, linewidth=0.8)
            text = f"{point['mean']:.3g}" if np.isfinite(point["mean"]) else "-"
            axes.annotate(text, (1.01, place), xycoords=axes.get_yaxis_transform(), va="center", fontsize=6)
        axes.set_yticks(range(len(names)), names if index == 0 else [])
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_title(LABELS[metric], pad=8)
        axes.grid(axis="y", visible=False)
    if any(bar.get_hatch() for axes in every for bar in axes.patches):
        every[0].set_xlabel("hatched: the bar is cut", fontsize=6, color="#777777", loc="left")
    return canvas


_DRAWN = {
    "curves": _curves,
    "lines": _lines,
    "bars": _bars,
    "front": _front,
    "fairness": _columns,
    "rates": _columns,
}
