from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from uavrl.datasets import ReplayLog, Transitions
from uavrl.errors import DatasetError


def batches(log: Transitions) -> list[dict[str, NDArray[Any]]]:
    """The rows as three environments flew them: one step of each at a time."""
    order = np.lexsort((log.episode, log.step, log.episode // 3))
    return [log.take(rows).columns() for rows in np.array_split(order, 40)]


def test_a_log_flown_in_step_comes_out_sorted_by_episode(log: Transitions) -> None:
    replay = ReplayLog(3)
    for batch in batches(log):
        replay.append(batch)
    assert len(replay) == 120
    np.testing.assert_array_equal(replay.take(np.arange(3)).episode, [0, 1, 2])  # as flown
    assert replay.to_transitions().digest() == log.digest()


def test_what_was_flown_is_not_changed_by_what_follows(log: Transitions) -> None:
    replay = ReplayLog(3)
    first, second = batches(log)[:2]
    replay.append(first)
    early, state = replay.to_transitions().digest(), replay.state_dict()
    reward = state["reward"].copy()
    replay.load_state_dict({name: values[::-1] for name, values in state.items()})
    replay.append(second)
    np.testing.assert_array_equal(state["reward"], reward)
    assert early == Transitions(**first).digest()


def test_only_the_rows_to_keep_are_added(log: Transitions) -> None:
    replay = ReplayLog(3)
    replay.append(log.columns(), keep=log.truncated)
    assert len(replay) == 9
    assert replay.take(np.arange(9)).truncated.all()


def test_a_log_goes_on_from_a_checkpoint(log: Transitions, tmp_path: Path) -> None:
    flown = batches(log)
    replay = ReplayLog(3)
    for batch in flown[:17]:
        replay.append(batch)
    save_file(replay.state_dict(), tmp_path / "log.safetensors")
    resumed = ReplayLog(3)
    resumed.append(flown[30])  # replaced by what is loaded
    resumed.load_state_dict(load_file(tmp_path / "log.safetensors"))
    for batch in flown[17:]:
        resumed.append(batch)
    assert resumed.to_transitions().digest() == log.digest()


def test_a_log_grows_and_keeps_its_rows(log: Transitions) -> None:
    replay = ReplayLog(3)
    for _ in range(80):  # 9,600 rows, more than twice what there is room for at first
        replay.append(log.columns())
    assert len(replay) == 80 * len(log)
    for start in (0, 34 * len(log), 79 * len(log)):
        assert replay.take(start + np.arange(len(log))).digest() == log.digest()


def test_a_log_refuses_foreign_rows_and_keeps_what_it_has(log: Transitions) -> None:
    replay = ReplayLog(3)
    replay.append(log.columns())
    with pytest.raises(DatasetError, match=r"'layout_m' has shape \(120, 3, 2\), allowed: \(120, 2, 2\)"):
        ReplayLog(2).append(log.take(slice(None)).columns())
    with pytest.raises(DatasetError, match="'age_term'"):
        replay.load_state_dict({name: v for name, v in log.columns().items() if name != "age_term"})
    cut = {**log.take(slice(60, 120)).columns(), "next_used_j": np.zeros(59)}
    with pytest.raises(DatasetError, match=r"'next_used_j' has shape \(59,\), allowed: \(60,\)"):
        replay.load_state_dict(cut)
    with pytest.raises(DatasetError, match="allowed: 0 to 119"):
        replay.take(np.array([0, 120]))  # allocated, but not flown
    assert replay.to_transitions().digest() == log.digest()
