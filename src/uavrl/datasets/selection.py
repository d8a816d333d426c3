"""Which part of a training's log to learn from: size, quality and seed."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uavrl.datasets.transitions import Transitions
from uavrl.errors import DatasetError

Quality = Literal["mixed", "good", "bad"]

_THIRD: dict[Quality, int | None] = {"mixed": None, "bad": 0, "good": 2}


def training_third(transitions: Transitions, total_episodes: int | None = None) -> NDArray[np.int64]:
    """Third of the training, 0 to 2, in which each row's episode began (n,).

    Args:
        transitions: a training's log, or a selection of it; episodes are numbered as they began.
        total_episodes: how many the training had; None: up to the last one of `transitions`.

    Raises:
        DatasetError: `total_episodes` is smaller than an episode's number.
    """
    last = int(transitions.episode.max()) if len(transitions) else 0
    total = last + 1 if total_episodes is None else total_episodes
    if total <= last:
        raise DatasetError(f"total_episodes = {total}, allowed: more than the last episode's number {last}")
    return transitions.episode * 3 // total


def select(
    transitions: Transitions,
    size: int,
    quality: Quality = "mixed",
    seed: int = 0,
    total_episodes: int | None = None,
) -> Transitions:
    """`size` rows without replacement, sorted by (episode, step).

    Each row draws a number from its seed, episode and step, and the smallest are taken. So, for one seed and quality,
    a smaller selection is part of a larger one, and a selection from a selection equals one from the whole log.

    Args:
        transitions: a training's log.
        size: rows wanted.
        quality: "mixed", uniform over the training; "good", its last third; "bad", its first third.
        seed: of the draw.
        total_episodes: as in `training_third`.

    Raises:
        DatasetError: unknown quality, or more rows wanted than there are.
    """
    if quality not in _THIRD:
        raise DatasetError(f"quality = {quality!r}, allowed: {', '.join(_THIRD)}")
    if not 0 <= seed < 2**63:
        raise DatasetError(f"seed = {seed}, allowed: 0 to 2^63 - 1")
    third = _THIRD[quality]
    if third is None:
        rows = np.arange(len(transitions))
    else:
        rows = np.flatnonzero(training_third(transitions, total_episodes) == third)
    if not 1 <= size <= len(rows):
        raise DatasetError(f"size = {size}, allowed: 1 to {len(rows)}, the rows of quality '{quality}'")
    draws = _draw(seed, transitions.episode[rows], transitions.step[rows])
    return transitions.take(rows[np.argsort(draws, kind="stable")[:size]]).in_order()


def _draw(seed: int, episode: NDArray[np.int64], step: NDArray[np.int64]) -> NDArray[np.uint64]:
    """A number in 0..2^64-1 for each row, that depends on nothing but its arguments."""
    draws = _mix(np.full(episode.shape, seed, dtype=np.uint64))
    draws = _mix(draws ^ episode.astype(np.uint64))
    return _mix(draws ^ step.astype(np.uint64))


def _mix(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """One step of SplitMix64 from each value (Steele, Lea and Flood 2014, fast splittable generators)."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
