from __future__ import annotations

from functools import partial

import pytest
import torch

from tests.agents.problems import KINDS, Kind, network, observation, spaces
from uavrl.errors import ConfigError
from uavrl.networks import (
    Spaces,
    fit_normalisers,
    make_actor,
    make_choice_actor,
    make_classifier,
    make_conditional,
    make_critic,
    make_denoiser,
)

MAKERS = [
    make_actor,
    make_choice_actor,
    make_classifier,
    partial(make_conditional, outputs=1),
    make_critic,
    make_denoiser,
]


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_network_for_the_other_observation_is_refused(maker: object, kind: Kind) -> None:
    other: Kind = "mlp" if kind == "devices" else "devices"
    with pytest.raises(ConfigError, match=f"network.kind = '{kind}'.*allowed here: '{other}'"):
        maker(spaces(other), network(kind))  # type: ignore[operator]  # one of MAKERS


@pytest.mark.parametrize("maker", MAKERS)
def test_a_set_of_devices_leaves_at_least_one_choice_beside_idling(maker: object) -> None:
    alone = Spaces(observation=None, continuous=2, choices=1)
    with pytest.raises(ConfigError, match="choices = 1, allowed for a set of devices"):
        maker(alone, network("devices"))  # type: ignore[operator]  # one of MAKERS


def test_fit_reaches_every_normaliser_and_leaves_sets_alone() -> None:
    seen = observation("mlp", 40)
    both = torch.nn.ModuleDict({name: make_critic(spaces("mlp"), network("mlp")) for name in ("critic", "target")})
    fit_normalisers(both, seen)
    means = [value for name, value in both.state_dict().items() if name.endswith("normaliser.mean")]
    assert len(means) == 2
    assert isinstance(seen, torch.Tensor)
    for mean in means:
        torch.testing.assert_close(mean[:7], seen.mean(dim=0))
    sets = torch.nn.ModuleDict({"critic": make_critic(spaces("devices"), network("devices"))})
    before = {name: value.clone() for name, value in sets.state_dict().items()}
    fit_normalisers(sets, observation("devices", 40))
    assert all(torch.equal(before[name], value) for name, value in sets.state_dict().items())


@pytest.mark.parametrize("kind", KINDS)
def test_layer_normalisation_is_asked_for_in_the_critic_alone(kind: Kind) -> None:
    def norms(layer_norm: bool) -> list[int]:
        made = [maker(spaces(kind), network(kind, layer_norm=layer_norm)) for maker in (make_critic, make_denoiser)]
        return [sum(isinstance(module, torch.nn.LayerNorm) for module in one.modules()) for one in made]

    assert norms(False) == [0, 0]
    critic, denoiser = norms(True)
    assert critic > 0
    assert denoiser == 0
