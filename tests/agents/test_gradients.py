"""Each loss reaches what it should train, through both blocks of the action, and nothing else."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tests.agents.problems import DEVICES, KINDS, Kind, agent, batch, copies, diffusion_sac, disturb, equal, noise
from uavrl.agents import diffusion_sac as module
from uavrl.agents.base import minimise
from uavrl.agents.bc import BehaviourCloning
from uavrl.agents.diffusion_actor import ChainNoise
from uavrl.agents.diffusion_sac import DiffusionSac
from uavrl.agents.sac import Sac
from uavrl.diffusion import straight_through_clamp
from uavrl.networks import Denoiser
from uavrl.networks.devices import SetDenoiser
from uavrl.networks.mlp import MlpDenoiser

GUIDANCES = [
    ("mlp", "expectation"),
    ("mlp", "straight_through"),
    ("mlp", "softmax"),
    ("devices", "expectation"),
    ("devices", "straight_through"),
]
GRADIENTS = ["full_chain", "last_k", "one_step"]
ROWS = 16


def make(kind: Kind, **changes: Any) -> DiffusionSac:
    """With Q as it is: a gradient is then known, and its size that of Q's own slope."""
    heads = changes.get("guidance") != "softmax"
    made = diffusion_sac(kind, network={"choice_heads": heads}, **{"gradient_steps": 2, "q_scale": "none", **changes})
    disturb(made.critic, 7)
    return made


def without_kinks(made: DiffusionSac) -> DiffusionSac:
    """Both Q functions equal: their minimum is then as smooth as they are, as finite differences need."""
    made.critic.second.load_state_dict(made.critic.first.state_dict())  # type: ignore[union-attr]  # modules
    return made


def actor_loss(made: DiffusionSac, seed: int = 0) -> Tensor:
    config = made.config
    size = 2 + made.spaces.choices
    chain = None
    if config.gradient != "one_step" and config.bc_weight < 1:
        chain = ChainNoise.draw(ROWS, size, config.diffusion.steps, torch.Generator().manual_seed(seed + 1))
    generator = torch.Generator().manual_seed(seed + 2)
    step = torch.randint(1, config.diffusion.steps + 1, (ROWS,), generator=generator)
    data = batch("mlp" if config.network.kind == "mlp" else "devices", ROWS)
    return made.actor_loss(data, step, noise(seed + 3, ROWS, size), chain)[0]


def gradients(loss: Tensor, network: nn.Module) -> dict[str, Tensor | None]:
    names, parameters = zip(*network.named_parameters(), strict=True)
    return dict(zip(names, torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True), strict=True))


def blocks(denoiser: Denoiser, gradient: dict[str, Tensor | None]) -> tuple[Tensor, Tensor]:
    """Gradient of the output rows of the displacement, and of the choice; both weights and biases."""

    def rows(name: str) -> Tensor:
        weight, bias = gradient[f"{name}.weight"], gradient[f"{name}.bias"]
        assert weight is not None
        assert bias is not None
        return torch.cat([weight, bias[:, None]], dim=1)

    if isinstance(denoiser, MlpDenoiser):
        return rows("rest.out")[:2], rows("rest.out")[2:]
    assert isinstance(denoiser, SetDenoiser)
    return rows("global_out")[:2], torch.cat([rows("global_out")[2:], rows("device_out")])


def assert_sane(gradient: Tensor) -> None:
    """Every row moves, and no row is starved or explodes."""
    norms = gradient.norm(dim=1)
    assert ((norms > 1e-4) & (norms < 1e3)).all(), norms


