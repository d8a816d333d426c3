from __future__ import annotations

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from benchmarks import ten_million
from tests.datasets.flights import fly, small_scenario
from uavrl.datasets.validation import validated


def test_copies_are_one_valid_log_of_as_many_rows_as_were_asked_for() -> None:
    scenario = small_scenario()
    log = fly(scenario)
    parts = list(validated(ten_million.copies(log, 290), scenario))
    assert [len(part) for part in parts] == [120, 120, 50]
    assert len(np.unique(np.concatenate([part.episode for part in parts]))) == 12 + 12 + 5
    np.testing.assert_array_equal(parts[1].reward, log.reward)


def ones(size: int) -> dict[str, int]:
    """Numbers that are given back; numpy may hold the interpreter all the while, so time for a look comes after."""
    made = np.ones(size)
    time.sleep(0.2)
    return {"last": int(made[-1])}


@pytest.mark.skipif(sys.platform != "linux", reason="/proc as Linux has it")
def test_memory_that_a_call_gives_back_is_in_its_peak() -> None:
    # in a process of its own: this one may give other tests' memory back meanwhile
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = pool.submit(ten_million.with_memory, ones, 10_000_000).result()
    assert found["last"] == 1
    assert 60 < found["peak_anonymous_mb"] - found["start_anonymous_mb"] < 110
    assert found["peak_resident_mb"] >= found["peak_anonymous_mb"]
