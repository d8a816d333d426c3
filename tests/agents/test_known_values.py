"""Small problems whose answer is known: a chain of two states, and bandits."""

from __future__ import annotations

import math
from typing import Literal

import pytest
import torch
from torch import Tensor

from uavrl.actions import HybridAction
from uavrl.agents.base import Batch
from uavrl.agents.bc import BcConfig, BehaviourCloning
from uavrl.agents.diffusion_actor import DiffusionConfig
from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig
from uavrl.agents.sac import Sac, SacConfig
from uavrl.experiments.ablation import BANDIT, UPDATES
from uavrl.experiments.bandit import SPACES, HybridBandit, fit_bandit, samples
from uavrl.networks import NetworkConfig, Spaces, fit_normalisers

GAMMA = 0.5
CHAIN_UPDATES = 250


def chain_batch(rows: int, ended: Literal["terminated", "truncated"], generator: torch.Generator) -> Batch:
    """State 0 pays 1 and leads to state 1, which pays 2 and ends; a truncated end leads back to state 0."""
    state = torch.randint(0, 2, (rows,), generator=generator)
    return Batch(
        observation=state[:, None].float(),
        action=HybridAction(
            2 * torch.rand((rows, 1), generator=generator) - 1, torch.randint(0, 2, (rows,), generator=generator)
        ),
        reward=1.0 + state.float(),
        duration_s=torch.ones(rows),
        terminated=state.float() * (ended == "terminated"),
        next_observation=(1 - state)[:, None].float(),
    )


@pytest.mark.parametrize("ended", ["terminated", "truncated"])
@pytest.mark.parametrize("name", ["sac", "diffusion_sac"])
def test_a_chain_of_two_states_has_its_known_values(name: str, ended: Literal["terminated", "truncated"]) -> None:
    """Terminated: Q(1) = 2, Q(0) = 1 + gamma 2. Truncated it goes on for ever: Q(0) = (1 + 2 gamma) / (1 - gamma^2)."""
    network = NetworkConfig(kind="mlp", width=16, depth=1, log_inputs=False)
    spaces = Spaces(observation=1, continuous=1, choices=2)
    torch.manual_seed(0)
    made: Sac | DiffusionSac
    if name == "sac":  # next to no entropy in its values
        made = Sac(
            spaces,
            SacConfig(network=network, learning_rate=1e-2, discount=GAMMA, polyak=0.1, initial_temperature=1e-6),
        )
        made.optimisers["temperature"].param_groups[0]["lr"] = 0.0
    else:
        made = DiffusionSac(spaces, DiffusionSacConfig(network=network, learning_rate=1e-2, discount=GAMMA, polyak=0.1))
    generator = torch.Generator().manual_seed(0)
    fit_normalisers(made.networks, chain_batch(100, ended, generator).observation)
    rates = {key: one.param_groups[0]["lr"] for key, one in made.optimisers.items()}
    for step in range(CHAIN_UPDATES):
        made.update(chain_batch(32, ended, generator), generator)
        for key, one in made.optimisers.items():
            one.param_groups[0]["lr"] = rates[key] * (1 - step / CHAIN_UPDATES)
    with torch.no_grad():
        states = torch.tensor([[0.0], [1.0]])
        q = made.critic.all_choices(made.critic.encode(states), torch.zeros(2, 1))
    if ended == "terminated":
        expected = torch.tensor([1 + GAMMA * 2, 2.0])
    else:
        first = (1 + 2 * GAMMA) / (1 - GAMMA**2)
        expected = torch.tensor([first, 2 + GAMMA * first])
    torch.testing.assert_close(q, expected[None, :, None].expand(2, 2, 2), rtol=0.04, atol=0.04)


ACTIONS = 10_000
SIGMA = 0.05  # of the displacement around its mode


