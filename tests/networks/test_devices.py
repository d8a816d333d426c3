"""Networks over the set of devices: order, number and padding of devices."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.agents.problems import disturb, noise, observation
from uavrl.networks import repeat
from uavrl.networks.devices import NEVER, SetActor, SetChoiceActor, SetConditional, SetCritic, SetDenoiser, features

ROWS, K = 6, 5
Devices = dict[str, Tensor]
# of an observation, the displacement w (B, 2) and the devices' entries (B, K): idle and device outputs (B, 1 + K, .)
Network = Callable[[Devices, Tensor, Tensor], Tensor]


def seen(devices: int = K, seed: int = 0) -> Devices:
    found = observation("devices", ROWS, seed, devices)
    assert isinstance(found, dict)
    return found


def critic(layer_norm: bool = False) -> Network:
    made = SetCritic(2, width=16, scale_m=500.0, reach_m=25.0, layer_norm=layer_norm)
    disturb(made, 0)
    return lambda s, w, _: made.all_choices(made.encode(s), w).permute(1, 2, 0)


def denoiser() -> Network:
    made = SetDenoiser(2, width=16, scale_m=500.0)
    disturb(made, 1)

    def run(s: Devices, w: Tensor, own: Tensor) -> Tensor:
        context = made.encode(s)
        assert made.vector_size(context) == 3 + own.shape[1]
        idle = torch.full((ROWS, 1), 0.3)
        predicted: Tensor = made(context, torch.cat([w, idle, own], dim=1), torch.full((ROWS,), 3))
        whole = predicted[:, None, :2].expand(-1, 1 + own.shape[1], -1)  # the displacement's, beside each entry's own
        return torch.cat([predicted[:, 2:, None], whole], dim=2)

    return run


def actor() -> Network:
    made = SetActor(2, width=16, scale_m=500.0)
    disturb(made, 2)

    def run(s: Devices, w: Tensor, own: Tensor) -> Tensor:
        mean, log_std, logits = made(s)
        whole = torch.cat([mean, log_std], dim=1)[:, None].expand(-1, 1 + own.shape[1], -1)
        return torch.cat([logits[:, :, None], whole], dim=2)

    return run


def choice_actor() -> Network:
    made = SetChoiceActor(2, width=16, scale_m=500.0)
    disturb(made, 3)

    def run(s: Devices, w: Tensor, own: Tensor) -> Tensor:
        mean, log_std, logits = made(s)
        return torch.cat([logits[:, :, None], mean, log_std], dim=2)

    return run


def conditional() -> Network:
    """Of every choice in turn."""
    made = SetConditional(2, 3, choice=True, width=16, scale_m=500.0)
    disturb(made, 4)

    def run(s: Devices, w: Tensor, own: Tensor) -> Tensor:
        context, every = made.encode(s), torch.eye(1 + own.shape[1])
        return torch.stack([made(context, w, one.expand(ROWS, -1)) for one in every], dim=1)

    return run


def unconditional() -> SetConditional:
    made = SetConditional(2, 3, choice=False, width=16, scale_m=500.0)
    disturb(made, 5)
    return made


NETWORKS = {
    "critic": critic,
    "normalised critic": lambda: critic(layer_norm=True),
    "denoiser": denoiser,
    "actor": actor,
    "choice actor": choice_actor,
    "conditional": conditional,
}


@pytest.fixture(params=NETWORKS)
def network(request: pytest.FixtureRequest) -> Network:
    return NETWORKS[request.param]()


def run(network: Network, s: Devices, w: Tensor, own: Tensor) -> Tensor:
    with torch.no_grad():
        return network(s, w, own)


def twins_of(s: Devices) -> Devices:
    """Each device and its twin, with ages of a round that takes twice as long."""
    older = s["devices"] * torch.tensor([1.0, 1.0, 2.0, 1.0, 1.0, 1.0])
    return {"uav": s["uav"], "devices": torch.cat([older, older], dim=1)}


def test_reordered_devices_reorder_the_outputs_and_change_nothing_else(network: Network) -> None:
    s, w, own = seen(), noise(1, ROWS, 2), noise(2, ROWS, K)
    order = torch.tensor([3, 0, 4, 1, 2])
    straight = run(network, s, w, own)
    shuffled = run(network, {"uav": s["uav"], "devices": s["devices"][:, order]}, w, own[:, order])
    torch.testing.assert_close(shuffled, straight[:, [0, *(order + 1).tolist()]], rtol=1e-4, atol=1e-5)
    # a network that looked at nothing would pass
    assert straight[:, 1:, 0].std(dim=1).min() > 1e-3


@pytest.mark.parametrize("other", [1, 3, 12])
def test_the_same_weights_take_another_number_of_devices(network: Network, other: int) -> None:
    found = run(network, seen(other), noise(1, ROWS, 2), noise(2, ROWS, other))
    assert found.shape[:2] == (ROWS, other + 1)
    assert found.isfinite().all()


@pytest.mark.parametrize("make", [critic, denoiser, actor, choice_actor])
def test_a_twin_of_each_device_changes_no_pooled_mean(make: Callable[[], Network]) -> None:
    """Every device twice, as old as a round is long: means over the set stay, so each output stays.

    A sum, a count, or ages that are not by the number of devices would change them.
    """
    s, w, own = seen(), noise(1, ROWS, 2), noise(2, ROWS, K)
    twice = twins_of(s)
    network = make()
    once, found = run(network, s, w, own), run(network, twice, w, torch.cat([own, own], dim=1))
    torch.testing.assert_close(found[:, : K + 1], once, rtol=1e-4, atol=1e-5)


def test_padding_changes_nothing_whatever_it_holds(network: Network) -> None:
    s, w, own = seen(), noise(1, ROWS, 2), noise(2, ROWS, K)
    straight = run(network, s, w, own)
    for fill in (0.0, 900.0):
        padding = torch.full((ROWS, 3, 6), fill)
        padding[:, :, 5] = 0.0
        padded = {"uav": s["uav"], "devices": torch.cat([s["devices"], padding], dim=1)}
        found = run(network, padded, w, torch.cat([own, 5 * noise(3, ROWS, 3)], dim=1))
        torch.testing.assert_close(found[:, : K + 1], straight, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("make", [critic, actor, choice_actor])
def test_a_padded_device_is_never_worth_choosing(make: Callable[[], Network]) -> None:
    s = seen()
    s["devices"][:, 2, 5] = 0.0
    assert (run(make(), s, noise(1, ROWS, 2), noise(2, ROWS, K))[:, 3, 0] == NEVER).all()


def test_a_function_without_a_choice_is_one_of_the_set() -> None:
    """Order, twins and padding of the devices change nothing; its further inputs do."""
    made, s, w = unconditional(), seen(), noise(1, ROWS, 2)
    with torch.no_grad():
        straight = made(made.encode(s), w)
        assert straight.shape == (ROWS, 3)
        assert straight.std(dim=0).min() > 1e-3
        padding = torch.full((ROWS, 2, 6), 900.0)
        padding[:, :, 5] = 0.0
        for other in (
            s["devices"][:, [3, 0, 4, 1, 2]],
            twins_of(s)["devices"],
            torch.cat([s["devices"], padding], 1),
        ):
            found = made(made.encode({"uav": s["uav"], "devices": other}), w)
            torch.testing.assert_close(found, straight, rtol=1e-4, atol=1e-5)
        assert not torch.allclose(made(made.encode(s), -w), straight, atol=1e-3)


def test_value_is_the_entry_of_all_choices() -> None:
    made = SetCritic(2, width=16, scale_m=500.0, reach_m=25.0)
    context, w = made.encode(seen()), noise(1, ROWS, 2)
    table = made.all_choices(context, w)
    assert table.shape == (2, ROWS, K + 1)
    for choice in range(K + 1):
        one_hot = torch.zeros(ROWS, K + 1)
        one_hot[:, choice] = 1.0
        torch.testing.assert_close(made.value(context, w, one_hot), table[:, :, choice])


def test_layer_normalisation_bounds_q_however_far_the_observation_is() -> None:
    """Ball et al. (2023), "Efficient online RL with offline data": what makes it worth having in a critic."""
    near, w = seen(), torch.zeros(ROWS, 2)
    far = near | {"devices": near["devices"] * torch.tensor([1e4, 1e4, 1.0, 1.0, 1.0, 1.0])}

    def moved(layer_norm: bool) -> float:
        network = critic(layer_norm)
        return float((run(network, far, w, w) - run(network, near, w, w)).abs().max())

    assert moved(layer_norm=False) > 100.0
    assert moved(layer_norm=True) < 20.0


def test_every_normalisation_of_a_critic_is_in_use() -> None:
    made = SetCritic(2, width=16, scale_m=500.0, reach_m=25.0, layer_norm=True)
    disturb(made, 0)
    weights = [module.weight for module in made.modules() if isinstance(module, torch.nn.LayerNorm)]
    assert len(weights) == 2 * 4
    found = torch.autograd.grad(made.all_choices(made.encode(seen()), torch.zeros(ROWS, 2)).sum(), weights)
    assert all(slope.norm() > 1e-6 for slope in found)


def test_the_two_q_functions_differ_and_a_shift_moves_every_value_of_both() -> None:
    made = SetCritic(2, width=16, scale_m=500.0, reach_m=25.0)
    context, w = made.encode(seen()), noise(1, ROWS, 2)
    before = made.all_choices(context, w)
    assert (before[0] - before[1]).abs().min() > 1e-4
    made.shift(-3.5)
    torch.testing.assert_close(made.all_choices(context, w), before - 3.5)


def test_repeat_pairs_a_rows_encoding_with_its_own_actions() -> None:
    made = SetCritic(2, width=16, scale_m=500.0, reach_m=25.0)
    s, w = seen(), noise(1, ROWS * 3, 2)
    found = made.all_choices(repeat(made.encode(s), 3), w)
    for row in range(ROWS):
        alone = {key: value[row : row + 1].repeat_interleave(3, dim=0) for key, value in s.items()}
        expected = made.all_choices(made.encode(alone), w[3 * row : 3 * row + 3])
        torch.testing.assert_close(found[:, 3 * row : 3 * row + 3], expected, rtol=1e-4, atol=1e-5)


def test_the_critic_sees_the_link_after_the_move_which_a_disc_limits() -> None:
    """A corner of the box flies no further than its direction on the circle, so the devices' outputs are equal there
    up to the raw w, which is taken out of this network.
    """
    made = SetCritic(2, width=16, scale_m=500.0, reach_m=200.0)
    for q in (made.first, made.second):
        assert q.trunk.global_extra is not None
        torch.nn.init.zeros_(q.trunk.global_extra.weight)
    context = made.encode(seen())
    corner = torch.ones(ROWS, 2)
    torch.testing.assert_close(made.all_choices(context, corner), made.all_choices(context, corner / 2**0.5))
    assert not torch.allclose(made.all_choices(context, corner), made.all_choices(context, 0.5 * corner))
    w = torch.zeros(ROWS, 2, requires_grad=True)  # the length of a zero vector has no slope, its network must
    (slope,) = torch.autograd.grad(made.all_choices(context, w).sum(), w)
    assert slope.isfinite().all()


def test_features_against_numbers_worked_out_by_hand() -> None:
    uav = torch.tensor([[250.0, 1000.0, torch.e - 1, 0.7]])
    devices = torch.tensor(
        [
            [
                [300.0, 400.0, (torch.e**2 - 1) / 5, 1.5, 2.0, 1.0],  # 2 valid devices: ages count 10 / 2 times
                [0.0, -500.0, 0.0, 0.5, 4.0, 1.0],
                [9.0, 9.0, 99.0, 9.0, 9.0, 0.0],
            ]
        ]
    )
    tokens, globals_, valid, offset = features({"uav": uav, "devices": devices}, 500.0)
    torch.testing.assert_close(
        tokens[0, 0], torch.tensor([0.6, 0.8, 1.0, 2.0, (torch.e**2 - 1) / 5, 1.0, 1.5, 1.0, 1.0]), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(
        tokens[0, 1], torch.tensor([0.0, -1.0, 1.0, 0.0, 0.0, 0.0, 0.5, 2.0, 1.0]), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(
        globals_[0], torch.tensor([-0.5, 1.0, 1.0, 0.7, 2.0, 1.0, (torch.e**2 - 1) / 10]), rtol=0, atol=1e-3
    )
    assert valid.tolist() == [[1.0, 1.0, 0.0]]
    assert torch.equal(offset, devices[..., :2])


def test_the_denoiser_knows_its_step() -> None:
    made = SetDenoiser(2, width=16, scale_m=500.0)
    context, vector = made.encode(seen()), noise(1, ROWS, 3 + K)
    found = [made(context, vector, torch.full((ROWS,), step)) for step in (1, 2, 5)]
    assert not torch.allclose(found[0], found[1], atol=1e-4)
    assert not torch.allclose(found[1], found[2], atol=1e-4)


def test_from_the_zero_vector_a_denoiser_predicts_the_same_without_its_part() -> None:
    made = SetDenoiser(2, width=16, scale_m=500.0)
    disturb(made, 1)
    context, step = made.encode(seen()), made.steps(torch.tensor([4]))
    torch.testing.assert_close(made.predict(context, None, step), made.predict(context, torch.zeros(ROWS, 3 + K), step))


def test_a_flat_observation_is_refused() -> None:
    with pytest.raises(TypeError, match="devices"):
        SetActor(2, width=8, scale_m=500.0)(torch.zeros(2, 5))
