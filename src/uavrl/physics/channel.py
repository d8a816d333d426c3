"""Ground-to-air channel: geometry, line of sight, path loss, fading, rate. Arrays of any one shape (...) throughout."""

from __future__ import annotations

import math

import numpy as np

from uavrl.physics.arrays import Array, array_namespace, components
from uavrl.scenario import Channel

# (a, b, eta_LoS dB, eta_NLoS dB) of Al-Hourani, Kandeepan & Lardner 2014, "Optimal LAP altitude for maximum coverage"
AL_HOURANI = {
    "suburban": (4.88, 0.43, 0.1, 21.0),
    "urban": (9.61, 0.16, 1.0, 20.0),
    "dense_urban": (12.08, 0.11, 1.6, 23.0),
    "high_rise": (27.23, 0.08, 2.3, 34.0),
}

# Nodes u and weights of E[f(X)], X ~ Exp(1), by the trapezoid rule in u = ln x. The integrand falls off exponentially
# on the left and doubly so on the right, so 64 nodes leave an error under 1e-7 for log2(1 + snr X).
_LOG_X = np.linspace(-20.0, 4.2, 64)
_EXPONENTIAL_NODES = np.exp(_LOG_X)
_EXPONENTIAL_WEIGHTS = (_LOG_X[1] - _LOG_X[0]) * np.exp(_LOG_X - np.exp(_LOG_X))


def link_distance_m(horizontal_m: Array, altitude_m: float) -> Array:
    """R = sqrt(h^2 + d^2) (m); `horizontal_m` is d."""
    xp = array_namespace(horizontal_m)
    return xp.sqrt(horizontal_m * horizontal_m + altitude_m**2)


def elevation_deg(horizontal_m: Array, altitude_m: float) -> Array:
    """theta = arcsin(h / R), in degrees: the constants C and D of eq. (LoS_Prob) are in degrees.

    Computed as 90 - arctan(d / h), for overhead the arcsine rounds badly and its slope is infinite.
    """
    xp = array_namespace(horizontal_m)
    return 90.0 - xp.atan(horizontal_m * (1.0 / altitude_m)) * (180.0 / math.pi)


def line_of_sight_probability(elevation: Array, channel: Channel) -> Array:
    """Eq. (LoS_Prob), 1/(1 + C exp(-D (theta - C))), or its Al-Hourani 2014 form with (a, b) for (C, D)."""
    xp = array_namespace(elevation)
    c, d = channel.los_c, channel.los_d
    if channel.line_of_sight == "al_hourani":
        c, d = AL_HOURANI[channel.environment][:2]
    return 1.0 / (1.0 + c * xp.exp(-d * (elevation - c)))


def free_space_loss_db(distance_m: Array, channel: Channel) -> Array:
    """Eq. (Path_loss_models) with xi = 0: 20 log10(4 pi f_c R / v_l) (dB)."""
    xp = array_namespace(distance_m)
    return 20.0 * xp.log10(distance_m * (4.0 * math.pi * channel.carrier_hz / channel.light_speed_mps))


def mean_path_loss_db(distance_m: Array, los_probability: Array, channel: Channel) -> Array:
    """Eq. (avg_path_loss): p Xi(xi_LoS) + (1 - p) Xi(xi_NLoS) (dB)."""
    los_db, nlos_db = channel.excess_los_db, channel.excess_nlos_db
    if channel.line_of_sight == "al_hourani":
        los_db, nlos_db = AL_HOURANI[channel.environment][2:]
    return free_space_loss_db(distance_m, channel) + nlos_db - (nlos_db - los_db) * los_probability


def noise_power_w(channel: Channel) -> float:
    """sigma^2 = N_0 B (W)."""
    return float(10.0 ** ((channel.noise_dbm_per_hz - 30.0) / 10.0) * channel.bandwidth_hz)


def mean_snr(path_loss_db: Array, channel: Channel) -> Array:
    """gamma without fading, below eq. (rate): 10^(-L/10) P / sigma^2 (ratio)."""
    xp = array_namespace(path_loss_db)
    return xp.exp(path_loss_db * (-math.log(10.0) / 10.0)) * (channel.transmit_power_w / noise_power_w(channel))


