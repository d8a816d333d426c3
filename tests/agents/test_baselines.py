"""CQL, IQL, BCQ and Gaussian cloning: losses against sums in NumPy, what each loss trains, small problems."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, Normal, kl_divergence
from torch.nn import functional

from tests.agents.problems import DEVICES, KINDS, Kind, agent, batch, copies, disturb, equal, noise, observation
from tests.agents.test_known_values import GAMMA, chain_batch
from tests.agents.test_losses import Array, discount_of, q_of, row
from uavrl.actions import HybridAction
from uavrl.agents import cql as cql_module
from uavrl.agents import diffusion_sac as diffusion_sac_module
from uavrl.agents.base import Agent, Batch
from uavrl.agents.bcq import Bcq, BcqConfig, candidate_choices, soft_minimum
from uavrl.agents.cql import Cql, CqlConfig, PenaltyNoise, conservative_penalty, proposals
from uavrl.agents.gaussian_actor import gaussian_action, log_likelihood
from uavrl.agents.gaussian_bc import GaussianBehaviourCloning
from uavrl.agents.iql import Iql, IqlConfig, expectile_loss
from uavrl.agents.registry import make_agent
from uavrl.networks import ChoiceActor, NetworkConfig, Observation, Spaces, fit_normalisers
from uavrl.networks.interfaces import ActorOutput, ChoiceActorOutput

ROWS, D = 6, DEVICES + 1
BOTH = pytest.mark.parametrize("kind", KINDS)


def cql(kind: Kind, **changes: Any) -> Cql:
    made = agent("cql", kind, **changes)
    assert isinstance(made, Cql)
    for seed, network in enumerate((made.critic, made.target, made.actor)):
        disturb(network, seed)
    with torch.no_grad():
        made.log_temperature.copy_(torch.tensor([math.log(0.3), math.log(0.7)]))
    return made


def iql(kind: Kind, **changes: Any) -> Iql:
    made = agent("iql", kind, **changes)
    assert isinstance(made, Iql)
    for seed, network in enumerate((made.critic, made.target, made.actor, made.value)):
        disturb(network, seed)
    return made


def bcq(kind: Kind, **changes: Any) -> Bcq:
    made = agent("bcq", kind, **changes)
    assert isinstance(made, Bcq)
    networks = (made.critic, made.target, made.classifier, made.coder, made.actor, made.actor_target)
    for seed, network in enumerate(networks):
        disturb(network, seed)
    return made


def gaussian_bc(kind: Kind, **changes: Any) -> GaussianBehaviourCloning:
    made = agent("gaussian_bc", kind, **changes)
    assert isinstance(made, GaussianBehaviourCloning)
    return made


def penalty_noise(rows: int, samples: int) -> PenaltyNoise:
    uniform = 2 * torch.rand((rows, samples, 2), generator=torch.Generator().manual_seed(5)) - 1
    return PenaltyNoise(uniform, noise(6, rows, samples, 2), noise(7, rows, samples, 2))


# CQL


def squashed(output: ActorOutput, eps: Tensor) -> tuple[Array, float]:
    """w and log pi(w|s) of one row, by the change of variables w = tanh(u)."""
    mean, std = output.mean[0].double().numpy(), np.exp(output.log_std[0].double().numpy())
    u = mean + std * eps.double().numpy()
    density = np.exp(-0.5 * ((u - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi)) / (1 - np.tanh(u) ** 2)
    return np.tanh(u), float(np.log(density).sum())


@BOTH
@pytest.mark.parametrize(("samples", "temperature"), [(1, 1.0), (3, 1.0), (3, 0.5)])
def test_penalty_sums_all_choices_and_three_kinds_of_displacements(
    kind: Kind, samples: int, temperature: float
) -> None:
    """Each e^(Q/T) over the density that its displacement came from; all of them judged at s."""
    made = cql(kind)
    data, eps = batch(kind, ROWS), penalty_noise(ROWS, samples)
    with torch.no_grad():
        here, after = made.actor(data.observation), made.actor(data.next_observation)
        w, log_density = proposals(here, after, eps)
    expected, q_data = 0.0, np.zeros((2, ROWS))
    for i in range(ROWS):
        seen = row(data.observation, i)
        q_data[:, i] = q_of(made.critic, seen, data.action.continuous[i], int(data.action.choice[i]))
        total = np.zeros(2)
        for n in range(samples):
            drawn = [(eps.uniform[i, n].double().numpy(), math.log(1 / 4))]
            with torch.no_grad():
                drawn.append(squashed(made.actor(seen), eps.here[i, n]))
                drawn.append(squashed(made.actor(row(data.next_observation, i)), eps.after[i, n]))
            for displacement, log_p in drawn:
                for d in range(D):
                    q = q_of(made.critic, seen, torch.from_numpy(displacement).float(), d)
                    total += np.exp(q / temperature - log_p) / (3 * samples)
        expected += float((temperature * np.log(total) - q_data[:, i]).sum()) / ROWS
    context = made.critic.encode(data.observation)
    q_tensor = torch.from_numpy(q_data).float()
    found = conservative_penalty(made.critic, context, w, q_tensor, log_density, temperature)
    assert float(found.detach()) == pytest.approx(expected, rel=1e-3)


def test_each_kind_of_displacement_estimates_the_same_integral() -> None:
    """Importance weights: log sum_d int e^Q dw does not depend on what w is drawn from; a grid says what it is."""
    made, many = cql("mlp"), 20_000
    data = batch("mlp", 1)
    wide = ActorOutput(torch.tensor([[0.2, -0.3]]), torch.zeros(1, 2), torch.zeros(1, D))
    other = ActorOutput(torch.tensor([[-0.5, 0.1]]), torch.full((1, 2), 0.2), torch.zeros(1, D))
    w, log_density = proposals(wide, other, penalty_noise(1, many))
    context = made.critic.encode(data.observation)
    ticks = (torch.arange(100) + 0.5) / 50 - 1
    grid = torch.cartesian_prod(ticks, ticks)
    with torch.no_grad():
        exact = conservative_penalty(made.critic, context, grid, torch.zeros(2, 1))
        for part in (slice(0, many), slice(many, 2 * many), slice(2 * many, None)):
            found = conservative_penalty(made.critic, context, w[part], torch.zeros(2, 1), log_density[part])
            assert float(found) == pytest.approx(float(exact), abs=0.05)


@BOTH
@pytest.mark.parametrize(("soft", "weight"), [(False, 0.0), (True, 0.0), (True, 0.7)])
def test_critic_loss_of_cql(kind: Kind, soft: bool, weight: float) -> None:
    settings: dict[str, Any] = {"discount": 0.8, "discount_per": "second", "huber": None}
    made = cql(kind, cql_weight=weight, soft_backup=soft, **settings)
    data, eps, samples = batch(kind, ROWS), noise(8, ROWS, 2), penalty_noise(ROWS, 2)
    loss, metrics = made.critic_loss(data, eps, samples if weight else None)
    expected = 0.0
    for i in range(ROWS):
        following = row(data.next_observation, i)
        with torch.no_grad():
            output = made.actor(following)
        w, log_w = squashed(output, eps[i])
        p = np.exp(output.logits[0].double().numpy())
        p /= p.sum()
        q_next = np.array([q_of(made.target, following, torch.from_numpy(w).float(), d).min() for d in range(D)])
        value = float((p * (q_next - soft * 0.7 * np.log(p))).sum()) - soft * 0.3 * log_w
        target = float(data.reward[i]) + discount_of(data, i, "second", 0.8) * value
        q = q_of(made.critic, row(data.observation, i), data.action.continuous[i], int(data.action.choice[i]))
        expected += 0.5 * float(((q - target) ** 2).sum()) / ROWS
    assert float(metrics["bellman_loss"]) == pytest.approx(expected, rel=1e-3)
    assert ("cql_penalty" in metrics) == (weight > 0)
    penalty = float(metrics["cql_penalty"]) if weight else 0.0
    assert float(loss.detach()) == pytest.approx(expected + weight * penalty, rel=1e-3)


@pytest.mark.parametrize("name", ["cql", "diffusion_sac"])
def test_uniform_displacements_of_an_update_fill_the_box(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of [-1, 1] in each entry, as their density 2^-C says; and what CQL draws beside them is standard normal."""
    seen: list[Tensor] = []
    module = {"cql": cql_module, "diffusion_sac": diffusion_sac_module}[name]

    def watched(critic: Any, context: Any, w: Tensor, q_data: Tensor, *rest: Any) -> Tensor:
        seen.append(w)
        return conservative_penalty(critic, context, w, q_data, *rest)

    monkeypatch.setattr(module, "conservative_penalty", watched)
    agent(name, "mlp", cql_weight=1.0, cql_samples=20).update(batch("mlp", 200), torch.Generator().manual_seed(0))
    (w,) = seen
    w = w.view(200, -1, 2)[:, :20].reshape(-1, 2)
    assert w.abs().max() <= 1.0
    torch.testing.assert_close(w.mean(dim=0), torch.zeros(2), rtol=0, atol=0.03)
    torch.testing.assert_close(w.var(dim=0), torch.full((2,), 1 / 3), rtol=0, atol=0.02)
    drawn = PenaltyNoise.draw(200, 20, 2, torch.Generator().manual_seed(0))
    for normal in (drawn.here, drawn.after):
        assert float(normal.mean()) == pytest.approx(0.0, abs=0.05)
        assert float(normal.std()) == pytest.approx(1.0, abs=0.05)
    assert not torch.equal(drawn.here, drawn.after)


