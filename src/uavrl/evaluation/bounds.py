"""Lower bounds on the age of information, derived in docs/bounds.md.

They hold for each flight where every service takes a known least time: fading "none" or "ergodic" and a fixed decision
time. Under fading drawn once a packet a lucky flight beats any of them; those over time hold there in the mean over the
fading, if a packet is lost after a limit. Ages start at 0. Priorities and packet sizes may differ between the devices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uavrl.errors import ConfigError
from uavrl.physics import channel
from uavrl.policies.service import service_model
from uavrl.scenario import Scenario

Float = NDArray[np.float64]
_FAR_S = 1e6  # a device that takes longer to reach counts apart from the others, whose share it would take


def service_s(scenario: Scenario, horizontal_m: ArrayLike) -> Float:
    """c_k (s) at horizontal distances (..., K) or one number: T_com + T_exec, infinite where every packet is lost.

    Under fading drawn once a packet the mean time of a delivery, (E[min(T_com, limit)] + T_exec) / P(T_com <= limit).

    Raises:
        ConfigError: the scenario's service times are measured, or random without a limit: nothing bounds them.
    """
    link = scenario.channel
    if fades(scenario) and link.max_transmission_s is None:
        raise ConfigError(
            f"channel.fading = {link.fading!r} without channel.max_transmission_s: "
            "the bounds need 'none', 'ergodic' or that limit"
        )
    highest_db, counted_db = max(link.rician_min_db, link.rician_max_db), 10.0 * np.log10(channel.LARGEST_FACTOR)
    if link.fading == "rician" and highest_db > counted_db:  # what fades less is counted as if it faded so much
        raise ConfigError(f"channel.rician_max_db = {highest_db:g}: the bounds need at most {counted_db:g}")
    if scenario.airframe.decision_time != "fixed":
        raise ConfigError(f"airframe.decision_time = {scenario.airframe.decision_time!r}: the bounds need 'fixed'")
    bits = np.array(scenario.traffic.packet_bits_each)
    distance_m, bits = np.broadcast_arrays(np.asarray(horizontal_m, dtype=np.float64), bits)
    seconds, arrival = channel.expected_service(distance_m, bits, link)
    with np.errstate(divide="ignore", over="ignore"):  # to infinity where (almost) nothing arrives
        service: Float = (seconds + scenario.airframe.decision_s) / arrival
    return service


def fades(scenario: Scenario) -> bool:
    """Whether fading is drawn once a packet, so that a bound can hold in the mean alone."""
    return scenario.channel.fading in ("rayleigh", "rician")


def _time_bound_s(scenario: Scenario, service: Float, elapsed_s: ArrayLike) -> Float:
    elapsed = np.asarray(elapsed_s, dtype=np.float64)
    if not (elapsed > 0).all():
        raise ConfigError(f"elapsed_s = {float(elapsed.min()):g}, allowed: more than 0")
    if elapsed.max() > scenario.traffic.max_age_s:
        raise ConfigError(
            f"elapsed_s = {float(elapsed.max()):g}, allowed: at most traffic.max_age_s = "
            f"{scenario.traffic.max_age_s:g}, beyond which ages are clipped"
        )
    priority = np.array(scenario.traffic.priority_each)
    longest = scenario.channel.max_transmission_s
    late = longest + scenario.airframe.decision_s if longest is not None and fades(scenario) else 0.0
    far = service > _FAR_S
    near = np.where(far, 0.0, service)
    root = np.sqrt(priority * near).sum(axis=-1)
    served = np.where(far, (elapsed + late)[..., None] / service, 0.0)  # at most so many times
    apart = np.where(far, priority / (1.0 + served), 0.0).sum(axis=-1)
    bound: Float = 0.5 * elapsed * (root**2 / (elapsed + late + near.sum(axis=-1)) + apart)
    return bound


def mean_age_bound_s(scenario: Scenario, elapsed_s: ArrayLike) -> Float:
    """Least time average of sum_k delta_k A_k over the first `elapsed_s` (...) of any flight, (...) (s).

    (T/2) (sum_k sqrt(delta_k c_k))^2 / (T + sum_k c_k), with c_k the service time from straight above device k. Under
    fading drawn once a packet in the mean over flights, with the longest service added to the denominator, and with c_k
    from where it is least: under a limit near the mean, fading far away delivers what no luck does overhead.

    Raises:
        ConfigError: as `service_s`, or a time that is not positive or at which ages are clipped.
    """
    service = service_s(scenario, 0.0)
    if fades(scenario):
        service = np.minimum(service, service_model(scenario).shortest_s)
    return _time_bound_s(scenario, service, elapsed_s)


def hover_age_bound_s(scenario: Scenario, layout_m: Float, position_m: Float, elapsed_s: ArrayLike) -> Float:
    """As `mean_age_bound_s`, for a flight that stays at `position_m` (..., 2) over `layout_m` (..., K, 2), (...) (s).

    (T/2) (sum_k sqrt(delta_k c_k(x)))^2 / (T + sum_k c_k(x)).

    Raises:
        ConfigError: as `mean_age_bound_s`.
    """
    distance_m = np.linalg.norm(layout_m - position_m[..., None, :], axis=-1)
    return _time_bound_s(scenario, service_s(scenario, distance_m), elapsed_s)


def step_mean_age_bound_s(scenario: Scenario, steps: int) -> float:
    """Least mean, over the first `steps` steps of any flight, of sum_k delta_k A_k after each step (s).

    For equal devices, the mean over i of min over j <= min(i, K) of
    [j (j-1) c / 2 + (K-j) (j c + (i-j) e)] / K, with e the shortest step without service.

    Raises:
        ConfigError: random or measured service times, or no step.
    """
    if fades(scenario):
        raise ConfigError(f"channel.fading = {scenario.channel.fading!r}: the bound a step needs 'none' or 'ergodic'")
    if steps < 1:
        raise ConfigError(f"steps = {steps}, allowed: 1 or more")
    frame, oldest_s = scenario.airframe, scenario.traffic.max_age_s
    service = np.sort(service_s(scenario, 0.0))
    service = service[np.isfinite(service)]
    quiet_s = min(max(frame.decision_s, frame.min_idle_s), float(service.min(initial=np.inf)))
    priority = np.sort(scenario.traffic.priority_each)[::-1]
    elapsed_s = np.concatenate([[0.0], np.cumsum(service)])  # of the j shortest services
    served = np.minimum(elapsed_s, oldest_s)  # least age of the device that was served j services ago
    below = np.concatenate([[0.0], np.cumsum(priority[: len(service)] * served[:-1])])
    rest = np.concatenate([[priority.sum()], priority.sum() - np.cumsum(priority)])[: len(elapsed_s)]
    i = np.arange(1, steps + 1)[:, None]
    j = np.arange(len(elapsed_s))
    never_s = np.minimum(elapsed_s + (i - j) * quiet_s, oldest_s)
    ages = np.where(j <= i, below + rest * never_s, np.inf)
    return float(ages.min(axis=1).mean())
