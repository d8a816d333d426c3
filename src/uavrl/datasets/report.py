"""What a log holds: behaviour, coverage, choices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from uavrl.datasets.selection import training_third
from uavrl.datasets.transitions import Transitions
from uavrl.scenario import Scenario

GRID = 20  # cells along each side of the area
_SHADES = " .:-=+*#%@"


def describe(transitions: Transitions, scenario: Scenario) -> dict[str, Any]:
    """Summary of a log in JSON's types.

    An episode is complete when its steps run from 0 without a gap to a termination or truncation; the return is the
    mean over complete episodes of their summed reward, none without one (a random selection has none). `visits[j][i]`
    counts the steps that ended in the cell of column i (x) and row j (y) of a grid of 20 x 20.
    """
    t = transitions
    starts = np.flatnonzero(np.diff(t.episode, prepend=t.episode[0] - 1))
    ends = np.append(starts[1:], len(t)) - 1
    complete = (t.step[ends] == ends - starts) & (t.step[starts] == 0) & (t.terminated[ends] | t.truncated[ends])
    returns = np.add.reduceat(t.reward.astype(np.float64), starts)[complete]
    size = np.array([scenario.area.width_m, scenario.area.depth_m])
    cells = np.clip((t.next_position_m / size * GRID).astype(np.int64), 0, GRID - 1)
    visits = np.bincount(cells[:, 1] * GRID + cells[:, 0], minlength=GRID * GRID).reshape(GRID, GRID)
    lengths = np.linalg.norm(t.executed_displacement_m, axis=1)
    third = training_third(t)
    age = t.next_age_s.mean(axis=0, dtype=np.float64)
    return {
        "scenario": scenario.name,
        "devices": t.devices,
        "rows": len(t),
        "episodes": len(starts),
        "complete_episodes": int(complete.sum()),
        "layouts": len(np.unique(t.layout_m[starts], axis=0)),
        "return": float(returns.mean()) if len(returns) else None,
        "reward_per_step": _mean(t.reward),
        "age_s": _mean(age),
        "age_worst_device_s": float(age.max()),
        "energy_per_step_j": _mean(t.next_energy_j),
        "duration_s": _mean(t.duration_s),
        "coverage_share": float((visits > 0).mean()),
        "visits": visits.tolist(),
        "device_shares": (np.bincount(t.device, minlength=t.devices + 1) / len(t)).tolist(),
        "flown_m": {
            "mean": _mean(lengths),
            **{f"p{q}": float(np.percentile(lengths, q)) for q in (5, 50, 95)},
        },
        "terminated_share": _mean(t.terminated),
        "truncated_share": _mean(t.truncated),
        "thirds": [
            {
                "rows": int((third == part).sum()),
                "reward_per_step": _mean(t.reward[third == part]) if (third == part).any() else None,
            }
            for part in range(3)
        ],
    }


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean(dtype=np.float64))


def render(summary: dict[str, Any], title: str) -> RenderableType:
    """The summary as a table and a map of where the aircraft was."""
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    shares = summary["device_shares"]
    flown = summary["flown_m"]
    rows = {
        "scenario": f"{summary['scenario']}, K = {summary['devices']} devices, {summary['layouts']:,} layouts",
        "transitions": f"{summary['rows']:,}",
        "episodes": f"{summary['episodes']:,}, of which complete {summary['complete_episodes']:,}",
        "return": "no complete episode" if summary["return"] is None else f"{summary['return']:.2f} an episode",
        "reward": f"{summary['reward_per_step']:.4f} a step",
        "age": f"{summary['age_s']:.2f} s mean, {summary['age_worst_device_s']:.2f} s of the worst device",
        "energy": f"{summary['energy_per_step_j']:.2f} J a step",
        "duration": f"{summary['duration_s']:.3f} s a step",
        "flown": f"{flown['mean']:.2f} m a step (5 %: {flown['p5']:.2f}, 50 %: {flown['p50']:.2f}, "
        f"95 %: {flown['p95']:.2f})",
        "served": f"idle {shares[0]:.1%}, " + _devices(shares[1:]),
        "ended": f"terminated {summary['terminated_share']:.2%}, truncated {summary['truncated_share']:.2%} of steps",
        "thirds of training": "; ".join(
            f"{part['rows']:,} rows" + ("" if part["rows"] == 0 else f" at {part['reward_per_step']:.4f}")
            for part in summary["thirds"]
        ),
        "coverage": f"{summary['coverage_share']:.0%} of {GRID} x {GRID} cells, darker where more often:",
    }
    for name, value in rows.items():
        table.add_row(name, value)
    return Group(table, Text(heat_map(summary["visits"])))


def _devices(shares: list[float]) -> str:
    if len(shares) <= 10:
        return "devices " + " ".join(f"{share:.1%}" for share in shares)
    return f"devices {min(shares):.2%} to {max(shares):.2%}"


def heat_map(visits: list[list[int]]) -> str:
    """Visits as text, north (large y) above; a shade stands for the square root of a cell's share of the most."""
    counts = np.array(visits, dtype=np.float64)
    level = np.ceil(np.sqrt(counts / max(counts.max(), 1.0)) * (len(_SHADES) - 1)).astype(int)
    return "\n".join("".join(_SHADES[shade] * 2 for shade in row) for row in level[::-1])
