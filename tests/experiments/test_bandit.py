from __future__ import annotations

import torch

from uavrl.actions import HybridAction
from uavrl.agents.gaussian_bc import GaussianBcConfig
from uavrl.agents.registry import make_agent
from uavrl.experiments.bandit import CHOICES, NOISE, SIGMA, SPACES, HybridBandit, fit_bandit, samples
from uavrl.networks import NetworkConfig


def test_the_log_is_what_the_bandit_says() -> None:
    bandit = HybridBandit.draw(3)
    shares = torch.bincount(bandit.action.choice, minlength=CHOICES) / len(bandit.reward)
    assert ((shares - 1 / CHOICES).abs() < 0.02).all()
    assert sorted(bandit.worth.tolist()) == [0.5 * rank for rank in range(CHOICES)]
    for choice in range(CHOICES):
        own = bandit.action.choice == choice
        w, reward = bandit.action.continuous[own], bandit.reward[own]
        torch.testing.assert_close(w.mean(dim=0), bandit.modes[choice], atol=0.01, rtol=0)
        assert abs(float(w.std(dim=0).mean()) - SIGMA) < 0.005
        assert abs(float(reward.mean() - bandit.worth[choice])) < 0.1
        assert abs(float(reward.std()) - NOISE) < 0.06
    assert not torch.equal(HybridBandit.draw(4).worth, bandit.worth)


def test_score_counts_each_part_and_both() -> None:
    bandit = HybridBandit.draw(0)
    best = int(bandit.worth.argmax())
    there, off = bandit.modes[best], bandit.modes[best] + 0.25
    w = torch.stack([there, off, there, off])
    choice = torch.tensor([best, best, (best + 1) % CHOICES, (best + 1) % CHOICES])
    assert bandit.score(HybridAction(w, choice)) == {"right_choice": 0.5, "near_mode": 0.5, "both": 0.25}


def test_a_clone_learns_each_choice_with_its_own_displacement() -> None:
    bandit = HybridBandit.draw(0)
    torch.manual_seed(0)
    network = NetworkConfig(kind="mlp", width=32, depth=2)
    agent = make_agent(SPACES, GaussianBcConfig(network=network, batch_size=64, learning_rate=5e-3))
    fit_bandit(agent, bandit, 400, 0)
    assert all(group["lr"] < 1e-6 for one in agent.optimisers.values() for group in one.param_groups)
    action = samples(agent, 1)
    assert float(((action.continuous - bandit.modes[action.choice]).norm(dim=1) < 0.3).float().mean()) > 0.9
    assert len(action.choice.unique()) == CHOICES


def test_every_episode_ends_after_its_one_step_and_rewards_are_shifted() -> None:
    bandit = HybridBandit.draw(0)
    batch = bandit.batch(2.0)
    assert bool((batch.terminated == 1.0).all())
    torch.testing.assert_close(batch.reward, bandit.reward - 2.0)
