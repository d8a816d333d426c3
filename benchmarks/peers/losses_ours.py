"""Our losses on random networks: `python -m benchmarks.peers.losses_ours OUT` writes networks, transitions and losses.

Returns say whether two learners end alike, with the spread of their seeds; equal losses of equal networks have none.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.peers import ours, point_mass
from benchmarks.peers.settings import DATA, LOSSES, PENALTY_SAMPLES, WIDE_LOG_STD
from uavrl.agents.cql import Cql, PenaltyNoise
from uavrl.agents.iql import Iql
from uavrl.networks.mlp import LOG_STD_RANGE

ROWS = 8
SPREAD = 2.0  # of the weights over their usual start, so that values differ from zero


def flat(first: list[nn.Module], hidden: nn.Module, out: nn.Module, rows: slice = slice(None)) -> list[Tensor]:
    """Weight and bias of each layer, a first layer in parts joined: a perceptron as d3rlpy holds it."""
    second = next(module for module in hidden.modules() if isinstance(module, nn.Linear))
    joined = torch.cat([part.get_parameter("weight") for part in first], dim=1)
    last = out.get_parameter("weight")[rows], out.get_parameter("bias")[rows]
    return [joined, first[0].get_parameter("bias"), second.weight, second.bias, *last]


def networks(agent: Cql | Iql, mean: slice) -> dict[str, list[Tensor]]:
    """Those of an agent; `mean` are the rows of the actor's output that hold it."""
    named = {}
    for kind in ("critic", "target"):
        for index, name in enumerate(("first", "second")):
            q = agent.networks[kind].get_submodule(name)
            parts = [q.get_submodule("observation"), q.get_submodule("continuous")]
            named[f"{kind}{index}"] = flat(parts, q.get_submodule("hidden"), q.get_submodule("out"))
    for kind, rows in (("actor", mean), ("value", slice(None))):
        if kind in agent.networks:
            network = agent.networks[kind]
            first = network.get_submodule("first" if kind == "actor" else "observation")
            named[kind] = flat([first], network.get_submodule("hidden"), network.get_submodule("out"), rows)
    return named


def spread(agent: Cql | Iql, log_std: slice, raw: float) -> None:
    """Larger weights, a target of its own, and a policy of one width everywhere, `raw` before its bounds."""
    for name, network in agent.networks.items():
        for parameter in network.parameters() if name != "temperature" else ():
            parameter.mul_(SPREAD)
    for parameter in agent.target.parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
    out = agent.actor.get_submodule("out")
    out.get_parameter("weight")[log_std] = 0.0
    out.get_parameter("bias")[log_std] = raw


def raw_log_std(log_std: float) -> float:
    """What `bounded_log_std` turns into `log_std`."""
    low, high = LOG_STD_RANGE
    return math.log((log_std - low) / (high - log_std))


@torch.no_grad()
def main(out: Path) -> None:
    """One .npz: networks, transitions, and each loss by name."""
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    log = {k: torch.as_tensor(v) for k, v in point_mass.transitions(point_mass.load(out / DATA)).items()}
    rows = torch.randint(0, len(log["reward"]), (ROWS,), generator=generator)
    batch = ours.batch(log, rows)

    iql, cql = Iql(ours.SPACES, ours.iql_config()), Cql(ours.SPACES, ours.cql_config())
    spread(iql, slice(3, 5), 0.0)  # an output is logit, mean, deviation; 0 is where d3rlpy starts
    spread(cql, slice(2, 4), raw_log_std(WIDE_LOG_STD))  # mean, deviation, logit
    noise = PenaltyNoise.draw(ROWS, PENALTY_SAMPLES, point_mass.ACTION, generator)
    mean_action = torch.zeros(ROWS, point_mass.ACTION)  # d3rlpy backs up the policy's mean
    many = replace(batch, observation=log["observation"][rows].repeat_interleave(PENALTY_SAMPLES, dim=0))
    normal = torch.randn((ROWS * PENALTY_SAMPLES, point_mass.ACTION), generator=generator)
    _, metrics = cql.critic_loss(batch, mean_action, noise)
    losses = {
        "iql_value": iql.value_loss(batch)[0],
        "iql_critic": 2 * iql.critic_loss(batch)[0],  # ours has a half
        "iql_actor": iql.actor_loss(batch)[0],
        "cql_bellman": 2 * metrics["bellman_loss"],
        "cql_penalty": metrics["cql_penalty"],
        "cql_actor": cql.actor_loss(many, normal)[0],
    }
    arrays = {f"batch.{name}": array[rows] for name, array in log.items()}
    arrays |= {f"loss.{name}": loss for name, loss in losses.items()}
    for learner, agent, mean in (("iql", iql, slice(1, 3)), ("cql", cql, slice(0, 2))):
        for network, tensors in networks(agent, mean).items():
            arrays |= {f"{learner}.{network}.{i}": tensor for i, tensor in enumerate(tensors)}
    plain = {name: array.numpy() for name, array in arrays.items()}
    np.savez(out / LOSSES, allow_pickle=False, **plain)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
