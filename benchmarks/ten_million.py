"""Training on ten million transitions that stay on disk, beside training on 30,000 in memory.

    python -m benchmarks.ten_million FOLDER --json results/speed/ten-million.json

FOLDER gets `copies.mapped`, 256 bytes a row, deleted at the end: the built-in `layouts`, over and over, each copy's
episodes numbered on from the last. Everything runs in a process of its own, because memory is measured by process:

    peak_anonymous_mb   most of RssAnon in /proc/self/status, looked at every 5 ms: what is allocated. It is the
                        `Anonymous` of smaps_rollup, without its walk over all pages of a map. Data in memory are in
                        it, mapped data are not.
    peak_resident_mb    VmHWM, the peak of all that is resident: with pages of mapped files, which belong to the page
                        cache, and which the system takes back when it needs memory. getrusage's ru_maxrss is the
                        same, but a process inherits it from the one that started it.

A sample is what `take` takes for a minibatch of the default preset; an update is the rest of a step.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from threading import Event, Thread
from typing import Annotated, Any

import torch
from tyro.conf import Positional, arg

from benchmarks import script
from uavrl.agents.registry import preset
from uavrl.benchmarks.timing import machine
from uavrl.cli.settings import check_writable
from uavrl.datasets import MappedTransitions, Transitions, load_source, save_mapped, select
from uavrl.training.batches import MappedRows, to_batch
from uavrl.training.fit import Rows
from uavrl.training.offline import OfflineLearner, TrainConfig

SOURCE = "layouts"
IN_MEMORY = 30_000  # rows that `uavrl train` draws from built-in data


def copies(log: Transitions, rows: int) -> Iterator[Transitions]:
    """`rows` rows: the log over and over, its episodes numbered on."""
    episodes = int(log.episode.max()) + 1
    for number, start in enumerate(range(0, rows, len(log))):
        columns = log.columns() | {"episode": log.episode + number * episodes}
        yield Transitions(**columns).take(slice(rows - start))


def memory_mb(name: str) -> float:
    """A line of /proc/self/status."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) / 1e3 for line in status if line.startswith(f"{name}:"))


def with_memory(call: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """What `call` found, with its seconds, and the memory of this process."""
    torch.set_num_threads(1)
    before, done = memory_mb("RssAnon"), Event()
    peak = [before]

    def watch() -> None:
        while not done.wait(0.005):
            peak[0] = max(peak[0], memory_mb("RssAnon"))

    watcher, began = Thread(target=watch), time.perf_counter()
    watcher.start()
    try:
        found = call(*arguments)
    finally:
        done.set()
        watcher.join()
    memory = {"start_anonymous_mb": before, "peak_anonymous_mb": peak[0], "peak_resident_mb": memory_mb("VmHWM")}
    return {**found, "seconds": time.perf_counter() - began, **memory}


def write(path: Path, rows: int) -> dict[str, Any]:
    """Stream the copies to disk."""
    log, scenario = load_source(SOURCE)
    written = save_mapped(path, copies(log, rows), scenario)
    return {"rows": len(written), "size_mb": sum(file.stat().st_size for file in path.iterdir()) / 1e6}


class Timed:
    """Rows, and the seconds that each minibatch of them took."""

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self.seconds: list[float] = []

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, rows: torch.Tensor) -> Any:
        """As of the rows."""
        began = time.perf_counter()
        batch = self.rows.take(rows)
        self.seconds.append(time.perf_counter() - began)
        return batch


def train(source: str, updates: int) -> dict[str, Any]:
    """The default preset's first updates on a source; built-in data as `uavrl train` draws them."""
    began = time.perf_counter()
    log, scenario = load_source(source)
    log = select(log, IN_MEMORY) if source == SOURCE else log
    plan = TrainConfig(scenario=scenario, agent=preset("diffusion_sac", "default"), updates=updates)
    learner = OfflineLearner(plan, log)
    learner.data = timed = Timed(learner.data)
    ready, steps = time.perf_counter() - began, []
    for _ in range(updates):
        began = time.perf_counter()
        learner.step()
        steps.append(time.perf_counter() - began)
    learner.support_distance()
    rests = [step - sample for step, sample in zip(steps, timed.seconds, strict=True)]
    return {
        "rows": len(log),
        "updates": updates,
        "ready_s": ready,
        "sample_ms": 1e3 * median(timed.seconds),
        "slowest_sample_ms": 1e3 * max(timed.seconds),
        "update_ms": 1e3 * median(rests),
        "sample_share": sum(timed.seconds) / sum(steps),
    }


def sample_unread(path: Path, samples: int) -> dict[str, Any]:
    """Minibatches from the disk: no page is in the page cache when the first is drawn, and hardly one is met again."""
    evict(path)
    log, scenario = load_source(path)
    if not isinstance(log, MappedTransitions):
        raise TypeError(f"{path} is not mapped")
    timed = Timed(MappedRows(log, lambda rows: to_batch(rows, "devices", scenario)))
    generator = torch.Generator().manual_seed(0)
    for _ in range(samples):
        timed.take(torch.randint(0, len(log), (256,), generator=generator))
    slowest = 1e3 * max(timed.seconds)
    return {"samples": samples, "sample_ms": 1e3 * median(timed.seconds), "slowest_sample_ms": slowest}


def evict(path: Path) -> None:
    """Ask the system to drop the files from its page cache; it keeps what another process has mapped."""
    for file in path.iterdir():
        descriptor = os.open(file, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def alone(call: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """`with_memory` in a new process."""
    with get_context("spawn").Pool(1) as pool:
        found: dict[str, Any] = pool.apply(with_memory, (call, *arguments))
    print(call.__name__, json.dumps(found), flush=True)
    return found


def main(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")],
    rows: int = 10_000_000,
    updates: int = 120,
    report: Annotated[Path | None, arg(name="json")] = None,
) -> None:
    """Write, train, sample, delete.

    Args:
        folder: where the copies lie meanwhile.
        rows: of the copies.
        updates: of each training.
        report: write what was measured here.
    """
    if report is not None:
        check_writable(report)
    path = folder / "copies.mapped"
    try:
        found = {"written": alone(write, path, rows)}
        evict(path)
        found["mapped"] = alone(train, str(path), updates)
        found["in_memory"] = alone(train, SOURCE, updates)
        found["unread"] = alone(sample_unread, path, 100)
    finally:
        shutil.rmtree(path, ignore_errors=True)
    if report is not None:
        report.write_text(json.dumps({"machine": machine(), **found}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    script.run(main, "benchmarks.ten_million")
