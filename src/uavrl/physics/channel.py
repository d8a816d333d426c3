"""Ground-to-air channel: geometry, line of sight, path loss, fading, rate. Arrays of any one shape (...) throughout."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from uavrl.scenario import Channel

Array = Any  # a NumPy array or torch tensor; the Array API has no common type to name

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


def elevation_deg(distance_m: Array, altitude_m: float) -> Array:
    """theta = arcsin(h / R), in degrees: the constants C and D of eq. (LoS_Prob) are in degrees."""
    xp = array_namespace(distance_m)
    return xp.asin(altitude_m / distance_m) * (180.0 / math.pi)


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
    xp = array_namespace(normal)
    scatter = xp.sqrt(0.5 / (factor + 1.0))
    real = xp.sqrt(factor / (factor + 1.0)) + scatter * normal[..., 0]
    imaginary = scatter * normal[..., 1]
    return real * real + imaginary * imaginary


def rate_bps(snr: Array, bandwidth_hz: float) -> Array:
    """Eq. (rate): B log2(1 + gamma) (bit/s)."""
    xp = array_namespace(snr)
    return xp.log1p(snr) * (bandwidth_hz / math.log(2.0))


def ergodic_rate_bps(snr: Array, bandwidth_hz: float) -> Array:
    """Mean of eq. (rate) over Rayleigh fading, B e^(1/gamma) E1(1/gamma) / ln 2 (bit/s), by quadrature."""
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
    elevation = elevation_deg(distance, channel.altitude_m)
    los = line_of_sight_probability(elevation, channel)
    return elevation, los, mean_snr(mean_path_loss_db(distance, los, channel), channel)
