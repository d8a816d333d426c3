from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tests.evaluation.flying import Scripted, Wanderer
from uavrl.errors import ConfigError
from uavrl.evaluation.metrics import flight_metrics
from uavrl.evaluation.report import (
    Judgement,
    judge,
    markdown_table,
    notes,
    returns_of_duty,
    rich_table,
    write_json,
)
from uavrl.evaluation.rollouts import evaluation_set
from uavrl.policies.base import Policy
from uavrl.scenario import PRESETS, load_scenario

SHORT = load_scenario("released", max_steps=20)


@pytest.fixture(scope="module")
def judgement() -> Judgement:
    policies: dict[str, Policy] = {
        "tdm": Scripted((1, 2, 3, 4, 5, 6, 7, 8, 9, 10)),
        "planner": Scripted((1, 0, 2, 0, 3), name="other"),
        "idle": Scripted((0,)),
        "wanderer": Wanderer(),
    }
    return judge(policies, evaluation_set(SHORT, "random", 6, fading_seeds=2), command="uavrl evaluate")


def plain(report: dict[str, Any]) -> str:
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(rich_table(report))
    return console.export_text()


def test_means_are_those_of_the_flights(judgement: Judgement) -> None:
    for name, flights in judgement.flights.items():
        for metric, values in flight_metrics(flights).items():
            mean = judgement.report["policies"][name][metric]["mean"]
            if np.isnan(values).all():
                assert mean is None
            else:
                assert mean == pytest.approx(values.mean())


def test_intervals_hold_their_mean_and_differences_are_of_means(judgement: Judgement) -> None:
    report = judgement.report
    assert {name: [*row] for name, row in report["paired"].items()} == {
        "tdm": ["planner"],
        "planner": ["tdm"],
        "idle": ["tdm", "planner"],
        "wanderer": ["tdm", "planner"],
    }
    for name, row in report["paired"].items():
        for baseline, metrics in row.items():
            assert {"return", "excess_cost", "decision_ms", "age_per_second_s"} <= set(metrics)
            for metric, value in metrics.items():
                own, other = (report["policies"][who][metric]["mean"] for who in (name, baseline))
                if value["mean"] is None:
                    assert None in (own, other)
                else:
                    assert value["mean"] == pytest.approx(own - other, abs=1e-12)
                    assert value["low"] <= value["mean"] <= value["high"]


def test_excess_cost_and_normalised_return_follow_their_formulae(judgement: Judgement) -> None:
    policies = judgement.report["policies"]
    means = {name: values["return"]["mean"] for name, values in policies.items()}
    for name, values in policies.items():
        assert values["excess_cost"]["mean"] == pytest.approx(means[name] / means["planner"] - 1)
        expected = 100 * (means[name] - means["tdm"]) / (means["planner"] - means["tdm"])
        assert values["normalised_return"]["mean"] == pytest.approx(expected)
    assert policies["planner"]["excess_cost"] == {"mean": 0, "low": 0, "high": 0}


def test_a_bootstrap_unit_is_an_environment_with_its_fading_repeats(judgement: Judgement) -> None:
    assert judgement.report["bootstrap"]["units"] == 6
    # starts and layouts differ much more than two fadings of one: the interval must be the wider one
    values = flight_metrics(judgement.flights["tdm"])["return"].reshape(6, 2).mean(axis=1)
    interval = judgement.report["policies"]["tdm"]["return"]
    assert interval["high"] - interval["low"] == pytest.approx(2 * 1.96 * values.std() / np.sqrt(6), rel=0.25)


def test_without_a_planner_there_is_no_excess_cost() -> None:
    report = judge({"tdm": Scripted((1,))}, evaluation_set(SHORT, "fixed", 2)).report
    assert not {"excess_cost", "normalised_return"} & set(report["policies"]["tdm"])
    assert "excess" not in markdown_table(report)


def test_the_order_of_policies_changes_no_number() -> None:
    environments = evaluation_set(SHORT, "random", 3)
    first = judge({"a": Wanderer(), "b": Scripted((1, 2))}, environments, baselines=["b"]).report
    second = judge({"b": Scripted((1, 2)), "a": Wanderer()}, environments, baselines=["b"]).report
    for report in (first, second):
        for row in (*report["policies"].values(), report["paired"]["a"]["b"]):
            del row["decision_ms"], row["decision_p95_ms"]
    assert first["policies"] == second["policies"]
    assert first["paired"] == second["paired"]


