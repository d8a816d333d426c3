"""Power and energy of the aircraft. Powers of a scenario are plain floats; energies are arrays of any one shape."""

from __future__ import annotations

import math

from uavrl.physics.arrays import Array
from uavrl.scenario import Airframe


def hover_power_w(airframe: Airframe) -> float:
    """Eq. (hover_power), sqrt((m g)^3 / (2 pi r_p^2 n_p rho)); or P0 + Pi of Zeng 2019 (W)."""
    if airframe.propulsion == "zeng":
        return airframe.blade_power_w + airframe.induced_power_w
    thrust_n = airframe.mass_kg * airframe.gravity_mps2
    disc = 2.0 * math.pi * airframe.propeller_radius_m**2 * airframe.propellers * airframe.air_density_kgpm3
    return math.sqrt(thrust_n**3 / disc)


def move_power_w(airframe: Airframe) -> float:
    """Eq. (move_power): extra power of moving, (P_max - P_idle) / v_max * v_u + P_idle (W)."""
    slope = (airframe.max_power_w - airframe.idle_power_w) / airframe.max_speed_mps
    return slope * airframe.speed_mps + airframe.idle_power_w


def rotary_wing_power_w(speed_mps: float, airframe: Airframe) -> float:
    """Zeng, Xu & Zhang 2019, eq. (12): blade profile, induced and parasite power at a forward speed (W)."""
    v2 = speed_mps**2
    hover_v2 = airframe.induced_speed_mps**2
    blade = airframe.blade_power_w * (1.0 + 3.0 * v2 / airframe.tip_speed_mps**2)
    induced = airframe.induced_power_w * math.sqrt(math.sqrt(1.0 + v2**2 / (4.0 * hover_v2**2)) - v2 / (2.0 * hover_v2))
    density = airframe.drag_ratio * airframe.air_density_kgpm3 * airframe.solidity * airframe.disc_area_m2
    return blade + induced + 0.5 * density * speed_mps**3


def flight_power_w(airframe: Airframe) -> float:
    """Power while moving at v_u (W): hover + eq. (move_power), or Zeng 2019."""
    if airframe.propulsion == "zeng":
        return rotary_wing_power_w(airframe.speed_mps, airframe)
    return hover_power_w(airframe) + move_power_w(airframe)


def communication_energy_j(transmission_s: Array, airframe: Airframe) -> Array:
    """Eq. (Energy_comm): T_com (P_hover + P_com) (J)."""
    return transmission_s * (hover_power_w(airframe) + airframe.communication_power_w)


def move_energy_j(move_s: Array, airframe: Airframe) -> Array:
    """Eq. (Energy_move): T_move (P_hover + P_move) (J)."""
    return move_s * flight_power_w(airframe)


def idle_energy_j(idle_s: Array, airframe: Airframe) -> Array:
    """Energy of time neither moving nor transmitting (J): none in the paper, hover power where it is charged."""
    return idle_s * (hover_power_w(airframe) if airframe.charge_idle_hover else 0.0)
