"""The simulator's one step: a pure function of arrays, batch first, without random numbers inside.

One environment alone steps several times as fast without the batch's axis: ages (K,), vectors (2,), all else Python's
own numbers. Every function here takes either.
"""

from __future__ import annotations

from uavrl.physics import age, channel, energy
from uavrl.physics.arrays import Array, array_namespace, components, length, per_device
from uavrl.scenario import Area, Scenario, hover_reference_j
from uavrl.simulation.state import Draws, FlightAction, Outcome, SimState


def initial_state(position_m: Array, devices: int) -> SimState:
    """All ages, energies and clocks 0 at `position_m` (N, 2) (m)."""
    xp = array_namespace(position_m)
    count = position_m.shape[0]
    zero = xp.zeros_like(position_m[:, 0])
    ages = xp.zeros((count, devices), dtype=position_m.dtype, device=position_m.device)
    steps = xp.zeros((count,), dtype=xp.int64, device=position_m.device)
    return SimState(position_m=position_m, age_s=ages, energy_j=zero, used_j=zero, time_s=zero, step=steps)


def may_terminate(scenario: Scenario) -> bool:
    """Whether the battery can be empty before the time is up, at full power throughout and through the last step."""
    frame, limits = scenario.airframe, scenario.limits
    limit_s = scenario.channel.max_transmission_s
    if limits.energy_budget_j is None:
        return False
    if limit_s is None or frame.decision_time == "measured":
        return True  # a step may take for ever
    step_s = frame.max_displacement_m / frame.speed_mps + limit_s + max(frame.decision_s, frame.min_idle_s)
    times = [] if limits.time_budget_s is None else [limits.time_budget_s + step_s]
    times += [] if limits.max_steps is None else [limits.max_steps * step_s]
    power_w = max(energy.hover_power_w(frame) + frame.communication_power_w, energy.flight_power_w(frame))
    return min(times) * power_w > limits.energy_budget_j


def _fly(x: Array, y: Array, displacement_m: Array, d_max: float, area: Area) -> tuple[Array, Array]:
    """Coordinates after a move of at most d_max under the scenario's border rule (m)."""
    xp = array_namespace(x)
    dx, dy = components(displacement_m)
    scale = d_max / xp.maximum(length(dx, dy), d_max)
    to_x, to_y = x + dx * scale, y + dy * scale
    clipped_x = xp.minimum(xp.maximum(to_x, 0.0), area.width_m)
    clipped_y = xp.minimum(xp.maximum(to_y, 0.0), area.depth_m)
    if area.border == "clip":
        return clipped_x, clipped_y
    inside_x, inside_y = clipped_x == to_x, clipped_y == to_y
    if area.border == "reflect":
        width, depth = area.width_m, area.depth_m
        reflected_x = width - xp.abs(xp.remainder(to_x, 2.0 * width) - width)
        reflected_y = depth - xp.abs(xp.remainder(to_y, 2.0 * depth) - depth)
        return xp.where(inside_x, to_x, reflected_x), xp.where(inside_y, to_y, reflected_y)
    inside = inside_x & inside_y  # "mirroring" in the paper: the whole move is cancelled at no cost
    return xp.where(inside, to_x, x), xp.where(inside, to_y, y)


def _place(layout_m: Array, index: Array) -> Array:
    """Positions (N, 2) of one device (N,) in each layout (N, K, 2); or without N."""
    if layout_m.ndim == 2:
        return layout_m[index]
    xp = array_namespace(layout_m)
    # one flat index into N x K is looked up several times as fast as a pair of indices
    rows = xp.arange(index.shape[0], device=index.device)
    return xp.take(layout_m.reshape((-1, 2)), rows * layout_m.shape[1] + index, axis=0)


def _packet_bits(scenario: Scenario, index: Array, like: Array) -> Array:
    """Packet size of a device (N,) or, where all are alike, one number (bit)."""
    bits = scenario.traffic.packet_bits
    if not isinstance(bits, tuple):
        return bits
    if isinstance(index, int):
        return bits[index]
    return array_namespace(like).asarray(bits, dtype=like.dtype, device=like.device)[index]


def _transmit(scenario: Scenario, horizontal_m: Array, draws: Draws) -> tuple[Array, Array]:
    """(snr, rate in bit/s) of a link, each (N,); idle rows mean nothing."""
    xp = array_namespace(horizontal_m)
    link = scenario.channel
    elevation, los, snr = channel.link_snr(horizontal_m, link)
    if link.fading == "rayleigh":
        snr = snr * channel.rayleigh_power(draws.scatter)
    elif link.fading == "rician":
        factor = xp.where(draws.sight < los, channel.rician_factor(elevation, link), xp.zeros_like(snr))
        snr = snr * channel.fading_power(draws.scatter, factor)
    if link.fading == "ergodic":
        return snr, channel.ergodic_rate_bps(snr, link.bandwidth_hz)
    return snr, channel.rate_bps(snr, link.bandwidth_hz)


