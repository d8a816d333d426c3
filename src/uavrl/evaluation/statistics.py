"""How sure a mean is: bootstrap intervals over independent environments, paired between policies.

Every estimate carries its bootstrap replicates. Estimates made from the same resampling are paired: replicate b of each
comes from the same environments, so arithmetic on them (`combine`) gives the interval of a difference or ratio on equal
flights. Estimates from different resamplings are independent, and `combine` is then the unpaired interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

Float = NDArray[np.float64]

RESAMPLES = 5_000
CONFIDENCE = 0.95


class Interval(NamedTuple):
    """An estimate with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Estimate:
    """A statistic of the sample, and the same statistic of each of B resamples."""

    point: float
    replicates: Float  # (B,)

    def interval(self) -> Interval:
        """Percentile interval; NaN throughout where the statistic does not exist."""
        known = self.replicates[np.isfinite(self.replicates)]
        if not np.isfinite(self.point) or not len(known):
            return Interval(np.nan, np.nan, np.nan)
        tail = 50.0 * (1.0 - CONFIDENCE)
        low, high = np.percentile(known, [tail, 100.0 - tail])
        return Interval(self.point, float(low), float(high))


def resampling(units: int, seed: int, resamples: int = RESAMPLES) -> Float:
    """How often each of U units occurs in each of B resamples of U, drawn with replacement (B, U)."""
    generator = np.random.default_rng(seed)
    return generator.multinomial(units, np.full(units, 1.0 / units), size=resamples).astype(np.float64)


def unit_means(values: Float, unit: NDArray[np.int64]) -> Float:
    """Mean of the values (N,) of each unit (U,), NaN left out; `unit` (N,) counts from 0."""
    known = np.isfinite(values)
    count = np.bincount(unit, weights=known)
    total = np.bincount(unit, weights=np.where(known, values, 0.0))
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def estimate_mean(values: Float, counts: Float) -> Estimate:
    """Mean over units (U,), NaN left out, under a `resampling` (B, U)."""
    known = np.isfinite(values)
    if not known.any():
        return Estimate(np.nan, np.full(len(counts), np.nan))
    weight = counts @ known.astype(np.float64)
    total = counts @ np.where(known, values, 0.0)
    replicates = np.divide(total, weight, out=np.full_like(total, np.nan), where=weight > 0)
    return Estimate(float(values[known].mean()), replicates)


def combine(function: Callable[..., Float], *estimates: Estimate) -> Estimate:
    """The statistic function(a, b, ...) of estimates; `function` is arithmetic, on numbers and arrays alike."""
    with np.errstate(divide="ignore", invalid="ignore"):
        point = function(*(np.float64(estimate.point) for estimate in estimates))
        return Estimate(float(point), function(*(estimate.replicates for estimate in estimates)))


def difference(first: Estimate, second: Estimate) -> Estimate:
    """first - second."""
    return combine(lambda a, b: a - b, first, second)


def excess_cost(returned: Estimate, planner: Estimate) -> Estimate:
    """(mean cost) / (planner's mean cost) - 1, cost = -return."""
    return combine(lambda own, best: own / best - 1.0, returned, planner)


def normalised_return(returned: Estimate, tdm: Estimate, planner: Estimate) -> Estimate:
    """The paper's scale, 0 = TDM and 100 = planner."""
    return combine(lambda own, zero, hundred: 100.0 * (own - zero) / (hundred - zero), returned, tdm, planner)


def over_seeds(values: Sequence[float]) -> Interval:
    """Mean of one number a training seed and its 95 % t interval; of two seeds the two numbers, of one itself."""
    numbers = np.array(values, dtype=np.float64)
    mean = float(numbers.mean())
    if len(numbers) < 3:
        return Interval(mean, float(numbers.min()), float(numbers.max()))
    half = float(t.ppf(0.5 + 0.5 * CONFIDENCE, len(numbers) - 1)) * float(numbers.std(ddof=1)) / len(numbers) ** 0.5
    return Interval(mean, mean - half, mean + half)


def interquartile_mean(scores: Float, seed: int, resamples: int = RESAMPLES) -> Interval:
    """Mean of the middle half of the scores of R training runs on T tasks (R, T), whole runs resampled.

    Source: Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice". Their tasks are learned apart, and
    they resample runs within each; here a run flies every task, so its tasks share its luck and stay together.
    """
    drawn = scores[_drawn_runs(len(scores), seed, resamples)]
    return Estimate(float(_middle_mean(scores.ravel())), _middle_mean(drawn.reshape(resamples, -1))).interval()


def run_mean(scores: Float, seed: int, resamples: int = RESAMPLES) -> Estimate:
    """Mean over R training runs and T tasks (R, T), whole runs resampled.

    Replicates spread as the mean of R runs does: resampling R of them spreads by sqrt((R - 1) / R) too little, which
    is made up for.
    """
    runs = len(scores)
    mean, means = float(scores.mean()), scores.mean(axis=1)
    drawn = means[_drawn_runs(runs, seed, resamples)].mean(axis=1)
    return Estimate(mean, mean + (drawn - mean) * np.sqrt(runs / max(runs - 1, 1)))


def _drawn_runs(runs: int, seed: int, resamples: int) -> NDArray[np.int64]:
    return np.random.default_rng(seed).integers(runs, size=(resamples, runs))


def _middle_mean(values: Float) -> Float:
    """Mean over the last axis without its lowest and highest quarter, as scipy's `trim_mean(values, 0.25)`."""
    count = values.shape[-1]
    cut = count // 4
    middle: Float = np.sort(values, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return middle


def probability_of_improvement(first: Float, second: Float, seed: int, resamples: int = RESAMPLES) -> Interval:
    """P(a run of `first` (R, T) scores above a run of `second` (Q, T)), ties half, averaged over tasks.

    Source: as `interquartile_mean`; whole runs are resampled, both sides independently.
    """
    wins = (first[:, None] > second[None]) + 0.5 * (first[:, None] == second[None])  # (R, Q, T)
    each = wins.mean(axis=2)  # (R, Q)
    left, right = _drawn_runs(len(first), seed, resamples), _drawn_runs(len(second), seed + 1, resamples)
    replicates = each[left[:, :, None], right[:, None]].mean(axis=(1, 2))
    return Estimate(float(wins.mean()), replicates).interval()


def decimals(value: float, significant: int) -> int:
    """Decimal places with which a number shows as many significant digits, none of a larger whole; 0 for 0."""
    return max(0, significant - 1 - math.floor(math.log10(abs(value)))) if value else 0