def test_a_penalised_critic_holds_what_is_not_in_the_data_under_what_is() -> None:
    """The choice 1 never occurs and equal rewards say nothing of it: without a penalty it is worth as much."""
    found = {}
    for weight in (0.0, 0.5):
        made = agent("cql", "mlp", cql_weight=weight, learning_rate=1e-2)
        assert isinstance(made, Cql)
        data = batch("mlp", 64)
        one = torch.ones(64)
        only = HybridAction(data.action.continuous, torch.zeros(64, dtype=torch.int64))
        same = Batch(data.observation, only, 0 * one, one, one, data.observation)
        generator = torch.Generator().manual_seed(0)
        for _ in range(100):
            made.update(same, generator)
        with torch.no_grad():
            q = made.critic.all_choices(made.critic.encode(data.observation), torch.zeros(64, 2)).mean(dim=(0, 1))
        found[weight] = float(q[0] - q[1:].max())
    assert found[0.5] > found[0.0] + 1.0


# The Gaussian of each choice, IQL


def a_policy(rows: int) -> ChoiceActorOutput:
    return ChoiceActorOutput(noise(1, rows, D, 2).tanh(), 0.5 * noise(2, rows, D, 2), noise(3, rows, D))


def test_likelihood_is_that_of_the_choice_and_of_its_own_gaussian() -> None:
    output, action = a_policy(40), batch("mlp", 40).action
    log_choice, log_w = log_likelihood(output, action)
    torch.testing.assert_close(log_choice, Categorical(logits=output.logits).log_prob(action.choice))
    for i in range(40):
        d = int(action.choice[i])
        normal = Normal(output.mean[i, d], output.log_std[i, d].exp())
        torch.testing.assert_close(log_w[i], normal.log_prob(action.continuous[i]).sum())
    edge = HybridAction(torch.ones(40, 2), action.choice)
    assert log_likelihood(output, edge)[1].isfinite().all()


