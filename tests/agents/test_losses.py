"""Losses against sums written out in NumPy, one action at a time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from tests.agents.problems import DEVICES, KINDS, Kind, agent, batch, diffusion_sac, disturb, noise
from uavrl.agents.base import Batch, bellman_loss, discounts, minimise
from uavrl.agents.bc import BehaviourCloning
from uavrl.agents.cql import conservative_penalty
from uavrl.agents.diffusion_actor import ChainNoise, block_mean
from uavrl.agents.sac import Sac, SquashedSample, soft_value
from uavrl.networks import Critic, Observation
from uavrl.networks.interfaces import ActorOutput

ROWS, D = 6, DEVICES + 1
Array = NDArray[np.float64]


def row(observation: Observation, index: int) -> Observation:
    if isinstance(observation, dict):
        return {key: value[index : index + 1] for key, value in observation.items()}
    return observation[index : index + 1]


def q_of(critic: Critic, observation: Observation, w: Tensor, choice: int) -> Array:
    """Both Q functions at one observation (1 row), displacement (2,) and choice, (2,)."""
    one_hot = torch.zeros(1, D)
    one_hot[0, choice] = 1.0
    with torch.no_grad():
        return critic.value(critic.encode(observation), w[None], one_hot)[:, 0].double().numpy()


def discount_of(data: Batch, index: int, per: str, gamma: float) -> float:
    ended = bool(data.terminated[index])
    return 0.0 if ended else gamma ** (float(data.duration_s[index]) if per == "second" else 1.0)


@pytest.mark.parametrize("per", ["step", "second"])
def test_discounts_stop_at_a_termination_and_follow_time_where_asked(per: str) -> None:
    data = batch("mlp", 40)
    assert 0 < data.terminated.sum() < 40
    made = agent("diffusion_sac", "mlp", discount=0.9, discount_per=per)
    expected = [discount_of(data, i, per, 0.9) for i in range(40)]
    np.testing.assert_allclose(discounts(data, made.config).numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("samples", [1, 4])
def test_penalty_is_the_log_of_the_integral_over_all_actions(kind: Kind, samples: int) -> None:
    """log sum_d int e^Q dw - Q(s, a), the integral over [-1, 1]^2 as 4 x the mean over uniform w."""
    made = diffusion_sac(kind)
    disturb(made.critic, 3)
    data = batch(kind, ROWS)
    uniform = noise(5, ROWS * samples, 2).clamp(-1, 1)
    context = made.critic.encode(data.observation)
    q_data = np.stack(
        [
            q_of(made.critic, row(data.observation, i), data.action.continuous[i], int(data.action.choice[i]))
            for i in range(ROWS)
        ],
        axis=1,
    )
    found = conservative_penalty(made.critic, context, uniform, torch.from_numpy(q_data).float())
    expected = 0.0
    for j in range(2):
        for i in range(ROWS):
            total = 0.0
            for n in range(samples):
                for choice in range(D):
                    q = q_of(made.critic, row(data.observation, i), uniform[i * samples + n], choice)[j]
                    total += 4.0 * math.exp(q) / samples
            expected += (math.log(total) - q_data[j, i]) / ROWS
    assert float(found.detach()) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("greedy", [False, True])
@pytest.mark.parametrize(("cql_weight", "samples", "per"), [(0.0, 2, "step"), (0.7, 2, "second"), (0.7, 0, "step")])
def test_critic_loss_of_diffusion_sac(kind: Kind, cql_weight: float, samples: int, per: str, greedy: bool) -> None:
    """The target is of the target critic at the target actor's w, and its argmax d or the target critic's best d.

    The penalty integrates over w, or without samples sums over d at the logged w. All four networks differ here.
    """
    settings: dict[str, Any] = {
        "cql_weight": cql_weight,
        "cql_samples": samples,
        "discount": 0.8,
        "discount_per": per,
        "huber": None,
    }
    made = diffusion_sac(kind, **settings, greedy_choice=greedy)
    for seed, network in enumerate((made.critic, made.target, made.actor.denoiser, made.actor.average)):
        disturb(network, seed)
    data = batch(kind, ROWS)
    chain = ChainNoise(noise(5, ROWS, 2 + D), noise(6, 3, ROWS, 2 + D))
    uniform = noise(7, samples * ROWS, 2).clamp(-1, 1) if samples else data.action.continuous
    loss, metrics = made.critic_loss(data, chain, uniform if cql_weight and samples else None)

    with torch.no_grad():
        context = made.actor.average.encode(data.next_observation)
        vector = made.actor.sample(made.actor.average, context, chain)
    expected, penalty = 0.0, 0.0
    for i in range(ROWS):
        w, choice = vector[i, :2].clamp(-1, 1), int(np.argmax(vector[i, 2:].numpy()))
        following = [q_of(made.target, row(data.next_observation, i), w, d).min() for d in range(D)]
        value = max(following) if greedy else following[choice]
        target = float(data.reward[i]) + discount_of(data, i, per, 0.8) * value
        q = q_of(made.critic, row(data.observation, i), data.action.continuous[i], int(data.action.choice[i]))
        expected += 0.5 * float(((q - target) ** 2).sum()) / ROWS
        for j in range(2):
            if samples:
                at, density = uniform[samples * i : samples * (i + 1)], 4 / samples
            else:
                at, density = uniform[i : i + 1], 1.0
            every = [
                math.exp(q_of(made.critic, row(data.observation, i), one, d)[j]) * density
                for one in at
                for d in range(D)
            ]
            penalty += (math.log(sum(every)) - q[j]) / ROWS
    assert float(metrics["bellman_loss"]) == pytest.approx(expected, rel=1e-3)
    assert float(loss.detach()) == pytest.approx(expected + cql_weight * penalty, rel=1e-3)


@pytest.mark.parametrize("clip_x0", [False, True])
def test_actor_loss_weighs_cloning_against_guidance(clip_x0: bool) -> None:
    data, step = batch("mlp", ROWS), torch.tensor([1, 2, 3, 1, 2, 3])
    found = {}
    for eta in (0.0, 0.25, 1.0):
        made = diffusion_sac("mlp", bc_weight=eta, q_scale="none", diffusion={"clip_x0": clip_x0})
        found[eta] = float(made.actor_loss(data, step, noise(3, ROWS, 2 + D), None)[0].detach())
    assert found[0.25] == pytest.approx(0.25 * found[1.0] + 0.75 * found[0.0], rel=1e-4)
    # one_step: Q of the action that one pass predicts from the noised data
    made = diffusion_sac("mlp", bc_weight=0.0, q_scale="none", diffusion={"clip_x0": clip_x0})
    schedule, expected = made.actor.schedule(torch.device("cpu")), 0.0
    with torch.no_grad():
        for i in range(ROWS):
            x0 = torch.cat([data.action.continuous[i], 2.0 * torch.eye(D)[data.action.choice[i]] - 1.0])
            bar = float(schedule.alpha_bar[step[i] - 1])
            x = math.sqrt(bar) * x0 + math.sqrt(1 - bar) * noise(3, ROWS, 2 + D)[i]
            context = made.actor.denoiser.encode(row(data.observation, i))
            x = (x - math.sqrt(1 - bar) * made.actor.denoiser(context, x[None], step[i : i + 1])[0]) / math.sqrt(bar)
            x = x.clamp(-1, 1) if clip_x0 else x
            p = np.exp(x[2:].double().numpy() / 0.5)
            q = [q_of(made.critic, row(data.observation, i), x[:2].clamp(-1, 1), d).min() for d in range(D)]
            expected -= float((p / p.sum() * np.array(q)).sum()) / ROWS
    assert found[0.0] == pytest.approx(expected, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("name", ["bc", "diffusion_sac"])
@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_cloning_is_the_weighted_mean_of_squared_noise_errors(name: str, weight: float) -> None:
    settings: dict[str, Any] = {"bc_weight": 1.0} if name == "diffusion_sac" else {}
    made = agent(name, "mlp", displacement_weight=weight, **settings)
    data, step, eps = batch("mlp", ROWS), torch.tensor([1, 2, 3, 4, 5, 1]), noise(3, ROWS, 2 + D)
    if isinstance(made, BehaviourCloning):
        loss = made.actor_loss(data, step, eps)[0]
    else:
        loss = made.actor_loss(data, step, eps, None)[0]  # type: ignore[attr-defined]  # a DiffusionSac
    actor = made.actor  # type: ignore[attr-defined]  # of both agents
    schedule, total = actor.schedule(torch.device("cpu")), 0.0
    with torch.no_grad():
        for i in range(ROWS):
            x0 = torch.cat([data.action.continuous[i], 2.0 * torch.eye(D)[data.action.choice[i]] - 1.0])
            bar = float(schedule.alpha_bar[step[i] - 1])
            x = math.sqrt(bar) * x0 + math.sqrt(1 - bar) * eps[i]
            context = actor.denoiser.encode(row(data.observation, i))
            error = ((eps[i] - actor.denoiser(context, x[None], step[i : i + 1])[0]) ** 2).double().numpy()
            total += (weight * error[:2].sum() + error[2:].sum()) / (2 * weight + D) / ROWS
    assert float(loss.detach()) == pytest.approx(total, rel=1e-3)


def test_block_mean_weighs_entries_not_blocks() -> None:
    error = torch.tensor([[1.0, 2.0, 10.0, 20.0, 30.0], [3.0, 4.0, 10.0, 20.0, 30.0]])
    assert float(block_mean(error, 2, 1.0)) == pytest.approx((2 + 3 + 60) / 5)
    assert float(block_mean(error, 2, 3.0)) == pytest.approx((3 * 5 + 60) / 9)


def test_density_of_a_squashed_sample_is_that_of_a_transformed_normal() -> None:
    output = ActorOutput(noise(0, ROWS, 2), 0.3 * noise(1, ROWS, 2), torch.zeros(ROWS, D))
    sample = SquashedSample(output, noise(2, ROWS, 2))
    normal = TransformedDistribution(Normal(output.mean, output.log_std.exp()), TanhTransform(cache_size=1))
    torch.testing.assert_close(sample.log_density, normal.log_prob(sample.continuous).sum(dim=1), rtol=1e-3, atol=1e-3)
    far = SquashedSample(ActorOutput(torch.full((1, 2), 40.0), torch.zeros(1, 2), torch.zeros(1, D)), torch.zeros(1, 2))
    assert far.log_density.isfinite().all()
    assert float(far.log_density) == pytest.approx(2 * (-0.5 * math.log(2 * math.pi) + 80 - 2 * math.log(2)), rel=1e-5)


def test_soft_value_is_the_sum_over_choices() -> None:
    q, logits, log_density = noise(0, ROWS, D), noise(1, ROWS, D), noise(2, ROWS)
    found = soft_value(q, logits.log_softmax(dim=1), log_density, torch.tensor(0.3), torch.tensor(0.7))
    for i in range(ROWS):
        p = np.exp(logits[i].double().numpy())
        p /= p.sum()
        value = sum(p[d] * (float(q[i, d]) - 0.7 * math.log(p[d])) for d in range(D)) - 0.3 * float(log_density[i])
        assert float(found[i]) == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_losses_of_sac(kind: Kind) -> None:
    made = agent("sac", kind, discount=0.8, huber=None, network={"choice_heads": False})
    assert isinstance(made, Sac)
    disturb(made.critic, 0)
    disturb(made.target, 1)
    with torch.no_grad():
        made.log_temperature.copy_(torch.tensor([math.log(0.3), math.log(0.7)]))
    data, first, second = batch(kind, ROWS), noise(3, ROWS, 2), noise(4, ROWS, 2)

    def value(critic: Critic, observation: Observation, eps: Tensor) -> float:
        """V of one observation: sum over d by one call each."""
        with torch.no_grad():
            output = made.actor(observation)
        mean, std = output.mean[0].double().numpy(), np.exp(output.log_std[0].double().numpy())
        u = mean + std * eps.double().numpy()
        w = np.tanh(u)
        log_w = float((-0.5 * eps.double().numpy() ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)).sum())
        log_w -= float(np.log(1 - w**2).sum())
        p = np.exp(output.logits[0].double().numpy())
        p /= p.sum()
        q = [q_of(critic, observation, torch.from_numpy(w).float(), d).min() for d in range(D)]
        return float(sum(p[d] * (q[d] - 0.7 * math.log(p[d])) for d in range(D))) - 0.3 * log_w

    expected = 0.0
    for i in range(ROWS):
        following = value(made.target, row(data.next_observation, i), first[i])
        target = float(data.reward[i]) + discount_of(data, i, "step", 0.8) * following
        q = q_of(made.critic, row(data.observation, i), data.action.continuous[i], int(data.action.choice[i]))
        expected += 0.5 * float(((q - target) ** 2).sum()) / ROWS
    assert float(made.critic_loss(data, first)[0].detach()) == pytest.approx(expected, rel=1e-3)
    mean = sum(value(made.critic, row(data.observation, i), second[i]) for i in range(ROWS)) / ROWS
    assert float(made.actor_loss(data, second)[0].detach()) == pytest.approx(-mean, rel=1e-3)


def test_a_gradient_is_clipped_by_its_norm_over_the_whole_network() -> None:
    first, second = torch.zeros(3, requires_grad=True), torch.zeros(4, requires_grad=True)
    moved = []
    for clip in (None, 1.0, 1000.0):
        optimiser = torch.optim.SGD([first, second], lr=1.0)
        before = torch.cat([first, second]).detach().clone()
        loss = (30 * first * torch.ones(3)).sum() + (40 * second * torch.ones(4)).sum()
        norm = minimise(loss, [first, second], optimiser, clip)
        assert float(norm) == pytest.approx(math.sqrt(3 * 900 + 4 * 1600))
        moved.append(float((torch.cat([first, second]).detach() - before).norm()))
    assert moved == pytest.approx([float(norm), 1.0, float(norm)], rel=1e-4)


@pytest.mark.parametrize("huber", [None, 0.5])
def test_bellman_loss_is_half_the_square_and_linear_from_huber_on(huber: float | None) -> None:
    q, target = noise(0, 2, 20), 2 * noise(1, 20)
    expected = 0.0
    for error in (q - target).abs().flatten().double().tolist():
        limit = math.inf if huber is None else huber
        expected += (0.5 * error**2 if error <= limit else limit * (error - 0.5 * limit)) / 20
    assert float(bellman_loss(q, target, huber)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("name", ["sac", "diffusion_sac"])
def test_the_critics_use_the_huber_limit_of_their_settings(name: str) -> None:
    found = []
    for huber in (None, 0.01):
        made = agent(name, "mlp", huber=huber)
        metrics = made.update(batch("mlp", ROWS), torch.Generator().manual_seed(0))
        found.append(float(metrics["critic_loss"]))
    assert found[1] < 0.1 * found[0]


@pytest.mark.parametrize("per", ["step", "second"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_pinned_level_takes_the_batchs_mean_from_the_target_and_nothing_else(kind: Kind, per: str) -> None:
    """The target is r + gamma (min Q' - its mean): the loss is that of rewards lowered by gamma times the mean.

    Per second a step loses the mean in proportion to its duration, so that long steps and short ones stay equal.
    """
    data = batch(kind, ROWS)
    data = replace(data, terminated=torch.zeros(ROWS))
    chain = ChainNoise(noise(5, ROWS, 2 + D), noise(6, 3, ROWS, 2 + D))
    free, pinned = (
        diffusion_sac(kind, pinned_level=flag, discount=0.9, discount_per=per, huber=None, greedy_choice=True)
        for flag in (False, True)
    )
    for made in (free, pinned):
        disturb(made.target, 1)
    loss, metrics = pinned.critic_loss(data, chain, None)
    with torch.no_grad():
        context = free.actor.average.encode(data.next_observation)
        w = free.actor.sample(free.actor.average, context, chain)[:, :2].clamp(-1, 1)
        level = free.target.all_choices(free.target.encode(data.next_observation), w).amin(dim=0).amax(dim=1).mean()
    share = data.duration_s / data.duration_s.mean() if per == "second" else torch.ones(ROWS)
    lowered = replace(data, reward=data.reward - discounts(data, free.config) * share * level)
    torch.testing.assert_close(loss, free.critic_loss(lowered, chain, None)[0])
    if per == "step":
        assert float(metrics["target_q"]) == pytest.approx(float(data.reward.mean()), abs=1e-5)


@pytest.mark.parametrize("greedy", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_advantage_learning_takes_what_the_logged_action_lacks_from_the_target(kind: Kind, greedy: bool) -> None:
    """The loss is that of rewards lowered by beta (V'(s) - Q'(s, a)), V' of the target actor's action at s."""
    data, eps = batch(kind, ROWS), noise(8, ROWS, 2)
    chain = ChainNoise(noise(5, ROWS, 2 + D), noise(6, 3, ROWS, 2 + D))
    plain, made = (
        diffusion_sac(kind, advantage_weight=beta, action_noise=0.2, huber=None, greedy_choice=greedy)
        for beta in (0.0, 0.7)
    )
    for one in (plain, made):
        disturb(one.target, 1)
        disturb(one.actor.average, 3)
    with torch.no_grad():
        vector = made.actor.sample(made.actor.average, made.actor.average.encode(data.observation), chain)
    lack = torch.zeros(ROWS)
    for i in range(ROWS):
        here = row(data.observation, i)
        w = (vector[i, :2].clamp(-1, 1) + 0.2 * eps[i]).clamp(-1, 1)
        values = [float(q_of(made.target, here, w, d).min()) for d in range(D)]
        value = max(values) if greedy else values[int(vector[i, 2:].argmax())]
        lack[i] = value - float(q_of(made.target, here, data.action.continuous[i], int(data.action.choice[i])).min())
    assert lack.abs().min() > 1e-4
    lowered = replace(data, reward=data.reward - 0.7 * lack)
    found, expected = made.critic_loss(data, chain, None, eps), plain.critic_loss(lowered, chain, None, eps)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found[1]["target_q"], expected[1]["target_q"], rtol=1e-4, atol=1e-5)
    assert not torch.isclose(found[0], plain.critic_loss(data, chain, None, eps)[0])


@pytest.mark.parametrize("kind", KINDS)
def test_action_noise_moves_what_the_critic_is_asked_about(kind: Kind) -> None:
    """w + sigma eps, held in the box: in the backup, and in L_g where it carries the gradient."""
    data, chain = batch(kind, ROWS), ChainNoise(noise(5, ROWS, 2 + D), noise(6, 3, ROWS, 2 + D))
    made = diffusion_sac(kind, action_noise=0.4, greedy_choice=False, discount=0.9, huber=None)
    disturb(made.target, 1)
    disturb(made.critic, 2)
    eps = noise(8, ROWS, 2)
    with torch.no_grad():
        vector = made.actor.sample(made.actor.average, made.actor.average.encode(data.next_observation), chain)
    expected = 0.0
    for i in range(ROWS):
        w = (vector[i, :2].clamp(-1, 1) + 0.4 * eps[i]).clamp(-1, 1)
        value = q_of(made.target, row(data.next_observation, i), w, int(vector[i, 2:].argmax())).min()
        target = float(data.reward[i]) + discount_of(data, i, "step", 0.9) * value
        q = q_of(made.critic, row(data.observation, i), data.action.continuous[i], int(data.action.choice[i]))
        expected += 0.5 * float(((q - target) ** 2).sum()) / ROWS
    assert float(made.critic_loss(data, chain, None, eps)[0].detach()) == pytest.approx(expected, rel=1e-3)

    asked = noise(9, ROWS, 2 + D).clamp(-0.5, 0.5).requires_grad_()
    moved = torch.cat([(asked[:, :2] + 0.4 * eps).clamp(-1, 1), asked[:, 2:]], dim=1)
    loss, plain = made.guidance_loss(data.observation, asked, eps)[0], made.guidance_loss(data.observation, moved)[0]
    torch.testing.assert_close(loss, plain)
    torch.testing.assert_close(torch.autograd.grad(loss, asked)[0][:, 2:], torch.autograd.grad(plain, asked)[0][:, 2:])


def test_action_noise_falls_by_equal_factors_over_a_training() -> None:
    made, data, eps = (
        diffusion_sac("mlp", action_noise=0.4, final_action_noise=0.1),
        batch("mlp", ROWS),
        noise(8, ROWS, 2),
    )
    assert made.noise_now() == pytest.approx(0.4)
    made.progress = 0.5
    assert made.noise_now() == pytest.approx(0.2)
    chain, half = ChainNoise(noise(5, ROWS, 2 + D), noise(6, 3, ROWS, 2 + D)), diffusion_sac("mlp", action_noise=0.2)
    half.networks.load_state_dict(made.networks.state_dict())
    torch.testing.assert_close(made.critic_loss(data, chain, None, eps)[0], half.critic_loss(data, chain, None, eps)[0])
    made.progress = 1.0
    assert made.noise_now() == pytest.approx(0.1)
    none = diffusion_sac("mlp", action_noise=0.0, final_action_noise=0.1)
    assert none.noise_now() == 0
    half.progress = 0.7
    assert half.noise_now() == 0.2


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_an_update_draws_action_noise_where_it_is_set(sigma: float, monkeypatch: pytest.MonkeyPatch) -> None:
    made, seen = diffusion_sac("mlp", action_noise=sigma), []
    asked = type(made).guidance_loss

    def guidance_loss(self: object, observation: object, vector: Tensor, jitter: Tensor | None = None) -> object:
        seen.append(jitter)
        return asked(self, observation, vector, jitter)  # type: ignore[arg-type]  # passed on as it came

    monkeypatch.setattr(type(made), "guidance_loss", guidance_loss)
    made.update(batch("mlp", 200), torch.Generator().manual_seed(0))
    (jitter,) = seen
    if sigma == 0:
        assert jitter is None
    else:
        assert jitter is not None
        assert 0.9 < float(jitter.std()) < 1.1
