from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from uavrl.evaluation.statistics import (
    Estimate,
    decimals,
    difference,
    estimate_mean,
    excess_cost,
    interquartile_mean,
    normalised_return,
    over_seeds,
    probability_of_improvement,
    resampling,
    run_mean,
    unit_means,
)

VALUES = np.array([3.0, -1.0, 4.0, 1.0, 5.0, 9.0])
OTHERS = np.array([2.0, 7.0, 1.0, 8.0, 2.0, 8.0])


def resamples(counts: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> list[list[int]]:
    """The drawn units of each resample, written out."""
    return [[unit for unit, count in enumerate(row) for _ in range(int(count))] for row in counts]


def test_every_resample_draws_as_many_units_as_there_are_uniformly() -> None:
    counts = resampling(6, seed=1, resamples=4000)
    assert (counts.sum(axis=1) == 6).all()
    assert counts.mean(axis=0) == pytest.approx(np.ones(6), abs=0.06)
    assert counts.var(axis=0) == pytest.approx(np.full(6, 5 / 6), abs=0.08)
    assert np.array_equal(counts, resampling(6, seed=1, resamples=4000))
    assert not np.array_equal(counts, resampling(6, seed=2, resamples=4000))


def test_means_differences_and_ratios_agree_with_resampling_by_hand() -> None:
    counts = resampling(6, seed=0, resamples=500)
    first, second = estimate_mean(VALUES, counts), estimate_mean(OTHERS, counts)
    drawn = resamples(counts)
    by_hand = np.array([VALUES[units].mean() for units in drawn])
    assert first.replicates == pytest.approx(by_hand)
    assert first.interval() == pytest.approx((3.5, *np.percentile(by_hand, [2.5, 97.5])))
    paired = np.array([(VALUES[units] - OTHERS[units]).mean() for units in drawn])
    assert difference(first, second).interval() == pytest.approx((-7 / 6, *np.percentile(paired, [2.5, 97.5])))
    ratio = np.array([VALUES[units].sum() / OTHERS[units].sum() - 1 for units in drawn])
    assert excess_cost(first, second).interval() == pytest.approx((21 / 28 - 1, *np.percentile(ratio, [2.5, 97.5])))


def test_the_interval_is_that_of_the_bootstrap_in_scipy() -> None:
    values = np.random.default_rng(4).exponential(size=80)
    ours = estimate_mean(values, resampling(80, seed=0)).interval()
    theirs = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=5000, rng=1).confidence_interval
    assert ours.mean == pytest.approx(values.mean())
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.015)


def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(8)
    counts = resampling(40, seed=0, resamples=400)
    intervals = [estimate_mean(generator.normal(size=40), counts).interval() for _ in range(400)]
    assert 0.90 <= np.mean([low <= 0 <= high for _, low, high in intervals]) <= 0.98


def test_pairing_removes_what_environments_share() -> None:
    generator = np.random.default_rng(2)
    hard = 100 * generator.normal(size=50)
    counts = resampling(50, seed=0)
    first, second = estimate_mean(hard, counts), estimate_mean(hard - 1 + 0.1 * generator.normal(size=50), counts)
    _, low, high = difference(first, second).interval()
    assert 0.9 < low < 1 < high < 1.1
    apart = estimate_mean(hard - 1, resampling(50, seed=1))
    _, low, high = difference(first, apart).interval()
    assert high - low > 20  # resampled apart, the difference has both spreads


def test_the_same_policy_compared_with_itself_differs_by_exactly_nothing() -> None:
    estimate = estimate_mean(VALUES, resampling(6, seed=0))
    assert difference(estimate, estimate).interval() == (0, 0, 0)
    assert excess_cost(estimate, estimate).interval() == (0, 0, 0)


def test_normalised_return_is_0_at_tdm_and_100_at_the_planner() -> None:
    counts = resampling(6, seed=0)
    tdm, planner = estimate_mean(VALUES - 30, counts), estimate_mean(VALUES - 10, counts)
    middle = estimate_mean(VALUES - 15, counts)
    assert normalised_return(tdm, tdm, planner).interval() == (0, 0, 0)
    assert normalised_return(planner, tdm, planner).interval() == (100, 100, 100)
    assert normalised_return(middle, tdm, planner).interval() == pytest.approx((75, 75, 75))


