"""The table of what both sides learned: `python -m benchmarks.peers.table OUT`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.peers import settings
from benchmarks.peers.ours import best_controller
from benchmarks.peers.point_mass import Array, behaviour, fly


def interval(values: Array) -> str:
    """Mean and 95 % interval of Student's t; of a single value, the value."""
    mean = float(values.mean())
    if len(values) < 2:
        return f"{mean:.3f}"
    half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return f"{mean:.3f} [{mean - half:.3f}, {mean + half:.3f}]"


def difference(ours: Array, theirs: Array) -> str:
    """Ours less theirs with Welch's 95 % interval, seeds unpaired."""
    if min(len(ours), len(theirs)) < 2:
        return f"{ours.mean() - theirs.mean():+.3f}"
    low, high = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
    return f"{ours.mean() - theirs.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


def seed_means(out: Path, side: str, name: str) -> tuple[Array, float]:
    """Mean return of each seed, and the processor's mean seconds."""
    means, seconds = [], []
    for path in sorted(out.glob(f"{side}-{name}-*.npz")):
        with np.load(path, allow_pickle=False) as file:
            means.append(float(file["returns"].mean()))
            seconds.append(float(file["seconds"]))
    return np.array(means), float(np.mean(seconds))


def table(out: Path) -> str:
    """Markdown; the yardsticks fly the same starts and gusts, their intervals are over episodes."""
    episodes, trial = settings.TRIAL_EPISODES, settings.TRIAL_SEED
    logged = fly(behaviour(episodes, trial + 1), episodes, trial).returns
    best = fly(best_controller(), episodes, trial).returns
    lines = ["| policy | seeds | return | processor s a run |", "|---|---|---|---|"]
    lines += [f"| behaviour | | {interval(logged)} | |", f"| regulator | | {interval(best)} | |"]
    differences = []
    for name in settings.UPDATES:
        runs = {side: seed_means(out, side, name) for side in ("d3rlpy", "uavrl")}
        for side, (means, seconds) in runs.items():
            lines.append(f"| {side} {name.upper()} | {len(means)} | {interval(means)} | {seconds:.0f} |")
        differences.append(f"- {name.upper()}, ours less theirs: {difference(runs['uavrl'][0], runs['d3rlpy'][0])}")
    return "\n".join([*lines, "", *differences])


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