class Given(ChoiceActor):
    """Always the same policy."""

    def __init__(self, output: ChoiceActorOutput) -> None:
        super().__init__()
        self.output = output

    def forward(self, observation: Observation) -> ChoiceActorOutput:
        rows = len(observation["uav"]) if isinstance(observation, dict) else len(observation)
        return ChoiceActorOutput(*(entry.expand(rows, *entry.shape[1:]) for entry in self.output))


def test_samples_have_the_policys_frequencies_means_and_deviations() -> None:
    one = a_policy(1)
    output = ChoiceActorOutput(0.5 * one.mean, one.log_std.clamp(max=-2.0), one.logits)
    many = 20_000
    action = gaussian_action(Given(output), torch.zeros(many, 1), torch.Generator().manual_seed(0), False)
    p = output.logits[0].softmax(dim=0)
    for d in range(D):
        of_d = action.continuous[action.choice == d]
        assert len(of_d) / many == pytest.approx(float(p[d]), abs=0.02)
        torch.testing.assert_close(of_d.mean(dim=0), output.mean[0, d], rtol=0, atol=0.03)
        torch.testing.assert_close(of_d.std(dim=0), output.log_std[0, d].exp(), rtol=0.1, atol=0.01)
    wide = ChoiceActorOutput(output.mean, torch.ones_like(output.log_std), output.logits)
    clipped = gaussian_action(Given(wide), torch.zeros(100, 1), torch.Generator().manual_seed(0), False).continuous
    assert float(clipped.min()) == -1.0
    assert float(clipped.max()) == 1.0
    likeliest = gaussian_action(Given(output), torch.zeros(3, 1), torch.Generator(), True)
    assert (likeliest.choice == p.argmax()).all()
    torch.testing.assert_close(likeliest.continuous, output.mean[0, p.argmax()].expand(3, 2))


@BOTH
def test_loss_of_gaussian_cloning_is_the_negative_log_likelihood(kind: Kind) -> None:
    made, data = gaussian_bc(kind), batch(kind, ROWS)
    loss, metrics = made.actor_loss(data)
    with torch.no_grad():
        output = made.actor(data.observation)
        every = Independent(Normal(output.mean, output.log_std.exp()), 1).log_prob(data.action.continuous[:, None])
        both = every + output.logits.log_softmax(dim=1)
    expected = -both[torch.arange(ROWS), data.action.choice].mean()
    torch.testing.assert_close(loss.detach(), expected)
    torch.testing.assert_close(metrics["choice_loss"] + metrics["displacement_loss"], expected)


