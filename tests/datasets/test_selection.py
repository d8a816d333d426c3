from __future__ import annotations

import numpy as np
import pytest

from uavrl.datasets import Transitions, select
from uavrl.datasets.selection import training_third
from uavrl.errors import DatasetError


def rows(selected: Transitions) -> set[tuple[int, int]]:
    return set(zip(selected.episode.tolist(), selected.step.tolist(), strict=True))


def long_log(log: Transitions) -> Transitions:
    """3,600 rows of 360 episodes of 10 steps: enough to see whether a draw is uniform."""
    columns = {name: np.resize(values, (3600, *values.shape[1:])) for name, values in log.columns().items()}
    return Transitions(**{**columns, "episode": np.arange(3600) // 10, "step": np.arange(3600) % 10})


def test_a_selection_is_sorted_without_repeats_and_of_whole_rows(log: Transitions) -> None:
    selected = select(log, 70, seed=3)
    assert len(rows(selected)) == 70
    assert selected.digest() == selected.in_order().digest()
    index = [np.flatnonzero((log.episode == e) & (log.step == s))[0] for e, s in sorted(rows(selected))]
    assert selected.digest() == log.take(np.array(index)).digest()


def test_seeds_draw_differently_and_repeatably(log: Transitions) -> None:
    assert rows(select(log, 60, seed=0)) == rows(select(log, 60, seed=0))
    assert rows(select(log, 60, seed=0)) != rows(select(log, 60, seed=1))


@pytest.mark.parametrize("quality", ["mixed", "good", "bad"])
def test_smaller_selections_are_parts_of_larger_ones(log: Transitions, quality: str) -> None:
    sets = [rows(select(log, size, quality, seed=5)) for size in (5, 12, 24)]  # type: ignore[arg-type]  # parametrized
    assert sets[0] < sets[1] < sets[2]


def test_a_selection_of_a_selection_equals_one_of_the_log(log: Transitions) -> None:
    whole = long_log(log)
    direct, again = select(whole, 300, seed=2), select(select(whole, 2000, seed=2), 300, seed=2)
    assert direct.digest() == again.digest()


def test_mixed_is_uniform_over_training(log: Transitions) -> None:
    whole = long_log(log)
    chosen = np.zeros(3600)
    for seed in range(40):
        chosen[[e * 10 + s for e, s in rows(select(whole, 900, seed=seed))]] += 1
    # each row is chosen in 40 draws with p = 1/4; sums over many rows against the hypergeometric spread
    for part in (chosen.reshape(36, 100).sum(axis=1), chosen.reshape(360, 10).sum(axis=0)[:, None].sum(axis=1)):
        expected = 40 * 900 / len(part)
        deviation = (part - expected) / np.sqrt(expected * 0.75)
        assert np.abs(deviation).max() < 4.5
        assert 0.3 < deviation.std() < 1.7
    assert 6.5 < chosen.var() < 8.5  # binomial: 40 x 1/4 x 3/4 = 7.5; a draw that ignored the seed would give 300


def test_good_is_the_last_third_of_training_and_bad_the_first(log: Transitions) -> None:
    assert select(log, 48, "bad").episode.tolist() == log.episode[log.episode < 4].tolist()
    assert set(select(log, 20, "good").episode) <= {8, 9, 10, 11}
    assert set(select(log, 48, "bad", total_episodes=12).episode) == {0, 1, 2, 3}
    assert set(select(log, 20, "bad", total_episodes=30).episode) <= set(range(10))
    np.testing.assert_array_equal(np.bincount(training_third(log)), [48, 48, 24])


@pytest.mark.parametrize(
    ("size", "quality", "seed", "total", "message"),
    [
        (121, "mixed", 0, None, "size = 121, allowed: 1 to 120"),
        (25, "good", 0, None, "size = 25, allowed: 1 to 24, the rows of quality 'good'"),
        (0, "mixed", 0, None, "size = 0, allowed: 1 to 120"),
        (5, "best", 0, None, "quality = 'best', allowed: mixed, bad, good"),
        (5, "mixed", -1, None, "seed = -1, allowed: 0"),
        (5, "bad", 0, 11, "total_episodes = 11, allowed: more than the last episode's number 11"),
    ],
)
def test_what_cannot_be_selected_is_refused(
    log: Transitions, size: int, quality: str, seed: int, total: int | None, message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        select(log, size, quality, seed, total)  # type: ignore[arg-type]  # wrong on purpose
