"""Age of information, eq. (AoI), and its integral over a step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavrl.physics.age import age_integral_s2, next_age_s

LIMIT_S = 400.0
ages = st.floats(0.0, LIMIT_S)
durations = st.floats(0.0, 1000.0)


def test_served_is_reset_and_others_grow_up_to_the_limit() -> None:
    age_s = np.array([[3.0, 5.0, 399.5], [0.0, 400.0, 1.0]])
    served = np.array([[False, True, False], [False, False, False]])
    after = next_age_s(age_s, served, np.array([1.0, 2.0]), LIMIT_S)
    assert after.tolist() == [[4.0, 0.0, 400.0], [2.0, 400.0, 3.0]]


@given(age=ages, duration=durations, served=st.booleans())
def test_age_stays_within_its_bounds(age: float, duration: float, served: bool) -> None:
    after = next_age_s(np.array([[age]]), np.array([[served]]), np.array([duration]), LIMIT_S)[0, 0]
    assert 0.0 <= after <= LIMIT_S
    assert after >= age or served


def test_integral_without_the_limit_is_a_tau_and_half_tau_squared() -> None:
    integral = age_integral_s2(np.array([[3.0, 0.0]]), np.array([2.0]), LIMIT_S)
    assert integral.tolist() == [[3.0 * 2.0 + 2.0, 2.0]]


@given(age=ages, duration=durations)
def test_integral_equals_a_numeric_one(age: float, duration: float) -> None:
    seconds = np.linspace(0.0, duration, 20_001)
    numeric = np.trapezoid(np.minimum(LIMIT_S, age + seconds), seconds)
    exact = age_integral_s2(np.array([[age]]), np.array([duration]), LIMIT_S)[0, 0]
    assert exact == pytest.approx(numeric, rel=1e-6, abs=1e-9)
    assert 0.0 <= exact <= LIMIT_S * duration * (1 + 1e-9) + 1e-9
