"""What is flown: a frozen, validated description of area, traffic, channel, airframe, objective and limits.

Symbols and equation labels are those of Eldeeb & Alves, arXiv:2606.16331, Table I, unless a field says otherwise.
Every field name is unique across sections, so `Scenario.replace(fading="none")` reaches any of them.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from uavrl.errors import ScenarioError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Area(_Section):
    """Where the aircraft flies and the devices lie."""

    width_m: Positive = Field(1000.0, description="extent along x (m)")
    depth_m: Positive = Field(1000.0, description="extent along y (m)")
    border: Literal["stay", "clip", "reflect"] = Field(
        "stay", description="a move over the border is cancelled at no cost (paper), clipped, or reflected"
    )


class Traffic(_Section):
    """The devices and what they send."""

    devices: int = Field(10, ge=1, le=10_000, description="K, devices (count)")
    packet_bits: Positive | tuple[Positive, ...] = Field(2e6, description="D_k (bit), one value or one a device")
    priority: tuple[Share, ...] | None = Field(
        None, description="delta_k, one a device in [0, 1] (weight); none: 1/K each"
    )
    max_age_s: Positive = Field(400.0, description="A_max, upper limit of the age of information (s)")

    @model_validator(mode="after")
    def _one_value_a_device(self) -> Self:
        if isinstance(self.packet_bits, tuple) and len(self.packet_bits) != self.devices:
            raise ValueError(f"packet_bits has {len(self.packet_bits)} values, devices = {self.devices} needs as many")
        if self.priority is not None:
            if len(self.priority) != self.devices:
                raise ValueError(f"priority has {len(self.priority)} values, devices = {self.devices} needs as many")
            if sum(self.priority) <= 0:
                raise ValueError("priority is zero for every device, at least one must be positive")
        return self

    @property
    def packet_bits_each(self) -> tuple[float, ...]:
        """D_k of every device, length K (bit)."""
        return self.packet_bits if isinstance(self.packet_bits, tuple) else (self.packet_bits,) * self.devices

    @property
    def priority_each(self) -> tuple[float, ...]:
        """delta_k of every device, length K."""
        return self.priority if self.priority is not None else (1.0 / self.devices,) * self.devices


class Channel(_Section):
    """Ground-to-air link, eqs. (LoS_Prob) to (rate)."""

    altitude_m: Positive = Field(100.0, description="h, height of flight (m)")
    line_of_sight: Literal["paper", "al_hourani"] = Field(
        "paper", description="eq. (LoS_Prob) with los_c and los_d; or Al-Hourani 2014 with its environment"
    )
    environment: Literal["suburban", "urban", "dense_urban", "high_rise"] = Field(
        "urban",
        description="of al_hourani alone: sets the sigmoid and both excess losses, in place of los_c to excess_nlos_db",
    )
    los_c: Positive = Field(10.0, description="C of eq. (LoS_Prob) (degree)")
    los_d: Positive = Field(0.6, description="D of eq. (LoS_Prob) (1/degree)")
    excess_los_db: NonNegative = Field(1.0, description="xi_LoS (dB)")
    excess_nlos_db: NonNegative = Field(20.0, description="xi_NLoS (dB)")
    carrier_hz: Positive = Field(2e9, description="f_c (Hz)")
    light_speed_mps: Positive = Field(3e8, description="v_l (m/s)")
    bandwidth_hz: Positive = Field(1e6, description="B (Hz)")
    noise_dbm_per_hz: float = Field(-174.0, ge=-250, le=0, description="N_0 (dBm/Hz)")
    transmit_power_w: Positive = Field(0.1259, description="P of a device (W); not in the paper, from its code")
    fading: Literal["none", "rayleigh", "rician", "ergodic"] = Field(
        "rayleigh",
        description="small-scale fading, drawn once a packet; rician: Rician in line of sight, else Rayleigh; "
        "ergodic: the rate is its mean over Rayleigh fading",
    )
    rician_min_db: float = Field(5.0, ge=-100, le=100, description="Rician factor at elevation 0 (dB)")
    rician_max_db: float = Field(15.0, ge=-100, le=100, description="Rician factor overhead (dB)")
    max_transmission_s: Positive | None = Field(
        None, description="a packet that would take longer is lost after this time (s): an outage"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.excess_nlos_db < self.excess_los_db:
            raise ValueError(f"excess_nlos_db = {self.excess_nlos_db} must be >= excess_los_db = {self.excess_los_db}")
        if self.rician_max_db < self.rician_min_db:
            raise ValueError(f"rician_max_db = {self.rician_max_db} must be >= rician_min_db = {self.rician_min_db}")
        return self


class Airframe(_Section):
    """The aircraft: speed, power and how it decides, eqs. (Energy_comm) to (time_total)."""

    speed_mps: Positive = Field(25.0, description="v_u, speed while moving (m/s)")
    max_speed_mps: Positive = Field(25.0, description="v_max (m/s)")
    max_displacement_m: Positive = Field(
        25.0, description="d_max, longest move in a step (m), a disc; not in the paper, from its code"
    )
    propulsion: Literal["paper", "zeng"] = Field("paper", description="eqs. (hover_power), (move_power); or Zeng 2019")
    mass_kg: Positive = Field(0.5, description="m_tot (kg)")
    gravity_mps2: Positive = Field(9.807, description="g (m/s^2)")
    propeller_radius_m: Positive = Field(0.2, description="r_p (m)")
    propellers: int = Field(4, ge=1, description="n_p, propellers (count)")
    air_density_kgpm3: Positive = Field(1.225, description="rho (kg/m^3)")
    max_power_w: NonNegative = Field(5.0, description="P_max, extra power at v_max (W)")
    idle_power_w: NonNegative = Field(0.0, description="P_idle (W)")
    communication_power_w: NonNegative = Field(0.0126, description="P_com (W)")
    blade_power_w: NonNegative = Field(79.86, description="P0 of Zeng 2019, blade profile power (W)")
    induced_power_w: NonNegative = Field(88.63, description="Pi of Zeng 2019, induced power (W)")
    tip_speed_mps: Positive = Field(120.0, description="U of Zeng 2019 (m/s)")
    induced_speed_mps: Positive = Field(4.03, description="v0 of Zeng 2019 (m/s)")
    drag_ratio: NonNegative = Field(0.6, description="d0 of Zeng 2019, fuselage drag (ratio)")
    solidity: NonNegative = Field(0.05, description="s of Zeng 2019, rotor solidity (ratio)")
    disc_area_m2: Positive = Field(0.503, description="A of Zeng 2019 (m^2)")
    decision_s: NonNegative = Field(0.02, description="T_exec, time of a decision (s)")
    decision_time: Literal["fixed", "measured"] = Field(
        "fixed",
        description="T_exec is decision_s; or the policy's own latency, where the caller of the simulator measures it",
    )
    charge_idle_hover: bool = Field(
        False, description="hovering without transmitting costs hover power; the paper charges nothing"
    )
    min_idle_s: NonNegative = Field(0.0, description="a step without service lasts at least this (s)")

    @model_validator(mode="after")
    def _speed(self) -> Self:
        if self.speed_mps > self.max_speed_mps:
            raise ValueError(f"speed_mps = {self.speed_mps} must be <= max_speed_mps = {self.max_speed_mps}")
        return self


class Objective(_Section):
    """What a step costs, eq. (reward) and its readings."""

    reward: Literal["per_step", "per_second"] = Field(
        "per_step",
        description="per_step: ages after the step; per_second: age integrated over the step, discount gamma^seconds",
    )
    age_weight: Share = Field(0.5, description="lambda, share of age against energy (ratio)")
    age_reference_s: Positive = Field(1.0, description="age is divided by this (s)")
    energy_reference_j: Positive | None = Field(
        1000.0, description="energy is divided by this (J); none: hover power x 1 s"
    )


class Limits(_Section):
    """When an episode ends. Steps and time truncate it; a drained battery terminates it."""

    max_steps: int | None = Field(400, ge=1, description="truncated at this many steps (count)")
    time_budget_s: Positive | None = Field(400.0, description="truncated once more than this has elapsed (s)")
    energy_budget_j: Positive | None = Field(None, description="battery; terminated once more has been used (J)")

    @model_validator(mode="after")
    def _ends(self) -> Self:
        if self.max_steps is None and self.time_budget_s is None:
            raise ValueError("max_steps and time_budget_s are both none, an episode needs one of them")
        return self


class Scenario(_Section):
    """A whole scenario. Frozen; make another with `replace`."""

    name: str = Field("custom", description="what tables call it")
    area: Area = Area()
    traffic: Traffic = Traffic()
    channel: Channel = Channel()
    airframe: Airframe = Airframe()
    objective: Objective = Objective()
    limits: Limits = Limits()

    def replace(self, **overrides: Any) -> Scenario:
        """The same scenario with some fields changed, by leaf name (`fading="none"`) or section (`channel={...}`).

        Raises:
            ScenarioError: unknown field, or a value out of its range.
        """
        data = self.model_dump()
        for key, value in overrides.items():
            if key == "name":
                data["name"] = value
            elif key in _SECTIONS:
                section = value.model_dump() if isinstance(value, BaseModel) else value
                if not isinstance(section, Mapping):
                    raise ScenarioError(f"scenario section '{key}' = {value!r}: must be fields with their values")
                data[key] = {**data[key], **section}
            elif key in _SECTION_OF:
                data[_SECTION_OF[key]][key] = value
            else:
                raise ScenarioError(f"scenario field '{key}' does not exist{_nearest(key, _SECTION_OF)}")
        return parse_scenario(data)

    def to_toml(self) -> str:
        """TOML text that `load_scenario` reads back to an equal scenario; None becomes the word "none"."""
        data = self.model_dump(mode="json")
        return tomli_w.dumps(
            {
                key: {k: _NONE if v is None else v for k, v in value.items()} if isinstance(value, dict) else value
                for key, value in data.items()
            }
        )

    def flat(self) -> dict[str, Any]:
        """Every leaf as `section.field` -> value."""
        data = self.model_dump()
        return {f"{section}.{key}": value for section in _SECTIONS for key, value in data[section].items()}


_NONE = "none"  # TOML has no null; the word stands for "no such limit"
_SECTIONS: tuple[str, ...] = tuple(name for name in Scenario.model_fields if name != "name")
_SECTION_OF: dict[str, str] = {
    field: section
    for section in _SECTIONS
    for field in Scenario.model_fields[section].annotation.model_fields  # type: ignore[union-attr]  # all are sections
}
_OPTIONAL = {"priority", "max_transmission_s", "energy_reference_j", "max_steps", "time_budget_s", "energy_budget_j"}


def parse_scenario(data: Mapping[str, Any]) -> Scenario:
    """Validate nested data (sections of fields) into a Scenario.

    Raises:
        ScenarioError: one line naming the field, the value and what is allowed.
    """
    cleaned = {
        key: {k: None if k in _OPTIONAL and v == _NONE else v for k, v in value.items()}
        if isinstance(value, Mapping)
        else value
        for key, value in data.items()
    }
    try:
        return Scenario.model_validate(cleaned)
    except ValidationError as error:
        raise ScenarioError(describe_validation(error, "scenario", known=(*_SECTION_OF, *_SECTIONS))) from None


def describe_validation(error: ValidationError, what: str, known: Iterable[str] = ()) -> str:
    """The first problem of a pydantic error as one line: field, value, what is allowed.

    Args:
        error: what pydantic raised.
        what: opens the line, such as "scenario".
        known: names from which to propose one where a field does not exist.
    """
    problems = error.errors(include_url=False)
    # a union reports each of its branches: the one that got furthest is the one that was meant
    first = max((p for p in problems if p["loc"][:2] == problems[0]["loc"][:2]), key=lambda p: len(p["loc"]))
    # and names them in the location: keep the names that a user wrote
    parts = [str(part) for part in first["loc"]]
    field = ".".join(part for part in parts if "[" not in part and part not in _KINDS)
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        return f"{what} field '{field}' does not exist{_nearest(parts[-1], known)}"
    if first["type"] == "value_error":
        return f"{what} section '{field}': {message}" if field else f"{what}: {message}"
    if first["type"] == "missing":
        return f"{what} field '{field}' is missing"
    return f"{what} field '{field}' = {first['input']!r}: {message[0].lower()}{message[1:]}"


_KINDS = {"float", "int", "str", "bool", "constrained-float", "constrained-int"}


def _nearest(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return f", nearest: {', '.join(near)}" if near else ""


PRESETS: dict[str, Scenario] = {
    # eq. (reward) as printed: both terms over T = 400, delta_k = 1/K inside the sum
    "paper": Scenario(name="paper", objective=Objective(age_reference_s=400.0, energy_reference_j=400.0)),
    "released": Scenario(name="released", objective=Objective(age_reference_s=1.0, energy_reference_j=1000.0)),
    "realistic": Scenario(
        name="realistic",
        channel=Channel(line_of_sight="al_hourani", environment="urban", fading="rician", max_transmission_s=2.0),
        airframe=Airframe(propulsion="zeng", charge_idle_hover=True, min_idle_s=0.1),
        objective=Objective(reward="per_second", age_reference_s=1.0, energy_reference_j=None),
        limits=Limits(max_steps=None, time_budget_s=400.0, energy_budget_j=150e3),
    ),
}


def load_scenario(source: str | Path | Scenario, **overrides: Any) -> Scenario:
    """A preset by name, a TOML file by path, or a Scenario as it is; then `overrides` as in `Scenario.replace`.

    Raises:
        ScenarioError: unknown preset, unreadable file, unknown field or value out of range.
    """
    if isinstance(source, Scenario):
        scenario = source
    elif str(source) in PRESETS:
        scenario = PRESETS[str(source)]
    else:
        path = Path(source)
        if path.suffix != ".toml":
            raise ScenarioError(f"scenario '{source}' is no preset ({', '.join(PRESETS)}) and no .toml file")
        try:
            scenario = parse_scenario(tomllib.loads(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise ScenarioError(f"scenario file '{path}' cannot be read: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ScenarioError(f"scenario file '{path}' is not valid TOML: {error}") from None
    return scenario.replace(**overrides) if overrides else scenario


def scenario_diff(first: Scenario, second: Scenario) -> dict[str, tuple[Any, Any]]:
    """Leaves that differ, as `section.field` -> (value in first, value in second)."""
    left, right = first.flat(), second.flat()
    return {key: (left[key], right[key]) for key in left if left[key] != right[key]}


def hover_reference_j(scenario: Scenario, hover_power_w: float) -> float:
    """The energy that counts 1 in the objective (J): the field, or hover power x 1 s when it is none."""
    reference = scenario.objective.energy_reference_j
    value = hover_power_w * 1.0 if reference is None else reference
    if not math.isfinite(value) or value <= 0:
        raise ScenarioError(f"objective.energy_reference_j = {value}: must be a positive energy in joules")
    return value
