"""A picture of one moment of a flight, drawn without pyplot: no window, no global state, safe beside a user's plots."""

from __future__ import annotations

from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from uavrl.scenario import Scenario

Float = NDArray[np.float64]

# Safe for colour-blind readers: ColorBrewer's YlOrRd (pale fresh, dark stale), and Okabe & Ito's blue and vermilion.
AGE_COLOURS = "YlOrRd"
BLUE = "#0072B2"
VERMILION = "#D55E00"
INK = "#222222"

MARGIN = 0.04  # of the larger side, around the area: devices on its border are drawn whole
YOUNGEST_S = 0.1  # ages below share one colour: the logarithmic scale needs an end, and a packet takes about this
NUMBERED = 30  # with more devices their numbers would be too small to read

_LOCK = Lock()  # frames of one scenario share a canvas


def dot_points(devices: int) -> float:
    """Diameter of a device's dot (points) that K = 1 and K = 100 both bear."""
    return float(np.clip(120.0 / np.sqrt(devices), 6.0, 17.0))


def numbered(layout_m: Float, apart_m: float) -> NDArray[np.intp]:
    """Devices (indices into layout_m (K, 2)) whose number can be written in their dot, dots lying in order of index.

    Of two closer than `apart_m` the one on top keeps its number; with more than `NUMBERED` devices none has one.
    """
    if len(layout_m) > NUMBERED:
        return np.empty(0, dtype=np.intp)
    gap_m = np.linalg.norm(layout_m[:, None] - layout_m[None], axis=2)
    return np.flatnonzero(~np.triu(gap_m < apart_m, 1).any(axis=1))


def draw_area(axes: Axes, scenario: Scenario) -> None:
    """The empty map: equal scales, the area's border, axes in metres."""
    width_m, depth_m = scenario.area.width_m, scenario.area.depth_m
    margin_m = MARGIN * max(width_m, depth_m)
    axes.set(xlim=(-margin_m, width_m + margin_m), ylim=(-margin_m, depth_m + margin_m))
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal")
    axes.set_axisbelow(True)
    axes.grid(color="#ececec", linewidth=0.6)
    axes.add_patch(Rectangle((0.0, 0.0), width_m, depth_m, fill=False, edgecolor="#9a9a9a", linewidth=0.8))


@lru_cache(maxsize=4)
def _stage(scenario: Scenario) -> tuple[FigureCanvasAgg, Axes, Any, LogNorm]:
    """What all frames of a scenario share, drawn once: canvas, axes, its pixels, and the scale of the ages."""
    figure = Figure(figsize=(6.4, 5.6), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.115, 0.1, 0.72, 0.82))
    draw_area(axes, scenario)
    norm = LogNorm(YOUNGEST_S, max(scenario.traffic.max_age_s, 10.0 * YOUNGEST_S))
    bar = figure.colorbar(ScalarMappable(norm, AGE_COLOURS), cax=figure.add_axes((0.86, 0.1, 0.025, 0.82)))
    bar.set_label("age of information (s)")
    bar.ax.minorticks_off()
    bar.ax.yaxis.set_major_formatter("{x:g}")
    canvas.draw()  # type: ignore[no-untyped-call]  # matplotlib leaves it untyped
    empty = canvas.copy_from_bbox(figure.bbox)  # type: ignore[no-untyped-call]  # matplotlib leaves it untyped
    return canvas, axes, empty, norm


def draw_frame(scenario: Scenario, layout_m: Float, path_m: Float, age_s: Float, served: int) -> NDArray[np.uint8]:
    """The map: devices coloured by age, the trajectory so far, the aircraft and the link to the device it served.

    The colours are those of one logarithmic scale, from 0.1 s to the scenario's largest age, so that frames compare.

    Args:
        scenario: gives the area's size and the largest age.
        layout_m: (K, 2) device positions (m).
        path_m: (T, 2) positions since the episode began, the present one last (m), T >= 1.
        age_s: (K,) ages (s).
        served: the device served last, 1..K; 0 draws no link.

    Returns:
        RGB image (560, 640, 3).
    """
    with _LOCK:
        canvas, axes, empty, norm = _stage(scenario)
        canvas.restore_region(empty)  # type: ignore[no-untyped-call]  # matplotlib leaves it untyped
        here = path_m[-1]
        artists: list[Any] = []
        artists += axes.plot(path_m[:, 0], path_m[:, 1], color=BLUE, linewidth=1.6, alpha=0.8)
        artists += axes.plot(*path_m[0], marker="s", markersize=6, color="white", markeredgecolor=BLUE)
        if served > 0:
            ends = np.stack([here, layout_m[served - 1]])
            artists += axes.plot(ends[:, 0], ends[:, 1], color=INK, linewidth=2.0, linestyle=(0, (3, 1.5)))
        points = dot_points(len(layout_m))
        artists.append(
            axes.scatter(
                layout_m[:, 0],
                layout_m[:, 1],
                c=np.maximum(age_s, YOUNGEST_S),
                norm=norm,
                cmap=AGE_COLOURS,
                s=points**2,
                edgecolors=INK,
                linewidths=[2.6 if device == served else 0.9 for device in range(1, len(layout_m) + 1)],
            )
        )
        pixel = axes.transData.inverted().transform([(0.0, 0.0), (1.0, 0.0)])
        metres_a_point = float(pixel[1, 0] - pixel[0, 0]) * canvas.figure.dpi / 72.0
        for device in numbered(layout_m, 0.85 * points * metres_a_point):
            age = max(float(age_s[device]), YOUNGEST_S)
            artists.append(
                axes.text(
                    layout_m[device, 0],
                    layout_m[device, 1],
                    str(device + 1),
                    color="white" if norm(age) > 0.6 else INK,
                    fontsize=9,
                    ha="center",
                    va="center_baseline",
                )
            )
        artists += axes.plot(*here, marker="X", markersize=13, color=BLUE, markeredgecolor="white")
        link = f"serves {served}" if served > 0 else "serves none"
        ages = f"age: mean {age_s.mean():.3g} s, oldest {age_s.max():.3g} s"
        title = f"step {len(path_m) - 1}   {link}   {ages}"
        artists.append(
            axes.annotate(
                title, (0.5, 1.0), (0.0, 6.0), "axes fraction", textcoords="offset points", ha="center", fontsize=10
            )
        )
        for artist in artists:
            axes.draw_artist(artist)
            artist.remove()
        pixels = canvas.buffer_rgba()  # type: ignore[no-untyped-call]  # matplotlib leaves it untyped
        return np.asarray(pixels, dtype=np.uint8)[:, :, :3].copy()