def rician_factor(elevation: Array, channel: Channel) -> Array:
    """K(theta) = K_min exp(A theta), A = (2/pi) ln(K_max/K_min), theta in radians (You & Zhang, arXiv:1901.04106)."""
    xp = array_namespace(elevation)
    low = 10.0 ** (channel.rician_min_db / 10.0)
    growth = (channel.rician_max_db - channel.rician_min_db) / 10.0 * math.log(10.0) / 90.0
    return low * xp.exp(growth * elevation)


def fading_power(normal: Array, factor: Array) -> Array:
    """|h|^2 of a Rician link with unit mean; factor 0 is Rayleigh.

    Args:
        normal: (..., 2) standard normal draws, real and imaginary part.
        factor: (...) Rician factor (ratio).
    """
    xp = array_namespace(factor)
    first, second = components(normal)
    scatter = xp.sqrt(0.5 / (factor + 1.0))
    real = xp.sqrt(factor / (factor + 1.0)) + scatter * first
    imaginary = scatter * second
    return real * real + imaginary * imaginary


def rayleigh_power(normal: Array) -> Array:
    """|h|^2 of Rayleigh fading, exponential with unit mean: `fading_power` with factor 0; arguments as there."""
    real, imaginary = components(normal)
    return 0.5 * (real * real + imaginary * imaginary)


def rate_bps(snr: Array, bandwidth_hz: float) -> Array:
    """Eq. (rate): B log2(1 + gamma) (bit/s)."""
    xp = array_namespace(snr)
    return xp.log1p(snr) * (bandwidth_hz / math.log(2.0))


def ergodic_rate_bps(snr: Array, bandwidth_hz: float) -> Array:
    """Mean of eq. (rate) over Rayleigh fading, B e^(1/gamma) E1(1/gamma) / ln 2 (bit/s), by quadrature."""
    if isinstance(snr, float):
        return float(ergodic_rate_bps(np.asarray(snr), bandwidth_hz))
    xp = array_namespace(snr)
    nodes = xp.asarray(_EXPONENTIAL_NODES, dtype=snr.dtype, device=snr.device)
    weights = xp.asarray(_EXPONENTIAL_WEIGHTS, dtype=snr.dtype, device=snr.device)
    return xp.sum(rate_bps(snr[..., None] * nodes, bandwidth_hz) * weights, axis=-1)


def transmission_s(packet_bits: Array, rate: Array) -> Array:
    """T_com = D_k / r (s), below eq. (Energy_comm)."""
    return packet_bits / rate


def link_snr(horizontal_m: Array, channel: Channel) -> tuple[Array, Array, Array]:
    """From horizontal distance d (m) to (elevation in degrees, P_LoS, gamma without fading)."""
    distance = link_distance_m(horizontal_m, channel.altitude_m)
    elevation = elevation_deg(horizontal_m, channel.altitude_m)
    los = line_of_sight_probability(elevation, channel)
    return elevation, los, mean_snr(mean_path_loss_db(distance, los, channel), channel)


# Nodes and weights of integrals over |h|^2 in u = ln |h|^2, and of the phase: errors under 1e-7 up to LARGEST_FACTOR.
_LOG_POWER = np.linspace(-20.0, 4.2, 160)
_POWER_NODES = np.exp(_LOG_POWER)
_POWER_WEIGHTS = (_LOG_POWER[1] - _LOG_POWER[0]) * _POWER_NODES
_PHASE_COSINES = np.cos((np.arange(48) + 0.5) * (np.pi / 48))
LARGEST_FACTOR = (
    100.0  # of Rician fading: above 20 dB the power hardly fades, and narrower densities would need more nodes
)


def fading_density(power: Array, factor: Array) -> Array:
    """Density of `fading_power` at |h|^2 = `power`, by integrating the complex Gaussian h over its phase.

    With m = sqrt(K/(K+1)) it is the mean over theta of (K+1) exp(-(K+1) |sqrt(power) e^(j theta) - m|^2); K = 0 gives
    Rayleigh's exp(-power). Factors above 100 count as 100.

    Args:
        power: (...) at least 0.
        factor: (...) Rician factor K (ratio), of a shape that broadcasts.
    """
    xp = array_namespace(power)
    factor = xp.clip(factor, 0.0, LARGEST_FACTOR)[..., None]
    root = xp.sqrt(power)[..., None]
    cosine = xp.asarray(_PHASE_COSINES, dtype=power.dtype, device=power.device)
    line = xp.sqrt(factor / (factor + 1.0))
    square = (root - line) ** 2 + 2.0 * root * line * (1.0 - cosine)
    return xp.mean((factor + 1.0) * xp.exp(-(factor + 1.0) * square), axis=-1)


