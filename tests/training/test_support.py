from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.agents.problems import agent, batch
from uavrl.actions import HybridAction
from uavrl.agents.base import Batch
from uavrl.networks import Observation
from uavrl.training.support import Support


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class Acting:
    """An agent that maps observations to displacements by a function."""

    def __init__(self, w: Callable[[Observation], Tensor]) -> None:
        self.w = w

    def act(self, observation: Observation, **_: object) -> HybridAction:
        return HybridAction(self.w(observation), None)


def data_of(observation: Tensor, continuous: Tensor) -> Batch:
    rows = len(observation)
    zero = torch.zeros(rows)
    action = HybridAction(continuous, torch.zeros(rows, dtype=torch.int64))
    return Batch(observation, action, zero, zero, zero, observation)


def two_towns(rows: int = 400) -> Batch:
    """Left of 0 all move to (-.8, 0), right of it to (.8, 0); a second entry of a thousandfold scale says nothing."""
    place = torch.where(torch.arange(rows) % 2 == 0, -1.0, 1.0) + 0.1 * torch.randn(rows, generator=generator())
    noise = 1000.0 * torch.randn(rows, generator=generator(1))
    return data_of(torch.stack([place, noise], 1), torch.stack([0.8 * place.sign(), torch.zeros(rows)], 1))


def measure(support: Support, w: Callable[[Any], Tensor]) -> float:
    return float(support.distance(Acting(w), generator()))  # type: ignore[arg-type]  # acts as an agent does


def test_a_policy_on_the_data_is_near_and_one_off_it_as_far_as_it_is_off() -> None:
    support = Support(two_towns(), rows=50, neighbours=5)

    def logged(seen: Tensor) -> Tensor:
        return torch.stack([0.8 * seen[:, 0].sign(), torch.zeros(len(seen))], 1)

    assert measure(support, logged) == pytest.approx(0.0, abs=1e-6)
    assert measure(support, lambda seen: logged(seen) + torch.tensor([0.0, 0.3])) == pytest.approx(0.3, rel=1e-5)
    assert measure(support, lambda seen: torch.zeros(len(seen), 2)) == pytest.approx(0.8, rel=1e-5)
    # what the other town does is in the data, but not here
    assert measure(support, lambda seen: -logged(seen)) == pytest.approx(1.6, rel=1e-5)


def test_one_of_k_neighbours_is_enough_and_a_row_of_its_own_always_counts() -> None:
    observation = torch.zeros(100, 3)  # all the same: every row is as near as its own
    logged = torch.rand((100, 2), generator=generator(3)) * 2 - 1
    support = Support(data_of(observation, logged), neighbours=7)
    assert support.logged.shape == (100, 7, 2)
    drawn = torch.randperm(100, generator=torch.Generator().manual_seed(0))
    assert torch.equal(support.logged[:, 0], logged[drawn])
    assert measure(support, lambda seen: support.logged[:, 3]) == 0.0
    alone = Support(data_of(observation, logged), neighbours=1)
    assert measure(alone, lambda seen: alone.logged[:, 0]) == 0.0
    assert measure(alone, lambda seen: support.logged[:, 3]) > 0.1


def test_the_nearest_are_those_of_a_brute_force_search() -> None:
    data = batch("devices", 60)
    assert isinstance(data.observation, dict)
    support = Support(data, rows=20, neighbours=4, seed=5)
    flat = torch.cat([data.observation["uav"], data.observation["devices"].flatten(1)], 1).numpy()
    deviation = flat.std(axis=0)
    flat = flat / [one if one > 1e-6 else 1.0 for one in deviation]
    drawn = torch.randperm(60, generator=torch.Generator().manual_seed(5))
    for position, row in enumerate(drawn[:20].tolist()):
        apart = ((flat - flat[row]) ** 2).sum(axis=1)
        expected = data.action.continuous[apart.argsort()[:4].tolist()]
        assert torch.equal(support.logged[position], expected)


def test_a_probe_is_no_larger_than_its_data_or_its_pool() -> None:
    few = Support(batch("mlp", 3))
    assert few.logged.shape == (3, 3, 2)
    pool = Support(batch("mlp", 50), pool=20)
    assert pool.logged.shape == (20, 10, 2)


@pytest.mark.parametrize("name", ["sac", "diffusion_sac", "bcq"])
def test_it_draws_from_the_generator_it_is_given(name: str) -> None:
    made, support = agent(name, "devices"), Support(batch("devices", 30))
    before = torch.random.get_rng_state()
    first, again, other = (float(support.distance(made, generator(seed))) for seed in (1, 1, 2))
    assert first == again != other
    assert torch.equal(torch.random.get_rng_state(), before)
