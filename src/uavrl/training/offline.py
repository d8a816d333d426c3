"""Learning from logged transitions alone."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uavrl.actions import HybridAction
from uavrl.agents.base import Batch
from uavrl.agents.registry import OfflineConfig, make_agent
from uavrl.datasets.transitions import Transitions
from uavrl.errors import CheckpointError, ConfigError, DivergenceError
from uavrl.evaluation.rollouts import EVALUATION_SEED
from uavrl.networks import Observation, fit_normalisers
from uavrl.scenario import Scenario
from uavrl.training.batches import OBSERVATION_OF, reward_transform, spaces_of, to_batch, transformed
from uavrl.training.checkpoint import agent_tensors, load_checkpoint, recover, restore_agent, save_checkpoint
from uavrl.training.interrupts import held_interrupts
from uavrl.training.log import MetricsLog, Reporter
from uavrl.training.policy import AgentPolicy

Evaluator = Callable[[AgentPolicy], dict[str, float]]

PRESET_UPDATES = {"default": 30_000, "paper": 70_000}  # the paper: J = 150 passes over 30 k rows in batches of 64


class TrainConfig(BaseModel):
    """A run of offline learning, all but its data."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scenario: Scenario
    agent: OfflineConfig
    updates: int = Field(PRESET_UPDATES["default"], ge=1, description="gradient steps")
    decay: Literal["none", "cosine"] = Field("cosine", description="learning rate over the run: constant, or to 0")
    seed: int = Field(0, ge=0, lt=EVALUATION_SEED, description="of weights, data order and noise")
    log_every: int = Field(200, ge=1, description="updates between rows of metrics.jsonl")
    save_every: int = Field(5_000, ge=1, description="updates between checkpoints")
    evaluate_every: int = Field(0, ge=0, description="updates between trial flights; 0: none")


def _index(observation: Observation, rows: torch.Tensor) -> Observation:
    if isinstance(observation, dict):
        return {key: value.index_select(0, rows) for key, value in observation.items()}
    return observation.index_select(0, rows)


def take(data: Batch, rows: torch.Tensor) -> Batch:
    """Rows of a batch."""
    return Batch(
        observation=_index(data.observation, rows),
        action=HybridAction(data.action.continuous.index_select(0, rows), data.action.choice.index_select(0, rows)),
        reward=data.reward.index_select(0, rows),
        duration_s=data.duration_s.index_select(0, rows),
        terminated=data.terminated.index_select(0, rows),
        next_observation=_index(data.next_observation, rows),
    )


def _to(data: Batch, device: torch.device) -> Batch:
    def move(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: entry.to(device) for key, entry in value.items()}
        if isinstance(value, HybridAction):
            return HybridAction(value.continuous.to(device), value.choice.to(device))
        return value.to(device)

    return Batch(**{field.name: move(getattr(data, field.name)) for field in fields(Batch)})


