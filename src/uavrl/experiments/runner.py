"""Runs that are never computed twice: a run is named by the hash of all that its result depends on.

Rows are appended to one JSONL file as runs finish, so an interrupted experiment goes on with what is missing.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from uavrl import __version__
from uavrl.training.log import Reporter


class Run(BaseModel):
    """One run of an experiment."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    problem: str = Field(description="what is learned")
    variant: str = Field(description="name in the table")
    settings: dict[str, Any] = Field(description="the agent's whole configuration")
    updates: int = Field(ge=1, description="gradient steps")
    seed: int = Field(ge=0, description="of weights, data order and noise")
    options: dict[str, Any] = Field(default={}, description="of the problem: data, evaluation")

    @property
    def key(self) -> str:
        """Name of the run: changes with anything that its result depends on, the code's version included."""
        content = json.dumps([__version__, self.model_dump(mode="json", exclude={"variant"})], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def finished(store: Path) -> dict[str, dict[str, Any]]:
    """Rows of a store by their run's key; a last line that was cut short does not count."""
    if not store.exists():
        return {}
    lines = store.read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines if line.endswith("}")]
    return {row["key"]: row for row in rows}


def run_all(
    runs: Sequence[Run],
    function: Callable[[Run], dict[str, float]],
    store: Path,
    workers: int,
    report: Reporter,
) -> list[dict[str, Any]]:
    """Compute what the store lacks, each run in a process of its own with one thread; the rows of `runs`, in order.

    Args:
        runs: what is wanted.
        function: from a run to its scores; importable, since another process calls it.
        store: JSONL file, made where missing.
        workers: processes at a time.
        report: told of each run that ends.
    """
    store.parent.mkdir(parents=True, exist_ok=True)
    rows = finished(store)
    missing = list({run.key: run for run in runs if run.key not in rows}.values())
    done = len(runs) - len(missing)
    report(done, "")
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread) as pool:
        futures = {pool.submit(_timed, function, run): run for run in missing}
        for future in as_completed(futures):
            run, (scores, seconds) = futures[future], future.result()
            row = {"key": run.key, **run.model_dump(mode="json"), "scores": scores, "seconds": round(seconds, 1)}
            _append(store, row)
            rows[run.key] = row
            done += 1
            report(done, f"{run.problem}: {run.variant}, seed {run.seed}")
    return [{**rows[run.key], "variant": run.variant} for run in runs]


def _append(store: Path, row: dict[str, Any]) -> None:
    """One line in one write, on disk when this returns; begun afresh where a killed writer left half a line."""
    broken = store.exists() and store.stat().st_size > 0 and not store.read_bytes().endswith(b"\n")
    with store.open("a", encoding="utf-8") as file:
        file.write(("\n" if broken else "") + json.dumps(row) + "\n")
        file.flush()
        os.fsync(file.fileno())


def _timed(function: Callable[[Run], dict[str, float]], run: Run) -> tuple[dict[str, float], float]:
    started = time.process_time()
    return function(run), time.process_time() - started


def _one_thread() -> None:
    """Each worker keeps to one core."""
    import torch

    torch.set_num_threads(1)
