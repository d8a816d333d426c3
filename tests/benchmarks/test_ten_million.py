from __future__ import annotations

import sys
import time

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


@pytest.mark.skipif(sys.platform != "linux", reason="/proc as Linux has it")
def test_memory_that_a_call_gives_back_is_in_its_peak() -> None:
    def call(size: int) -> dict[str, int]:
        ones = np.ones(size)  # numpy may hold the interpreter all the while: time for a look comes after
        time.sleep(0.2)
        return {"last": int(ones[-1])}

    found = ten_million.with_memory(call, 10_000_000)
    assert found["last"] == 1
    assert 60 < found["peak_anonymous_mb"] - found["start_anonymous_mb"] < 110
    assert found["peak_resident_mb"] >= found["peak_anonymous_mb"]
