from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.datasets.flights import fly, small_scenario
from uavrl.datasets import Transitions, select, validate
from uavrl.datasets.validation import validated
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario, load_scenario

Columns = dict[str, NDArray[Any]]


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"border": "reflect"},
        {"border": "clip", "reward": "per_second"},
        {"priority": (0.7, 0.1, 0.2), "packet_bits": (1e6, 2e6, 3e6), "age_reference_s": 400.0},
        {"max_age_s": 5.0, "reward": "per_second", "age_weight": 0.9},
        {"energy_budget_j": 150.0, "propulsion": "zeng", "charge_idle_hover": True, "energy_reference_j": None},
        {"fading": "rician", "max_transmission_s": 2.0, "min_idle_s": 0.1},
    ],
)
def test_what_the_simulator_logs_is_valid(overrides: dict[str, Any]) -> None:
    scenario = small_scenario(**overrides)
    log = fly(scenario, environments=8, steps=60)
    validate(log, scenario)
    validate(select(log, 200), scenario)


@pytest.mark.parametrize("name", ["paper", "released", "realistic"])
def test_long_flights_of_each_preset_are_valid(name: str) -> None:
    scenario = load_scenario(name)
    validate(fly(scenario, environments=4, steps=500), scenario)


def test_a_single_row_is_valid(log: Transitions, scenario: Scenario) -> None:
    validate(log.take(slice(7, 8)), scenario)


def put(name: str, index: Any, value: Any) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        columns[name][index] = value

    return change


def scaled(name: str, factor: float) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        columns[name] *= factor

    return change


def swapped(first: int, second: int) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        for values in columns.values():
            values[[first, second]] = values[[second, first]]

    return change


REFUSED = {
    "nan": (put("age_s", (17, 2), np.nan), r"row 17 \(episode 1, step 5\), column 'age_s'\[2\] = nan, .* finite"),
    "inf": (put("reward", 3, -np.inf), r"row 3 .*'reward' = -inf, allowed: a finite number"),
    "huge": (put("next_energy_j", 3, 3e38), r"row 3 .*'energy_term' = .*, allowed: 3e\+35 from next_energy_j"),
    "layout outside": (put("layout_m", (slice(0, 12), 1, 0), 1001.0), r"row 0 .*'layout_m'\[1\]\[0\] = 1001, .*area"),
    "position outside": (put("position_m", (4, 1), -1.0), r"row 4 .*'position_m'\[1\] = -1, .*inside the area"),
    "next outside": (put("next_position_m", (4, 1), 1e4), r"row 4 .*'next_position_m'\[1\] = 10000, .*1000 x 1000 m"),
    "age negative": (put("age_s", (9, 0), -0.5), r"row 9 .*'age_s'\[0\] = -0.5, allowed: 0 to 400 s \(max_age_s\)"),
    "age in ms": (put("next_age_s", (9, 0), 1200.0), r"row 9 .*'next_age_s'\[0\] = 1200, allowed: 0 to 400 s"),
    "age in minutes": (scaled("next_age_s", 1 / 60), r"row 0 .*'age_term' = .*are ages, durations or the term in"),
    "commanded in cm": (scaled("displacement_m", 100.0), r"row 0 .*'displacement_m'\[.\] = .*-25 to 25 m"),
    "flown too far": (put("executed_displacement_m", 5, (20.0, 20.0)), r"row 5 .* = 20, 20, .*a move of at most 25 m"),
    "flown in km": (scaled("executed_displacement_m", 1e-3), r"row 0 .*'next_position_m'\[.\].*= position_m \+ exec"),
    "device": (put("device", 8, 4), r"row 8 .*'device' = 4, allowed: 0 \(idle\) to 3"),
    "device below": (put("device", 8, -1), r"row 8 .*'device' = -1"),
    "duration": (put("duration_s", 8, -0.1), r"row 8 .*'duration_s' = -0.1, allowed: 0 s or more"),
    "energy": (put("next_used_j", 8, -0.1), r"row 8 .*'next_used_j' = -0.1, allowed: 0 J or more"),
    "energy in mJ": (scaled("next_energy_j", 1e3), r"row 0 .*'energy_term' = .*is the energy or the term in other"),
    "energy term": (scaled("energy_term", 2.5), r"row 0 .*'energy_term' = "),
    "reward halved": (
        scaled("reward", 0.5),
        r"row 0 .*'reward' = .*lambda = 0.5: is the reward in other units, or .*uavrl data relabel changes it\)\?",
    ),
    "reward sign": (scaled("reward", -1.0), r"row 0 .*'reward' = "),
    "one reward": (put("reward", 30, -9.0), r"row 30 .*'reward' = -9, allowed: -"),
    "episode negative": (put("episode", slice(0, 12), -1), r"row 0 .*'episode' = -1, allowed: 0 or more"),
    "step negative": (put("step", 0, -1), r"row 0 .*'step' = -1, allowed: 0 or more"),
    "episodes out of order": (swapped(11, 12), r"row 12 \(episode 0, step 11\), column 'episode' = 0, .*no less than"),
    "steps out of order": (swapped(3, 4), r"row 4 \(episode 0, step 3\), column 'step' = 3, allowed: more than"),
    "step repeated": (put("step", 4, 3), r"row 4 .*'step' = 3, allowed: more than"),
    "layout changes": (put("layout_m", (6, 0, 0), 1.0), r"row 6 .*'layout_m'\[0\]\[0\] = 1, allowed: one layout"),
    "devices from 0": (scaled("device", 0), r"'next_age_s'\[.\] = 0, allowed: .* = age_s \+ duration_s, or 0 for the"),
    "duration in ms": (scaled("duration_s", 1000), r"'next_age_s'\[.\] = .*duration_s or device is wrong"),
    "time limit as an end": (
        put("terminated", 11, True),
        r"row 11 .*'terminated' = 1, allowed: false where nothing but",
    ),
    "goes on after the end": (put("terminated", 6, True), r"row 6 .*'terminated' = 1, allowed: false, as the next row"),
    "goes on after a cut": (put("truncated", 6, True), r"row 6 .*'truncated' = 1, allowed: false"),
    "age jumps": (put("age_s", (6, 1), 3.25), r"row 6 .*'age_s'\[1\] = 3.25, allowed: .*, the next_age_s of the step"),
    "used jumps": (put("used_j", 6, 1e3), r"row 6 .*'used_j' = 1000, allowed: .*, the next_used_j of the step"),
    "energy jumps": (put("energy_j", 6, 1e3), r"row 6 .*'energy_j' = 1000, allowed: .*, the next_energy_j of the"),
    "position jumps": (put("position_m", 6, 500.0), r"row 6 .*'next_position_m'\[0\] = .*allowed: "),
}


