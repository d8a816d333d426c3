"""Powers and energies of the aircraft."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavrl.physics import energy
from uavrl.scenario import Airframe

PAPER = Airframe()
ZENG = Airframe(propulsion="zeng")


def test_hover_power_of_the_paper() -> None:
    assert energy.hover_power_w(PAPER) == pytest.approx(9.785, abs=5e-4)


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        ({"mass_kg": 2.0}, 8.0),
        ({"gravity_mps2": 9.807 * 4}, 8.0),
        ({"propeller_radius_m": 0.4}, 0.5),
        ({"propellers": 16}, 0.5),
        ({"air_density_kgpm3": 4.9}, 0.5),
    ],
)
def test_hover_power_scales_as_the_equation(change: dict[str, float], factor: float) -> None:
    changed = Airframe.model_validate(change)
    assert energy.hover_power_w(changed) == pytest.approx(factor * energy.hover_power_w(PAPER), rel=1e-12)


def test_move_power_lies_between_idle_and_largest() -> None:
    frame = Airframe(max_power_w=5.0, idle_power_w=1.0, max_speed_mps=25.0, speed_mps=20.0)
    assert energy.move_power_w(frame) == pytest.approx(4.0 / 25.0 * 20.0 + 1.0)
    assert energy.move_power_w(PAPER) == pytest.approx(5.0)


def test_flight_power_adds_hovering_in_the_paper() -> None:
    assert energy.flight_power_w(PAPER) == pytest.approx(9.785 + 5.0, abs=5e-4)


def test_zeng_at_hover_at_its_minimum_and_at_full_speed() -> None:
    assert energy.hover_power_w(ZENG) == pytest.approx(168.49)
    assert energy.rotary_wing_power_w(0.0, ZENG) == pytest.approx(168.49)
    speeds = np.arange(0.0, 30.0, 0.1)
    powers = [energy.rotary_wing_power_w(float(speed), ZENG) for speed in speeds]
    assert speeds[int(np.argmin(powers))] == pytest.approx(10.2, abs=0.11)
    assert min(powers) == pytest.approx(126.0, abs=0.5)
    assert energy.flight_power_w(ZENG) == pytest.approx(249.0, abs=0.5)


def test_zeng_term_by_term_at_ten_metres_a_second() -> None:
    blade = 79.86 * (1 + 3 * 100 / 14400)
    v0 = 4.03
    induced = 88.63 * ((1 + 1e4 / (4 * v0**4)) ** 0.5 - 100 / (2 * v0**2)) ** 0.5
    parasite = 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * 1000
    assert energy.rotary_wing_power_w(10.0, ZENG) == pytest.approx(blade + induced + parasite, rel=1e-12)


def test_energies_are_time_times_power() -> None:
    seconds = np.array([0.0, 0.5, 2.0])
    hover = energy.hover_power_w(PAPER)
    assert energy.communication_energy_j(seconds, PAPER) == pytest.approx(seconds * (hover + 0.0126), rel=1e-12)
    assert energy.move_energy_j(seconds, PAPER) == pytest.approx(seconds * (hover + 5.0), rel=1e-12)
    assert energy.communication_energy_j(seconds, ZENG) == pytest.approx(seconds * (168.49 + 0.0126), rel=1e-12)
    assert energy.move_energy_j(seconds, ZENG) == pytest.approx(seconds * energy.flight_power_w(ZENG), rel=1e-12)


def test_idle_hover_is_free_unless_charged() -> None:
    seconds = np.array([0.0, 0.5, 2.0])
    assert energy.idle_energy_j(seconds, PAPER).tolist() == [0.0, 0.0, 0.0]
    charged = Airframe(charge_idle_hover=True)
    assert energy.idle_energy_j(seconds, charged) == pytest.approx(seconds * energy.hover_power_w(charged))


@given(
    seconds=st.floats(0.0, 1e4),
    mass=st.floats(0.01, 100.0),
    speed=st.floats(0.01, 60.0),
    idle=st.floats(0.0, 500.0),
    largest=st.floats(0.0, 500.0),
    propulsion=st.sampled_from(["paper", "zeng"]),
    charged=st.booleans(),
)
def test_no_energy_is_negative(
    seconds: float, mass: float, speed: float, idle: float, largest: float, propulsion: str, charged: bool
) -> None:
    frame = Airframe.model_validate(
        {
            "mass_kg": mass, "speed_mps": speed, "max_speed_mps": 60.0, "idle_power_w": idle, "max_power_w": largest,
            "propulsion": propulsion, "charge_idle_hover": charged,
        }
    )  # fmt: skip
    time = np.array([seconds])
    for spent in (energy.communication_energy_j, energy.move_energy_j, energy.idle_energy_j):
        assert spent(time, frame)[0] >= 0.0
