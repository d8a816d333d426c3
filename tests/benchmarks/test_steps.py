from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import steps
from tests.training.test_policy import saved
from uavrl.experiments.flights import Setting
from uavrl.experiments.paper import ALGORITHMS, PROTOCOLS, SCALES, YARDSTICK, Plan
from uavrl.experiments.runner import finished
from uavrl.scenario import load_scenario

SHORT = load_scenario("released", max_steps=6)
WAYS = (
    "one-step student",
    "DDIM, 5, own choice",
    "DDIM, 2",
    "DPM-Solver++(2M), 3",
    "DDIM, 1, best of 10 samples",
)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An untrained teacher of five steps and an untrained student, and few short flights."""
    monkeypatch.setattr(steps, "EPISODES", 3)
    monkeypatch.setattr(steps, "FADINGS", 2)
    monkeypatch.setattr(steps, "load_scenario", lambda name: SHORT)
    monkeypatch.setattr(steps, "WAYS", {name: steps.WAYS[name] for name in WAYS})
    monkeypatch.setattr(steps, "CHARGED", WAYS[:2])
    saved(tmp_path / "teacher-0", "diffusion_sac", "devices", SHORT)
    saved(tmp_path / "student-0", "one_step", "devices", SHORT)
    return tmp_path


def test_every_way_is_flown_once_in_the_comparisons_environments(runs: Path) -> None:
    steps.main("fly", str(runs), str(runs / "out"), "0")
    first = (runs / "out" / "steps.jsonl").read_text()
    rows = [json.loads(line) for line in first.splitlines()]
    assert [row["way"] for row in rows] == list(WAYS)
    assert all(len(row["flown"]["return"]) == 3 for row in rows)
    assert len({tuple(row["flown"]["return"]) for row in rows}) == len(WAYS)
    steps.main("fly", str(runs), str(runs / "out"), "0")
    assert (runs / "out" / "steps.jsonl").read_text() == first
    with (runs / "out" / "steps.jsonl").open("a") as file:
        file.write('{"way": "cut sh')
    assert len(finished(runs / "out" / "steps.jsonl")) == len(rows)


def test_the_environments_are_the_comparisons() -> None:
    plan = Plan(SCALES["standard"]).comparison(PROTOCOLS["layouts"])[0]
    compared = Setting.model_validate(plan.options)
    expected, found = compared.environments(compared.fading_seeds), steps.environments(compared.scenario)
    assert (found.seed, found.fading_seeds) == (expected.seed, expected.fading_seeds)
    assert (found.layout_m == expected.layout_m).all()
    assert (found.start_m == expected.start_m).all()


def test_every_way_and_algorithm_is_timed(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "WAYS", {"DDIM, 2": steps.WAYS["DDIM, 2"]})
    monkeypatch.setattr(steps, "ALGORITHMS", {"IQL": "iql"})
    monkeypatch.setattr(steps, "ROUND_S", 0.02)
    monkeypatch.setattr(steps, "ROUNDS", 2)
    (runs / "out").mkdir()
    steps.main("time", str(runs), str(runs / "out"))
    found = json.loads((runs / "out" / "steps-times.json").read_text())
    for name in ("DDIM, 2", "IQL"):
        assert 0 < found[f"{name}_ms"] <= found[f"{name}_p99_ms"]
        assert found[f"{name}_floor_ms"] > 0
        assert found[f"{name}_batch_decisions_per_s"] > 1e3 / found[f"{name}_ms"]


def test_a_decision_that_takes_longer_is_charged_to_the_flight(runs: Path) -> None:
    out = runs / "out"
    out.mkdir()
    (out / "steps-times.json").write_text(json.dumps({f"{name}_ms": 1.0 + number for number, name in enumerate(WAYS)}))
    steps.main("charge", str(runs), str(out), "0")
    rows = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    assert [row["decision_s"] for row in rows] == pytest.approx([0.001, 0.01, 0.002, 0.02])
    slow, slower = (sum(rows[number]["flown"]["duration_s"]) for number in (0, 1))
    assert slower - slow == pytest.approx(3 * 6 * 0.009, rel=0.1)  # it decides otherwise, too
    table = steps._charged_table(rows)
    assert [line[:3] for line in table[1:3]] == [
        ["one-step student", "this machine", "1"],
        ["one-step student", "ten times slower", "10"],
    ]


def test_the_table_sets_cost_beside_time(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def written(way: str, values: list[float]) -> list[dict[str, Any]]:
        return [
            {
                "key": f"{way} {seed}",
                "way": way,
                "seed": seed,
                "charged": "",
                "flown": {"return": [value - 1.0, value + 1.0]},
                "decision_s": 0.02,
            }
            for seed, value in enumerate(values)
        ]

    monkeypatch.setattr(steps, "CHARGED", ())
    monkeypatch.setattr(steps, "WAYS", {steps.TEACHER: steps.WAYS["DDIM, 2"], WAYS[0]: steps.WAYS[WAYS[0]]})
    out = runs / "out"
    out.mkdir()
    rows = written(steps.TEACHER, [-110.0, -120.0]) + written(WAYS[0], [-121.0, -132.0])
    (out / "steps.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    names = [*steps.WAYS, *ALGORITHMS]
    keys = {"ms": 0.5, "p99_ms": 0.9, "floor_ms": 0.1, "batch_decisions_per_s": 1234.0}
    (out / "steps-times.json").write_text(json.dumps({f"{name}_{key}": keys[key] for name in names for key in keys}))
    planner = next(run for run in Plan(SCALES["standard"]).comparison(PROTOCOLS["layouts"]) if run.variant == YARDSTICK)
    row = {"key": planner.key, "scores": {"flown": {"return": [-99.0, -101.0]}}}
    (out / "standard.jsonl").write_text(json.dumps(row) + "\n")
    steps.main("draw", str(out), str(out / "standard.jsonl"))
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in (out / "steps.md").read_text().splitlines()]
    assert len(lines) == 4  # no row of an algorithm, so none in the table
    teacher, student = lines[2:]
    assert teacher[:3] == [steps.TEACHER, "2", teacher[2]]
    assert teacher[3].startswith("15.0 [")
    assert teacher[4] == "+0.0 [0.0, 0.0]"
    assert student[2].startswith("-126 [")
    assert student[4].startswith("+10.0 [")
    low, high = (float(number) for number in student[4].partition("[")[2].strip("]").split(","))
    assert 9.8 < low <= 10.0 <= high < 10.2  # a tenth worse with each seed alike: their spread is not the student's
    assert student[5:] == ["0.5", "0.9", "0.1", "1,234"]
    assert (out / "steps.png").stat().st_size > 10_000


def test_wrong_words_are_refused() -> None:
    for words in ((), ("fly",), ("swim", "a", "b")):
        with pytest.raises(SystemExit, match="Fewer denoising steps"):
            steps.main(*words or ("",))
