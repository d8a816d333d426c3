"""Perceptrons against the same sums in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.func import functional_call

from tests.agents.problems import disturb, noise, observation
from uavrl.networks.activations import ActivationName
from uavrl.networks.mlp import (
    LOG_STD_RANGE,
    Layers,
    MlpActor,
    MlpChoiceActor,
    MlpConditional,
    MlpCritic,
    MlpDenoiser,
    Normaliser,
    step_embedding,
)

ROWS, K = 5, 4
Array = NDArray[np.float64]
SHAPE: dict[str, Any] = {"width": 7, "depth": 2, "activation": "silu", "layer_norm": False}


def seen() -> Tensor:
    found = observation("mlp", ROWS, 0, K)
    assert isinstance(found, Tensor)
    return found


def weights(module: torch.nn.Module) -> dict[str, Array]:
    return {name: value.double().numpy() for name, value in module.state_dict().items()}


def silu(x: Array) -> Array:
    return x / (1.0 + np.exp(-x))


def normalised(s: Array, log: bool) -> Array:
    raw = np.concatenate([s, np.sign(s) * np.log1p(np.abs(s))], axis=1) if log else s
    return np.asarray((raw - raw.mean(axis=0)) / (raw.std(axis=0) + 1e-6))


@pytest.mark.parametrize("log", [False, True])
def test_normaliser_is_the_papers_equation(log: bool) -> None:
    made = Normaliser(K + 3, log)
    s = seen()
    s[:, 0] -= 700.0  # both signs
    made.fit(s)
    np.testing.assert_allclose(made(s).numpy(), normalised(s.double().numpy(), log), rtol=2e-4, atol=2e-5)
    assert made.size == (2 * (K + 3) if log else K + 3)


def test_a_normaliser_is_saved_with_the_weights_and_trained_by_nothing() -> None:
    made = Normaliser(3, log=True)
    assert not list(made.parameters())
    made.fit(noise(0, 50, 3))
    other = Normaliser(3, log=True)
    other.load_state_dict(made.state_dict())
    assert torch.equal(other(noise(1, 4, 3)), made(noise(1, 4, 3)))


@pytest.mark.parametrize("heads", [False, True])
@pytest.mark.parametrize("log", [False, True])
def test_critic_is_the_sum_that_its_weights_say(heads: bool, log: bool) -> None:
    made = MlpCritic(K + 3, 2, K + 1, heads=heads, log=log, **SHAPE)
    disturb(made, 0)
    s, w = seen(), noise(1, ROWS, 2)
    made.normaliser.fit(s)
    table = made.all_choices(made.encode(s), w).detach().double().numpy()
    value, x = weights(made), normalised(s.double().numpy(), log)
    for j, name in enumerate(("first", "second")):
        before = x @ value[f"{name}.observation.weight"].T + value[f"{name}.observation.bias"]
        before = before + w.double().numpy() @ value[f"{name}.continuous.weight"].T
        for choice in range(K + 1):
            here = before if heads else before + value[f"{name}.choice.weight"][:, choice]
            hidden = silu(silu(here) @ value[f"{name}.rest.hidden.0.weight"].T + value[f"{name}.rest.hidden.0.bias"])
            q = (hidden @ value[f"{name}.rest.out.weight"].T + value[f"{name}.rest.out.bias"])[
                :, choice if heads else 0
            ]
            np.testing.assert_allclose(table[j, :, choice], q, rtol=1e-3, atol=1e-4)
            one_hot = torch.zeros(ROWS, K + 1)
            one_hot[:, choice] = 1.0
            alone = made.value(made.encode(s), w, one_hot)[j].detach()
            np.testing.assert_allclose(alone.numpy(), q, rtol=1e-3, atol=1e-4)
    before_shift = made.all_choices(made.encode(s), w)
    made.shift(2.0)
    torch.testing.assert_close(made.all_choices(made.encode(s), w), before_shift + 2.0, rtol=1e-4, atol=1e-4)


def test_denoiser_is_the_sum_that_its_weights_say() -> None:
    made = MlpDenoiser(K + 3, K + 3, log=False, **SHAPE)
    disturb(made, 0)
    s, x, step = seen(), noise(1, ROWS, K + 3), torch.tensor([1, 2, 3, 4, 5])
    made.normaliser.fit(s)
    value = weights(made)
    angle = step.numpy()[:, None] * 1e4 ** (-np.arange(8) / 7)
    embedded = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    first = normalised(s.double().numpy(), False) @ value["observation.weight"].T + value["observation.bias"]
    first = first + x.double().numpy() @ value["action.weight"].T + embedded @ value["step.weight"].T
    hidden = silu(silu(first) @ value["rest.hidden.0.weight"].T + value["rest.hidden.0.bias"])
    expected = hidden @ value["rest.out.weight"].T + value["rest.out.bias"]
    found = made(made.encode(s), x, step).detach().numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
    assert made.vector_size(made.encode(s)) == K + 3
    np.testing.assert_allclose(step_embedding(step, 16).numpy(), embedded, rtol=1e-4, atol=1e-5)


def test_actors_deviation_is_bounded_and_its_parts_are_apart() -> None:
    made = MlpActor(K + 3, 2, K + 1, log=False, **SHAPE)
    with torch.no_grad():
        made.rest.out.weight.zero_()
        made.rest.out.bias.copy_(torch.tensor([0.1, 0.2, -1e3, 1e3, 1.0, 2.0, 3.0, 4.0, 5.0]))
    mean, log_std, logits = made(seen())
    torch.testing.assert_close(mean[0], torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(log_std[0], torch.tensor(LOG_STD_RANGE))
    torch.testing.assert_close(logits[0], torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0]))


def test_choice_actor_has_a_mean_and_a_deviation_of_each_choice() -> None:
    made = MlpChoiceActor(K + 3, 2, 3, log=False, **SHAPE)
    raw = torch.tensor([[1.0, 0.1, 0.2, -1e3, 1e3], [2.0, 0.3, 40.0, 0.0, 0.0], [3.0, -0.5, -40.0, 1e3, -1e3]])
    with torch.no_grad():
        made.rest.out.weight.zero_()
        made.rest.out.bias.copy_(raw.flatten())
    mean, log_std, logits = made(seen())
    low, high = LOG_STD_RANGE
    middle = (low + high) / 2
    torch.testing.assert_close(logits[0], torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(mean[0], torch.tensor([[0.1, 0.2], [0.3, 40.0], [-0.5, -40.0]]).tanh())
    torch.testing.assert_close(log_std[0], torch.tensor([[low, high], [middle, middle], [high, low]]))
    classifier = MlpChoiceActor(K + 3, 0, 3, log=False, **SHAPE)(seen())
    assert (classifier.mean.shape, classifier.logits.shape) == ((ROWS, 3, 0), (ROWS, 3))


@pytest.mark.parametrize("inputs", [0, 2])
@pytest.mark.parametrize("choices", [0, 3])
def test_conditional_is_the_sum_that_its_weights_say(inputs: int, choices: int) -> None:
    made = MlpConditional(K + 3, inputs, choices, 4, log=False, **SHAPE)
    disturb(made, 0)
    s, x = seen(), noise(1, ROWS, 2) if inputs else None
    d = torch.eye(3)[torch.tensor([0, 2, 1, 0, 2])] if choices else None
    made.normaliser.fit(s)
    value = weights(made)
    first = normalised(s.double().numpy(), False) @ value["observation.weight"].T + value["observation.bias"]
    if x is not None:
        first = first + x.double().numpy() @ value["inputs.weight"].T
    if d is not None:
        first = first + d.double().numpy() @ value["choice.weight"].T
    hidden = silu(silu(first) @ value["rest.hidden.0.weight"].T + value["rest.hidden.0.bias"])
    expected = hidden @ value["rest.out.weight"].T + value["rest.out.bias"]
    np.testing.assert_allclose(made(made.encode(s), x, d).detach().numpy(), expected, rtol=1e-3, atol=1e-4)


def test_layer_norm_makes_the_critic_bounded_in_its_inputs() -> None:
    plain, normed = (
        MlpCritic(K + 3, 2, K + 1, heads=True, log=False, **{**SHAPE, "layer_norm": norm}) for norm in (False, True)
    )
    far = torch.full((1, K + 3), 1e7)
    assert plain.all_choices(plain.encode(far), torch.zeros(1, 2)).abs().max() > 1e4
    assert normed.all_choices(normed.encode(far), torch.zeros(1, 2)).abs().max() < 1e2


def test_a_set_of_devices_is_refused() -> None:
    made = MlpActor(K + 3, 2, K + 1, log=False, **SHAPE)
    with pytest.raises(TypeError, match="paper"):
        made({"uav": torch.zeros(1, 4), "devices": torch.zeros(1, K, 6)})


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("activation", ["silu", "mish", "relu"])
def test_layers_have_the_gradient_of_what_they_compute(activation: ActivationName, layer_norm: bool) -> None:
    torch.manual_seed(0)
    made = Layers(5, 3, 4, activation, layer_norm).double()
    first = torch.randn(6, 5, dtype=torch.float64, requires_grad=True)
    names, parameters = zip(*made.named_parameters(), strict=True)

    def run(first: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = functional_call(made, dict(zip(names, values, strict=True)), (first,))
        return out

    assert torch.autograd.gradcheck(run, (first, *parameters))


def test_stacked_layers_are_layers_under_vmap() -> None:
    torch.manual_seed(0)
    several = [Layers(5, 3, 4, "mish", layer_norm=False) for _ in range(3)]
    first, shared = torch.randn(3, 6, 5, requires_grad=True), torch.randn(6, 5)
    weights = {
        name: torch.stack([dict(one.named_parameters())[name].detach() for one in several]).requires_grad_()
        for name, _ in several[0].named_parameters()
    }

    def run(values: dict[str, torch.Tensor], first: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = functional_call(several[0], values, (first,))
        return out

    for inputs, dims in ((first, 0), (shared, None), (first.detach().movedim(0, 1).contiguous(), 1)):
        out = torch.vmap(run, in_dims=(0, dims))(weights, inputs)
        out.square().sum().backward()
        for row, one in enumerate(several):
            alone = one(inputs if dims is None else inputs.select(dims, row))
            torch.testing.assert_close(out[row], alone)
            for name, gradient in zip(
                weights, torch.autograd.grad(alone.square().sum(), list(one.parameters())), strict=True
            ):
                found = weights[name].grad
                assert found is not None
                torch.testing.assert_close(found[row], gradient)
        for value in weights.values():
            value.grad = None
    out = torch.vmap(run)(weights, first)
    (through,) = torch.autograd.grad(out.square().sum(), first)
    assert through.shape == first.shape
    assert through.abs().sum() > 0


def test_layers_are_linear_layers_with_activations_between() -> None:
    torch.manual_seed(0)
    made, first = Layers(5, 2, 4, "mish", layer_norm=True), torch.randn(6, 5)
    assert made.norms is not None
    mish = torch.nn.functional.mish
    hidden = made.hidden[0](mish(made.norms[0](first)))
    torch.testing.assert_close(made(first), made.out(mish(made.norms[1](hidden))))


def test_frozen_layers_still_lead_a_gradient_through() -> None:
    made, first = Layers(5, 2, 4, "silu", layer_norm=False), torch.randn(6, 5, requires_grad=True)
    (free,) = torch.autograd.grad(made(first).sum(), first)
    made.requires_grad_(False)
    loss = made(first).sum()
    made.requires_grad_(True)
    (through,) = torch.autograd.grad(loss, first, retain_graph=True)
    torch.testing.assert_close(through, free)
    assert all(found is None for found in torch.autograd.grad(loss, list(made.parameters()), allow_unused=True))
