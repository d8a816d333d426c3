from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.agents.problems import KINDS, Kind, agent, noise, observation
from uavrl.agents.diffusion_actor import DiffusionConfig, Solver
from uavrl.agents.diffusion_sac import DiffusionSac
from uavrl.diffusion import ddim, dpm_solver_pp_2m, thinned

STEPS = 7


def teacher(kind: Kind) -> DiffusionSac:
    made = agent("diffusion_sac", kind, diffusion=DiffusionConfig(steps=STEPS))
    assert isinstance(made, DiffusionSac)
    return made


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["ddim", "dpm"])
def test_a_solver_asks_the_network_at_the_steps_that_it_was_trained_at(name: str, kind: Kind) -> None:
    made = teacher(kind)
    context, start = made.actor.average.encode(observation(kind, 5)), noise(1, 5, 7)
    schedule, kept = thinned("vp", STEPS, 3)
    assert kept == [2, 5, 7]

    def predict(x: Tensor, step: int) -> Tensor:
        predicted: Tensor = made.actor.average(context, x, torch.full((5,), kept[step - 1]))
        return predicted

    with torch.no_grad():
        expected = (
            ddim(predict, schedule, start, None, clip_x0=True)
            if name == "ddim"
            else dpm_solver_pp_2m(predict, schedule, start, clip_x0=True)
        )
        whole = made.actor.map(made.actor.average, context, start)
        made.actor.use(Solver(name, 3))  # type: ignore[arg-type]  # parametrised
        found = made.actor.map(made.actor.average, context, start)
    torch.testing.assert_close(found, expected)
    assert (found - whole).abs().max() > 1e-3


def test_ddim_over_all_steps_is_what_a_deterministic_decision_takes_anyway() -> None:
    made, seen = teacher("devices"), observation("devices", 50)
    expected = made.decide(seen, None)
    made.actor.use(Solver("ddim", STEPS))
    found = made.decide(seen, None)
    assert torch.equal(found.continuous, expected.continuous)
    assert torch.equal(found.choice, expected.choice)


def test_a_sample_by_a_solver_is_its_walk_from_a_random_start() -> None:
    made, seen = teacher("devices"), observation("devices", 50)
    assert made.noise_shape(5) == (STEPS + 1, 7)
    made.actor.use(Solver("dpm", 2))
    assert made.noise_shape(5) == (1, 7)
    still = made.decide(seen, None)
    found = made.decide(seen, torch.zeros(50, 1, 7))
    assert torch.equal(found.continuous, still.continuous)
    sample = made.act(seen, generator=torch.Generator().manual_seed(3))
    again = made.decide(seen, torch.randn((1, 50, 7), generator=torch.Generator().manual_seed(3)).transpose(0, 1))
    assert torch.equal(sample.continuous, again.continuous)
    assert (sample.continuous - still.continuous).abs().max() > 1e-3
    made.actor.use(None)
    assert made.noise_shape(5) == (STEPS + 1, 7)
