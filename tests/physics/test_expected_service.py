"""The expected service against closed forms, against sampling, and at its limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import ncx2

from uavrl.physics import channel
from uavrl.scenario import PRESETS, Scenario

DISTANCE_M = np.array([0.0, 150.0, 400.0, 1000.0])


def expected(scenario: Scenario, bits: float = 2e6) -> tuple[Any, Any]:
    return channel.expected_service(DISTANCE_M, np.full_like(DISTANCE_M, bits), scenario.channel)


@pytest.mark.parametrize("factor", [0.0, 3.0, 30.0, 100.0])
def test_density_of_the_fading_power_is_a_scaled_noncentral_chi_square(factor: float) -> None:
    power = np.linspace(0.01, 3.0, 50)
    scale = 2.0 * (factor + 1.0)
    known = scale * ncx2.pdf(scale * power, 2, 2.0 * factor)
    np.testing.assert_allclose(channel.fading_density(power, np.array(factor)), known, rtol=1e-6, atol=1e-12)


def test_without_fading_a_service_takes_its_rate() -> None:
    seconds, arrival = expected(PRESETS["released"].replace(fading="none"))
    assert seconds[0] == pytest.approx(0.1084, abs=5e-5)
    assert (arrival == 1.0).all()


def test_rayleigh_without_a_limit_takes_its_mean_rate() -> None:
    seconds, arrival = expected(PRESETS["released"])
    assert seconds[0] == pytest.approx(0.1135, abs=5e-5)
    np.testing.assert_array_equal(seconds, expected(PRESETS["released"].replace(fading="ergodic"))[0])
    assert (arrival == 1.0).all()


def test_success_under_rayleigh_is_an_exponential_tail() -> None:
    scenario = PRESETS["released"].replace(max_transmission_s=0.3)
    _, _, snr = channel.link_snr(DISTANCE_M, scenario.channel)
    seconds, arrival = expected(scenario)
    np.testing.assert_allclose(arrival, np.exp(-(2.0 ** (2.0 / 0.3) - 1.0) / snr), rtol=1e-6)
    assert (seconds < 0.3).all()


@pytest.mark.parametrize("fading", ["rayleigh", "rician"])
@pytest.mark.parametrize("limit_s", [0.25, 2.0])
def test_mean_and_success_agree_with_sampling(fading: str, limit_s: float) -> None:
    scenario = PRESETS["realistic"].replace(fading=fading, max_transmission_s=limit_s)
    generator = np.random.default_rng(3)
    count = 20_000
    elevation, los, snr = channel.link_snr(DISTANCE_M, scenario.channel)
    factor = np.zeros((count, 4))
    if fading == "rician":
        factor = np.where(generator.random((count, 4)) < los, channel.rician_factor(elevation, scenario.channel), 0.0)
    power = channel.fading_power(generator.standard_normal((count, 4, 2)), factor)
    drawn_s = 2e6 / channel.rate_bps(snr * power, scenario.channel.bandwidth_hz)
    seconds, arrival = expected(scenario)
    limited_s = np.minimum(drawn_s, limit_s)
    error = limited_s.std(axis=0) / math.sqrt(count)
    np.testing.assert_array_less(np.abs(seconds - limited_s.mean(axis=0)), 4.0 * error + 1e-9)
    came = (drawn_s <= limit_s).mean(axis=0)
    np.testing.assert_array_less(np.abs(arrival - came), 4.0 * np.sqrt(came * (1 - came) / count) + 1e-4)


def test_rician_without_a_limit_takes_its_mean_rate() -> None:
    scenario = PRESETS["realistic"].replace(max_transmission_s=None)
    generator = np.random.default_rng(4)
    elevation, los, snr = channel.link_snr(DISTANCE_M, scenario.channel)
    sight = generator.random((30_000, 4)) < los
    factor = np.where(sight, channel.rician_factor(elevation, scenario.channel), 0.0)
    power = channel.fading_power(generator.standard_normal((30_000, 4, 2)), factor)
    rate = channel.rate_bps(snr * power, scenario.channel.bandwidth_hz).mean(axis=0)
    np.testing.assert_allclose(expected(scenario)[0], 2e6 / rate, rtol=1e-2)


@pytest.mark.parametrize("fading", ["none", "ergodic", "rayleigh", "rician"])
def test_a_limit_far_too_short_loses_every_packet_after_it(fading: str) -> None:
    seconds, arrival = expected(PRESETS["realistic"].replace(fading=fading, max_transmission_s=1e-4))
    np.testing.assert_allclose(seconds, 1e-4)
    np.testing.assert_array_equal(arrival, 0.0)


@pytest.mark.parametrize("fading", ["none", "rayleigh", "rician"])
def test_torch_float32_agrees(fading: str) -> None:
    link = PRESETS["realistic"].replace(fading=fading).channel
    distance = torch.tensor(DISTANCE_M, dtype=torch.float32)
    seconds, arrival = channel.expected_service(distance, torch.full_like(distance, 2e6), link)
    known = channel.expected_service(DISTANCE_M, np.full_like(DISTANCE_M, 2e6), link)
    assert seconds.dtype == torch.float32
    np.testing.assert_allclose(seconds.numpy(), known[0], rtol=1e-4)
    np.testing.assert_allclose(arrival.numpy(), known[1], rtol=1e-4)
