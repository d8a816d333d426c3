"""Comparisons in numbers: training runs and environments together, with intervals of both kinds."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavrl.evaluation.statistics import (
    Estimate,
    Interval,
    decimals,
    difference,
    estimate_mean,
    excess_cost,
    interquartile_mean,
    normalised_return,
    probability_of_improvement,
    resampling,
    run_mean,
)
from uavrl.experiments.flights import Setting, flown
from uavrl.experiments.paper import OURS, ROUND_ROBIN, YARDSTICK
from uavrl.experiments.runner import Row, grouped

Float = NDArray[np.float64]

SEED = 0  # of the resampling


class Compared(NamedTuple):
    """An algorithm, or a policy that learns nothing, beside the others."""

    name: str
    seeds: int  # 0: nothing was learned
    returned: Interval
    middle: Interval | None  # interquartile mean
    excess: Interval | None  # over the planner
    normalised: Interval | None  # 0 TDM, 100 planner
    ahead: Interval | None  # of ours: difference of the returns, paired over environments
    improves: Interval | None  # P(a run of ours returns more)
    other_return: float | None  # by the action that was not asked for
    diverged: int


def scores(rows: Sequence[Row], metric: str) -> Float:
    """A metric over seeds and environments, (R, E); NaN where it does not exist."""
    return np.stack([flown(row, metric) for row in rows])


def compare(rows: Sequence[Row], ours: str = OURS) -> list[Compared]:
    """Every variant of `rows`, in their order.

    Intervals of a return, of excess costs and of differences resample the environments, which every policy shares, and
    whole training seeds; those of `middle` and `improves` whole training seeds.
    """
    groups = grouped(rows)
    estimates = {name: estimated(scores(seeds, "return"), name) for name, seeds in groups.items()}
    found = []
    for name, seeds in groups.items():
        own, learned = scores(seeds, "return"), seeds[0]["problem"] != "policy"
        planner, tdm = estimates.get(YARDSTICK), estimates.get(ROUND_ROBIN)
        first = scores(groups[ours], "return") if ours in groups and name != ours else None
        known = [np.mean(row["scores"]["other_return"]) for row in seeds if "other_return" in row["scores"]]
        found.append(
            Compared(
                name,
                len(seeds) if learned else 0,
                estimates[name].interval(),
                interquartile_mean(own, SEED) if learned else None,
                None if planner is None else excess_cost(estimates[name], planner).interval(),
                None if planner is None or tdm is None else normalised_return(estimates[name], tdm, planner).interval(),
                None if first is None else difference(estimates[ours], estimates[name]).interval(),
                None if first is None else probability_of_improvement(first, own, SEED),
                float(np.mean(known)) if known else None,
                sum("diverged" in row["scores"] for row in seeds),
            )
        )
    return found


def estimated(values: Float, name: str = "") -> Estimate:
    """Mean of (R, E): environments resampled, the same for every policy, and whole seeds, each name's by themselves."""
    known = np.isfinite(values).all(axis=0)  # a flight without a packet has no transmission time
    environments = estimate_mean(np.where(known, values.mean(axis=0), np.nan), resampling(values.shape[1], SEED))
    if len(values) == 1 or not known.any():
        return environments
    seeds = run_mean(values[:, known], zlib.crc32(name.encode()))
    return Estimate(environments.point, environments.replicates + (seeds.replicates - seeds.point))


_FAIRNESS = {"Jain 1/age": "jain_age", "worst device, s": "worst_device_age_s"}
# Columns and their metrics, by what the objective counts: policies take different numbers of steps in equal times
PER_STEP = {"age per step, s": "age_per_step_s", "energy per step, J": "energy_per_step_j"} | _FAIRNESS
PER_SECOND = {"age per second, s": "age_per_second_s", "energy a flight, J": "energy_per_episode_j"} | _FAIRNESS


def table(rows: Sequence[Row], ours: str = OURS) -> list[list[str]]:
    """`compare` in words: a header, then a line a variant."""
    per_second = Setting.model_validate(rows[0]["options"]).scenario.objective.reward == "per_second"
    metrics = PER_SECOND if per_second else PER_STEP
    header = [
        "policy", "seeds", "return", "IQM", "over the planner, %", "0 TDM .. 100 planner", f"{ours} ahead by",
        f"P({ours} better)", "the other action", *metrics,
    ]  # fmt: skip
    lines, groups, compared = [header], grouped(rows), compare(rows, ours)
    least = min(abs(one.returned.mean) for one in compared)
    digits = decimals(least, 3)  # of the best return
    for one in compared:
        means = [_mean(scores(groups[one.name], metric)) for metric in metrics.values()]
        seeds = f"{one.seeds}" if one.seeds else ""
        lines.append(
            [
                one.name,
                seeds + (f" ({one.diverged} diverged)" if one.diverged else ""),
                interval(one.returned, digits=digits),
                interval(one.middle, digits=digits),
                interval(one.excess, 100.0, digits=1),
                interval(one.normalised, digits=0),
                interval(one.ahead, digits=max(1, digits), signed=True),
                interval(one.improves, digits=2),
                "" if one.other_return is None else f"{one.other_return:.{digits}f}",
                *means,
            ]
        )
    return lines


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table of a header and lines; a line's break within a cell is kept."""
    header, *rest = [[cell.replace("\n", "<br>") for cell in line] for line in lines]
    text = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return "\n".join([*text, *("| " + " | ".join(cells) + " |" for cells in rest)]) + "\n"


def _mean(values: Float) -> str:
    known = values[np.isfinite(values)]
    return f"{known.mean():.3g}" if len(known) else ""


def interval(value: Interval | None, scale: float = 1.0, *, digits: int | None = None, signed: bool = False) -> str:
    """mean [low, high]; none where there is nothing."""
    if value is None or not np.isfinite(value.mean):
        return ""
    mean, low, high = (number * scale for number in value)
    if digits is None:
        digits = next((count for limit, count in ((100, 0), (10, 1), (1, 2)) if abs(mean) >= limit), 3)
    sign = "+" if signed else ""
    return f"{mean:{sign}.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