@pytest.mark.parametrize("expectile", [0.5, 0.7, 0.9])
def test_expectile_of_a_uniform_variable_is_the_known_one(expectile: float) -> None:
    """It solves tau (1 - e)^2 = (1 - tau) e^2."""
    sample = (torch.arange(1000) + 0.5) / 1000
    e = torch.tensor(1 / (1 + math.sqrt((1 - expectile) / expectile)), requires_grad=True)
    (slope,) = torch.autograd.grad(expectile_loss(sample - e, expectile), e)
    assert float(slope) == pytest.approx(0.0, abs=1e-3)
    weights = [expectile if u > 0 else 1 - expectile for u in (-1.0, 3.0)]
    found = expectile_loss(torch.tensor([-1.0, 3.0]), expectile)
    assert float(found) == pytest.approx((weights[0] + 9 * weights[1]) / 2)


@BOTH
@pytest.mark.parametrize(("beta", "limit"), [(1.0, 1e6), (2.0, 1.0)])
def test_losses_of_iql(kind: Kind, beta: float, limit: float) -> None:
    settings: dict[str, Any] = {"discount": 0.8, "huber": None, "expectile": 0.8}
    made = iql(kind, **settings, inverse_temperature=beta, weight_limit=limit)
    rows = 16
    data = batch(kind, rows)
    with torch.no_grad():  # as many advantages above 0 as below
        middle = (made.target_q(data) - made.state_value(data.observation)).quantile(0.5)  # between two of them
        last = made.value.rest.out if kind == "mlp" else made.value.out  # type: ignore[union-attr]  # a module
        last.bias.add_(middle)  # type: ignore[operator,union-attr]  # a tensor
    v_loss, q_loss, actor_loss, capped = 0.0, 0.0, 0.0, 0
    for i in range(rows):
        seen, w, d = row(data.observation, i), data.action.continuous[i], int(data.action.choice[i])
        with torch.no_grad():
            v = float(made.state_value(seen))
            v_next = float(made.state_value(row(data.next_observation, i)))
            output = made.actor(seen)
        u = float(q_of(made.target, seen, w, d).min()) - v
        v_loss += (0.8 if u > 0 else 0.2) * u**2 / rows
        target = float(data.reward[i]) + discount_of(data, i, "step", 0.8) * v_next
        q_loss += 0.5 * float(((q_of(made.critic, seen, w, d) - target) ** 2).sum()) / rows
        log_p = float(output.logits[0].log_softmax(dim=0)[d])
        log_p += float(Normal(output.mean[0, d], output.log_std[0, d].exp()).log_prob(w).sum())
        capped += math.exp(beta * u) >= limit
        actor_loss -= min(math.exp(beta * u), limit) * log_p / rows
    assert (0 < capped < rows) == (limit == 1.0)
    assert float(made.value_loss(data)[0].detach()) == pytest.approx(v_loss, rel=1e-3)
    assert float(made.critic_loss(data)[0].detach()) == pytest.approx(q_loss, rel=1e-3)
    loss, metrics = made.actor_loss(data)
    assert float(loss.detach()) == pytest.approx(actor_loss, rel=1e-3)
    assert float(metrics["weights_at_limit"]) == pytest.approx(capped / rows)


def test_iql_without_advantage_clones() -> None:
    made, data = iql("mlp", inverse_temperature=0.0), batch("mlp", ROWS)
    log_choice, log_w = log_likelihood(made.actor(data.observation), data.action)
    torch.testing.assert_close(made.actor_loss(data)[0], -(log_choice + log_w).mean())


# BCQ


@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.95])
@pytest.mark.parametrize("count", [1, 4, 13])
def test_candidates_go_round_the_choices_over_the_threshold(threshold: float, count: int) -> None:
    logits = torch.cat([2 * noise(0, 20, D), torch.zeros(1, D), torch.tensor([[-1e4, 0.0, -1e4, -0.5, -1e4]])])
    found = candidate_choices(logits, threshold, count)
    assert found.shape == (22, count)
    for i in range(22):
        g = np.exp(logits[i].double().numpy())
        allowed = sorted(np.flatnonzero(g / g.max() > threshold).tolist(), key=lambda d: -g[d])
        assert found[i].tolist() == [allowed[n % len(allowed)] for n in range(count)]


