"""d3rlpy's losses on our networks: `python -m benchmarks.peers.losses_theirs OUT` prints them beside ours."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from benchmarks.peers import point_mass, settings, theirs


def _fill(module: Any, tensors: list[torch.Tensor], last: str = "_fc") -> None:
    """Weights and biases of a perceptron of two hidden layers."""
    own = [module._encoder._layers[0], module._encoder._layers[2], getattr(module, last)]
    for layer, weight, bias in zip(own, tensors[::2], tensors[1::2], strict=True):
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)


def _learner(name: str, file: Any) -> Any:
    """d3rlpy's implementation with our networks, its temperature at its start."""
    config = theirs.config(name)
    if name == "cql":
        config.temp_learning_rate = 0.0
        config.n_action_samples = settings.PENALTY_SAMPLES
    algorithm = config.create(device="cpu:0")
    algorithm.create_impl((point_mass.OBSERVATION,), point_mass.ACTION)
    modules = algorithm.impl._modules

    def stored(network: str) -> list[torch.Tensor]:
        return [torch.as_tensor(file[f"{name}.{network}.{i}"]) for i in range(6)]

    for index in range(2):
        _fill(modules.q_funcs[index], stored(f"critic{index}"))
        _fill(modules.targ_q_funcs[index], stored(f"target{index}"))
    _fill(modules.policy, stored("actor"), "_mu")
    if name == "iql":
        _fill(modules.value_func, stored("value"))
    else:  # IQL's deviation is a parameter that starts there
        modules.policy._logstd.weight.zero_()
        modules.policy._logstd.bias.fill_(settings.WIDE_LOG_STD)
    return algorithm.impl


def _critic_loss(learner: Any, batch: Any) -> torch.Tensor:
    error: torch.Tensor = learner._q_func_forwarder.compute_error(
        observations=batch.observations,
        actions=batch.actions,
        rewards=batch.rewards,
        target=learner.compute_target(batch),
        terminals=batch.terminals,
        gamma=settings.DISCOUNT,
    )
    return error


@torch.no_grad()
def main(out: Path) -> None:
    """A table of both sides' losses."""
    torch.manual_seed(1)
    with np.load(out / settings.LOSSES, allow_pickle=False) as file:
        rows = {name: torch.as_tensor(file[f"batch.{name}"]) for name in ("observation", "action", "next_observation")}
        reward = torch.as_tensor(file["batch.reward"])[:, None]
        batch = SimpleNamespace(
            observations=rows["observation"],
            actions=rows["action"],
            next_observations=rows["next_observation"],
            rewards=reward,
            terminals=torch.zeros_like(reward),
            returns_to_go=torch.zeros_like(reward),
        )
        many = SimpleNamespace(observations=batch.observations.repeat_interleave(settings.PENALTY_SAMPLES, dim=0))
        iql, cql = _learner("iql", file), _learner("cql", file)
        gap = cql._compute_conservative_loss(
            batch.observations, batch.actions, batch.next_observations, batch.returns_to_go
        ).sum()
        # theirs is weighted, less a threshold, and a sum where ours is a mean over 3 N
        constant = cql._alpha_threshold - math.log(3 * settings.PENALTY_SAMPLES)
        losses = {
            "iql_value": iql.compute_value_loss(batch),
            "iql_critic": _critic_loss(iql, batch),
            "iql_actor": iql.compute_actor_loss(batch, iql._modules.policy(batch.observations)).actor_loss,
            "cql_bellman": _critic_loss(cql, batch),
            "cql_penalty": gap / settings.CQL_WEIGHT + 2 * constant,
            "cql_actor": cql.compute_actor_loss(many, cql._modules.policy(many.observations)).actor_loss,
        }
        print("| loss | d3rlpy | uavrl |\n|---|---|---|")
        for name, loss in losses.items():
            print(f"| {name} | {float(loss):.5f} | {float(file[f'loss.{name}']):.5f} |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]))