def _power_quadrature(least: Array, factor: Array | None) -> tuple[Array, Array]:
    """Nodes |h|^2 > least and their weights (..., nodes): sum(weights f(nodes)) = E[f(|h|^2); |h|^2 > least].

    `factor` is Rician's, or None for Rayleigh.
    """
    xp = array_namespace(least)
    nodes = xp.asarray(_POWER_NODES, dtype=least.dtype, device=least.device)
    weights = xp.asarray(_POWER_WEIGHTS, dtype=least.dtype, device=least.device)
    power = least[..., None] + nodes
    density = xp.exp(-power) if factor is None else fading_density(power, factor[..., None])
    return power, density * weights


def _limited_service(unit_s: Array, snr: Array, factor: Array | None, limit_s: float) -> tuple[Array, Array]:
    """(E[min(T_com, limit)], P(T_com <= limit)) over one kind of fading; `unit_s` is T_com at 1 bit/s/Hz."""
    xp = array_namespace(snr)
    exponent = xp.clip(unit_s * (math.log(2.0) / limit_s), 0.0, 80.0)  # beyond it nothing arrives; exp would overflow
    power, weights = _power_quadrature(xp.expm1(exponent) / snr, factor)
    arrival = xp.clip(xp.sum(weights, axis=-1), 0.0, 1.0)
    seconds = unit_s[..., None] * math.log(2.0) / xp.log1p(snr[..., None] * power)
    return xp.sum(weights * seconds, axis=-1) + (1.0 - arrival) * limit_s, arrival


def _mean_rate_bps(snr: Array, los: Array, factor: Array, channel: Channel) -> Array:
    """Mean of eq. (rate) over the channel's fading (bit/s)."""
    xp = array_namespace(snr)
    if channel.fading == "none":
        return rate_bps(snr, channel.bandwidth_hz)
    rate = ergodic_rate_bps(snr, channel.bandwidth_hz)
    if channel.fading == "rician":
        power, weights = _power_quadrature(xp.zeros_like(snr), factor)
        in_sight = xp.sum(weights * rate_bps(snr[..., None] * power, channel.bandwidth_hz), axis=-1)
        rate = los * in_sight + (1.0 - los) * rate
    return rate


def expected_service(horizontal_m: Array, packet_bits: Array, channel: Channel) -> tuple[Array, Array]:
    """How long one attempt to send a packet takes on average, and how likely the packet arrives.

    With an outage limit: E[min(T_com, limit)] and P(T_com <= limit) over the fading. Without one, Rayleigh and Rician
    fading make the mean of T_com infinite (1/log2(1 + gamma X) diverges at X -> 0), so T_com at the mean rate stands
    for it, with probability 1.

    Args:
        horizontal_m: (...) horizontal distance d (m).
        packet_bits: (...) D_k (bit), of the same shape.

    Returns:
        Seconds and probability, each (...).
    """
    xp = array_namespace(horizontal_m)
    elevation, los, snr = link_snr(horizontal_m, channel)
    factor, limit_s = rician_factor(elevation, channel), channel.max_transmission_s
    if limit_s is None or channel.fading in ("none", "ergodic"):
        seconds = transmission_s(packet_bits, _mean_rate_bps(snr, los, factor, channel))
        limit = math.inf if limit_s is None else limit_s
        return xp.clip(seconds, 0.0, limit), xp.where(seconds <= limit, xp.ones_like(seconds), 0.0)
    unit_s = packet_bits / channel.bandwidth_hz
    seconds, arrival = _limited_service(unit_s, snr, None, limit_s)
    if channel.fading == "rician":
        in_sight_s, in_sight = _limited_service(unit_s, snr, factor, limit_s)
        seconds, arrival = los * in_sight_s + (1.0 - los) * seconds, los * in_sight + (1.0 - los) * arrival
    return seconds, arrival