def candidate_of(made: Bcq, seen: Observation, d: int, z: Tensor, target: bool) -> Tensor:
    """w (2,) of one candidate."""
    one_hot = torch.eye(D)[d : d + 1]
    perturbation = made.actor_target if target else made.actor
    with torch.no_grad():
        w = torch.tanh(made.decoder(made.decoder.encode(seen), z.clamp(-0.5, 0.5)[None], one_hot))
        moved = w + 0.05 * torch.tanh(perturbation(perturbation.encode(seen), w, one_hot))
    return moved[0].clamp(-1, 1)


@BOTH
def test_target_of_bcq_is_the_best_candidate_by_the_soft_minimum(kind: Kind) -> None:
    made = bcq(kind, discount=0.8, huber=None)
    data, eps = batch(kind, ROWS), noise(3, ROWS, 7, 4)
    assert (eps.abs() > 0.5).any()
    expected, kept = 0.0, []
    for i in range(ROWS):
        following = row(data.next_observation, i)
        with torch.no_grad():
            g = made.classifier(following).logits[0].softmax(dim=0).double().numpy()
        allowed = sorted(np.flatnonzero(g / g.max() > 0.3).tolist(), key=lambda d: -g[d])
        kept.append(len(allowed))
        values = []
        for n in range(7):
            d = allowed[n % len(allowed)]
            q = q_of(made.target, following, candidate_of(made, following, d, eps[i, n], True), d)
            values.append(0.75 * q.min() + 0.25 * q.max())
        target = float(data.reward[i]) + discount_of(data, i, "step", 0.8) * max(values)
        q = q_of(made.critic, row(data.observation, i), data.action.continuous[i], int(data.action.choice[i]))
        expected += 0.5 * float(((q - target) ** 2).sum()) / ROWS
    assert min(kept) < D  # the threshold has left something out
    assert float(made.critic_loss(data, eps)[0].detach()) == pytest.approx(expected, rel=1e-3)


@BOTH
def test_losses_of_what_bcq_imitates_with_and_of_its_perturbation(kind: Kind) -> None:
    made, data, eps = bcq(kind), batch(kind, ROWS), noise(3, ROWS, 4)
    error, divergence, choice, worth = 0.0, 0.0, 0.0, 0.0
    for i in range(ROWS):
        seen, w, d = row(data.observation, i), data.action.continuous[i], int(data.action.choice[i])
        one_hot = torch.eye(D)[d : d + 1]
        with torch.no_grad():
            mean, raw = made.encoder(made.encoder.encode(seen), w[None], one_hot)[0].split([4, 4])
            std = torch.exp(-5 + 7 * torch.sigmoid(raw))
            decoded = torch.tanh(made.decoder(made.decoder.encode(seen), (mean + std * eps[i])[None], one_hot))[0]
            choice -= float(made.classifier(seen).logits[0].log_softmax(dim=0)[d]) / ROWS
        error += float((decoded - w).square().mean()) / ROWS
        divergence += float(kl_divergence(Normal(mean, std), Normal(torch.zeros(4), torch.ones(4))).mean()) / ROWS
        worth += q_of(made.critic, seen, candidate_of(made, seen, d, eps[i], False), d)[0] / ROWS
    assert float(made.coder_loss(data, eps)[0].detach()) == pytest.approx(error + 0.5 * divergence, rel=1e-3)
    assert float(made.classifier_loss(data)[0].detach()) == pytest.approx(choice, rel=1e-4)
    assert float(made.actor_loss(data, eps)[0].detach()) == pytest.approx(-worth, rel=1e-3)


def test_soft_minimum_by_hand() -> None:
    q = torch.tensor([[1.0, 5.0], [3.0, -3.0]])
    torch.testing.assert_close(soft_minimum(q, 0.75), torch.tensor([1.5, -1.0]))


@BOTH
def test_bcq_acts_within_the_perturbation_of_the_decoder_and_by_the_best_of_its_candidates(kind: Kind) -> None:
    made, seen = bcq(kind), observation(kind, 30)
    action = made.act(seen, generator=torch.Generator().manual_seed(0), deterministic=True)
    for i in range(30):
        here = row(seen, i)
        with torch.no_grad():
            g = made.classifier(here).logits[0].softmax(dim=0)
        best, value = -1, -math.inf
        for d in range(D):
            if g[d] / g.max() > 0.3:
                q = q_of(made.critic, here, candidate_of(made, here, d, torch.zeros(4), False), d)
                if 0.75 * q.min() + 0.25 * q.max() > value:
                    best, value = d, 0.75 * q.min() + 0.25 * q.max()
        assert int(action.choice[i]) == best
        expected = candidate_of(made, here, best, torch.zeros(4), False)
        torch.testing.assert_close(action.continuous[i], expected, rtol=1e-3, atol=1e-4)


