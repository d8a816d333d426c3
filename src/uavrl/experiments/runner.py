"""Runs that are never computed twice: a run is named by the hash of its configuration and of the package's version.

Rows are appended to one JSONL file as runs finish. Until its row is written, a run keeps its checkpoints in a directory
of its own: so an interrupted experiment goes on with what is missing, and an interrupted run with its last checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from uavrl import __version__
from uavrl.benchmarks.timing import machine
from uavrl.errors import ConfigError
from uavrl.training.log import Reporter, read_metrics

Scores = dict[str, Any]  # of one run, JSON
Row = Mapping[str, Any]  # of the store: key, the run's fields, scores, seconds, machine

_ANSWER_S = 10.0  # within which a cluster must answer
RETRIES = 10  # of a run whose worker or node is lost


class Run(BaseModel):
    """One run of an experiment."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    problem: str = Field(description="what is learned")
    variant: str = Field(description="name in the table")
    settings: dict[str, Any] = Field(description="the agent's whole configuration")
    updates: int = Field(ge=0, description="gradient steps; flights of an online learner; 0: nothing is learned")
    seed: int = Field(ge=0, description="of weights, data order and noise")
    options: dict[str, Any] = Field(default={}, description="of the problem: data, evaluation")

    @property
    def key(self) -> str:
        """Name of the run: the hash of its whole configuration and of the package's version; of data, their name."""
        content = json.dumps([__version__, self.model_dump(mode="json", exclude={"variant"})], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


Function = Callable[[Run, Path], Scores]
Ended = tuple[Scores, float, dict[str, Any]]  # with its seconds of processor time, and its machine
Finished = Iterator[tuple[Run, Ended]]


def finished(store: Path) -> dict[str, dict[str, Any]]:
    """Rows of a store by their run's key; a last line that was cut short does not count."""
    if not store.exists():
        return {}
    return {row["key"]: row for row in read_metrics(store)}


def grouped(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by variant, in their order; each holds a variant's seeds."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["variant"], []).append(row)
    return groups


def run_all(
    runs: Sequence[Run],
    function: Function,
    store: Path,
    workers: int,
    report: Reporter,
    cluster: str | None = None,
) -> list[dict[str, Any]]:
    """Compute what the store lacks, each run in a process of its own with one thread; the rows of `runs`, in order.

    Args:
        runs: what is wanted, begun in this order.
        function: from a run and its own directory to its scores; importable, since another process calls it. What a run
            that was cut short had saved there, it finds there.
        store: JSONL file, made where missing.
        workers: processes at a time on this machine.
        report: told of each run that ends.
        cluster: address of a Ray cluster, or "auto" for the one that this machine belongs to; its nodes run then what
            they have cores for, and see the store's folder. A run whose worker or node is lost goes on elsewhere.

    Raises:
        ConfigError: `cluster`, and Ray is not installed or does not answer.
    """
    store.parent.mkdir(parents=True, exist_ok=True)
    rows = finished(store)
    missing = {run.key: run for run in runs if run.key not in rows}
    done = len(runs) - len(missing)
    report(done, "")
    unfinished = store.with_suffix(".unfinished").absolute()
    places = [(run, unfinished / key) for key, run in missing.items()]
    ended = _here(places, function, workers) if cluster is None else _on_cluster(places, function, cluster)
    for run, (scores, seconds, where) in ended if places else ():
        row = {"key": run.key, **run.model_dump(mode="json"), "scores": scores, "seconds": round(seconds, 1)}
        row["machine"] = where
        append(store, row)
        rows[run.key] = row
        shutil.rmtree(unfinished / run.key, ignore_errors=True)
        done += 1
        report(done, f"{run.problem}: {run.variant}, seed {run.seed}")
    if unfinished.is_dir() and not any(unfinished.iterdir()):
        unfinished.rmdir()
    return [{**rows[run.key], "variant": run.variant} for run in runs]


def _here(places: Sequence[tuple[Run, Path]], function: Function, workers: int) -> Finished:
    """Runs on this machine, as they end."""
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    pool = ProcessPoolExecutor(workers, mp_context=context)
    try:
        futures = {pool.submit(_timed, function, run, place): run for run, place in places}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(cancel_futures=True)  # after an error or an interrupt none is begun any more


def _on_cluster(places: Sequence[tuple[Run, Path]], function: Function, address: str) -> Finished:
    """Runs on a Ray cluster, as they end."""
    try:
        import ray
    except ImportError:
        raise ConfigError("--cluster needs Ray, install it: pip install 'uavrl[cluster]'") from None
    host, _, port = address.rpartition(":")
    try:
        if host and port.isdigit():  # Ray itself would try for minutes
            socket.create_connection((host, int(port)), timeout=_ANSWER_S).close()
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError) as error:
        raise ConfigError(f"--cluster '{address}' does not answer: {str(error).splitlines()[0]}") from None
    try:
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(_timed)
        waiting = {task.remote(function, run, place): run for run, place in places}
        while waiting:
            (ended, *_), _ = ray.wait(list(waiting))
            yield waiting.pop(ended), ray.get(ended)
    finally:
        ray.shutdown()  # leaves the cluster; the runs that it was doing for us end


def append(store: Path, row: dict[str, Any]) -> None:
    """One line in one write, on disk when this returns; begun afresh where a killed writer left half a line."""
    broken = store.exists() and store.stat().st_size > 0 and not store.read_bytes().endswith(b"\n")
    with store.open("a", encoding="utf-8") as file:
        file.write(("\n" if broken else "") + json.dumps(row) + "\n")
        file.flush()
        os.fsync(file.fileno())


def _timed(function: Function, run: Run, directory: Path) -> Ended:
    """In a process that keeps to one core. Of a run that goes on, the seconds of its last part."""
    import torch

    torch.set_num_threads(1)
    directory.mkdir(parents=True, exist_ok=True)
    started = time.process_time()
    return function(run, directory), time.process_time() - started, machine()