def test_fading_repeats_are_averaged_within_their_unit() -> None:
    values = np.array([1.0, 3.0, 10.0, np.nan, np.nan, np.nan])
    assert unit_means(values, np.array([0, 0, 1, 1, 2, 2])) == pytest.approx([2, 10, np.nan], nan_ok=True)


def test_units_without_a_value_are_left_out() -> None:
    counts = resampling(3, seed=0, resamples=300)
    estimate = estimate_mean(np.array([2.0, np.nan, 6.0]), counts)
    assert estimate.point == 4.0
    for units, replicate in zip(resamples(counts), estimate.replicates, strict=True):
        known = [{0: 2.0, 2: 6.0}[unit] for unit in units if unit != 1]
        assert replicate == pytest.approx(np.mean(known) if known else np.nan, nan_ok=True)
    assert estimate.interval().low == 2.0
    assert np.isnan(estimate_mean(np.full(3, np.nan), counts).interval()).all()
    assert np.isnan(excess_cost(Estimate(1.0, np.ones(3)), Estimate(0.0, np.zeros(3))).interval()).all()


def test_interquartile_mean_is_the_trimmed_mean_of_all_runs() -> None:
    scores = np.random.default_rng(0).normal(size=(5, 8)) + np.arange(8)
    interval = interquartile_mean(scores, seed=0)
    assert interval.mean == pytest.approx(stats.trim_mean(scores, 0.25, axis=None))
    assert interval.low < interval.mean < interval.high


def test_interquartile_mean_resamples_whole_runs() -> None:
    apart = np.array([[0.0] * 8, [4.0] * 8, [8.0] * 8])  # a run's tasks share its luck: no task evens it out
    assert interquartile_mean(apart, seed=0)[1:] == (0.0, 8.0)
    scores = np.array([[0.0, 10.0, 20.0, 30.0]] * 4)  # tasks differ, runs of a task do not: nothing to resample
    assert interquartile_mean(scores, seed=0) == (15, 15, 15)
    two = np.array([[0.0], [1.0]])  # every resample is one of four
    expected = {float(np.mean(pair)) for pair in itertools.product((0.0, 1.0), repeat=2)}
    assert {*interquartile_mean(two, seed=0)} <= expected


def test_an_interval_over_seeds_by_hand() -> None:
    assert over_seeds([1.0]) == (1.0, 1.0, 1.0)
    assert over_seeds([1.0, 3.0]) == (2.0, 1.0, 3.0)
    assert over_seeds([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.0 - 4.3027 / 3**0.5, 2.0 + 4.3027 / 3**0.5), abs=1e-4)


def test_the_mean_of_runs_spreads_as_their_number_says() -> None:
    luck = np.random.default_rng(0).normal(size=(6, 1))
    estimate = run_mean(luck + np.zeros((6, 50)), seed=0)
    assert estimate.point == pytest.approx(luck.mean())
    assert estimate.replicates.std() == pytest.approx(luck.std(ddof=1) / 6**0.5, rel=0.05)


def test_probability_of_improvement_resamples_whole_runs() -> None:
    first, second = np.array([[0.0] * 9, [2.0] * 9]), np.array([[1.0] * 9])
    assert probability_of_improvement(first, second, seed=0) == (0.5, 0.0, 1.0)


def test_probability_of_improvement_counts_pairs_of_runs() -> None:
    first, second = np.array([[1.0, 5.0], [3.0, 5.0]]), np.array([[2.0, 5.0], [0.0, 4.0], [3.0, 6.0]])
    wins = [(1, 2, 0), (1, 0, 1), (1, 3, 0), (3, 2, 1), (3, 0, 1), (3, 3, 0.5)]
    wins += [(5, 5, 0.5), (5, 4, 1), (5, 6, 0)] * 2
    interval = probability_of_improvement(first, second, seed=0)
    assert interval.mean == pytest.approx(np.mean([win for *_, win in wins]))
    assert 0 <= interval.low <= interval.mean <= interval.high <= 1
    assert probability_of_improvement(first + 10, second, seed=0) == (1, 1, 1)


@pytest.mark.parametrize(
    ("value", "significant", "places"),
    [(-247.3, 3, 0), (-24.73, 3, 1), (0.9992, 3, 3), (1.0, 3, 2), (0.0123, 2, 3), (12345.0, 3, 0), (0.0, 3, 0)],
)
def test_decimals_show_as_many_significant_digits(value: float, significant: int, places: int) -> None:
    assert decimals(value, significant) == places
