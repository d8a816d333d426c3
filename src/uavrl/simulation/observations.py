"""What a policy sees, in raw units (metres, seconds, joules); networks scale it themselves."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from uavrl.physics.arrays import Array, array_namespace
from uavrl.scenario import Scenario

ObservationKind = Literal["paper", "devices"]

UAV_ENTRIES = ("x_m", "y_m", "energy_j", "energy_left")
DEVICE_ENTRIES = ("dx_m", "dy_m", "age_s", "priority", "packet_mbit", "valid")


class DevicesObservation(NamedTuple):
    """The aircraft and its devices as a set; what a policy needs to meet other layouts and another K."""

    uav: Array  # (..., 4) UAV_ENTRIES; energy_left is the unused share of the battery, 1 without one
    devices: Array  # (..., K, 6) DEVICE_ENTRIES; position from the aircraft, priority x K, valid 1 or 0 (padding)


def _last_axis(xp: Any, value: Array) -> Array:
    """(...) as (..., 1), a plain number as (1,)."""
    return xp.asarray(value)[..., None]


def paper_observation(position_m: Array, age_s: Array, energy_j: Array) -> Array:
    """s_t = [x, y, A_1..A_K, E_total] (paper, Section V-A), (..., K + 3)."""
    xp = array_namespace(position_m)
    return xp.concat([position_m, age_s, _last_axis(xp, energy_j)], axis=-1)


def devices_observation(
    scenario: Scenario, layout_m: Array, position_m: Array, age_s: Array, energy_j: Array, used_j: Array
) -> DevicesObservation:
    """The set observation; arguments as in SimState, layout_m (..., K, 2)."""
    xp = array_namespace(position_m)
    budget, energy_j = scenario.limits.energy_budget_j, _last_axis(xp, energy_j)
    left = xp.ones_like(energy_j) if budget is None else xp.maximum(1.0 - _last_axis(xp, used_j) / budget, 0.0)
    uav = xp.concat([position_m, energy_j, left], axis=-1)
    count = age_s.shape[-1]

    def a_device(values: tuple[float, ...]) -> Array:
        row = xp.asarray(values, dtype=age_s.dtype, device=age_s.device)
        return xp.broadcast_to(row, age_s.shape)

    tokens = [
        layout_m[..., 0] - position_m[..., :1],
        layout_m[..., 1] - position_m[..., 1:],
        age_s,
        a_device(tuple(value * count for value in scenario.traffic.priority_each)),
        a_device(tuple(value / 1e6 for value in scenario.traffic.packet_bits_each)),
        xp.ones_like(age_s),
    ]
    return DevicesObservation(uav, xp.stack(tokens, axis=-1))
