"""Time of a decision of an exported policy, end to end, beside its network's matrix products alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from uavrl.agents.base import Agent
from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.one_step import OneStepConfig
from uavrl.agents.registry import changed, make_agent, preset
from uavrl.benchmarks.timing import rate
from uavrl.benchmarks.train import Products
from uavrl.datasets import load_builtin
from uavrl.deployment.export import export
from uavrl.deployment.runtime import Policy
from uavrl.networks import fit_normalisers
from uavrl.scenario import Scenario, load_scenario
from uavrl.training.batches import OBSERVATION_OF, spaces_of, to_tensors

AIRCRAFT = 10_000  # of a ground station's batch
WARM_UP = 50


class Case(NamedTuple):
    """A preset of Diffusion-SAC with a chain of so many steps, or its one-step student (1), and who says the device."""

    preset: str
    steps: int
    critic: bool = False


# The set network of the default, without and with its critic; and the paper's perceptron, 3 x 256.
CASES = {
    "one_step": Case("default", 1),
    "five_step": Case("default", 5),
    "fifty_step": Case("default", 50),
    "one_step_critic": Case("default", 1, critic=True),
    "five_step_critic": Case("default", 5, critic=True),
    "paper_one_step": Case("paper", 1),
    "paper_five_step": Case("paper", 5),
    "paper_fifty_step": Case("paper", 50),
}


def settings(case: Case) -> DiffusionSacConfig | OneStepConfig:
    """The preset with the case's number of steps, or a student of it."""
    config = preset("diffusion_sac", case.preset)
    if case.steps == 1:
        choice = "critic" if case.critic else "student"
        student = {"teacher": config.model_dump(), "network": config.network, "choice": choice}
        student["shortest_move"] = config.shortest_move
        return OneStepConfig.model_validate(student)
    return changed(config, {"diffusion": {"steps": case.steps}, "greedy_choice": case.critic})  # type: ignore[return-value]  # of its own type


def times_s(call: Callable[[int], Any], seconds: float) -> NDArray[np.float64]:
    """Durations of call(0), call(1), ... for about `seconds`, after a warm-up."""
    for index in range(WARM_UP):
        call(index)
    found: list[float] = []
    end = time.perf_counter() + seconds
    while not found or time.perf_counter() < end:
        began = time.perf_counter()
        call(len(found))
        found.append(time.perf_counter() - began)
    return np.array(found)


def floor_s(products: Products, each_s: float) -> float:
    """All products one after another in NumPy, each kind with the matrix in its faster order, timed for `each_s`."""
    total = 0.0
    for (first, second), times in products.found.items():
        a, b = np.ones(first.shape, dtype=np.float32), np.ones(second.shape, dtype=np.float32)
        turned = np.ascontiguousarray(np.swapaxes(b, -1, -2)).swapaxes(-1, -2)
        out = a @ b
        fastest = max(
            rate(lambda a=a, b=matrix, out=out: np.matmul(a, b, out=out), seconds=each_s / 2).per_s  # type: ignore[misc]  # bound now
            for matrix in (b, turned)
        )
        total += times / fastest
    return total


def measure(name: str, seconds: float, scenario: Scenario | None = None) -> dict[str, float]:
    """`Exported.figures` of one of `CASES`, untrained, which changes no time."""
    scenario = load_scenario("released") if scenario is None else scenario
    config = settings(CASES[name])
    with torch.random.fork_rng(devices=[]):
        agent = make_agent(spaces_of(scenario, config.network.kind), config)
    logged, _ = load_builtin("layouts").observations(OBSERVATION_OF[config.network.kind], scenario)
    fit_normalisers(agent.networks, to_tensors(logged))
    exported = Exported(agent, scenario)
    return exported.figures(name, exported.times_s(seconds), seconds)


class Exported:
    """An agent's file, loaded, beside logged observations that it decides on.

    Args:
        agent: is exported.
        scenario: of the observations.
        sampled: its samples, drawing the noise included; else its deterministic action.
    """

    def __init__(self, agent: Agent, scenario: Scenario, *, sampled: bool = False) -> None:
        self.agent, self.sampled = agent, sampled
        self.logged, _ = load_builtin("layouts").observations(OBSERVATION_OF[agent.config.network.kind], scenario)
        with tempfile.TemporaryDirectory() as folder:
            export(agent, scenario, Path(folder) / "policy.onnx", sampled=sampled)
            self.policy = Policy(Path(folder) / "policy.onnx")
        self.count = len(next(iter(self.logged.values())) if isinstance(self.logged, dict) else self.logged)

    def _rows(self, index: slice | int) -> Any:
        if isinstance(self.logged, dict):
            return {key: value[index] for key, value in self.logged.items()}
        return self.logged[index]

    def times_s(self, seconds: float) -> NDArray[np.float64]:
        """Of `Policy.decide` for one aircraft (n,), for about `seconds`."""
        singles = [self._rows(index) for index in range(min(self.count, 1000))]
        return times_s(lambda index: self.policy.decide(singles[index % len(singles)]), seconds)

    def figures(self, name: str, taken_s: NDArray[np.float64], seconds: float) -> dict[str, float]:
        """Milliseconds of `taken_s` and the floor, decisions a second for `AIRCRAFT` at once; `name` opens the keys.

        The floor is the products of one decision with each of the network's matrices, one after another.
        """
        products, noise = Products(), torch.zeros((1, *self.agent.noise_shape(self.agent.spaces.choices)))
        with products, torch.no_grad():
            self.agent.decide(to_tensors(self._rows(slice(0, 1))), noise if self.sampled else None)
        many = self._rows(slice(0, AIRCRAFT))
        batch = rate(lambda: self.policy.decide(many), work=min(self.count, AIRCRAFT), seconds=seconds, repeats=3)
        return {
            f"{name}_ms": 1e3 * float(np.median(taken_s)),
            f"{name}_p99_ms": 1e3 * float(np.percentile(taken_s, 99)),
            f"{name}_floor_ms": 1e3 * floor_s(products, min(0.1, seconds)),
            **batch.named(f"{name}_batch_decisions"),
        }
