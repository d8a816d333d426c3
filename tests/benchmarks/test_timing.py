from __future__ import annotations

import time

import torch

from uavrl.benchmarks.timing import copied_bytes_per_s, machine, rate


def test_a_rate_counts_work_and_leaves_the_warm_up_out() -> None:
    calls: list[int] = []

    def call() -> None:
        time.sleep(0.2 if not calls else 0.002)
        calls.append(1)

    found = rate(call, work=10.0, seconds=0.3, repeats=3)
    assert found.slowest <= found.per_s <= found.fastest
    assert 500 < found.per_s < 5_000  # the first call's .2 s would make it 50
    assert len(calls) > 100  # the slow first call does not set how many a repeat has


def test_the_machine_says_what_ran() -> None:
    told = machine()
    assert told["threads"] == torch.get_num_threads()
    assert told["processor"]
    assert copied_bytes_per_s(1 << 16) > 1e6
