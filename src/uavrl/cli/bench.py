"""`uavrl bench simulate|train`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uavrl.errors import ConfigError


@dataclass(frozen=True)
class _Bench:
    json: Path | None = None
    """file for the figures, machine and versions included"""
    seconds: float = 5.0
    """how long each figure is measured for, after a warm-up"""
    threads: int = 1
    """of torch and its libraries"""

    def _begin(self) -> None:
        import torch

        if not 0.01 <= self.seconds <= 3600:
            raise ConfigError(f"--seconds {self.seconds}, allowed: 0.01 to 3600")
        if self.threads < 1:
            raise ConfigError(f"--threads {self.threads}, allowed: 1 or more")
        for path in (self.json, getattr(self, "plot", None)):
            if path is not None and not path.parent.is_dir():
                raise ConfigError(f"'{path}' cannot be written, allowed: a file in a directory that exists")
        torch.set_num_threads(self.threads)

    def _end(self, found: dict[str, Any]) -> None:
        from uavrl.benchmarks.timing import machine
        from uavrl.evaluation.report import write_text

        told = machine()
        print("on " + ", ".join(f"{name} {value}" for name, value in told.items() if value))
        if self.json is not None:
            write_text(self.json, json.dumps({"machine": told, "seconds": self.seconds, **found}, indent=2) + "\n")


def _line(what: str, found: float, floor: float, of: str) -> None:
    print(f"{what:<44}{found:>14,.4g}/s   {of} {floor:,.4g}/s, {found / floor:.0%} of it")


@dataclass(frozen=True)
class BenchSimulate(_Bench):
    """Measure environment steps a second, beside what memory and Gymnasium allow."""

    scaling: bool = False
    """also time a step over the numbers of environments and of devices"""
    plot: Path | None = None
    """PNG of the scaling"""

    def run(self) -> None:
        from uavrl.benchmarks import simulate

        self._begin()
        found: dict[str, Any] = {**simulate.measure(self.seconds)}
        batch, single = f"steps, batch of {simulate.BATCH:,}, K = 10", "steps, one Gymnasium environment, K = 10"
        _line(batch, found["batch_steps_per_s"], found["batch_steps_floor_per_s"], "memory allows")
        _line(single, found["single_steps_per_s"], found["single_steps_floor_per_s"], "Gymnasium alone")
        if "gpu_batch_steps_per_s" in found:
            print(f"{batch + ', GPU':<44}{found['gpu_batch_steps_per_s']:>14,.4g}/s")
        if self.scaling or self.plot is not None:
            found["scaling"] = simulate.scaling(min(self.seconds, 1.0))
            for row in found["scaling"]:
                per_s = row["environments"] / row["step_s"]
                print(f"N = {row['environments']:>7,}, K = {row['devices']:>5,}: {per_s:>12,.4g} steps/s")
        if self.plot is not None:
            from uavrl.viewer.figures import step_times

            step_times(found["scaling"], self.plot)
        self._end(found)


@dataclass(frozen=True)
class BenchTrain(_Bench):
    """Measure updates a second of Diffusion-SAC, beside what its own matrix products allow."""

    def run(self) -> None:
        from uavrl.benchmarks import train

        self._begin()
        found: dict[str, Any] = {}
        for name in train.PRESETS:
            found |= train.measure(name, self.seconds)
            updates, floor = found[f"{name}_updates_per_s"], found[f"{name}_updates_floor_per_s"]
            _line(f"updates, preset {name}", updates, floor, "its products in f32")
            bf16, flop = found[f"{name}_updates_bf16_floor_per_s"], found[f"{name}_gflop_per_update"]
            print(f"{'':<44}{'':>16}   its products in bf16 {bf16:,.4g}/s; {flop:.3g} GFLOP an update")
        self._end(found)