def fit(agent: DiffusionSac | BehaviourCloning, w: Tensor, d: Tensor, reward: Tensor, updates: int, seed: int) -> None:
    """Learn a bandit, whose only state is 0, from its logged actions; the learning rate falls on a cosine."""
    generator = torch.Generator().manual_seed(seed)
    count = agent.config.batch_size
    for update in range(updates):
        for optimiser in agent.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = agent.config.learning_rate * 0.5 * (1 + math.cos(math.pi * update / updates))
        rows = torch.randint(0, len(reward), (count,), generator=generator)
        state, one = torch.zeros(count, 1), torch.ones(count)
        agent.update(Batch(state, HybridAction(w[rows], d[rows]), reward[rows], one, one, state), generator)


def sampled(agent: DiffusionSac | BehaviourCloning) -> HybridAction:
    return agent.act(torch.zeros(2_000, 1), generator=torch.Generator().manual_seed(9))


NETWORK = NetworkConfig(kind="mlp", width=128, depth=3)


# Wang et al. 2023, Section 5: corners and mean rewards
CORNERS = torch.tensor([[-0.8, 0.8], [-0.8, -0.8], [0.8, 0.8], [0.8, -0.8]])
WORTH = torch.tensor([3.0, 0.0, 1.5, 5.0])


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", ["diffusion_sac", "bc"])
def test_two_dimensional_bandit_of_diffusion_q_learning(name: str) -> None:
    """Four Gaussians: the guided actor keeps to the best, the cloned one to all four in proportion.

    Fifty steps for the clone, the paper's M: of its samples 50 % lie within .2 of a mode at M = 5, 84 % at 10, 94 % at
    20, since a Gaussian step cannot split a sample between modes that are still near each other in the noise.
    """
    generator = torch.Generator().manual_seed(0)
    corner = torch.randint(0, 4, (ACTIONS,), generator=generator)
    w = (CORNERS[corner] + SIGMA * torch.randn((ACTIONS, 2), generator=generator)).clamp(-1, 1)
    reward = WORTH[corner] + 0.5 * torch.randn(ACTIONS, generator=generator)
    choice = torch.randint(0, 2, (ACTIONS,), generator=generator)  # changes nothing
    spaces = Spaces(observation=1, continuous=2, choices=2)
    torch.manual_seed(0)
    made: DiffusionSac | BehaviourCloning
    if name == "bc":
        made = BehaviourCloning(
            spaces, BcConfig(network=NETWORK, learning_rate=1e-3, diffusion=DiffusionConfig(steps=50))
        )
    else:  # the choice changes nothing, so Q has no spread over it to be scaled by
        config = DiffusionSacConfig(
            network=NETWORK, learning_rate=1e-3, q_scale="absolute", huber=None, action_noise=0.0
        )
        made = DiffusionSac(spaces, config)
    fit(made, w, choice, reward - reward.median(), 5_000, 0)
    action = sampled(made)
    near = (action.continuous[:, None] - CORNERS).norm(dim=2) < 0.2
    shares = near.float().mean(dim=0)
    if name == "bc":
        assert near.any(dim=1).float().mean() >= 0.95
        assert ((shares - 0.25).abs() < 0.05).all(), shares
    else:
        assert shares[3] >= 0.95, shares


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", range(5))
def test_hybrid_bandit_keeps_both_parts_of_the_best_action(seed: int) -> None:
    """Eleven choices, each with a displacement of its own, all logged equally often; rewards .5 apart, noise .5.

    What it takes: the gradient through the whole chain, for one pass from a noised action judges the w logged
    with one choice beside another choice, a pair that no data hold; a displacement that weighs in L_bc; and a little of
    the conservative penalty, without which Q beyond a mode's neighbourhood is extrapolated, and guidance follows it.
    """
    bandit = HybridBandit.draw(seed)
    torch.manual_seed(seed)
    agent = DiffusionSac(SPACES, BANDIT)
    fit_bandit(agent, bandit, UPDATES["bandit"], seed)
    shares = bandit.score(samples(agent, 9))
    assert shares["right_choice"] >= 0.95, shares
    assert shares["near_mode"] >= 0.90, shares
