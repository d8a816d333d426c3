"""`uavrl bench simulate|train|decide`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from uavrl.cli.settings import check_writable
from uavrl.errors import ConfigError


def _check(seconds: float, *files: Path | None) -> None:
    if not 0.01 <= seconds <= 3600:
        raise ConfigError(f"--seconds {seconds}, allowed: 0.01 to 3600")
    for file in files:
        if file is not None:
            check_writable(file)


def _line(what: str, found: dict[str, float], name: str, floor: str) -> None:
    per_s, most = found[f"{name}_per_s"], found[f"{name}_floor_per_s"]
    spread = f"{found[f'{name}_slowest_per_s']:,.4g} to {found[f'{name}_fastest_per_s']:,.4g}"
    print(f"{what}: {per_s:,.4g}/s ({spread}), {per_s / most:.1%} of the {most:,.4g}/s that {floor}")


def _end(found: dict[str, Any], seconds: float, file: Path | None) -> None:
    from uavrl.benchmarks.timing import machine
    from uavrl.evaluation.report import write_text

    told = machine()
    print("on " + ", ".join(f"{name} {value}" for name, value in told.items() if value))
    if file is not None:
        write_text(file, json.dumps({"machine": told, "seconds": seconds, **found}, indent=2) + "\n")


@dataclass(frozen=True)
class BenchSimulate:
    """Measure environment steps a second, beside what memory and Gymnasium allow."""

    json: Path | None = None
    """file for the figures, machine and versions included"""
    seconds: float = 5.0
    """how long each rate is measured for, after a warm-up; at most 1 of the scaling"""
    scaling: bool = False
    """also time a step over the numbers of environments and of devices"""
    plot: Path | None = None
    """PNG of the scaling"""

    def run(self) -> None:
        _check(self.seconds, self.json, self.plot)
        from uavrl.benchmarks import simulate

        found: dict[str, Any] = {**simulate.measure(self.seconds)}
        memory = "copying what goes in and out allows"
        _line(f"simulator, batch of {simulate.BATCH:,}, K = 10, steps", found, "batch_steps", memory)
        _line(f"vector environment of {simulate.BATCH:,}, K = 10, steps", found, "vector_steps", memory)
        _line("one environment, K = 10, steps", found, "single_steps", "Gymnasium allows around one that does nothing")
        if "gpu_batch_steps_per_s" in found:
            print(f"simulator on the GPU, batch of {simulate.BATCH:,}: {found['gpu_batch_steps_per_s']:,.4g}/s")
        if self.scaling or self.plot is not None:
            found["scaling"] = simulate.scaling(min(self.seconds, 1.0))
            for row in found["scaling"]:
                per_s = row["environments"] / row["step_s"]
                print(f"N = {row['environments']:>7,}, K = {row['devices']:>5,}: {per_s:>12,.4g} steps/s")
        _end(found, self.seconds, self.json)
        if self.plot is not None:
            from uavrl.viewer.figures import step_times

            step_times(found["scaling"], self.plot)


@dataclass(frozen=True)
class BenchTrain:
    """Measure updates a second of Diffusion-SAC on the CPU, beside what its own matrix products allow."""

    json: Path | None = None
    """file for the figures, machine and versions included"""
    seconds: float = 5.0
    """how long each rate is measured for, after a warm-up"""
    threads: int = 1
    """of torch"""

    def run(self) -> None:
        _check(self.seconds, self.json)
        if self.threads < 1:
            raise ConfigError(f"--threads {self.threads}, allowed: 1 or more")
        import torch

        from uavrl.benchmarks import train

        torch.set_num_threads(self.threads)
        found: dict[str, Any] = {}
        for name in train.PRESETS:
            found |= train.measure(name, self.seconds)
            flop = found[f"{name}_gflop_per_update"]
            _line(f"preset {name}, updates", found, f"{name}_updates", f"its products allow ({flop:.3g} GFLOP) in f32")
            if f"{name}_updates_bf16_floor_per_s" in found:
                print(f"    in bf16 they allow {found[f'{name}_updates_bf16_floor_per_s']:,.4g}/s")
        _end(found, self.seconds, self.json)


@dataclass(frozen=True)
class BenchDecide:
    """Measure decisions of exported Diffusion-SAC policies, end to end, one aircraft and one thread, and in a batch."""

    json: Path | None = None
    """file for the figures, machine and versions included"""
    seconds: float = 5.0
    """how long each time and rate is measured for, after a warm-up"""

    def run(self) -> None:
        _check(self.seconds, self.json)
        missing = [name for name in ("onnx", "onnxscript", "onnxruntime") if find_spec(name) is None]
        if missing:
            raise ConfigError(f"bench decide needs {', '.join(missing)}, install: pip install 'uavrl[export,deploy]'")
        import torch

        from uavrl.benchmarks import decide

        torch.set_num_threads(1)
        found: dict[str, Any] = {}
        for name, case in decide.CASES.items():
            found |= decide.measure(name, self.seconds)
            what = "one-step student" if case.steps == 1 else f"{case.steps} steps"
            what += ", the critic chooses the device" if case.critic else ""
            print(
                f"preset {case.preset}, {what}: {found[f'{name}_ms']:.3g} ms in the median, "
                f"{found[f'{name}_p99_ms']:.3g} ms in the 99th percentile; its products take "
                f"{found[f'{name}_floor_ms']:.3g} ms"
            )
            print(
                f"    {decide.AIRCRAFT:,} aircraft at once: {found[f'{name}_batch_decisions_per_s']:,.4g} decisions/s"
            )
        _end(found, self.seconds, self.json)
