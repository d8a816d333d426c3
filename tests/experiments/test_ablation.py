from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.registry import changed, preset
from uavrl.experiments import ablation
from uavrl.experiments.ablation import BASE, BASES, CANDIDATES, VARIANTS, measure, runs, summary, table
from uavrl.experiments.runner import Run
from uavrl.scenario import load_scenario


def small(run: Run, **settings: object) -> Run:
    config = DiffusionSacConfig.model_validate(run.settings)
    network = config.network.model_copy(update={"width": 8})
    tiny = config.model_copy(update={"network": network, "batch_size": 8, **settings})
    return run.model_copy(update={"settings": tiny.model_dump(mode="json"), "updates": 2})


@pytest.mark.parametrize("problem", list(BASES))
def test_each_run_changes_what_its_name_says_and_nothing_else(problem: str) -> None:
    found = runs(problem, (0, 1))
    base = BASES[problem].model_dump(mode="json")
    assert len({run.key for run in found}) == len(found)
    for run in found:
        differing = {name for name in base if run.settings[name] != base[name]}
        assert differing <= set(VARIANTS[run.variant]), run.variant
        assert (run.variant == BASE) == (not differing)
        assert run.seed in (0, 1)


def test_flights_start_from_the_default_preset_with_every_move_flown() -> None:
    assert BASES["fixed"] == preset("diffusion_sac", "default").model_copy(update={"shortest_move": 0.0})


def test_a_nested_change_keeps_its_neighbours() -> None:
    config = changed(BASES["bandit"], {"network": {"choice_heads": False}})
    assert config.network.width == BASES["bandit"].network.width
    assert not config.network.choice_heads


def test_the_bandit_is_measured_with_each_number_of_candidates(tmp_path: Path) -> None:
    (run,) = runs("bandit", (0,), (BASE,))
    scores = measure(small(run), tmp_path)
    names = ("right_choice", "near_mode", "both")
    assert set(scores) == {*names, *(f"{name}@{count}" for name in names for count in CANDIDATES)}
    for end in ("", *(f"@{count}" for count in CANDIDATES)):
        right, near, both = (scores[f"{name}{end}"] for name in names)
        assert right + near - 1 <= both <= min(right, near)


def test_flights_are_measured_by_either_action(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ablation, "CANDIDATES", (2,))
    monkeypatch.setattr(ablation, "load_scenario", lambda name: load_scenario(name, max_steps=5))
    (run,) = runs("fixed", (0,), (BASE,))
    few = run.model_copy(update={"options": {**run.options, "episodes": 2}})
    scores = measure(small(few, null_candidate=False), tmp_path)  # which may be every first step's best
    assert set(scores) == {"return_deterministic", "return_sampled", "return_sampled@2"}
    assert all(-100 < value < 0 for value in scores.values())
    assert len(set(scores.values())) == 3


def test_returns_are_filed_under_the_action_that_flew_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fly(policy: object, flights: object, *, deterministic: bool) -> SimpleNamespace:
        return SimpleNamespace(reward=np.full((3, 2), -1.0 if deterministic else -2.0), active=np.ones((3, 2)))

    monkeypatch.setattr(ablation, "fly", fly)
    (run,) = runs("fixed", (0,), ("no action noise",))
    assert measure(small(run), tmp_path) == {"return_deterministic": -3.0, "return_sampled": -6.0}


def test_the_table_has_a_line_a_variant_and_one_for_each_number_of_candidates() -> None:
    rows = [
        {"variant": "base", "scores": {"a": 0.5, "a@10": 0.75}},
        {"variant": "base", "scores": {"a": 0.25, "a@10": 1.0}},
        {"variant": "mean |Q|", "scores": {"a": 1.0}},
    ]
    assert table(rows).splitlines()[2:] == [
        "| base | 2 | 0.500, 0.250 |",
        "| 10 candidates | 2 | 0.750, 1.000 |",
        r"| mean \|Q\| | 1 | 1.000 |",
    ]


def test_the_interval_is_students() -> None:
    assert summary([1.0, 2.0, 3.0]) == "2.000 ± 2.484"  # 4.3027 / sqrt(3)
    assert summary([-100.0, -200.0, -300.0]) == "-200 ± 248"