def age_term(scenario: Scenario, age_s: Array, next_age_s: Array, duration_s: Array) -> Array:
    """Age part of eq. (reward), (...): ages (..., K) after the step, or integrated over it, weighted by delta_k."""
    xp = array_namespace(age_s)
    objective, traffic = scenario.objective, scenario.traffic
    cost = next_age_s
    if objective.reward == "per_second":
        cost = age.age_integral_s2(age_s, duration_s, traffic.max_age_s)
    if traffic.priority is None:
        weight = xp.full((traffic.devices,), 1.0 / traffic.devices, dtype=cost.dtype, device=cost.device)
    else:
        weight = xp.asarray(traffic.priority, dtype=cost.dtype, device=cost.device)
    return cost @ weight / objective.age_reference_s


def advance(
    scenario: Scenario,
    layout_m: Array,
    state: SimState,
    action: FlightAction,
    draws: Draws,
    decision_s: Array | None = None,
) -> tuple[SimState, Outcome]:
    """One step of every environment: move, then serve from the new position.

    Args:
        scenario: what is flown.
        layout_m: (N, K, 2) device positions.
        state: N environments.
        action: wanted displacement and device.
        draws: this step's randomness.
        decision_s: (N,) measured T_exec, used where the scenario's `decision_time` is "measured".

    Returns:
        The state after the step and what happened in it.
    """
    xp = array_namespace(state.time_s)
    frame, objective, limits, traffic = scenario.airframe, scenario.objective, scenario.limits, scenario.traffic
    zero = xp.zeros_like(state.time_s)

    from_x, from_y = components(state.position_m)
    x, y = _fly(from_x, from_y, action.displacement_m, frame.max_displacement_m, scenario.area)
    moved_x, moved_y = x - from_x, y - from_y
    move_s = length(moved_x, moved_y) / frame.speed_mps

    wants = action.device > 0
    index = xp.maximum(action.device - 1, 0)
    device_x, device_y = components(_place(layout_m, index))
    snr, rate = _transmit(scenario, length(device_x - x, device_y - y), draws)
    bits = _packet_bits(scenario, index, snr)
    transmission_s = channel.transmission_s(bits, rate)
    limit_s = scenario.channel.max_transmission_s
    never = xp.zeros_like(wants)
    outage = never
    if limit_s is not None:
        outage = wants & (transmission_s > limit_s)
        transmission_s = xp.minimum(transmission_s, limit_s)
    transmission_s = xp.where(wants, transmission_s, zero)
    arrived = wants & xp.logical_not(outage)

    idle_s = zero + frame.decision_s if decision_s is None or frame.decision_time == "fixed" else decision_s
    if frame.min_idle_s > 0:
        idle_s = xp.where(wants, idle_s, xp.maximum(idle_s, frame.min_idle_s - move_s))
    duration_s = move_s + transmission_s + idle_s  # eq. (time_total)

    move_j = energy.move_energy_j(move_s, frame)
    communication_j = energy.communication_energy_j(transmission_s, frame)
    idle_j = energy.idle_energy_j(idle_s, frame)
    total_j = move_j + communication_j + idle_j  # eq. (energy_total)

    devices = array_namespace(layout_m).arange(layout_m.shape[-2], device=layout_m.device)
    reset = per_device(xp.where(arrived, index, -1)) == devices
    ages = age.next_age_s(state.age_s, reset, duration_s, traffic.max_age_s)
    age_cost = age_term(scenario, state.age_s, ages, duration_s)
    energy_term = total_j / hover_reference_j(scenario, energy.hover_power_w(frame))
    reward = -(objective.age_weight * age_cost + (1.0 - objective.age_weight) * energy_term)  # eq. (reward)

    after = SimState(
        position_m=xp.stack((x, y), axis=-1),
        age_s=ages,
        energy_j=total_j,
        used_j=state.used_j + total_j,
        time_s=state.time_s + duration_s,
        step=state.step + 1,
    )
    terminated = never if limits.energy_budget_j is None else after.used_j > limits.energy_budget_j
    truncated = never
    if limits.max_steps is not None:
        truncated = truncated | (after.step >= limits.max_steps)
    if limits.time_budget_s is not None:
        truncated = truncated | (after.time_s > limits.time_budget_s)
    outcome = Outcome(
        reward=reward,
        age_term=age_cost,
        energy_term=energy_term,
        displacement_m=xp.stack((moved_x, moved_y), axis=-1),
        duration_s=duration_s,
        move_s=move_s,
        transmission_s=transmission_s,
        snr=xp.where(wants, snr, zero),
        rate_bps=xp.where(wants, rate, zero),
        energy_j=total_j,
        energy_move_j=move_j,
        energy_communication_j=communication_j,
        energy_idle_j=idle_j,
        device_energy_j=transmission_s * scenario.channel.transmit_power_w,
        bits=xp.where(arrived, bits, zero),
        served=arrived,
        outage=outage,
        terminated=terminated,
        truncated=truncated & xp.logical_not(terminated),
    )
    return after, outcome