@BOTH
def test_more_candidates_find_a_better_action(kind: Kind) -> None:
    seen, found = observation(kind, 60), {}
    for count in (1, 40):
        made = bcq(kind, candidates=count)
        action = made.act(seen, generator=torch.Generator().manual_seed(0))
        one_hot = functional.one_hot(action.choice, D).float()
        with torch.no_grad():
            found[count] = made.judge(made.critic, seen, action.continuous, one_hot)[:, 0]
    assert (found[40] >= found[1] - 1e-5).float().mean() > 0.9
    assert (found[40] > found[1] + 1e-3).float().mean() > 0.5


# What each loss trains


def plain(name: str) -> Callable[[Kind], Agent]:
    """Undisturbed: advantages and likelihoods of the size that a run begins with."""
    return lambda kind: agent(name, kind)


Loss = Callable[[Any, Batch], Tensor]
THROUGH = {"cql actor": "critic", "bcq actor": "critic"}  # judged by it: the slope passes, and `minimise` leaves it
LOSSES: dict[str, tuple[Callable[..., Agent], str, Loss]] = {
    "cql critic": (cql, "critic", lambda a, b: a.critic_loss(b, noise(1, 64, 2), penalty_noise(64, 3))[0]),
    "cql critic, no penalty": (cql, "critic", lambda a, b: a.critic_loss(b, noise(1, 64, 2), None)[0]),
    "cql actor": (cql, "actor", lambda a, b: a.actor_loss(b, noise(1, 64, 2))[0]),
    "cql temperature": (
        cql,
        "temperature",
        lambda a, b: a.temperature_loss(a.actor_loss(b, noise(1, 64, 2))[1]["entropy"]),
    ),
    "iql value": (plain("iql"), "value", lambda a, b: a.value_loss(b)[0]),
    "iql critic": (plain("iql"), "critic", lambda a, b: a.critic_loss(b)[0]),
    "iql actor": (plain("iql"), "actor", lambda a, b: a.actor_loss(b)[0]),
    "bcq classifier": (bcq, "classifier", lambda a, b: a.classifier_loss(b)[0]),
    "bcq coder": (bcq, "coder", lambda a, b: a.coder_loss(b, noise(1, 64, 4))[0]),
    "bcq critic": (bcq, "critic", lambda a, b: a.critic_loss(b, noise(1, 64, 5, 4))[0]),
    "bcq actor": (bcq, "actor", lambda a, b: a.actor_loss(b, noise(1, 64, 4))[0]),
    "gaussian_bc actor": (gaussian_bc, "actor", lambda a, b: a.actor_loss(b)[0]),
}


def gradients(loss: Tensor, network: nn.Module) -> dict[str, Tensor | None]:
    """None for what the loss does not depend on, and for what is not trained at all."""
    names, parameters = zip(*network.named_parameters(), strict=True)
    asked = [parameter for parameter in parameters if parameter.requires_grad]
    if not asked:
        return dict.fromkeys(names)
    found = torch.autograd.grad(loss, asked, retain_graph=True, allow_unused=True)
    return dict(zip(names, found, strict=True))


@BOTH
@pytest.mark.parametrize("which", LOSSES)
def test_each_loss_trains_the_whole_of_its_network_and_no_other(kind: Kind, which: str) -> None:
    make, trained, loss_of = LOSSES[which]
    made = make(kind)
    loss = loss_of(made, batch(kind, 64))
    for name, network in made.networks.items():
        for key, gradient in gradients(loss, network).items():
            if name == THROUGH.get(which):
                continue
            if name != trained:
                assert gradient is None, (name, key)
            else:
                assert gradient is not None, key
                # a constant added before a softmax may have no slope; a weight matrix has one
                if gradient.ndim == 2:
                    assert 1e-6 < gradient.norm() < 1e4, (key, gradient.norm())


@BOTH
@pytest.mark.parametrize("which", ["iql actor", "gaussian_bc actor"])
def test_likelihood_trains_logits_means_and_deviations_of_every_choice(kind: Kind, which: str) -> None:
    make, _, loss_of = LOSSES[which]
    made, data = make(kind), batch(kind, 64)
    assert set(data.action.choice.tolist()) == set(range(D))
    found = gradients(loss_of(made, data), made.networks["actor"])
    names = ["rest.out.weight"] if kind == "mlp" else ["idle_out.weight", "device_out.weight"]
    for name in names:
        weight = found[name]
        assert weight is not None
        for choice in weight.norm(dim=1).view(-1, 5):  # logit, two means, two deviations
            assert ((choice > 1e-5) & (choice < 1e3)).all(), (name, choice)


