from __future__ import annotations

import pytest
import torch

from tests.agents.problems import agent, batch, copies, equal
from uavrl.agents.base import Batch, Metrics
from uavrl.training.fit import fit, learn_once


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_fit_sets_the_normalisers_and_updates_so_many_times_on_minibatches() -> None:
    data, straight, fitted = batch("mlp", 40), agent("bc", "mlp", batch_size=8), agent("bc", "mlp", batch_size=8)
    assert isinstance(data.observation, torch.Tensor)
    metrics = fit(fitted, data, 3, generator())
    state = fitted.networks.state_dict()
    means = [value for name, value in state.items() if name.endswith("normaliser.mean")]
    for mean in means:
        torch.testing.assert_close(mean[:7], data.observation.mean(dim=0))
    assert means
    straight.networks.load_state_dict(
        straight.networks.state_dict() | {name: value for name, value in state.items() if "normaliser" in name}
    )
    noise = generator()
    for _ in range(3):
        rows = torch.randint(0, 40, (8,), generator=noise)
        last = straight.update(data.take(rows), noise)
    assert equal(copies(straight.networks), copies(fitted.networks))
    assert metrics == {name: float(value) for name, value in last.items()}
    assert fit(fitted, data, 0, generator()) == {}
    assert fitted.progress == pytest.approx(2 / 3)


def test_minibatches_come_from_the_generator_and_reach_every_row() -> None:
    data, made = batch("mlp", 12), agent("bc", "mlp", batch_size=6)
    seen: list[torch.Tensor] = []

    def update(batch: Batch, generator: torch.Generator) -> Metrics:
        seen.append(batch.reward)
        return {}

    made.update = update  # type: ignore[method-assign]  # a spy
    noise = generator(1)
    for _ in range(20):
        learn_once(made, data, noise)
    assert set(torch.cat(seen).tolist()) == set(data.reward.tolist())
    assert not torch.equal(seen[0], seen[1])
    learn_once(made, data, generator(1))
    assert torch.equal(seen[-1], seen[0])
