from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

from tests.datasets.flights import fly, small_scenario
from uavrl.agents.base import AgentConfig, Batch, RewardConfig
from uavrl.datasets import save_mapped
from uavrl.scenario import load_scenario
from uavrl.simulation.environment import observe
from uavrl.simulation.observations import ObservationKind
from uavrl.simulation.state import SimState
from uavrl.training.batches import MappedRows, RewardTransform, spaces_of, to_batch


@pytest.mark.parametrize("kind", ["paper", "devices"])
def test_a_batch_holds_what_a_policy_saw_and_flew(kind: ObservationKind) -> None:
    scenario = small_scenario()
    log = fly(scenario, steps=20)
    data = to_batch(log, kind, scenario)
    for row in (0, 7, len(log) - 1):
        one = log.take(np.array([row]))
        zero = np.zeros(1)
        before = SimState(one.position_m, one.age_s, one.energy_j, one.used_j, zero, one.step)
        after = SimState(one.next_position_m, one.next_age_s, one.next_energy_j, one.next_used_j, zero, one.step)
        for state, found in ((before, data.observation), (after, data.next_observation)):
            expected = observe(kind, scenario, one.layout_m.astype(np.float64), state)
            if kind == "paper":
                assert isinstance(found, torch.Tensor)
                np.testing.assert_allclose(found[row], expected[0], rtol=1e-6)
            else:
                assert isinstance(found, dict)
                for name, value in expected.items():
                    np.testing.assert_allclose(found[name][row], value[0], rtol=1e-5, atol=1e-3)
    reach = scenario.airframe.max_displacement_m
    np.testing.assert_allclose(
        data.action.continuous.numpy() * reach, log.executed_displacement_m, rtol=1e-5, atol=1e-4
    )
    assert not np.allclose(log.displacement_m, log.executed_displacement_m)  # commands of the box, moves of the disc
    assert data.action.choice.tolist() == log.device.tolist()
    assert data.reward.tolist() == log.reward.tolist()
    assert data.duration_s.tolist() == log.duration_s.tolist()


def test_a_truncated_flight_goes_on_in_the_batch_and_a_drained_battery_ends_it() -> None:
    scenario = small_scenario(max_steps=30, energy_budget_j=10.0)
    log = fly(scenario, steps=90)
    assert log.truncated.any() or log.terminated.any()
    assert log.terminated.any()
    data = to_batch(log, "devices", scenario)
    assert data.terminated.tolist() == log.terminated.astype(float).tolist()
    endless = small_scenario()
    log = fly(endless, steps=30)
    assert log.truncated.any()
    assert not to_batch(log, "paper", endless).terminated.any()


@pytest.mark.parametrize("kind", ["paper", "devices"])
def test_rows_read_one_by_one_are_those_taken_from_all_to_the_last_bit(kind: ObservationKind, tmp_path: Path) -> None:
    scenario = small_scenario(energy_budget_j=200.0)
    log = fly(scenario, steps=20)
    data, rows = to_batch(log, kind, scenario), torch.tensor([50, 3, 3, 0, 59, 50])
    on_disk = save_mapped(tmp_path / "log.mapped", [log], scenario)
    mapped = MappedRows(on_disk, lambda part: to_batch(part, kind, scenario))
    assert len(mapped) == len(data) == 60

    def tensors(batch: Batch) -> list[torch.Tensor]:
        seen = [batch.observation, batch.next_observation]
        flat = [value for one in seen for value in (one.values() if isinstance(one, dict) else [one])]
        return [*flat, *batch.action, batch.reward, batch.duration_s, batch.terminated]

    for found, expected in zip(tensors(mapped.take(rows)), tensors(data.take(rows)), strict=True):
        assert found.dtype == expected.dtype
        assert torch.equal(found, expected)


def test_spaces_are_those_of_the_scenario() -> None:
    scenario = load_scenario("released", devices=6)
    assert (spaces_of(scenario, "mlp").observation, spaces_of(scenario, "devices").observation) == (9, None)
    assert (spaces_of(scenario, "mlp").continuous, spaces_of(scenario, "mlp").choices) == (2, 7)


REWARD = np.array([-10.0, -1.0, -2.0, -3.0, -4.0])
DURATION_S = np.array([0.5, 1.0, 2.0, 0.5, 0.25])


