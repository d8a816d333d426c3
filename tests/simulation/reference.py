"""One step of one aircraft in plain Python, written from the paper's equations alone, and scenarios to try it on."""

from __future__ import annotations

import math
from typing import Any

from scipy import special

from uavrl.scenario import Scenario, load_scenario

_ENVIRONMENTS = {
    "suburban": (4.88, 0.43, 0.1, 21.0),
    "urban": (9.61, 0.16, 1.0, 20.0),
    "dense_urban": (12.08, 0.11, 1.6, 23.0),
    "high_rise": (27.23, 0.08, 2.3, 34.0),
}

_UNEVEN = tuple(5e5 * (1 + k) for k in range(10))
_PRIORITY = tuple((1 + k) / 55 for k in range(10))

_CHANGES: dict[str, dict[str, Any]] = {
    "no fading": {"fading": "none"},
    "ergodic": {"fading": "ergodic"},
    "rician": {"fading": "rician"},
    "rician in a wide range": {"fading": "rician", "rician_min_db": -3.0, "rician_max_db": 20.0},
    "outage": {"max_transmission_s": 0.2},
    "outage without fading": {"fading": "none", "max_transmission_s": 0.2},
    **{name: {"line_of_sight": "al_hourani", "environment": name} for name in _ENVIRONMENTS},
    "zeng": {"propulsion": "zeng", "speed_mps": 10.0},
    "slow": {"speed_mps": 8.0, "idle_power_w": 2.0, "max_power_w": 7.0},
    "clip": {"border": "clip", "max_displacement_m": 400.0},
    "reflect": {"border": "reflect", "max_displacement_m": 2500.0},
    "far moves": {"max_displacement_m": 400.0},
    "long and narrow": {"depth_m": 300.0, "border": "clip", "max_displacement_m": 100.0},
    "idle charged": {"charge_idle_hover": True},
    "shortest idle": {"min_idle_s": 0.5},
    "shortest idle charged": {"min_idle_s": 0.5, "charge_idle_hover": True},
    "battery": {"energy_budget_j": 20.0},
    "time only": {"max_steps": None, "time_budget_s": 30.0},
    "measured": {"decision_time": "measured"},
    "measured, charged": {"decision_time": "measured", "charge_idle_hover": True, "min_idle_s": 0.1},
    "packets": {"packet_bits": _UNEVEN},
    "priorities": {"priority": _PRIORITY},
    "per second": {"reward": "per_second", "max_age_s": 12.0},
    "per second, priorities": {"reward": "per_second", "priority": _PRIORITY, "age_weight": 0.8, "max_age_s": 12.0},
    "low ceiling": {"max_age_s": 5.0, "age_weight": 1.0},
    "no reference": {"energy_reference_j": None, "age_reference_s": 3.0},
}

SCENARIOS: dict[str, Scenario] = {
    **{name: load_scenario(name) for name in ("paper", "released", "realistic")},
    **{f"released, {name}": load_scenario("released", **changes) for name, changes in _CHANGES.items()},
}


def _fold(value: float, size: float) -> float:
    while not 0.0 <= value <= size:
        value = -value if value < 0.0 else 2.0 * size - value
    return value


def _moved(scenario: Scenario, position: tuple[float, float], displacement: tuple[float, float]) -> tuple[float, float]:
    length = math.hypot(*displacement)
    longest = scenario.airframe.max_displacement_m
    share = longest / length if length > longest else 1.0
    sizes = (scenario.area.width_m, scenario.area.depth_m)
    target = [x + share * dx for x, dx in zip(position, displacement, strict=True)]
    if all(0.0 <= value <= size for value, size in zip(target, sizes, strict=True)):
        return target[0], target[1]
    if scenario.area.border == "stay":
        return position
    if scenario.area.border == "clip":
        return min(max(target[0], 0.0), sizes[0]), min(max(target[1], 0.0), sizes[1])
    return _fold(target[0], sizes[0]), _fold(target[1], sizes[1])


def _transmission(
    scenario: Scenario, horizontal: float, bits: float, scatter: tuple[float, float], sight: float
) -> tuple[float, float, float]:
    link = scenario.channel
    distance = math.sqrt(link.altitude_m**2 + horizontal**2)
    theta = math.degrees(math.asin(link.altitude_m / distance))
    c, d, los_db, nlos_db = link.los_c, link.los_d, link.excess_los_db, link.excess_nlos_db
    if link.line_of_sight == "al_hourani":
        c, d, los_db, nlos_db = _ENVIRONMENTS[link.environment]
    los = 1 / (1 + c * math.exp(-d * (theta - c)))
    free = 20 * math.log10(4 * math.pi * link.carrier_hz * distance / link.light_speed_mps)
    loss = los * (free + los_db) + (1 - los) * (free + nlos_db)
    noise_w = 10 ** (link.noise_dbm_per_hz / 10) / 1000 * link.bandwidth_hz
    snr = 10 ** (-loss / 10) * link.transmit_power_w / noise_w
    if link.fading in ("rayleigh", "rician"):
        k = 0.0
        if link.fading == "rician" and sight < los:
            low, high = 10 ** (link.rician_min_db / 10), 10 ** (link.rician_max_db / 10)
            k = low * math.exp(2 / math.pi * math.log(high / low) * math.radians(theta))
        h = complex(math.sqrt(k / (k + 1)), 0.0) + math.sqrt(1 / (k + 1)) * complex(*scatter) / math.sqrt(2)
        snr *= abs(h) ** 2
    rate = link.bandwidth_hz * math.log2(1 + snr)
    if link.fading == "ergodic":
        rate = link.bandwidth_hz / math.log(2) * math.exp(1 / snr) * float(special.exp1(1 / snr))
    return snr, rate, bits / rate


