"""Ground-to-air channel: known values, closed forms, independent implementations and properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial.hermite_e import hermegauss
from scipy import special, stats

from uavrl.physics import channel
from uavrl.scenario import Channel

PAPER = Channel(fading="none")
ENVIRONMENTS = {  # a, b, eta_LoS, eta_NLoS: Al-Hourani, Kandeepan & Lardner 2014
    "suburban": (4.88, 0.43, 0.1, 21.0),
    "urban": (9.61, 0.16, 1.0, 20.0),
    "dense_urban": (12.08, 0.11, 1.6, 23.0),
    "high_rise": (27.23, 0.08, 2.3, 34.0),
}
distances = st.floats(0.0, 1500.0)
CHANNELS = [PAPER, *(Channel(line_of_sight="al_hourani", environment=name) for name in ENVIRONMENTS)]


def at(horizontal_m: float, link: Channel = PAPER) -> tuple[float, float, float]:
    elevation, los, snr = channel.link_snr(np.array([horizontal_m]), link)
    return float(elevation[0]), float(los[0]), float(snr[0])


class TestGeometry:
    def test_distance_and_elevation(self) -> None:
        horizontal = np.array([0.0, 100.0, 100.0 * math.sqrt(3.0)])
        distance = channel.link_distance_m(horizontal, 100.0)
        assert distance == pytest.approx([100.0, 100.0 * math.sqrt(2.0), 200.0])
        assert channel.elevation_deg(horizontal, 100.0) == pytest.approx([90.0, 45.0, 30.0])
        assert channel.elevation_deg(horizontal, 100.0) == pytest.approx(np.degrees(np.arcsin(100.0 / distance)))


class TestLineOfSight:
    def test_even_odds_at_13_84_degrees_or_406_metres(self) -> None:
        assert channel.line_of_sight_probability(np.array([10.0 + math.log(10.0) / 0.6]), PAPER) == pytest.approx(0.5)
        elevation, los, _ = at(406.0)
        assert elevation == pytest.approx(13.84, abs=5e-3)
        assert los == pytest.approx(0.5, abs=1e-3)

    def test_at_theta_equal_c_it_is_one_over_one_plus_c(self) -> None:
        assert channel.line_of_sight_probability(np.array([10.0]), PAPER) == pytest.approx(1 / 11)

    @pytest.mark.parametrize("name", ENVIRONMENTS)
    def test_al_hourani(self, name: str) -> None:
        a, b, los_db, nlos_db = ENVIRONMENTS[name]
        link = Channel.model_validate({"line_of_sight": "al_hourani", "environment": name})
        theta = np.array([0.0, 20.0, 90.0])
        expected = 1 / (1 + a * np.exp(-b * (theta - a)))
        assert channel.line_of_sight_probability(theta, link) == pytest.approx(expected, rel=1e-12)
        free = channel.free_space_loss_db(np.array([300.0]), link)[0]
        loss = channel.mean_path_loss_db(np.array([300.0, 300.0]), np.array([1.0, 0.0]), link)
        assert loss - free == pytest.approx([los_db, nlos_db])

    @pytest.mark.parametrize("link", CHANNELS)
    @given(distance=distances)
    def test_is_a_probability_and_falls_with_distance(self, link: Channel, distance: float) -> None:
        _, near, _ = at(distance, link)
        _, far, _ = at(distance + 1.0, link)
        assert 0.0 < far <= near < 1.0 or far == near == pytest.approx(1.0)


class TestPathLoss:
    def test_free_space_at_a_hundred_metres(self) -> None:
        loss = channel.free_space_loss_db(np.array([100.0, 1000.0]), PAPER)
        assert loss[0] == pytest.approx(20 * math.log10(4 * math.pi * 2e9 * 100 / 3e8))
        assert loss[0] == pytest.approx(78.46, abs=5e-3)
        assert loss[1] - loss[0] == pytest.approx(20.0)

    def test_mean_weighs_both_losses(self) -> None:
        distance = np.array([250.0])
        free = channel.free_space_loss_db(distance, PAPER)
        mixed = channel.mean_path_loss_db(distance, np.array([0.3]), PAPER)
        assert mixed - free == pytest.approx(0.3 * 1.0 + 0.7 * 20.0)

    def test_snr_from_the_link_budget_in_decibels(self) -> None:
        assert channel.noise_power_w(PAPER) == pytest.approx(10 ** (-11.4) * 1e-3)
        assert channel.mean_snr(np.array([79.46]), PAPER)[0] == pytest.approx(
            10 ** ((10 * math.log10(125.9) - 79.46 + 114.0) / 10)
        )

    def test_link_puts_the_equations_together(self) -> None:
        distance = math.sqrt(100.0**2 + 300.0**2)
        theta = math.degrees(math.asin(100.0 / distance))
        sight = 1 / (1 + 10 * math.exp(-0.6 * (theta - 10)))
        loss_db = 20 * math.log10(4 * math.pi * 2e9 * distance / 3e8) + 1.0 * sight + 20.0 * (1 - sight)
        snr_db = 10 * math.log10(125.9) - loss_db + 114.0
        assert at(300.0) == pytest.approx((theta, sight, 10 ** (snr_db / 10)))


class TestRate:
    def test_is_shannons(self) -> None:
        assert channel.rate_bps(np.array([0.0, 1.0, 1023.0]), 1e6) == pytest.approx([0.0, 1e6, 1e7])
        assert channel.transmission_s(np.array([2e6]), np.array([1e7])) == pytest.approx(0.2)

    def test_overhead_a_packet_takes_0_1084_s_and_0_1135_s_ergodic(self) -> None:
        _, _, snr = at(0.0)
        fixed = 2e6 / channel.rate_bps(np.array([snr]), 1e6)[0]
        ergodic = 2e6 / channel.ergodic_rate_bps(np.array([snr]), 1e6)[0]
        assert fixed == pytest.approx(0.1084, abs=5e-5)
        assert ergodic == pytest.approx(0.1135, abs=5e-5)

    def test_ergodic_rate_is_the_exponential_integral(self) -> None:
        snr = np.logspace(-2, 9, 45)
        exact = 1e6 / math.log(2.0) * np.exp(1 / snr) * special.exp1(1 / snr)
        assert channel.ergodic_rate_bps(snr, 1e6) == pytest.approx(exact, rel=1e-6)

    @pytest.mark.parametrize("link", CHANNELS)
    @given(near=distances, step=st.floats(0.1, 500.0))
    def test_falls_with_distance(self, link: Channel, near: float, step: float) -> None:
        _, _, snr = channel.link_snr(np.array([near, near + step]), link)
        for rate in (channel.rate_bps(snr, 1e6), channel.ergodic_rate_bps(snr, 1e6)):
            assert rate[0] > rate[1] > 0.0

    @given(snr=st.floats(1e-3, 1e9))
    def test_fading_costs_rate_on_average(self, snr: float) -> None:
        ergodic = channel.ergodic_rate_bps(np.array([snr]), 1.0)
        assert 0.0 < ergodic[0] < channel.rate_bps(np.array([snr]), 1.0)[0]  # Jensen


class TestFading:
    def test_rician_factor_at_both_ends_and_between(self) -> None:
        link = Channel(rician_min_db=5.0, rician_max_db=15.0)
        assert channel.rician_factor(np.array([0.0, 45.0, 90.0]), link) == pytest.approx([10**0.5, 10.0, 10**1.5])

    @pytest.mark.parametrize("factor", [0.0, 0.5, 3.16, 31.6])
    def test_power_has_unit_mean_and_the_rician_variance(self, factor: float) -> None:
        points, weights = hermegauss(6)  # exact for these polynomials of normal numbers
        normal = np.stack(np.meshgrid(points, points), axis=-1).reshape(-1, 2)
        weight = np.outer(weights, weights).ravel() / weights.sum() ** 2
        power = channel.fading_power(normal, np.full(len(normal), factor))
        assert weight @ power == pytest.approx(1.0, rel=1e-12)
        assert weight @ power**2 == pytest.approx((factor**2 + 4 * factor + 2) / (factor + 1) ** 2, rel=1e-12)

    def test_rayleigh_is_rician_with_factor_zero(self) -> None:
        normal = np.random.default_rng(0).standard_normal((1000, 2))
        expected = channel.fading_power(normal, np.zeros(1000))
        assert channel.rayleigh_power(normal) == pytest.approx(expected, rel=1e-12)
        assert stats.kstest(channel.rayleigh_power(normal), "expon").pvalue > 0.01

    def test_a_large_factor_hardly_fades(self) -> None:
        normal = np.random.default_rng(0).standard_normal((1000, 2))
        assert channel.fading_power(normal, np.full(1000, 1e8)) == pytest.approx(np.ones(1000), abs=1e-3)