@pytest.mark.parametrize(
    ("config", "terminates", "expected"),
    [
        (RewardConfig(transform="none", clip=None), False, REWARD),
        (RewardConfig(transform="none", clip=5.0, scale=2.0), False, [-5.0, -2.0, -4.0, -5.0, -5.0]),
        (RewardConfig(transform="centred", clip=None), False, REWARD + 3.0),
        (RewardConfig(transform="centred", clip=4.0, scale=3.0), False, [-4.0, 4.0, 3.0, 0.0, -3.0]),
        (RewardConfig(transform="centred", clip=None), True, REWARD),  # a shift would pay for ending, or for not ending
        (RewardConfig(transform="zscore", clip=None), False, (REWARD - REWARD.mean()) / REWARD.std()),
        (RewardConfig(transform="zscore", clip=None), True, REWARD / REWARD.std()),
        (RewardConfig(transform="robust", clip=None), False, (REWARD + 3.0) / 10.0),  # 7, 2, 1, 0, 1 from the median
        (RewardConfig(transform="robust", clip=0.5, scale=5.0), False, [-0.5, 0.5, 0.5, 0.0, -0.5]),
        (RewardConfig(transform="robust", clip=None), True, REWARD / 10.0),
    ],
)
def test_rewards_are_transformed_as_the_setting_says(config: RewardConfig, terminates: bool, expected: Any) -> None:
    seen = RewardTransform.fitted(REWARD, DURATION_S, AgentConfig(reward=config), terminates)
    found = seen(torch.from_numpy(REWARD), torch.from_numpy(DURATION_S))
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5)


def test_a_level_per_second_is_the_same_for_any_cut_of_the_time_into_steps() -> None:
    config = AgentConfig(discount_per="second", reward=RewardConfig(transform="centred", clip=None, scale=2.0))
    seen = RewardTransform.fitted(REWARD, DURATION_S, config, False)  # rates -20, -1, -1, -6, -16
    assert seen.level == -6.0
    found = seen(torch.from_numpy(REWARD), torch.from_numpy(DURATION_S))
    np.testing.assert_allclose(found.numpy(), 2.0 * (REWARD + 6.0 * DURATION_S))
    whole = seen(torch.tensor([-4.0]), torch.tensor([3.0]))
    halves = seen(torch.tensor([-1.0, -3.0]), torch.tensor([2.0, 1.0]))
    assert halves.sum() == pytest.approx(float(whole))
    assert RewardTransform.fitted(REWARD, DURATION_S, config, True).level == 0.0
    held = seen._replace(clip=3.0)(torch.from_numpy(REWARD), torch.from_numpy(DURATION_S))  # -14, 10, 20, 0, -5
    np.testing.assert_allclose(held.numpy(), [-1.5, 3.0, 6.0, 0.0, -0.75])  # at most 3 a second


def test_zscored_rewards_a_second_have_no_level_and_unit_deviation() -> None:
    config = AgentConfig(discount_per="second", reward=RewardConfig(transform="zscore", clip=None))
    seen = RewardTransform.fitted(REWARD, DURATION_S, config, False)
    found = seen(torch.from_numpy(REWARD), torch.from_numpy(DURATION_S)).numpy()
    assert (found / DURATION_S).mean() == pytest.approx(0.0, abs=1e-6)
    assert found.std() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("discount_per", ["step", "second"])
def test_robust_rewards_do_not_depend_on_their_unit(discount_per: str) -> None:
    config = AgentConfig.model_validate({"discount_per": discount_per, "reward": {"transform": "robust"}})
    duration_s = torch.from_numpy(DURATION_S)
    found = [
        RewardTransform.fitted(unit * REWARD, DURATION_S, config, False)(torch.from_numpy(unit * REWARD), duration_s)
        for unit in (1.0, 1.0 / 400.0)
    ]
    np.testing.assert_allclose(found[0].numpy(), found[1].numpy(), rtol=1e-9)
    apart = np.abs(found[0].numpy())
    assert np.median(apart) == pytest.approx(0.1)


@pytest.mark.parametrize("jitter", [0.0, 1e-8])
def test_robust_rewards_of_which_half_are_equal_are_measured_by_their_mean_deviation(jitter: float) -> None:
    config = AgentConfig(reward=RewardConfig(transform="robust", clip=None))
    reward = np.array([-1.0, -1.0 + jitter, -1.0 - jitter, -1.0, -6.0])
    seen = RewardTransform.fitted(reward, DURATION_S, config, False)
    np.testing.assert_allclose(
        seen(torch.from_numpy(reward), torch.from_numpy(DURATION_S)).numpy()[-1], -0.5, rtol=1e-6
    )


@pytest.mark.parametrize("transform", ["zscore", "robust"])
def test_equal_rewards_do_not_divide_by_zero(transform: Literal["zscore", "robust"]) -> None:
    config = RewardConfig(transform=transform, clip=None)
    seen = RewardTransform.fitted(np.full(5, -2.0), DURATION_S, AgentConfig(reward=config), False)
    assert seen(torch.full((5,), -2.0), torch.from_numpy(DURATION_S)).abs().max() < 1e-3
