from __future__ import annotations

import numpy as np
import pytest

from tests.evaluation.flying import Scripted, Wanderer, overhead, timed_scenario
from uavrl.evaluation.metrics import age_percentile_s, flight_metrics, jain
from uavrl.evaluation.rollouts import Flights, evaluation_set, fly
from uavrl.physics.energy import hover_power_w
from uavrl.scenario import Scenario, load_scenario


def judged(scenario: Scenario, *devices: int) -> tuple[Flights, dict[str, float]]:
    flights = fly(Scripted(devices), overhead(scenario))
    return flights, {name: float(values[0]) for name, values in flight_metrics(flights).items()}


def test_every_metric_of_a_flight_worked_out_by_hand() -> None:
    # Steps last 1.5, .5, 2.5, 2.5 s. Device 1 is left at ages 0, .5, 3, 5.5, device 2 at 1.5, 2, 0, 0.
    scenario = timed_scenario()
    _, metrics = judged(scenario, 1, 0, 2, 2)
    power_w = hover_power_w(scenario.airframe) + 0.0126
    age_1 = (1.5**2 / 2 + 0.5**2 / 2 + (3**2 - 0.5**2) / 2 + (5.5**2 - 3**2) / 2) / 7
    age_2 = (1.5**2 / 2 + (2**2 - 1.5**2) / 2 + (4.5**2 - 2**2) / 2 + 2.5**2 / 2) / 7
    bits = 5 * scenario.traffic.packet_bits_each[0]
    assert metrics == pytest.approx(
        {
            "return": -(0.5 * (0.75 + 1.25 + 1.5 + 2.75) + 0.5 * 5 * power_w / 1000),
            "age_per_step_s": (0.75 + 1.25 + 1.5 + 2.75) / 4,
            "age_per_second_s": (age_1 + age_2) / 2,
            "worst_device_age_s": age_1,
            "age_p95_s": 4.8,  # of 14 device-seconds .7 lie above: device 1 alone passes 4.5, and ends at 5.5
            "energy_per_step_j": 5 * power_w / 4,
            "energy_per_episode_j": 5 * power_w,
            "device_energy_j": 5 * 0.1259,
            "throughput_mbps": bits / 7 / 1e6,
            "data_mb": bits / 8e6,
            "transmission_mean_s": 5 / 3,
            "transmission_median_s": 2.0,
            "jain_bits": (1 + 4) ** 2 / (2 * (1 + 16)),
            "jain_age": (1 / age_1 + 1 / age_2) ** 2 / (2 * (1 / age_1**2 + 1 / age_2**2)),
            "outage_rate": 0.0,
            "steps": 4.0,
            "duration_s": 7.0,
        },
        rel=1e-9,
    )


def test_priorities_weigh_the_ages_and_need_not_sum_to_one() -> None:
    _, metrics = judged(timed_scenario(priority=(0.6, 0.2)), 1, 0, 2, 2)
    assert metrics["age_per_step_s"] == pytest.approx((0.75 * (0 + 0.5 + 3 + 5.5) + 0.25 * (1.5 + 2)) / 4)
    assert metrics["age_per_second_s"] == pytest.approx((0.75 * 16.25 + 0.25 * 13.25) / 7)


def test_the_median_of_an_even_number_of_packets_is_between_the_middle_two() -> None:
    _, metrics = judged(timed_scenario(), 1, 1, 2, 2)
    assert metrics["transmission_median_s"] == pytest.approx(1.5)


def test_a_lost_packet_counts_its_time_but_not_its_bits() -> None:
    scenario = timed_scenario(max_transmission_s=1.25)  # device 2 needs 2 s
    _, metrics = judged(scenario, 1, 2, 2, 1)
    assert metrics["outage_rate"] == 0.5
    assert metrics["data_mb"] == pytest.approx(2 * scenario.traffic.packet_bits_each[0] / 8e6)
    assert metrics["transmission_mean_s"] == pytest.approx((1 + 1.25 + 1.25 + 1) / 4)
    assert metrics["worst_device_age_s"] == pytest.approx(6.5 / 2)  # device 2, never renewed in 6.5 s


def test_what_does_not_exist_for_an_idle_flight_is_nan() -> None:
    _, metrics = judged(timed_scenario(), 0)
    missing = {"transmission_mean_s", "transmission_median_s", "jain_bits", "outage_rate"}
    assert {name for name, value in metrics.items() if np.isnan(value)} == missing
    assert metrics["age_per_second_s"] == pytest.approx(1.0)


def test_ages_cut_at_their_maximum_are_the_percentile() -> None:
    scenario = timed_scenario(max_age_s=3.0)
    _, metrics = judged(scenario, 1, 0, 2, 2)
    assert metrics["age_p95_s"] == 3.0  # above 2.99 s for 2.5 + 1.5 of 14 s
    assert metrics["age_per_second_s"] == pytest.approx((16.25 - 2.5**2 / 2 + 13.25 - 1.5**2 / 2) / 14)


def test_the_age_percentile_agrees_with_ages_looked_at_every_millisecond() -> None:
    scenario = timed_scenario(devices=2, max_steps=40, time_budget_s=25.0, max_transmission_s=4.0)
    flights = fly(Wanderer(), evaluation_set(scenario, "random", 3, fading_seeds=2))
    for flight, found in enumerate(age_percentile_s(flights, 0.9)):
        episode = flights.episode(flight)
        looked = []
        for step, began in enumerate(episode.time_s[:-1]):
            moments = np.arange(0, episode.time_s[step + 1] - began, 1e-3)
            looked.append(np.add.outer(episode.age_s[step], moments).ravel())
        assert found == pytest.approx(np.quantile(np.concatenate(looked), 0.9), abs=5e-3)


@pytest.mark.parametrize(("share", "index"), [([2, 2, 2], 1.0), ([1, 0, 0, 0], 0.25), ([1, 3], 0.8), ([0, 0], np.nan)])
def test_jains_index(share: list[float], index: float) -> None:
    assert jain(np.array([share], dtype=float))[0] == pytest.approx(index, nan_ok=True)


def test_a_flight_that_ends_before_the_others_counts_nothing_more() -> None:
    scenario = load_scenario("released", devices=4, max_steps=None, time_budget_s=8.0)
    environments = evaluation_set(scenario, "random", 4)
    policy = Scripted((1, 3, 2, 4, 0))
    flights = fly(policy, environments)
    assert len(set(flights.steps)) > 2
    among = flight_metrics(flights)
    for episode in range(4):
        for name, alone in flight_metrics(fly(policy, environments.only(episode))).items():
            assert among[name][episode] == pytest.approx(alone[0], rel=1e-9), name