@BOTH
def test_sacs_actor_is_trained_by_both_blocks_in_cql(kind: Kind) -> None:
    made = cql(kind)
    found = gradients(made.actor_loss(batch(kind, 64), noise(1, 64, 2))[0], made.actor)
    names = ["rest.out.weight"] if kind == "mlp" else ["global_out.weight", "device_out.weight"]
    for name in names:
        weight = found[name]
        assert weight is not None
        assert ((weight.norm(dim=1) > 1e-6) & (weight.norm(dim=1) < 1e3)).all()


@BOTH
@pytest.mark.parametrize("name", ["cql", "iql", "bcq", "gaussian_bc"])
def test_a_step_moves_each_network_by_its_own_optimiser_alone(kind: Kind, name: str) -> None:
    targets = {"critic": {"target"}, "actor": {"actor_target"}}
    for moving in agent(name, kind).optimisers:
        made = agent(name, kind)
        for other, optimiser in made.optimisers.items():
            if other != moving:
                optimiser.param_groups[0]["lr"] = 0.0
        before = {key: copies(network) for key, network in made.networks.items()}
        made.update(batch(kind, 16), torch.Generator().manual_seed(0))
        moved = {key for key, network in made.networks.items() if not equal(before[key], copies(network))}
        assert moved == {moving} | (targets.get(moving, set()) & set(made.networks)), moving


@pytest.mark.parametrize(("name", "pairs"), [("cql", 1), ("iql", 1), ("bcq", 2)])
def test_targets_move_by_polyak_averaging_of_the_updated_networks(name: str, pairs: int) -> None:
    made = {"cql": cql, "iql": iql, "bcq": bcq}[name]("mlp", polyak=0.1)
    both = [(key, source) for key, source in (("target", "critic"), ("actor_target", "actor")) if key in made.networks]
    assert len(both) == pairs
    before = {key: copies(made.networks[key]) for key, _ in both}
    made.update(batch("mlp", 16), torch.Generator().manual_seed(0))
    for key, source in both:
        updated = copies(made.networks[source])
        for parameter, value in made.networks[key].named_parameters():
            torch.testing.assert_close(value, 0.9 * before[key][parameter] + 0.1 * updated[parameter])


@pytest.mark.parametrize("name", ["cql", "iql", "bcq"])
def test_the_critics_use_the_huber_limit_of_their_settings(name: str) -> None:
    found = []
    for huber in (None, 0.01):
        settings: dict[str, Any] = {"cql_weight": 0.0} if name == "cql" else {}
        made = agent(name, "mlp", huber=huber, **settings)
        metrics = made.update(batch("mlp", ROWS), torch.Generator().manual_seed(0))
        found.append(float(metrics["critic_loss"]))
    assert found[1] < 0.1 * found[0]


# Small problems whose answer is known


def shrink(made: Agent, rates: dict[str, float], share: float) -> None:
    """Learning rates, falling on a cosine."""
    for key, optimiser in made.optimisers.items():
        optimiser.param_groups[0]["lr"] = rates[key] * 0.5 * (1 + math.cos(math.pi * share))


def learn(made: Agent, draw: Callable[[torch.Generator], Batch], updates: int, seed: int = 0) -> None:
    generator = torch.Generator().manual_seed(seed)
    rates = {key: optimiser.param_groups[0]["lr"] for key, optimiser in made.optimisers.items()}
    for update in range(updates):
        shrink(made, rates, update / updates)
        made.update(draw(generator), generator)


@pytest.mark.parametrize("ended", ["terminated", "truncated"])
@pytest.mark.parametrize("name", ["cql", "iql", "bcq"])
def test_a_chain_of_two_states_has_its_known_values(name: str, ended: Literal["terminated", "truncated"]) -> None:
    """As in test_known_values.py: 0 pays 1 and leads to 1, which pays 2 and ends, or leads back when truncated."""
    shared: dict[str, Any] = {
        "network": NetworkConfig(kind="mlp", width=16, depth=1, log_inputs=False),
        "learning_rate": 1e-2,
        "discount": GAMMA,
        "polyak": 0.1,
    }
    configs = {"cql": CqlConfig(**shared, cql_weight=0.01), "iql": IqlConfig(**shared), "bcq": BcqConfig(**shared)}
    torch.manual_seed(0)
    made = make_agent(Spaces(observation=1, continuous=1, choices=2), configs[name])
    fit_normalisers(made.networks, chain_batch(100, ended, torch.Generator().manual_seed(0)).observation)
    learn(made, lambda generator: chain_batch(32, ended, generator), 300)
    assert isinstance(made, Cql | Iql | Bcq)
    with torch.no_grad():
        states = torch.tensor([[0.0], [1.0]])
        q = made.critic.all_choices(made.critic.encode(states), torch.zeros(2, 1))
    first = 1 + GAMMA * 2 if ended == "terminated" else (1 + 2 * GAMMA) / (1 - GAMMA**2)
    expected = torch.tensor([first, 2.0 if ended == "terminated" else 2 + GAMMA * first])
    torch.testing.assert_close(q, expected[None, :, None].expand(2, 2, 2), rtol=0.04, atol=0.04)
    if isinstance(made, Iql):
        torch.testing.assert_close(made.state_value(states).detach(), expected, rtol=0.04, atol=0.04)


