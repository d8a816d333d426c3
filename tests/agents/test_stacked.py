from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch

from tests.agents.problems import KINDS, Kind, batch, copies, diffusion_sac
from uavrl.actions import HybridAction
from uavrl.agents.base import Batch
from uavrl.agents.diffusion_sac import DiffusionSac
from uavrl.agents.stacked import StackedDiffusionSac
from uavrl.training.checkpoint import agent_tensors, restore_agent

SEEDS, ROWS = 3, 16
SETTINGS: list[dict[str, Any]] = [
    {},
    {
        "gradient": "full_chain",
        "cql_weight": 0.3,
        "cql_samples": 2,
        "q_scale": "absolute",
        "guidance": "straight_through",
    },
    {"gradient": "last_k", "gradient_steps": 2, "bc_weight": 0.0, "cql_weight": 0.2, "cql_samples": 0, "huber": None},
    {"bc_weight": 1.0, "action_noise": 0.0, "pinned_level": True, "discount_per": "second", "gradient_clip": None},
    {"gradient_clip": 0.05, "greedy_choice": False, "final_action_noise": 0.02, "weight_decay": 0.1},
    {"diffusion": {"sampler": "ddim", "ddim_eta": 0.5}, "gradient": "full_chain", "network": {"layer_norm": True}},
]


def made(kind: Kind, settings: dict[str, Any]) -> list[DiffusionSac]:
    return [diffusion_sac(kind, seed=seed, **{**settings}) for seed in range(SEEDS)]


def generators() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(10 + seed) for seed in range(SEEDS)]


def together(batches: Sequence[Batch]) -> Batch:
    def seen(name: str) -> Any:
        parts = [getattr(one, name) for one in batches]
        if isinstance(parts[0], dict):
            return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
        return torch.cat(parts)

    action = HybridAction(*(torch.cat([one.action[entry] for one in batches]) for entry in range(2)))
    names = ("observation", "reward", "duration_s", "terminated", "next_observation")
    return replace(batches[0], action=action, **{name: seen(name) for name in names}).grouped(len(batches))


def teach(
    kind: Kind, agents: list[DiffusionSac], stack: StackedDiffusionSac | None, noise: list[torch.Generator], first: int
) -> list[dict[str, float]]:
    """Two updates of each, alone or stacked; the last one's metrics."""
    for update in range(first, first + 2):
        batches = [batch(kind, ROWS, 100 * seed + update) for seed in range(SEEDS)]
        agents[0].progress = update / 4
        for agent in agents:
            agent.progress = update / 4
        if stack is None:
            metrics = [agent.update(rows, one) for agent, rows, one in zip(agents, batches, noise, strict=True)]
        else:
            metrics = stack.update(together(batches), noise)
    return [{name: float(value) for name, value in one.items()} for one in metrics]


def close(first: DiffusionSac, second: DiffusionSac) -> None:
    """Nearly equal weights: of the entries whose gradient is rounding error alone Adam makes a whole step."""
    for name, value in first.networks.state_dict().items():
        far = (value - second.networks.state_dict()[name]).abs() > 2e-5
        assert far.float().mean() < 0.02, name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("settings", SETTINGS)
def test_stacked_learners_learn_what_each_would_learn_alone(kind: Kind, settings: dict[str, Any]) -> None:
    alone, stacked = made(kind, settings), made(kind, settings)
    started = [copies(agent.networks) for agent in stacked]
    expected = teach(kind, alone, None, generators(), 0)
    found = teach(kind, stacked, StackedDiffusionSac(stacked), generators(), 0)
    for mine, theirs in zip(found, expected, strict=True):
        assert mine == pytest.approx(theirs, rel=2e-3, abs=2e-4)
    for one, other, before in zip(stacked, alone, started, strict=True):
        close(one, other)
        moved = [name for name, value in one.networks.state_dict().items() if not torch.equal(value, before[name])]
        assert {name.split(".")[0] for name in moved} == {"actor", "critic", "target"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_stack_goes_on_from_its_agents_and_an_agent_from_a_stack(kind: Kind) -> None:
    alone, first = made(kind, {}), made(kind, {})
    noise, stacked_noise = generators(), generators()
    teach(kind, alone, None, noise, 0)
    teach(kind, first, StackedDiffusionSac(first), stacked_noise, 0)
    saved = [agent_tensors(agent) for agent in first]
    stacks, singles = made(kind, {}), made(kind, {})
    for agents in (stacks, singles):
        for agent, tensors in zip(agents, saved, strict=True):
            restore_agent(agent, {file: {k: v.clone() for k, v in one.items()} for file, one in tensors.items()})
    states = [one.get_state() for one in stacked_noise]
    expected = teach(kind, alone, None, noise, 2)
    for agents, stack in ((stacks, StackedDiffusionSac(stacks)), (singles, None), (first, None)):
        again = generators()
        for generator, state in zip(again, states, strict=True):
            generator.set_state(state)
        for mine, theirs in zip(teach(kind, agents, stack, again, 2), expected, strict=True):
            assert mine == pytest.approx(theirs, rel=5e-3, abs=5e-4)
        for one, other in zip(agents, alone, strict=True):
            close(one, other)
            steps = [state["step"] for optimiser in one.optimisers.values() for state in optimiser.state.values()]
            assert {float(step) for step in steps} == {4.0}


def test_agents_of_a_stack_act_with_its_weights() -> None:
    agents = made("devices", {})
    stack = StackedDiffusionSac(agents)
    teach("devices", agents, stack, generators(), 0)
    for row, agent in enumerate(agents):
        for name, value in agent.networks.named_parameters():
            assert value.data_ptr() == stack.tensors[name][row].data_ptr()


def test_agents_of_different_settings_or_ages_are_refused() -> None:
    with pytest.raises(ValueError, match="equal spaces and settings"):
        StackedDiffusionSac([diffusion_sac("mlp"), diffusion_sac("mlp", bc_weight=0.5)])
    with pytest.raises(ValueError, match="at least one"):
        StackedDiffusionSac([])
    ahead, fresh = diffusion_sac("mlp"), diffusion_sac("mlp")
    ahead.update(batch("mlp", ROWS), torch.Generator().manual_seed(0))
    for order in ([ahead, fresh], [fresh, ahead]):
        with pytest.raises(ValueError, match="equally many updates"):
            StackedDiffusionSac(order)