class OfflineLearner:
    """An agent, its data as tensors, and the generator of data order and noise.

    Raises:
        ConfigError: data of another number of devices than the scenario, or no such device.
    """

    def __init__(self, config: TrainConfig, transitions: Transitions, device: str = "cpu") -> None:
        devices = config.scenario.traffic.devices
        if transitions.devices != devices:
            raise ConfigError(f"the data have {transitions.devices} devices, the scenario traffic.devices = {devices}")
        if device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("device = 'cuda', but torch finds no GPU; allowed here: 'cpu'")
        self.config, self.device = config, torch.device(device)
        kind = OBSERVATION_OF[config.agent.network.kind]
        data = to_batch(transitions, kind, config.scenario)
        terminates = config.scenario.limits.energy_budget_j is not None
        reward = config.agent.reward
        self.shift, factor = reward_transform(transitions.reward, reward, terminates)
        data = Batch(
            **{field.name: getattr(data, field.name) for field in fields(Batch) if field.name != "reward"},
            reward=transformed(data.reward, self.shift, factor, reward),
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.agent = make_agent(spaces_of(config.scenario, config.agent.network.kind), config.agent)
        fit_normalisers(self.agent.networks, data.observation)
        self.agent.networks.to(self.device)
        self.data = _to(data, self.device)
        self.generator = torch.Generator(self.device).manual_seed(config.seed)
        self.digest = transitions.digest()
        self.updates = 0
        # |Q| of transformed rewards cannot exceed this; ten times beyond it nothing is learned any more
        largest = float(data.reward.abs().max())
        per = (
            config.agent.discount
            if config.agent.discount_per == "step"
            else config.agent.discount ** float(data.duration_s.mean())
        )
        self.q_limit = 10.0 * max(largest, 1.0) / (1.0 - per)

    def _rate(self) -> float:
        base = self.config.agent.learning_rate
        if self.config.decay == "none":
            return base
        return base * 0.5 * (1.0 + math.cos(math.pi * self.updates / self.config.updates))

    def step(self) -> dict[str, torch.Tensor]:
        """One update on a fresh minibatch."""
        rate = self._rate()
        for optimiser in self.agent.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = rate
        count = len(self.data.reward)
        shape = (self.config.agent.batch_size,)
        rows = torch.randint(0, count, shape, generator=self.generator, device=self.device)
        metrics = self.agent.update(take(self.data, rows), self.generator)
        self.updates += 1
        return metrics

    def run(self, directory: Path, report: Reporter, evaluate: Evaluator | None = None) -> AgentPolicy:
        """Update until the end, with checkpoints, metrics and trial flights; saves on interrupt.

        Raises:
            DivergenceError: a metric is not finite, or Q beyond any possible return; the last checkpoint stays.
        """
        log = MetricsLog(directory / "metrics.jsonl")
        log.cut(self.updates)
        policy = AgentPolicy(self.config.agent.name, self.agent, self.config.scenario)
        config, text = self.config, ""
        with held_interrupts() as interrupted:
            while self.updates < config.updates:
                metrics = self.step()
                stop = interrupted()
                logs = self.updates % config.log_every == 0 or self.updates == config.updates
                saves = self.updates % config.save_every == 0 or stop
                if logs or saves:  # nothing is saved that has not been looked at
                    row = {name: float(value) for name, value in metrics.items()}
                    self._check(row)
                if logs:
                    log.write({"step": self.updates} | row)
                    shown = ("q", "critic_loss", "bc_loss")
                    text = ", ".join(f"{name} {row[name]:.3g}" for name in shown if name in row)
                if evaluate and config.evaluate_every and self.updates % config.evaluate_every == 0:
                    flown = evaluate(policy)
                    log.write({"step": self.updates} | flown)
                if saves:
                    self.save(directory)
                if stop:
                    raise KeyboardInterrupt
                report(self.updates, text)
        self.save(directory)
        return policy

    def _check(self, row: dict[str, float]) -> None:
        for name, value in row.items():
            if not math.isfinite(value):
                raise DivergenceError(f"training diverged: {name} = {value} after {self.updates} updates")
        if abs(row.get("q", 0.0)) > self.q_limit:
            raise DivergenceError(
                f"training diverged: q = {row['q']:.3g} after {self.updates} updates, allowed: +-{self.q_limit:.3g}; "
                "try a smaller learning_rate or a larger bc_weight"
            )

    def save(self, directory: Path) -> None:
        """Everything that `resume` needs, into directory/checkpoint."""
        document = {
            "kind": "offline",
            "agent": self.config.agent.name,
            "config": self.config.agent.model_dump(mode="json"),
            "spaces": self.agent.spaces.model_dump(),
            "scenario": self.config.scenario.model_dump(mode="json"),
            "train": json.loads(self.config.model_dump_json()),
            "data": {"rows": len(self.data.reward), "sha256": self.digest},
            "step": self.updates,
            "device": self.device.type,
        }
        tensors = agent_tensors(self.agent) | {"loop": {"generator": self.generator.get_state()}}
        save_checkpoint(directory / "checkpoint", document, tensors)

    @classmethod
    def resume(cls, directory: Path, transitions: Transitions, device: str = "cpu") -> OfflineLearner | None:
        """The learner as it stood at its last checkpoint, None where there is none.

        Raises:
            CheckpointError: a damaged checkpoint, or one trained on other data.
        """
        path = recover(directory / "checkpoint")
        if path is None:
            return None
        checkpoint = load_checkpoint(path)
        if checkpoint.document.get("kind") != "offline":
            raise CheckpointError(f"checkpoint '{path}' is of kind {checkpoint.document.get('kind')!r}, not 'offline'")
        try:
            config = TrainConfig.model_validate(checkpoint.document["train"])
            made_on = checkpoint.document["device"]
        except (KeyError, ValidationError):
            raise CheckpointError(f"checkpoint '{path}' holds no run of this version of uavrl") from None
        if made_on != device:  # their generators differ
            raise CheckpointError(f"checkpoint '{path}' was made with device = '{made_on}', go on with the same")
        learner = cls(config, transitions, device)
        if learner.digest != checkpoint.document["data"]["sha256"]:
            raise CheckpointError(f"checkpoint '{path}' was trained on other data; give the same --data")
        restore_agent(learner.agent, checkpoint.tensors)
        learner.generator.set_state(checkpoint.tensors["loop"]["generator"])
        learner.updates = checkpoint.document["step"]
        return learner
