from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.datasets.flights import fly, small_scenario
from uavrl.datasets import COLUMNS, Transitions, concatenate, validate
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario
from uavrl.simulation.observations import ObservationKind


def with_column(log: Transitions, **columns: Any) -> Transitions:
    return Transitions(**{**log.columns(), **columns})


def same(first: Any, second: Any, tolerance: float) -> None:
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            np.testing.assert_allclose(first[key], second[key], atol=tolerance, rtol=1e-5)
    else:
        np.testing.assert_allclose(first, second, atol=tolerance, rtol=1e-5)


@pytest.mark.parametrize("kind", ["paper", "devices"])
def test_observations_are_those_of_the_environment_that_repeats_the_flight(kind: ObservationKind) -> None:
    scenario = small_scenario(fading="none", energy_budget_j=150.0, max_steps=40, priority=(0.2, 0.5, 0.3))
    log = fly(scenario, environments=2, steps=40)
    before, after = log.observations(kind, scenario)

    def row(observation: Any, i: int) -> Any:
        return {key: value[i] for key, value in observation.items()} if kind == "devices" else observation[i]

    rows = np.flatnonzero(log.episode == 0)
    environment = gymnasium.make("uavrl/DataCollection-v0", scenario=scenario, observation=kind)
    options = {"position_m": log.position_m[rows[0]], "layout": log.layout_m[rows[0]]}
    seen, _ = environment.reset(seed=0, options=options)
    for i in rows.tolist():
        same(row(before, i), seen, 2e-3)
        action = {"displacement_m": log.displacement_m[i], "device": log.device[i]}
        seen, reward, terminated, truncated, _ = environment.step(action)
        same(row(after, i), seen, 2e-3)
        assert float(reward) == pytest.approx(float(log.reward[i]), rel=1e-4)
        assert (terminated, truncated) == (log.terminated[i], log.truncated[i])
    assert log.terminated[rows[-1]], "the battery was meant to end this flight"
    leaf = after["uav"] if kind == "devices" else after
    assert leaf.dtype == np.float32


def test_columns_have_the_declared_types_and_shapes(log: Transitions) -> None:
    for name, values in log.columns().items():
        assert values.dtype == COLUMNS[name].dtype
        assert values.shape == (120, *COLUMNS[name].row_shape(3))
    assert list(log.columns()) == list(COLUMNS)
    assert (len(log), log.devices) == (120, 3)


def test_a_wrong_shape_is_refused_by_name(log: Transitions) -> None:
    with pytest.raises(DatasetError, match=r"'next_age_s' has shape \(120, 2\), allowed: \(120, 3\)"):
        with_column(log, next_age_s=log.next_age_s[:, :2])
    with pytest.raises(DatasetError, match=r"'reward' has shape \(119,\)"):
        with_column(log, reward=log.reward[1:])


def test_repr_says_what_is_inside(log: Transitions) -> None:
    assert repr(log) == f"Transitions(120 rows of 12 episodes, K = 3, reward {log.reward.mean():.4g} a step)"
    assert repr(log.take(slice(0, 0))) == "Transitions(0 rows of 0 episodes, K = 3)"


def test_rows_are_taken_and_put_in_order(log: Transitions) -> None:
    shuffled = log.take(np.random.default_rng(0).permutation(len(log)))
    assert (shuffled.episode != log.episode).any()
    assert shuffled.in_order().digest() == log.digest()
    assert log.take(log.device == 0).device.max() == 0


def test_the_digest_depends_on_every_column(log: Transitions) -> None:
    digests = {log.digest()}
    for name, values in log.columns().items():
        changed = values.copy()
        changed.flat[5] = not changed.flat[5] if values.dtype == bool else changed.flat[5] + 1
        digests.add(with_column(log, **{name: changed}).digest())
    assert len(digests) == 1 + len(COLUMNS)


def test_joined_logs_keep_their_episodes_apart(log: Transitions, scenario: Scenario) -> None:
    other = fly(scenario, seed=1)
    joined = concatenate([log, other, log])
    validate(joined, scenario)
    assert len(np.unique(joined.episode)) == 36
    np.testing.assert_array_equal(joined.reward, np.concatenate([log.reward, other.reward, log.reward]))


def test_logs_of_different_k_do_not_join(log: Transitions) -> None:
    with pytest.raises(DatasetError, match="K = 2, 3 devices"):
        concatenate([log, fly(small_scenario(devices=2))])
    with pytest.raises(DatasetError, match="nothing to concatenate"):
        concatenate([])


def test_the_documentation_lists_the_columns_as_they_are() -> None:
    lines = (Path(__file__).parents[2] / "docs" / "data.md").read_text().splitlines()
    sizes = {(): "1", (2,): "2", ("K",): "K", ("K", 2): "2K"}
    rows = [f"| `{name}` | {sizes[column.shape]} | {column.meaning} |" for name, column in COLUMNS.items()]
    start = lines.index(rows[0])
    assert lines[start : start + len(rows) + 1] == [*rows, ""]
