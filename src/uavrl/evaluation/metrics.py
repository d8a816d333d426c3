"""What a flight is judged by: one number a flight and metric, units in the names.

Notation: a flight of S steps lasting T seconds; step t takes tau_t, leaves device k at age A_k(t) and spends E_t; K
devices of weight w_k = delta_k / sum delta. A metric that does not exist for a flight (the transmission time of one
that never transmitted) is NaN and left out of means.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavrl.evaluation.rollouts import Flights
from uavrl.physics.age import age_integral_s2

Float = NDArray[np.float64]

PERCENTILE = 0.95
_FLIGHTS_AT_ONCE = 64  # bounds the memory of sorting all ages of a flight


def flight_metrics(flights: Flights) -> dict[str, Float]:
    """Every metric of every flight, name -> (N,).

    return: sum of rewards, undiscounted.
    age_per_step_s: 1/S sum_t sum_k w_k A_k(t), ages after the step.
    age_per_second_s: 1/T integral of sum_k w_k A_k, ages as they grow within a step.
    worst_device_age_s: max_k 1/T integral of A_k.
    age_p95_s: the age that a device has at most during 95 % of the time, devices pooled.
    energy_per_step_j, energy_per_episode_j: 1/S sum_t E_t, sum_t E_t, of the aircraft.
    device_energy_j: transmit power x time on air, all devices, per episode.
    throughput_mbps, data_mb: bits that arrived / T / 1e6, / 8e6.
    transmission_mean_s, transmission_median_s: over the packets of the flight, lost ones included with their time.
    jain_bits, jain_age: (sum x)^2 / (K sum x^2) of x_k = bits of device k, and of x_k = 1 / time-averaged age.
    outage_rate: lost packets / packets.
    steps, duration_s: S, T.
    """
    scenario = flights.evaluation_set.scenario
    active = flights.active
    steps = flights.steps
    duration_s = _total(flights.duration_s, active)
    priority = np.array(scenario.traffic.priority_each)
    weight = priority / priority.sum()
    mean_age_s = device_ages_s(flights)
    used_j = _total(flights.energy_j, active)
    bits = _total(flights.bits, active)
    wanted = active & (flights.device > 0)
    packets = wanted.sum(axis=0)
    on_air_s = np.where(wanted, flights.transmission_s, np.nan)
    return {
        "return": _total(flights.reward, active),
        "age_per_step_s": _total(flights.age_s[1:] @ weight, active) / steps,
        "age_per_second_s": mean_age_s @ weight,
        "worst_device_age_s": mean_age_s.max(axis=1),
        "age_p95_s": age_percentile_s(flights, PERCENTILE),
        "energy_per_step_j": used_j / steps,
        "energy_per_episode_j": used_j,
        "device_energy_j": _total(flights.device_energy_j, active),
        "throughput_mbps": bits / duration_s / 1e6,
        "data_mb": bits / 8e6,
        "transmission_mean_s": _divide(_total(flights.transmission_s, wanted), packets),
        "transmission_median_s": _median(on_air_s),
        "jain_bits": jain(device_bits(flights)),
        "jain_age": jain(1.0 / mean_age_s),
        "outage_rate": _divide(_total(flights.outage, wanted), packets),
        "steps": steps.astype(np.float64),
        "duration_s": duration_s,
    }


def jain(share: Float) -> Float:
    """Jain's index (sum x)^2 / (K sum x^2) of (N, K), (N,); NaN where every x is 0. Jain, Chiu & Hawe 1984."""
    return _divide(share.sum(axis=1) ** 2, share.shape[1] * (share**2).sum(axis=1))


def device_ages_s(flights: Flights) -> Float:
    """Time-averaged age of each device (N, K) (s)."""
    limit_s = flights.evaluation_set.scenario.traffic.max_age_s
    total: Float = np.zeros_like(flights.age_s[0])
    for age_s, duration_s, active in zip(flights.age_s, flights.duration_s, flights.active, strict=False):
        total += np.where(active[:, None], age_integral_s2(age_s, duration_s, limit_s), 0.0)
    mean: Float = total / _total(flights.duration_s, flights.active)[:, None]
    return mean


def device_bits(flights: Flights) -> Float:
    """Bits that arrived from each device (N, K)."""
    devices = flights.age_s.shape[2]
    arrived = np.where(flights.active, flights.bits, 0.0)
    flight = np.broadcast_to(np.arange(arrived.shape[1]), arrived.shape)
    total = np.zeros((arrived.shape[1], devices + 1))
    np.add.at(total, (flight, flights.device), arrived)
    return total[:, 1:]


def age_percentile_s(flights: Flights, share: float) -> Float:
    """The age x with which {A_k(t) <= x} holds during `share` of the time, devices pooled (N,) (s).

    Exact: within a step an age runs from A to A + tau at unit speed, so the time spent below x is piecewise linear in
    x, with corners at the steps' first and last ages.
    """
    limit_s = flights.evaluation_set.scenario.traffic.max_age_s
    devices = flights.age_s.shape[2]
    tau_s = np.where(flights.active, flights.duration_s, 0.0)
    result = np.empty(tau_s.shape[1])
    for first in range(0, len(result), _FLIGHTS_AT_ONCE):
        part = slice(first, first + _FLIGHTS_AT_ONCE)
        low = flights.age_s[:-1, part].transpose(1, 0, 2)
        high = np.minimum(low + tau_s[:, part].T[:, :, None], limit_s)
        count = len(low)
        corners = np.concatenate([low.reshape(count, -1), high.reshape(count, -1)], axis=1)
        slope = np.ones_like(corners)
        slope[:, corners.shape[1] // 2 :] = -1.0  # a step's ages begin at its low corner and end at its high one
        order = np.argsort(corners, axis=1, kind="stable")
        corners = np.take_along_axis(corners, order, axis=1)
        slope = np.cumsum(np.take_along_axis(slope, order, axis=1), axis=1)
        below = np.cumsum(slope[:, :-1] * np.diff(corners, axis=1), axis=1)  # time at ages <= corners[:, 1:]
        wanted = share * devices * tau_s[:, part].sum(axis=0)
        index = np.minimum((below < wanted[:, None]).sum(axis=1), below.shape[1] - 1)[:, None]
        over = np.take_along_axis(below, index, axis=1)[:, 0] - wanted
        at = np.take_along_axis(corners, index + 1, axis=1)[:, 0]
        step = np.take_along_axis(slope, index, axis=1)[:, 0]
        result[part] = np.where(over < 0, limit_s, at - _divide(over, step))  # ages cut at A_max hold the rest
    return result


def _total(values: NDArray[np.generic], mask: NDArray[np.bool_]) -> Float:
    """Sum over the steps of `mask` (S, N) -> (N,)."""
    total: Float = np.where(mask, values, 0.0).sum(axis=0, dtype=np.float64)
    return total


def _divide(top: Float, bottom: NDArray[np.generic]) -> Float:
    """Quotient, NaN where the bottom is 0."""
    divisor = np.asarray(bottom, dtype=np.float64)
    return np.divide(top, divisor, out=np.full_like(divisor, np.nan), where=divisor != 0)


def _median(values: Float) -> Float:
    """Median over the first axis of what is not NaN (S, N) -> (N,); NaN where nothing is."""
    count = np.isfinite(values).sum(axis=0)
    ordered = np.sort(values, axis=0)  # NaN last
    columns = np.arange(values.shape[1])
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    middle: Float = 0.5 * (ordered[low, columns] + ordered[np.minimum(high, len(values) - 1), columns])
    return middle
