from __future__ import annotations

import numpy as np
import pytest

from uavrl.benchmarks import simulate
from uavrl.benchmarks.simulate import SINGLE_ACTIONS, Batch, Single, step_bytes
from uavrl.scenario import load_scenario
from uavrl.simulation.environment import DataCollectionEnv


def test_a_batch_goes_on_from_where_it_was_in_numpy_and_in_torch() -> None:
    scenario = load_scenario("released", devices=3)
    for device in (None, "cpu"):
        batch = Batch(scenario, 5, device)
        batch.step()
        batch.step()
        assert batch.state.age_s.shape == (5, 3)
        assert (np.asarray(batch.state.step) == 2).all()


def test_a_batch_starts_anew_when_its_episodes_end_and_keeps_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulate, "EPISODE", 30)
    batch = Batch(load_scenario("released", devices=3), 200)
    for _ in range(30):
        before = batch.state.position_m
        batch.step()
    assert (batch.state.step == 30).all()
    assert (batch.state.position_m != before).any(axis=1).mean() > 0.9
    batch.step()
    assert (batch.state.step == 1).all()


def test_a_steps_bytes_grow_by_the_ages_alone() -> None:
    assert (
        step_bytes(load_scenario("released", devices=11)) - step_bytes(load_scenario("released")) == 2 * 8
    )  # read and written


def test_a_single_environment_flies_on_over_an_episodes_end() -> None:
    single = Single(load_scenario("released", max_steps=100))
    single.fly()
    flown = single.environment.unwrapped
    assert isinstance(flown, DataCollectionEnv)
    assert flown.state.step == SINGLE_ACTIONS % 100
