"""The scenario: presets, ranges and units, overrides, TOML, and one clear line for every mistake."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pydantic
import pytest
from pydantic.fields import FieldInfo

from uavrl.errors import ScenarioError, UavrlError
from uavrl.scenario import (
    PRESETS,
    Channel,
    Scenario,
    hover_reference_j,
    load_scenario,
    parse_scenario,
    scenario_diff,
)

SECTIONS = ("area", "traffic", "channel", "airframe", "objective", "limits")
FIELDS: dict[str, FieldInfo] = {
    name: field for section in SECTIONS for name, field in type(getattr(Scenario(), section)).model_fields.items()
}
UNITS = ("_m", "_s", "_j", "_w", "_kg", "_hz", "_db", "_dbm_per_hz", "_mps", "_mps2", "_kgpm3", "_m2", "_bits")


def save(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


class TestFields:
    def test_names_are_unique_across_sections(self) -> None:
        names = [name for section in SECTIONS for name in type(getattr(Scenario(), section)).model_fields]
        assert len(names) == len(set(names))
        assert not set(names) & set(SECTIONS)

    def test_each_is_described_and_a_number_has_its_unit(self) -> None:
        for name, field in FIELDS.items():
            assert field.description, name
            is_number = any(kind in str(field.annotation) for kind in ("float", "int"))
            if is_number and not name.endswith(UNITS):
                assert re.search(r"\([\w/^]+\)", field.description), f"{name} has no unit"

    def test_a_number_has_a_range(self) -> None:
        for name, field in FIELDS.items():
            values: list[Any] = [float("nan"), float("inf")]
            if not isinstance(field.default, bool | str):
                values.append(-1e6)
            for value in values:
                with pytest.raises(ScenarioError, match=name):
                    load_scenario("released", **{name: value})

    def test_is_frozen(self) -> None:
        with pytest.raises(pydantic.ValidationError, match="frozen"):
            PRESETS["paper"].channel.altitude_m = 1.0  # type: ignore[misc]  # what must fail


class TestPresets:
    def test_paper_holds_table_one(self) -> None:
        flat = PRESETS["paper"].flat()
        table = {
            "area.width_m": 1000.0,
            "area.depth_m": 1000.0,
            "area.border": "stay",
            "traffic.devices": 10,
            "traffic.packet_bits": 2e6,
            "traffic.priority": None,
            "traffic.max_age_s": 400.0,
            "channel.altitude_m": 100.0,
            "channel.line_of_sight": "paper",
            "channel.los_c": 10.0,
            "channel.los_d": 0.6,
            "channel.excess_los_db": 1.0,
            "channel.excess_nlos_db": 20.0,
            "channel.carrier_hz": 2e9,
            "channel.light_speed_mps": 3e8,
            "channel.bandwidth_hz": 1e6,
            "channel.noise_dbm_per_hz": -174.0,
            "channel.transmit_power_w": 0.1259,
            "channel.fading": "rayleigh",
            "channel.max_transmission_s": None,
            "airframe.speed_mps": 25.0,
            "airframe.max_speed_mps": 25.0,
            "airframe.max_displacement_m": 25.0,
            "airframe.propulsion": "paper",
            "airframe.mass_kg": 0.5,
            "airframe.gravity_mps2": 9.807,
            "airframe.propeller_radius_m": 0.2,
            "airframe.propellers": 4,
            "airframe.air_density_kgpm3": 1.225,
            "airframe.max_power_w": 5.0,
            "airframe.idle_power_w": 0.0,
            "airframe.communication_power_w": 0.0126,
            "airframe.decision_s": 0.02,
            "airframe.decision_time": "fixed",
            "airframe.charge_idle_hover": False,
            "airframe.min_idle_s": 0.0,
            "objective.reward": "per_step",
            "objective.age_weight": 0.5,
            "objective.age_reference_s": 400.0,
            "objective.energy_reference_j": 400.0,
            "limits.max_steps": 400,
            "limits.time_budget_s": 400.0,
            "limits.energy_budget_j": None,
        }
        assert {key: flat[key] for key in table} == table

    def test_released_is_paper_with_another_reward(self) -> None:
        assert scenario_diff(PRESETS["paper"], PRESETS["released"]) == {
            "objective.age_reference_s": (400.0, 1.0),
            "objective.energy_reference_j": (400.0, 1000.0),
        }

    def test_realistic_differs_from_released_where_the_table_says(self) -> None:
        changes = {key: new for key, (_, new) in scenario_diff(PRESETS["released"], PRESETS["realistic"]).items()}
        assert changes == {
            "channel.line_of_sight": "al_hourani",
            "channel.fading": "rician",
            "channel.max_transmission_s": 2.0,
            "airframe.propulsion": "zeng",
            "airframe.charge_idle_hover": True,
            "airframe.min_idle_s": 0.1,
            "objective.reward": "per_second",
            "objective.energy_reference_j": None,
            "limits.max_steps": None,
            "limits.energy_budget_j": 150e3,
        }
        assert PRESETS["realistic"].channel.environment == "urban"
        zeng = PRESETS["realistic"].airframe
        assert (zeng.blade_power_w, zeng.induced_power_w, zeng.tip_speed_mps, zeng.induced_speed_mps) == (
            79.86, 88.63, 120.0, 4.03,
        )  # fmt: skip
        assert (zeng.drag_ratio, zeng.solidity, zeng.disc_area_m2) == (0.6, 0.05, 0.503)
        assert (Channel().rician_min_db, Channel().rician_max_db) == (5.0, 15.0)

    @pytest.mark.parametrize("name", PRESETS)
    def test_is_named_as_it_is_called(self, name: str) -> None:
        assert load_scenario(name) is PRESETS[name]
        assert PRESETS[name].name == name


class TestToml:
    @pytest.mark.parametrize("name", PRESETS)
    def test_round_trip(self, name: str, tmp_path: Path) -> None:
        path = save(tmp_path / "my.toml", PRESETS[name].to_toml())
        assert load_scenario(path) == PRESETS[name]
        assert load_scenario(str(path)) == PRESETS[name]

    def test_round_trip_of_lists_and_limits(self, tmp_path: Path) -> None:
        scenario = load_scenario(
            "paper", devices=3, packet_bits=(1e6, 2e6, 4e6), priority=(0.2, 0.3, 0.5), max_steps=None
        )
        assert load_scenario(save(tmp_path / "my.toml", scenario.to_toml())) == scenario

    def test_the_word_none_stands_for_no_limit(self, tmp_path: Path) -> None:
        text = '[limits]\nmax_steps = "none"\n[channel]\nfading = "none"\nmax_transmission_s = "none"\n'
        scenario = load_scenario(save(tmp_path / "my.toml", text))
        assert scenario.limits.max_steps is None
        assert scenario.channel.max_transmission_s is None
        assert scenario.channel.fading == "none"

    def test_what_a_file_leaves_out_is_as_released(self, tmp_path: Path) -> None:
        path = save(tmp_path / "my.toml", 'name = "low"\n[channel]\naltitude_m = 50\n')
        assert load_scenario(path) == PRESETS["released"].replace(name="low", altitude_m=50.0)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a = = 3", "not valid TOML"),
            ("[channel]\nfadin = 'none'", "'channel.fadin' does not exist, nearest: fading"),
            ("[chanel]\nfading = 'none'", "'chanel' does not exist, nearest: channel"),
            ("channel = 5", "'channel' = 5"),
            ("[channel]\ntransmit_power_w = -1", "'channel.transmit_power_w' = -1: input should be greater than 0"),
            ("[area]\nwidth_m = 'none'", "'area.width_m' = 'none'"),
        ],
    )
    def test_a_bad_file_gets_one_line(self, text: str, message: str, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=re.escape(message)) as error:
            load_scenario(save(tmp_path / "my.toml", text))
        assert "\n" not in str(error.value)

    def test_a_file_that_is_not_there_or_no_text(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=r"gone\.toml' cannot be read: No such file"):
            load_scenario(tmp_path / "gone.toml")
        (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
        with pytest.raises(ScenarioError, match="not valid TOML"):
            load_scenario(tmp_path / "bytes.toml")

    def test_an_unknown_preset_lists_the_presets(self) -> None:
        with pytest.raises(ScenarioError, match=r"'papers' is no preset \(paper, released, realistic\)"):
            load_scenario("papers")


class TestReplace:
    def test_reaches_any_field(self) -> None:
        other: dict[str, Any] = {
            "border": "clip",
            "line_of_sight": "al_hourani",
            "environment": "suburban",
            "fading": "ergodic",
            "propulsion": "zeng",
            "decision_time": "measured",
            "charge_idle_hover": True,
            "reward": "per_second",
            "priority": (0.05,) * 10,
            "devices": 7,
            "propellers": 7,
            "max_steps": 7,
            "age_weight": 0.25,
            "noise_dbm_per_hz": -170.0,
            "speed_mps": 20.0,
            "max_speed_mps": 30.0,
            "excess_los_db": 0.5,
        }
        base = PRESETS["released"]
        for name in FIELDS:
            value = other.get(name, 7.5 if name != "excess_nlos_db" else 25.0)
            changed = base.replace(**{name: value})
            (key,) = scenario_diff(base, changed)
            assert key.endswith(f".{name}")
            assert changed.flat()[key] == value
            assert base.replace(**{key.split(".")[0]: {name: value}}) == changed

    def test_takes_a_section_whole(self) -> None:
        channel = Channel(fading="none", altitude_m=60.0)
        assert PRESETS["paper"].replace(channel=channel).channel == channel

    def test_a_list_of_another_length_than_devices(self) -> None:
        scenario = PRESETS["paper"].replace(packet_bits=[1e6] * 10, priority=[0.1] * 10)
        with pytest.raises(ScenarioError, match=r"packet_bits has 10 values, devices = 5 needs as many"):
            scenario.replace(devices=5)
        with pytest.raises(ScenarioError, match=r"priority has 10 values, devices = 5 needs as many"):
            scenario.replace(devices=5, packet_bits=2e6)
        assert scenario.replace(devices=5, packet_bits=2e6, priority=None).traffic.priority_each == (0.2,) * 5

    @pytest.mark.parametrize(
        ("overrides", "message"),
        [
            ({"fadin": "none"}, "field 'fadin' does not exist, nearest: fading"),
            ({"channel": 5}, "section 'channel' = 5: must be fields with their values"),
            ({"channel": "none"}, "section 'channel' = 'none': must be fields with their values"),
            (
                {"fading": "rice"},
                "'channel.fading' = 'rice': input should be 'none', 'rayleigh', 'rician' or 'ergodic'",
            ),
            ({"packet_bits": -1}, "'traffic.packet_bits' = -1: input should be greater than 0"),
            ({"packet_bits": [1e6] * 9 + [0]}, "'traffic.packet_bits.9' = 0: input should be greater than 0"),
            ({"priority": [0.1] * 9 + [2]}, "'traffic.priority.9' = 2: input should be less than or equal to 1"),
            ({"priority": [0.0] * 10}, "priority is zero for every device"),
            ({"devices": 2.5}, "'traffic.devices' = 2.5: input should be a valid integer"),
            ({"max_steps": None, "time_budget_s": "none"}, "max_steps and time_budget_s are both none"),
            ({"speed_mps": 30}, "speed_mps = 30.0 must be <= max_speed_mps = 25.0"),
            ({"excess_nlos_db": 0.5}, "excess_nlos_db = 0.5 must be >= excess_los_db = 1.0"),
            ({"rician_max_db": 4}, "rician_max_db = 4.0 must be >= rician_min_db = 5.0"),
        ],
    )
    def test_a_mistake_gets_one_line(self, overrides: dict[str, Any], message: str) -> None:
        with pytest.raises(ScenarioError, match=re.escape(message)) as error:
            load_scenario("released", **overrides)
        assert "\n" not in str(error.value)
        assert isinstance(error.value, UavrlError)

    def test_leaves_the_original_alone(self) -> None:
        before = PRESETS["paper"].flat()
        PRESETS["paper"].replace(fading="none")
        assert PRESETS["paper"].flat() == before


def test_lists_of_each_device() -> None:
    traffic = load_scenario("released", devices=4).traffic
    assert traffic.priority_each == (0.25,) * 4
    assert traffic.packet_bits_each == (2e6,) * 4
    assert sum(load_scenario("released").traffic.priority_each) == pytest.approx(1.0)


def test_hover_reference_is_a_second_of_hovering_where_none_is_given() -> None:
    assert hover_reference_j(PRESETS["released"], 9.8) == 1000.0
    assert hover_reference_j(PRESETS["realistic"], 168.49) == 168.49
    with pytest.raises(ScenarioError, match=r"energy_reference_j = 0\.0: must be a positive energy"):
        hover_reference_j(PRESETS["realistic"], 0.0)


def test_a_missing_section_is_the_default() -> None:
    assert parse_scenario({"name": "custom"}) == Scenario()