@pytest.mark.parametrize("change", REFUSED)
def test_the_first_bad_row_is_named(log: Transitions, scenario: Scenario, change: str) -> None:
    alter, message = REFUSED[change]
    columns = {name: values.copy() for name, values in log.columns().items()}
    alter(columns)
    with pytest.raises(DatasetError, match=message) as caught:
        validate(Transitions(**columns), scenario, "my.parquet")
    assert str(caught.value).startswith("my.parquet: row ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rows", [1, 7])
@pytest.mark.parametrize("change", REFUSED)
def test_the_same_row_is_named_where_a_log_comes_in_parts(
    log: Transitions, scenario: Scenario, change: str, rows: int
) -> None:
    """Also where it contradicts a row of the part before: with a row a part, every contradiction does."""
    alter, _ = REFUSED[change]
    columns = {name: values.copy() for name, values in log.columns().items()}
    alter(columns)
    whole = Transitions(**columns)
    with pytest.raises(DatasetError) as expected:
        validate(whole, scenario)
    with pytest.raises(DatasetError) as caught:
        list(validated(whole.parts(rows), scenario))
    assert str(caught.value).split(",")[0] == str(expected.value).split(",")[0]  # row and episode


def test_parts_pass_as_they_are_and_empty_ones_are_left_out(log: Transitions, scenario: Scenario) -> None:
    nothing = log.take(slice(0, 0))
    found = list(validated([nothing, *log.parts(50), nothing, log.take(slice(100, 100))], scenario))
    assert [len(part) for part in found] == [50, 50, 20]
    assert found[1].digest() == log.take(slice(50, 100)).digest()
    with pytest.raises(DatasetError, match="log: no rows, allowed: 1 or more"):
        list(validated([nothing], scenario, "log"))
    with pytest.raises(DatasetError, match="K = 2 devices, allowed: 3"):
        list(validated([log, fly(small_scenario(devices=2), steps=3)], scenario))


def test_a_gap_excuses_a_jump_and_rounding_is_no_error(log: Transitions, scenario: Scenario) -> None:
    validate(log.take(np.r_[0:3, 5:12, 40:44]), scenario)
    columns = log.columns()
    rounded: dict[str, Any] = {
        name: (values * np.float32(1 + 3e-7) if name in ("reward", "age_term", "energy_term", "used_j") else values)
        for name, values in columns.items()
    }
    validate(Transitions(**rounded), scenario)


def test_another_scenario_is_noticed(log: Transitions, scenario: Scenario) -> None:
    with pytest.raises(DatasetError, match="K = 3 devices, allowed: 10, as scenario 'released' has"):
        validate(log, load_scenario("released"))
    with pytest.raises(DatasetError, match=r"'reward' = .* lambda = 0\.25"):
        validate(log, scenario.replace(age_weight=0.25))
    with pytest.raises(DatasetError, match="'age_term' = "):
        validate(log, scenario.replace(age_reference_s=400.0))
    with pytest.raises(DatasetError, match="no rows"):
        validate(log.take(slice(0, 0)), scenario)