def test_the_report_says_what_was_flown_and_is_json(judgement: Judgement, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_json(path, judgement.report)
    read = json.loads(path.read_text(), parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert read == judgement.report
    assert load_scenario("released").replace(**{k: v for k, v in read["scenario"].items() if k != "name"}) == SHORT
    assert (read["seed"], read["layouts"], read["episodes"], read["fading_seeds"]) == (1_000_000, "random", 6, 2)
    assert set(read["versions"]) == {"uavrl", "python", "numpy", "torch", "commit"}
    assert read["command"] == "uavrl evaluate"


def test_a_failed_write_leaves_the_old_report(
    judgement: Judgement, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("uavrl.evaluation.report.os.fsync", full)
    with pytest.raises(ConfigError, match="No space left"):
        write_json(path, judgement.report)
    assert path.read_text() == "old"
    assert [*tmp_path.iterdir()] == [path]


def test_both_tables_show_every_policy_and_the_same_numbers(judgement: Judgement) -> None:
    markdown, terminal = markdown_table(judgement.report), plain(judgement.report)
    value = judgement.report["policies"]["wanderer"]["age_per_step_s"]
    shown = f"{value['mean']:.2f} [{value['low']:.2f}, {value['high']:.2f}]"
    for text in (markdown, terminal):
        assert shown in text
        assert "Difference in return on equal flights" in text
        assert "infinite" in text  # Rayleigh fading, no limit on a transmission
        assert "20 steps or 400 s" in text
        for name in judgement.report["policies"]:
            assert name in text
    row = next(line for line in markdown.splitlines() if line.startswith("| idle |") and " - |" in line)
    assert row.count("-") >= 4  # what an idle flight has none of
    assert markdown.count("|---") == sum(line.count("|") - 1 for line in markdown.splitlines() if line[:4] == "|---")


def test_a_difference_is_marked_only_where_its_interval_is_clear_of_zero(judgement: Judgement) -> None:
    rows = markdown_table(judgement.report).split("equal flights")[1].splitlines()
    for name, row in judgement.report["paired"].items():
        (line,) = [line for line in rows if line.startswith(f"| {name} |")]
        clear = [value["return"]["low"] > 0 or value["return"]["high"] < 0 for value in row.values()]
        assert line.count("*") == sum(clear)


def test_idling_is_said_to_pay_where_it_does() -> None:
    # steps of T_com + T_exec = .1335 s (ergodic), K = 10: served every step, the mean age settles at 4.5 steps
    for preset, pays in (("paper", True), ("released", False)):
        always, seldom = returns_of_duty(PRESETS[preset], (1, 5))
        assert (seldom > always) == pays, preset
    always = returns_of_duty(PRESETS["released"], (1,))[0]
    settled = 400 * 0.5 * (4.5 * 0.1335 + 0.1135 * 9.797 / 1000)
    assert always == pytest.approx(-settled, rel=0.03)
    told = judge({"tdm": Scripted((1,))}, evaluation_set("paper", "random", 1)).report["notes"]
    assert not any("Whoever flies" in note for note in told)  # a lucky draw of Rayleigh fading beats any bound
    assert any("pays for serving rarely" in note for note in told)


def test_flights_flown_before_count_as_if_flown_now(judgement: Judgement) -> None:
    environments = evaluation_set(SHORT, "random", 6, fading_seeds=2)
    before = {name: judgement.flights[name] for name in ("tdm", "planner", "idle")}
    again = judge({"wanderer": Wanderer()}, environments, flown=before).report
    assert [*again["policies"]] == [*judgement.report["policies"]]
    for name in again["policies"]:
        assert again["policies"][name]["return"] == judgement.report["policies"][name]["return"]
    with pytest.raises(ConfigError, match="'tdm' was flown in other environments"):
        judge({}, evaluation_set(SHORT, "random", 6, fading_seeds=2, seed=3), flown=before)
    with pytest.raises(ConfigError, match="'idle' takes part twice"):
        judge({"idle": Wanderer()}, environments, flown=before)


def test_who_takes_part_is_checked() -> None:
    environments = evaluation_set(SHORT, "random", 1)
    with pytest.raises(ConfigError, match="baseline 'planner' does not take part, allowed: tdm"):
        judge({"tdm": Scripted((1,))}, environments, baselines=["planner"])
    with pytest.raises(ConfigError, match="policies is empty"):
        judge({}, environments)


@pytest.mark.parametrize(
    ("changes", "bound"),
    [
        ({}, "0.558 s a step over 400 steps"),
        ({"max_steps": None}, "0.640 s a second over 400 s"),
        ({"priority": (1.0,) * 10}, "0.558 s a step over 400 steps"),  # ages are weighed by shares of the priorities
    ],
)
def test_lower_bounds_are_told_where_service_times_have_them(changes: dict[str, Any], bound: str) -> None:
    calm = load_scenario("released", fading="none", **changes)
    assert f"Whoever flies, the mean age is at least {bound} (docs/bounds.md)." in [*notes(calm, {})]
    assert not any("Whoever flies" in note for note in notes(calm.replace(decision_time="measured"), {}))
    lossy = PRESETS["realistic"]  # fading drawn once a packet, which is lost after a limit
    told = "In the mean over the fading, whoever flies, the mean age is at least 0.638 s a second over 400 s"
    assert f"{told} (docs/bounds.md)." in [*notes(lossy, {})]
    assert not any("whoever flies" in note for note in notes(lossy.replace(max_steps=400), {}))
