"""Age of information. Ages (..., K) in seconds; durations (...) in seconds."""

from __future__ import annotations

from uavrl.physics.arrays import Array, array_namespace, per_device


def next_age_s(age_s: Array, served: Array, duration_s: Array, max_age_s: float) -> Array:
    """Eq. (AoI): 0 for a served device, else min(A_max, A + T_total).

    Args:
        age_s: (..., K) ages before the step.
        served: (..., K) true where a packet arrived.
        duration_s: (...) T_total.
    """
    xp = array_namespace(age_s)
    return xp.minimum(age_s + per_device(duration_s), max_age_s) * ~served  # a product is faster than a choice here


def age_integral_s2(age_s: Array, duration_s: Array, max_age_s: float) -> Array:
    """Integral of min(A_max, A + t) over a step, A tau + tau^2/2 less what is clipped (..., K) (s^2)."""
    xp = array_namespace(age_s)
    tau = per_device(duration_s)
    over = xp.maximum(age_s + tau - max_age_s, 0.0)
    return age_s * tau + 0.5 * tau * tau - 0.5 * over * over
