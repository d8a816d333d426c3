from __future__ import annotations

import pytest

from uavrl.agents.registry import preset
from uavrl.experiments.ablation import BASES
from uavrl.experiments.flights import Setting
from uavrl.experiments.paper import (
    ALGORITHMS,
    FIGURES,
    OURS,
    PRIORITIES,
    PROTOCOLS,
    SCALES,
    STARVED,
    Plan,
    wanted,
)
from uavrl.experiments.schedule import estimated_s

STANDARD = Plan(SCALES["standard"])


def test_standard_stays_under_twenty_core_hours() -> None:
    runs = {run.key: run for runs in wanted(SCALES["standard"]).values() for run in runs}
    assert sum(map(estimated_s, runs.values())) < 20 * 3600


def test_a_run_that_two_figures_want_is_one_run() -> None:
    figures = wanted(SCALES["standard"])
    comparison = {run.key for run in figures["comparison"]}
    assert {run.key for run in figures["rates"]} == comparison
    sizes = {run.variant: run.key for run in figures["sizes"] if run.seed == 0}
    denoising = {run.key for run in figures["denoising"]}
    assert {sizes[f"{name} @ 30,000"] for name in ALGORITHMS if name != OURS} < denoising
    assert sizes["CQL @ 10,000"] not in denoising


def test_the_comparison_gives_every_algorithm_equal_data_updates_network_and_seeds() -> None:
    runs = [run for run in STANDARD.comparison(PROTOCOLS["layouts"]) if run.problem == "offline"]
    assert len({run.updates for run in runs}) == 1
    assert len({str(run.options["data"]) for run in runs}) == 1
    assert len({str(run.settings["network"]) for run in runs}) == 1
    for name in ALGORITHMS:
        assert [run.seed for run in runs if run.variant == name] == [0, 1, 2, 3, 4]


def test_sweeps_are_shorter_than_the_headline_and_every_line_of_one_as_long() -> None:
    for name, runs in wanted(SCALES["standard"]).items():
        headline = name in ("comparison", "rates", "fairness")
        lengths = {run.updates for run in runs if run.problem == "offline"}
        assert lengths <= {4_000 if headline or name.endswith("published") else 2_000}, name


def test_no_algorithm_has_its_drift_held_where_algorithms_meet() -> None:
    assert preset("diffusion_sac", "default").shortest_move == 0.04
    assert BASES["fixed"].shortest_move == 0
    for name, runs in wanted(SCALES["standard"]).items():
        assert all(run.settings["shortest_move"] == 0 for run in runs if run.problem != "policy"), name


def test_as_published_means_the_papers_settings_and_a_sampled_action() -> None:
    for run in STANDARD.comparison(PROTOCOLS["published"]):
        setting = Setting.model_validate(run.options)
        assert setting.layouts == "fixed"
        if run.problem == "offline":
            settings = preset(ALGORITHMS[run.variant], "paper").model_dump(mode="json")
            assert run.settings == settings | ({"candidates": 10} if run.variant == "BCQ" else {})
            assert not setting.deterministic


def test_our_settings_are_judged_by_each_algorithms_better_action() -> None:
    judged = {run.variant: run.options["deterministic"] for run in STANDARD.comparison(PROTOCOLS["layouts"])}
    assert {name: judged[name] for name in ALGORITHMS} == {
        OURS: True, "CQL": True, "IQL": True, "BCQ": False, "BC": False,
    }  # fmt: skip


@pytest.mark.parametrize("figure", ["variants", "variants-published"])
def test_the_six_variants_differ_in_alpha_and_eta_alone(figure: str) -> None:
    runs = [run for run in FIGURES[figure].runs(STANDARD) if run.variant.startswith("alpha") and run.seed == 0]
    pairs = {(run.settings.pop("cql_weight"), run.settings.pop("bc_weight")) for run in runs}
    assert pairs == {(alpha, eta) for alpha in (0.0, 1.0) for eta in (0.0, 0.5, 1.0)}
    assert all(run.settings == runs[0].settings for run in runs)


def test_what_a_sweep_sweeps() -> None:
    weights = {run.options["scenario"]["objective"]["age_weight"] for run in STANDARD.age_weights()}
    assert weights == {0.1, 0.5, 0.9}
    assert {tuple(run.options["scenario"]["traffic"]["priority"]) for run in STANDARD.priorities()} == {PRIORITIES}
    assert sum(PRIORITIES) == pytest.approx(1.0)
    logs = {tuple(run.options["data"]["never_served"]) for run in STANDARD.biased() if run.problem == "offline"}
    assert logs == {(), STARVED}
    chains = {
        (run.settings["diffusion"]["schedule"], run.settings["diffusion"]["steps"])
        for run in STANDARD.denoising(PROTOCOLS["layouts"])
        if run.settings.get("name") == "diffusion_sac"
    }
    assert chains == {(schedule, steps) for schedule in ("linear", "vp") for steps in (5, 10, 20, 50)}


def test_every_seed_stays_below_those_of_the_evaluation() -> None:
    for runs in wanted(SCALES["full"]).values():
        assert all(run.seed < 500_000 and run.options["seed"] == 1_000_000 for run in runs)