@pytest.mark.parametrize("bc_weight", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize(("kind", "guidance"), GUIDANCES)
def test_actor_loss_trains_the_whole_denoiser_by_both_blocks(
    kind: Kind, guidance: str, gradient: str, bc_weight: float
) -> None:
    made = make(kind, guidance=guidance, gradient=gradient, bc_weight=bc_weight)
    found = gradients(actor_loss(made), made.actor.denoiser)
    assert all(value is not None and value.isfinite().all() for value in found.values())
    for block in blocks(made.actor.denoiser, found):
        assert_sane(block)


@pytest.mark.parametrize("kind", KINDS)
def test_behaviour_cloning_trains_the_whole_denoiser_by_both_blocks(kind: Kind) -> None:
    made = agent("bc", kind)
    assert isinstance(made, BehaviourCloning)
    loss, _ = made.actor_loss(batch(kind, ROWS), torch.full((ROWS,), 2), noise(0, ROWS, 7))
    found = gradients(loss, made.actor.denoiser)
    assert all(value is not None for value in found.values())
    for block in blocks(made.actor.denoiser, found):
        assert_sane(block)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cql_weight", [0.0, 1.0])
def test_critic_loss_trains_both_critics_and_only_them(kind: Kind, cql_weight: float) -> None:
    made = make(kind, cql_weight=cql_weight)
    uniform = noise(4, ROWS * made.config.cql_samples, 2).clamp(-1, 1) if cql_weight else None
    chain = ChainNoise(noise(5, ROWS, 7), noise(6, 3, ROWS, 7))
    loss, _ = made.critic_loss(batch(kind, ROWS), chain, uniform)
    for name, value in gradients(loss, made.critic).items():
        assert value is not None, name
        # a constant added to Q, or to one layer before a softmax, may have no slope; a weight matrix has one
        if value.ndim == 2:
            assert 1e-6 < value.norm() < 1e4, name
    assert all(value is None for value in gradients(loss, made.actor.denoiser).values())
    frozen = [*made.target.parameters(), *made.actor.average.parameters()]
    assert not any(parameter.requires_grad for parameter in frozen)


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_moves_each_network_by_its_own_loss_alone(kind: Kind, gradient: str) -> None:
    """The learning rate of one network is 0: it stays bit for bit, whatever the other's loss does."""
    for still, moving in (("critic", "actor"), ("actor", "critic")):
        made = make(kind, gradient=gradient)
        for group in made.optimisers[still].param_groups:
            group["lr"] = 0.0
        held = {"critic": made.critic, "actor": made.actor.denoiser}
        before = {name: copies(network) for name, network in held.items()}
        made.update(batch(kind, ROWS), torch.Generator().manual_seed(0))
        assert equal(before[still], copies(held[still]))
        assert not equal(before[moving], copies(held[moving]))


def test_the_actors_step_leaves_no_trace_in_the_critics_step() -> None:
    """Guided or not, the critic moves equally; whatever the rewards, pure cloning moves the actor equally."""
    results = []
    for bc_weight in (0.0, 1.0):
        made = make("devices", bc_weight=bc_weight, gradient="full_chain")
        made.update(batch("devices", ROWS), torch.Generator().manual_seed(0))
        results.append(made)
    assert equal(copies(results[0].critic), copies(results[1].critic))
    assert not equal(copies(results[0].actor.denoiser), copies(results[1].actor.denoiser))
    actors = []
    for seed in (0, 1):
        made = make("devices", bc_weight=1.0)
        disturb(made.critic, seed)
        made.update(batch("devices", ROWS), torch.Generator().manual_seed(0))
        actors.append(copies(made.actor.denoiser))
    assert equal(*actors)


@pytest.mark.parametrize("kind", KINDS)
def test_targets_move_by_polyak_averaging_of_the_updated_networks(kind: Kind) -> None:
    made = make(kind, polyak=0.1, actor_average=0.8)
    disturb(made.actor.average, 3)
    target, average = copies(made.target), copies(made.actor.average)
    made.update(batch(kind, ROWS), torch.Generator().manual_seed(0))
    for before, rate, now, source in (
        (target, 0.1, made.target, made.critic),
        (average, 0.2, made.actor.average, made.actor.denoiser),
    ):
        updated = copies(source)
        for name, value in now.named_parameters():
            torch.testing.assert_close(value, (1 - rate) * before[name] + rate * updated[name])


def test_the_clones_average_moves_as_its_setting_says() -> None:
    made = agent("bc", "mlp", actor_average=0.8, learning_rate=0.01)
    assert isinstance(made, BehaviourCloning)
    before = copies(made.actor.average)
    made.update(batch("mlp", ROWS), torch.Generator().manual_seed(0))
    updated = copies(made.actor.denoiser)
    for name, value in made.actor.average.named_parameters():
        torch.testing.assert_close(value, 0.8 * before[name] + 0.2 * updated[name])


@pytest.mark.parametrize(("kind", "guidance"), [(k, g) for k, g in GUIDANCES if g != "softmax"])
@pytest.mark.parametrize("temperature", [0.25, 0.5, 1.0])
def test_slope_of_the_guidance_in_the_choice_entries_is_the_known_one(
    kind: Kind, guidance: str, temperature: float
) -> None:
    """dL/dz_d = -p_d (Q_d - sum p Q) / tau, over B rows."""
    made = make(kind, guidance=guidance, choice_temperature=temperature)
    data, vector = batch(kind, ROWS), noise(1, ROWS, 7).clamp(-1, 1).requires_grad_()
    (slope,) = torch.autograd.grad(made.guidance_loss(data.observation, vector)[0], vector)
    q = made.critic.all_choices(made.critic.encode(data.observation), vector[:, :2]).amin(dim=0).double()
    p = torch.softmax(vector[:, 2:].double() / temperature, dim=1)
    expected = -p * (q - (p * q).sum(dim=1, keepdim=True)) / temperature / ROWS
    torch.testing.assert_close(slope[:, 2:].double(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("kind", "guidance"), GUIDANCES)
def test_slope_of_the_guidance_in_the_displacement_is_that_of_q(kind: Kind, guidance: str) -> None:
    made = without_kinks(make(kind, guidance=guidance))
    data, vector = batch(kind, ROWS), noise(1, ROWS, 7).clamp(-0.9, 0.9).requires_grad_()
    (slope,) = torch.autograd.grad(made.guidance_loss(data.observation, vector)[0], vector)
    direction = torch.cat([noise(2, ROWS, 2), torch.zeros(ROWS, 5)], dim=1)
    with torch.no_grad():
        ahead = made.guidance_loss(data.observation, vector + 1e-2 * direction)[0]
        behind = made.guidance_loss(data.observation, vector - 1e-2 * direction)[0]
    assert float((slope * direction).sum()) == pytest.approx(float(ahead - behind) / 2e-2, rel=0.02, abs=1e-4)


def test_softmax_guidance_has_the_slope_of_the_critic_at_the_relaxed_choice() -> None:
    made = without_kinks(make("mlp", guidance="softmax"))
    data, vector = batch("mlp", ROWS), noise(1, ROWS, 7).clamp(-0.9, 0.9).requires_grad_()
    (slope,) = torch.autograd.grad(made.guidance_loss(data.observation, vector)[0], vector)
    direction = torch.cat([torch.zeros(ROWS, 2), noise(2, ROWS, 5)], dim=1)
    with torch.no_grad():
        ahead = made.guidance_loss(data.observation, vector + 1e-2 * direction)[0]
        behind = made.guidance_loss(data.observation, vector - 1e-2 * direction)[0]
    assert float((slope * direction).sum()) == pytest.approx(float(ahead - behind) / 2e-2, rel=0.02, abs=1e-4)


def test_a_displacement_outside_the_box_is_judged_at_its_edge_and_moved_only_inwards() -> None:
    made = make("mlp")
    data, vector = batch("mlp", ROWS), noise(1, ROWS, 7)
    vector[:, 0] = 1.7
    vector.requires_grad_()
    loss, _ = made.guidance_loss(data.observation, vector)
    edge = torch.cat([torch.ones(ROWS, 1), vector.detach()[:, 1:2].clamp(-1, 1), vector.detach()[:, 2:]], dim=1)
    edge.requires_grad_()
    loss_at_edge = made.guidance_loss(data.observation, edge)[0]
    torch.testing.assert_close(loss, loss_at_edge)
    (slope,), (slope_at_edge,) = torch.autograd.grad(loss, vector), torch.autograd.grad(loss_at_edge, edge)
    inwards = slope_at_edge[:, 0] > 0  # descent lowers w there
    assert inwards.any()
    torch.testing.assert_close(slope[:, 0], torch.where(inwards, slope_at_edge[:, 0], 0.0))


@pytest.mark.parametrize("gradient", ["full_chain", "one_step"])
@pytest.mark.parametrize("kind", KINDS)
def test_actor_gradient_is_that_of_finite_differences(
    kind: Kind, gradient: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along a random direction of all weights at once; without clamps, whose gradient is not their slope."""
    monkeypatch.setattr(module, "straight_through_clamp", lambda x: x)
    made = without_kinks(make(kind, gradient=gradient, bc_weight=0.3, diffusion={"clip_x0": False}))
    parameters = list(made.actor.denoiser.parameters())
    slope = torch.autograd.grad(actor_loss(made), parameters)
    directions = [noise(40 + i, *parameter.shape) for i, parameter in enumerate(parameters)]
    expected = sum(float((a * b).sum()) for a, b in zip(slope, directions, strict=True))

    def moved(by: float) -> float:
        with torch.no_grad():
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter.add_(by * direction)
            value = float(actor_loss(made).detach())
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter.sub_(by * direction)
        return value

    assert expected == pytest.approx((moved(1e-3) - moved(-1e-3)) / 2e-3, rel=0.05, abs=2e-3)


def test_last_k_is_the_full_chain_at_k_of_m_and_differs_below() -> None:
    found = {}
    for gradient, steps in (("full_chain", 1), ("last_k", 3), ("last_k", 1)):
        made = make("devices", gradient=gradient, gradient_steps=steps, bc_weight=0.0)
        loss = actor_loss(made)
        found[gradient, steps] = (loss, torch.autograd.grad(loss, list(made.actor.denoiser.parameters())))
    full, three, one = found.values()
    assert full[0] == three[0] == one[0]  # one chain, whatever the graph holds
    assert all(torch.equal(a, b) for a, b in zip(full[1], three[1], strict=True))
    assert not all(torch.allclose(a, b) for a, b in zip(full[1], one[1], strict=True))


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize(("kind", "guidance"), GUIDANCES)
def test_guided_steps_against_a_fixed_critic_raise_expected_q(kind: Kind, guidance: str, gradient: str) -> None:
    made = make(kind, guidance=guidance, gradient=gradient, bc_weight=0.0, learning_rate=3e-3)
    data = batch(kind, ROWS)

    def value() -> tuple[float, float]:
        """sum p Q of the chain's samples, and the Q of their argmax, over many noises."""
        with torch.no_grad():
            chain = ChainNoise.draw(ROWS, 7, 3, torch.Generator().manual_seed(99))
            vector = made.actor.sample(made.actor.denoiser, made.actor.denoiser.encode(data.observation), chain)
            q = made.critic.all_choices(made.critic.encode(data.observation), vector[:, :2].clamp(-1, 1)).amin(dim=0)
            p = functional.softmax(vector[:, 2:] / made.config.choice_temperature, dim=1)
            chosen = q.gather(1, vector[:, 2:].argmax(dim=1, keepdim=True))
            return float((p * q).sum(dim=1).mean()), float(chosen.mean())

    before = value()
    for seed in range(60):
        minimise(actor_loss(made, seed), made.actor.denoiser, made.optimisers["actor"], 10.0)
    after = value()
    with torch.no_grad():
        q = made.critic.all_choices(made.critic.encode(data.observation), torch.zeros(ROWS, 2)).amin(dim=0)
    spread = float(q.std(dim=1).mean())
    assert after[0] > before[0] + 0.2 * spread
    assert after[1] > before[1]


@pytest.mark.parametrize("gradient", ["one_step", "full_chain"])
def test_guidance_that_pulls_outwards_for_ever_does_not_ruin_the_predicted_noise(gradient: str) -> None:
    """Q rises towards a corner of the box: the prediction goes to its edge and little further.

    With an identity for the clamp's gradient the cloning error comes to several hundred here, from 1 at first.
    """
    made = make("mlp", gradient=gradient, q_scale="none", bc_weight=0.5, learning_rate=3e-3)
    data = batch("mlp", ROWS)

    def pull(observation: object, vector: Tensor, jitter: object = None) -> tuple[Tensor, dict[str, Tensor]]:
        w, z = straight_through_clamp(vector[:, :2]), functional.softmax(2 * vector[:, 2:], dim=1)
        return -(3 * w.sum(dim=1) + 3 * z[:, 1]).mean(), {}

    made.guidance_loss = pull  # type: ignore[method-assign]  # a critic with a constant slope
    generator, cloning = torch.Generator().manual_seed(0), []
    for _ in range(150):
        cloning.append(float(made.update(data, generator)["bc_loss"]))
    assert sum(cloning[-20:]) / 20 < 5.0


@pytest.mark.parametrize("kind", KINDS)
def test_what_has_no_weight_is_not_computed(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise AssertionError("computed")

    monkeypatch.setattr(module, "conservative_penalty", fail)
    made = make(kind, cql_weight=0.0, bc_weight=1.0)
    monkeypatch.setattr(made, "guidance_loss", fail)
    metrics = made.update(batch(kind, ROWS), torch.Generator().manual_seed(0))
    assert not {"cql_penalty", "guided_q"} & set(metrics)
    made = make(kind, bc_weight=0.0, gradient="full_chain")
    metrics = made.update(batch(kind, ROWS), torch.Generator().manual_seed(0))
    assert "bc_loss" not in metrics
    with pytest.raises(AssertionError, match="computed"):
        make(kind, cql_weight=0.1).update(batch(kind, ROWS), torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("q_scale", "factor", "shift"), [("absolute", 100, 0), ("spread", 100, 0), ("spread", 1, 50)])
def test_scaled_guidance_pulls_equally_whatever_the_scale_of_q(q_scale: str, factor: float, shift: float) -> None:
    slopes = []
    for change in (False, True):
        made = make("mlp", q_scale=q_scale, bc_weight=0.0)
        if change:
            with torch.no_grad():
                for name, value in made.critic.named_parameters():
                    if ".out." in name:
                        value.mul_(factor)
            made.critic.shift(shift)
        slopes.append(
            torch.cat(
                [g.flatten() for g in torch.autograd.grad(actor_loss(made), list(made.actor.denoiser.parameters()))]
            )
        )
    torch.testing.assert_close(*slopes, rtol=0.01, atol=1e-3 * float(slopes[0].abs().max()))
    unscaled = make("mlp", q_scale="none", bc_weight=0.0)
    raw = torch.cat(
        [g.flatten() for g in torch.autograd.grad(actor_loss(unscaled), list(unscaled.actor.denoiser.parameters()))]
    )
    assert not torch.allclose(raw, slopes[0], rtol=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_sac_losses_train_their_own_networks(kind: Kind) -> None:
    made = agent("sac", kind)
    assert isinstance(made, Sac)
    data = batch(kind, ROWS)
    critic = made.critic_loss(data, noise(1, ROWS, 2))[0]
    assert all(value is not None for value in gradients(critic, made.critic).values())
    assert all(value is None for value in gradients(critic, made.actor).values())
    assert torch.autograd.grad(critic, made.log_temperature, retain_graph=True, allow_unused=True)[0] is None
    actor, metrics = made.actor_loss(data, noise(2, ROWS, 2))
    found = gradients(actor, made.actor)
    assert all(value is not None for value in found.values())
    if kind == "mlp":
        rows = found["rest.out.weight"]
        assert rows is not None
        assert (rows.norm(dim=1) > 1e-6).all()  # means, deviations and logits
    assert torch.autograd.grad(actor, made.log_temperature, retain_graph=True, allow_unused=True)[0] is None
    assert not any(parameter.requires_grad for parameter in made.target.parameters())
    # a temperature rises while its entropy is too small, and falls while it is too large
    wanted = torch.tensor([made.config.continuous_entropy, made.config.choice_entropy * math.log(5)])
    for less, more in ((0, 1), (1, 0)):
        entropy = wanted.clone()
        entropy[less] -= 1
        entropy[more] += 1
        (slope,) = torch.autograd.grad(made.temperature_loss(entropy, 5), made.log_temperature)
        assert slope[less] < 0 < slope[more]
    assert metrics["entropy"].shape == (2,)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["diffusion_sac", "sac"])
def test_the_actors_loss_holds_no_graph_of_the_critics_weights(name: str, kind: Kind) -> None:
    """Their gradients would cost as much again as the actor's, and nobody reads them."""
    made = agent(name, kind)
    data = batch(kind, ROWS)
    if isinstance(made, DiffusionSac):
        loss, _ = made.guidance_loss(data.observation, noise(1, ROWS, DEVICES + 3).requires_grad_())
    else:
        assert isinstance(made, Sac)
        loss, _ = made.actor_loss(data, noise(1, ROWS, 2))
    assert loss.requires_grad
    assert all(value is None for value in gradients(loss, made.critic).values())
    assert all(parameter.requires_grad for parameter in made.critic.parameters())
