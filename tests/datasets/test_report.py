from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from uavrl.datasets import Transitions, describe, select
from uavrl.datasets.report import heat_map, render
from uavrl.scenario import Scenario


def test_returns_are_of_complete_episodes_alone(log: Transitions, scenario: Scenario) -> None:
    summary = describe(log, scenario)
    returns = [log.reward[log.episode == e].sum() for e in range(12) if log.truncated[log.episode == e].any()]
    assert summary["complete_episodes"] == len(returns) == 9
    assert summary["return"] == pytest.approx(np.mean(returns), rel=1e-5)
    holed = log.take(~((log.step == 3) & (log.episode < 8)))
    assert describe(holed, scenario)["complete_episodes"] == 1
    headless = log.take(log.step > 0)
    assert describe(headless, scenario)["return"] is None


def test_figures_are_those_of_the_columns(log: Transitions, scenario: Scenario) -> None:
    part = select(log, 97)
    summary = describe(part, scenario)
    assert (summary["rows"], summary["episodes"], summary["layouts"]) == (97, 12, 12)
    assert summary["reward_per_step"] == pytest.approx(part.reward.mean(), rel=1e-5)
    assert summary["age_worst_device_s"] == pytest.approx(max(part.next_age_s[:, k].mean() for k in range(3)), rel=1e-5)
    assert summary["energy_per_step_j"] == pytest.approx(part.next_energy_j.mean(), rel=1e-5)
    assert summary["device_shares"] == pytest.approx([(part.device == k).mean() for k in range(4)])
    assert summary["truncated_share"] == pytest.approx(part.truncated.mean())
    assert [third["rows"] for third in summary["thirds"]] == [(part.episode // 4 == k).sum() for k in range(3)]
    flown = np.hypot(*part.executed_displacement_m.T)
    assert summary["flown_m"]["p50"] == pytest.approx(np.median(flown))
    assert json.loads(json.dumps(summary)) == summary


def test_cells_are_counted_where_the_aircraft_was(log: Transitions, scenario: Scenario) -> None:
    position = np.tile(np.array([[1000.0, 0.0]], dtype=np.float32), (len(log), 1))  # the far corner is inside
    position[:30] = [125.0, 60.0]
    columns = {**log.columns(), "next_position_m": position}
    summary = describe(Transitions(**columns), scenario)
    visits = np.array(summary["visits"])
    assert visits.shape == (20, 20)
    assert (visits[1, 2], visits[0, 19], visits.sum()) == (30, 90, 120)
    assert summary["coverage_share"] == pytest.approx(2 / 400)


def test_the_map_has_north_above_and_shades_by_number() -> None:
    assert heat_map([[0, 1], [100, 0]]) == "@@  \n  .."
    assert heat_map([[0]]) == "  "


def test_the_report_shows_what_was_found(log: Transitions, scenario: Scenario) -> None:
    summary = describe(log, scenario)
    text = shown(summary, "my log")
    for piece in ("my log", "12, of which complete 9", f"{summary['return']:.2f} an episode", "K = 3 devices"):
        assert piece in text
    assert heat_map(summary["visits"]).splitlines()[10].rstrip() in text
    assert "no complete episode" in shown(describe(log.take(log.step > 0), scenario), "part")


def shown(summary: dict[str, object], title: str) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(render(summary, title))
    return capture.get()
