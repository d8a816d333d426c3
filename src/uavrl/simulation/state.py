"""What the simulator carries from step to step. N environments, K devices.

NumPy or torch arrays of one dtype; of one environment alone the axis N is left out, and numbers are Python's own.
"""

from __future__ import annotations

from typing import NamedTuple

from uavrl.physics.arrays import Array


class FlightAction(NamedTuple):
    """What the aircraft is told to do."""

    displacement_m: Array  # (N, 2), longer than d_max is shortened to it
    device: Array  # (N,) int64, 0 = idle, k = device k


class SimState(NamedTuple):
    """State between two steps."""

    position_m: Array  # (N, 2)
    age_s: Array  # (N, K)
    energy_j: Array  # (N,) of the last step, E_total in the paper's state
    used_j: Array  # (N,) since the episode began
    time_s: Array  # (N,)
    step: Array  # (N,) int64


class Draws(NamedTuple):
    """The randomness of one step: the same shape whatever the fading."""

    scatter: Array  # (N, 2) standard normal, the small-scale fading
    sight: Array  # (N,) uniform in [0, 1), line of sight or not


class Outcome(NamedTuple):
    """What a step did."""

    reward: Array  # (N,) -(lambda age_term + (1 - lambda) energy_term)
    age_term: Array  # (N,) weighted age (or its time integral) over age_reference_s
    energy_term: Array  # (N,) energy over energy_reference_j
    displacement_m: Array  # (N, 2) executed
    duration_s: Array  # (N,) T_total
    move_s: Array  # (N,) T_move
    transmission_s: Array  # (N,) T_com, 0 when idle
    snr: Array  # (N,) of the served link with fading, 0 when idle
    rate_bps: Array  # (N,) 0 when idle
    energy_j: Array  # (N,) E_total, sum of the next three
    energy_move_j: Array  # (N,)
    energy_communication_j: Array  # (N,)
    energy_idle_j: Array  # (N,)
    device_energy_j: Array  # (N,) transmit power x T_com, spent by the served device
    bits: Array  # (N,) that arrived
    served: Array  # (N,) bool, a packet arrived
    outage: Array  # (N,) bool, a packet was lost
    terminated: Array  # (N,) bool, battery drained
    truncated: Array  # (N,) bool, step or time limit
