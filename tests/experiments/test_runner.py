from __future__ import annotations

import json
from pathlib import Path

import pytest

from uavrl.experiments import runner
from uavrl.experiments.runner import Run, finished, run_all


def wanted(count: int) -> list[Run]:
    return [Run(problem="p", variant=f"v{seed}", settings={"a": 1}, updates=2, seed=seed) for seed in range(count)]


def scores(run: Run, directory: Path) -> dict[str, float]:
    return {"score": 10.0 * run.seed}


def refuses(run: Run, directory: Path) -> dict[str, float]:
    raise ValueError(f"computed again: {run.seed}")


def silent(done: int, text: str) -> None:
    pass


def test_rows_come_in_order_and_are_never_computed_twice(tmp_path: Path) -> None:
    store = tmp_path / "rows.jsonl"
    told: list[int] = []
    rows = run_all(wanted(3), scores, store, 2, lambda done, text: told.append(done))
    assert [row["scores"]["score"] for row in rows] == [0.0, 10.0, 20.0]
    assert told == [0, 1, 2, 3]
    again = run_all(wanted(3), refuses, store, 2, silent)
    assert again == rows
    with pytest.raises(ValueError, match="computed again: 3"):
        run_all(wanted(4), refuses, store, 1, silent)


def test_an_interrupted_store_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    store = tmp_path / "rows.jsonl"
    run_all(wanted(3), scores, store, 1, silent)
    text = store.read_text()
    for cut in range(text.rindex("\n", 0, -1) + 1, len(text) - 1):  # killed while the last line was written
        store.write_text(text[:cut])
        assert len(finished(store)) == 2
    assert [row["scores"]["score"] for row in run_all(wanted(3), scores, store, 1, silent)] == [0.0, 10.0, 20.0]
    assert len(finished(store)) == 3


def test_a_runs_name_changes_with_all_that_its_result_depends_on(monkeypatch: pytest.MonkeyPatch) -> None:
    (run,) = wanted(1)
    same = run.model_copy(update={"variant": "another line of the table"})
    assert same.key == run.key
    for change in ({"problem": "q"}, {"settings": {"a": 2}}, {"updates": 3}, {"seed": 1}, {"options": {"b": 1}}):
        assert run.model_copy(update=change).key != run.key, change
    before = run.key
    monkeypatch.setattr(runner, "__version__", "another")
    assert run.key != before


def test_rows_hold_the_whole_run(tmp_path: Path) -> None:
    store = tmp_path / "rows.jsonl"
    (run,) = wanted(1)
    run_all([run], scores, store, 1, silent)
    row = json.loads(store.read_text())
    assert {name: row[name] for name in Run.model_fields} == run.model_dump()
    assert row["seconds"] >= 0
    assert row["machine"]["threads"] == 1  # of the process that computed it
