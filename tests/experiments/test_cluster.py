"""Runs on a Ray cluster of two nodes on this machine, one of which is killed."""

from __future__ import annotations

import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from uavrl.errors import ConfigError
from uavrl.experiments.runner import Run, Scores, finished, run_all

STEPS = 20


def wanted(count: int) -> list[Run]:
    return [Run(problem="p", variant="v", settings={}, updates=STEPS, seed=seed) for seed in range(count)]


def steps_with_checkpoints(run: Run, directory: Path) -> Scores:
    """Twenty steps of a fifth of a second, each saved; says from which step this attempt went on."""
    place = directory / "step"
    began = int(place.read_text()) if place.exists() else 0
    with (directory / "attempts").open("a") as file:
        file.write(f"{began}\n")
    for step in range(began, run.updates):
        time.sleep(0.2)
        aside = directory / "step.tmp"
        aside.write_text(str(step + 1))
        aside.replace(place)
    attempts = [int(line) for line in (directory / "attempts").read_text().split()]
    return {"attempts": attempts, "steps": int(place.read_text())}


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_killed_node_loses_no_finished_run_and_its_running_ones_resume(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    doomed = cluster.add_node(num_cpus=1)
    store, killed = tmp_path / "rows.jsonl", threading.Event()

    def kill_once_two_runs_are_on_their_way() -> None:
        begun = tmp_path / "rows.unfinished"
        while sum(int(place.read_text() or 0) >= 3 for place in begun.glob("*/step")) < 2:
            time.sleep(0.05)
        cluster.remove_node(doomed, allow_graceful=False)
        killed.set()

    threading.Thread(target=kill_once_two_runs_are_on_their_way, daemon=True).start()
    try:
        rows = run_all(wanted(4), steps_with_checkpoints, store, 1, lambda done, text: None, cluster.address)
    finally:
        cluster.shutdown()
    assert killed.is_set()
    assert [row["seed"] for row in rows] == [0, 1, 2, 3]
    assert all(row["scores"]["steps"] == STEPS for row in rows)
    resumed = [row["scores"]["attempts"] for row in rows if len(row["scores"]["attempts"]) > 1]
    assert resumed, "no run was on the node that was killed"
    assert all(later >= 3 for attempts in resumed for later in attempts[1:])
    assert len(finished(store)) == 4
    assert not (tmp_path / "rows.unfinished").exists()


def test_a_cluster_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")

    def refuses(**options: object) -> None:
        raise ConnectionError("Could not find any running Ray instance.\nMore.")

    monkeypatch.setattr(ray, "init", refuses)
    with pytest.raises(ConfigError, match=r"--cluster 'auto' does not answer: Could not find any running Ray instance"):
        run_all(wanted(1), steps_with_checkpoints, tmp_path / "rows.jsonl", 1, lambda done, text: None, "auto")


def test_an_address_where_nobody_listens_is_named_at_once(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, but nobody listens
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ConfigError, match=f"--cluster '{address}' does not answer: .*refused"):
            run_all(wanted(1), steps_with_checkpoints, tmp_path / "rows.jsonl", 1, lambda done, text: None, address)