CHOICES = 11


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", ["cql", "iql", "bcq"])
def test_hybrid_bandit_finds_the_best_choice_and_its_own_displacement(name: str, seed: int) -> None:
    """Eleven choices, each logged equally often with a displacement of its own; rewards .5 apart, noise .5.

    Sampled actions: at least 95 % the right choice, and 90 % of all within .2 of that choice's mode.
    """
    generator = torch.Generator().manual_seed(seed)
    angle = torch.arange(CHOICES) * 2 * math.pi / CHOICES
    modes = 0.8 * torch.stack([angle.cos(), angle.sin()], dim=1)
    worth = torch.linspace(0, 5, CHOICES)[torch.randperm(CHOICES, generator=generator)]
    d = torch.randint(0, CHOICES, (10_000,), generator=generator)
    w = (modes[d] + 0.05 * torch.randn((len(d), 2), generator=generator)).clamp(-1, 1)
    reward = worth[d] + 0.5 * torch.randn(len(d), generator=generator)
    reward = reward - reward.median()
    shared: dict[str, Any] = {"network": NetworkConfig(kind="mlp", width=64, depth=2), "batch_size": 128, "huber": None}
    configs = {
        "cql": CqlConfig(**shared, continuous_entropy=-4.0, choice_entropy=0.02, cql_samples=4),
        # its policy is the data's times min(e^(beta A), 100): V close to the best Q, for 100 not to be met there, and
        # beta 8, for the second best, .5 behind, to have e^-4 of the best's weight; at beta 3 it has a quarter
        "iql": IqlConfig(**shared, expectile=0.98, inverse_temperature=8.0),
        "bcq": BcqConfig(**shared, target_candidates=1),
    }
    torch.manual_seed(seed)
    made = make_agent(Spaces(observation=1, continuous=2, choices=CHOICES), configs[name])

    def draw(chance: torch.Generator) -> Batch:
        rows = torch.randint(0, len(d), (128,), generator=chance)
        state, one = torch.zeros(128, 1), torch.ones(128)
        return Batch(state, HybridAction(w[rows], d[rows]), reward[rows], one, one, state)

    learn(made, draw, 2_000, seed)
    action = made.act(torch.zeros(500, 1), generator=torch.Generator().manual_seed(9))
    best = int(worth.argmax())
    right = (action.choice == best).float().mean()
    near = ((action.continuous - modes[best]).norm(dim=1) < 0.2).float().mean()
    assert right >= 0.95, (right, near)
    assert near >= 0.90, (right, near)


@pytest.mark.parametrize("name", ["cql", "iql", "bcq"])
def test_a_single_choice_makes_the_action_continuous_alone(name: str) -> None:
    """Uniform w, reward 4 - 8 (w - .4)^2: no entropy, likelihood or sum of the missing choice gets in the way."""
    shared: dict[str, Any] = {"network": NetworkConfig(kind="mlp", width=32, depth=2), "learning_rate": 3e-3}
    configs = {
        "cql": CqlConfig(**shared, huber=None, cql_weight=0.1, continuous_entropy=-1.0),
        "iql": IqlConfig(**shared),
        "bcq": BcqConfig(**shared),
    }
    torch.manual_seed(0)
    made = make_agent(Spaces(observation=1, continuous=1, choices=1), configs[name])

    def draw(generator: torch.Generator) -> Batch:
        w = 2 * torch.rand((128, 1), generator=generator) - 1
        state, one = torch.zeros(128, 1), torch.ones(128)
        reward = 4 - 8 * (w[:, 0] - 0.4).square()
        return Batch(state, HybridAction(w, torch.zeros(128, dtype=torch.int64)), reward, one, one, state)

    learn(made, draw, 600)
    action = made.act(torch.zeros(200, 1), generator=torch.Generator().manual_seed(0))
    assert (action.choice == 0).all()
    assert float(action.continuous.mean()) == pytest.approx(0.4, abs=0.15)
    if name == "cql":
        metrics = made.update(draw(torch.Generator().manual_seed(1)), torch.Generator().manual_seed(1))
        assert float(metrics["entropy_choice"]) == 0.0
        assert float(metrics["temperature_choice"]) == pytest.approx(0.1)
