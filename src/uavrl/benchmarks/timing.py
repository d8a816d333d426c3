"""Rates by the clock, the machine that gave them, and what it could do at best."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from uavrl.evaluation.report import versions

REPEATS = 7


@dataclass(frozen=True)
class Rate:
    """How often a second: the median over repeats, the slowest and the fastest of them."""

    per_s: float
    slowest: float
    fastest: float

    def named(self, name: str) -> dict[str, float]:
        """For a file of figures."""
        return {
            f"{name}_per_s": self.per_s,
            f"{name}_slowest_per_s": self.slowest,
            f"{name}_fastest_per_s": self.fastest,
        }


def rate(call: Callable[[], Any], *, work: float = 1.0, seconds: float = 2.0, repeats: int = REPEATS) -> Rate:
    """Repeat `call`, which does `work` units, for about `seconds` in all, after a first call and a warm-up.

    A repeat is as many calls as the warm-up made in `seconds / repeats`.
    """
    call()  # slower than the others: caches, allocations
    calls, began = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - began < seconds / repeats:
        call()
        calls += 1
    rates = []
    for _ in range(repeats):
        began = time.perf_counter()
        for _ in range(calls):
            call()
        rates.append(work * calls / (time.perf_counter() - began))
    return Rate(median(rates), min(rates), max(rates))


def copied_bytes_per_s(size: int) -> float:
    """Memory traffic of copying `size` bytes, each of which is read and written."""
    source, target = np.ones(max(1, size // 8)), np.zeros(max(1, size // 8))
    return rate(lambda: np.copyto(target, source), work=2.0 * source.nbytes, seconds=0.5).per_s


def _processor() -> tuple[str, set[str]]:
    """Name, and flags where the system tells."""
    described = Path("/proc/cpuinfo")
    if not described.exists():
        return platform.processor() or platform.machine(), set()
    entries = [line.partition(":") for line in described.read_text(encoding="utf-8").splitlines()]
    found = {key.strip(): value.strip() for key, _, value in entries}
    return found.get("model name", platform.machine()), set(found.get("flags", "").split())


def bf16_units() -> list[str]:
    """What the processor has for products in bf16."""
    return sorted({"amx_bf16", "avx512_bf16"} & _processor()[1])


def machine() -> dict[str, Any]:
    """Processor, its units for bf16, cores, threads of torch, accelerator, versions and commit."""
    return {
        "processor": _processor()[0],
        "bf16": ", ".join(bf16_units()) or "no units",
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        **versions(),
    }