def _powers(scenario: Scenario) -> tuple[float, float]:
    """Hovering and flying (W)."""
    f = scenario.airframe
    if f.propulsion == "zeng":
        v, u, v0 = f.speed_mps, f.tip_speed_mps, f.induced_speed_mps
        flying = (
            f.blade_power_w * (1 + 3 * v**2 / u**2)
            + f.induced_power_w * (math.sqrt(1 + v**4 / (4 * v0**4)) - v**2 / (2 * v0**2)) ** 0.5
            + 0.5 * f.drag_ratio * f.air_density_kgpm3 * f.solidity * f.disc_area_m2 * v**3
        )
        return f.blade_power_w + f.induced_power_w, flying
    weight = f.mass_kg * f.gravity_mps2
    hover = math.sqrt(weight**3 / (2 * math.pi * f.propeller_radius_m**2 * f.propellers * f.air_density_kgpm3))
    return hover, hover + (f.max_power_w - f.idle_power_w) / f.max_speed_mps * f.speed_mps + f.idle_power_w


def step(
    scenario: Scenario,
    layout: list[tuple[float, float]],
    position: tuple[float, float],
    ages: list[float],
    displacement: tuple[float, float],
    device: int,
    scatter: tuple[float, float],
    sight: float,
    measured_s: float | None = None,
) -> dict[str, Any]:
    """What one step does, by the names of `Outcome`, plus `position_m` and `age_s` after it."""
    frame, limit_s = scenario.airframe, scenario.channel.max_transmission_s
    place = _moved(scenario, position, displacement)
    move_s = math.dist(place, position) / frame.speed_mps
    snr = rate = transmission_s = bits = 0.0
    served = outage = False
    if device:
        bits = scenario.traffic.packet_bits_each[device - 1]
        horizontal = math.dist(layout[device - 1], place)
        snr, rate, transmission_s = _transmission(scenario, horizontal, bits, scatter, sight)
        served = limit_s is None or transmission_s <= limit_s
        outage = not served
        if limit_s is not None and outage:
            transmission_s = limit_s
    decision_s = frame.decision_s
    if frame.decision_time == "measured" and measured_s is not None:
        decision_s = measured_s
    duration_s = move_s + transmission_s + decision_s
    if not device:
        duration_s = max(duration_s, frame.min_idle_s)
    idle_s = duration_s - move_s - transmission_s

    hover_w, flight_w = _powers(scenario)
    move_j = move_s * flight_w
    communication_j = transmission_s * (hover_w + frame.communication_power_w)
    idle_j = idle_s * hover_w if frame.charge_idle_hover else 0.0
    energy_j = move_j + communication_j + idle_j

    oldest = scenario.traffic.max_age_s
    after = [0.0 if served and k + 1 == device else min(oldest, age + duration_s) for k, age in enumerate(ages)]
    costs = after
    if scenario.objective.reward == "per_second":
        costs = []
        for age in ages:  # a ramp up to the ceiling, then a plateau
            ramp_s = min(duration_s, oldest - age)
            costs.append(age * ramp_s + ramp_s**2 / 2 + oldest * (duration_s - ramp_s))
    weights = scenario.traffic.priority or [1 / len(ages)] * len(ages)
    goal = scenario.objective
    age_term = sum(weight * cost for weight, cost in zip(weights, costs, strict=True)) / goal.age_reference_s
    energy_term = energy_j / (hover_w * 1.0 if goal.energy_reference_j is None else goal.energy_reference_j)
    return {
        "position_m": place,
        "age_s": after,
        "reward": -(goal.age_weight * age_term) - (1 - goal.age_weight) * energy_term,
        "age_term": age_term,
        "energy_term": energy_term,
        "displacement_m": (place[0] - position[0], place[1] - position[1]),
        "duration_s": duration_s,
        "move_s": move_s,
        "transmission_s": transmission_s,
        "snr": snr,
        "rate_bps": rate,
        "energy_j": energy_j,
        "energy_move_j": move_j,
        "energy_communication_j": communication_j,
        "energy_idle_j": idle_j,
        "device_energy_j": transmission_s * scenario.channel.transmit_power_w,
        "bits": bits if served else 0.0,
        "served": served,
        "outage": outage,
    }
