"""Hybrid SAC learning online on the vector environment, its whole training logged: where the offline data come from."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uavrl.agents.sac import Sac, SacConfig
from uavrl.datasets.replay import ReplayLog
from uavrl.datasets.transitions import Transitions, transition_columns
from uavrl.errors import CheckpointError, ConfigError, DivergenceError
from uavrl.evaluation.rollouts import EVALUATION_SEED, fixed_layout
from uavrl.networks import fit_normalisers
from uavrl.scenario import Scenario
from uavrl.simulation.dynamics import may_terminate
from uavrl.simulation.environment import ENVIRONMENT_ID, DataCollectionVectorEnv
from uavrl.simulation.state import FlightAction, Outcome, SimState
from uavrl.training.batches import OBSERVATION_OF, RewardTransform, spaces_of, to_batch, to_tensors
from uavrl.training.checkpoint import (
    agent_tensors,
    load_checkpoint,
    numpy_state,
    recover,
    restore_agent,
    save_checkpoint,
    set_numpy_state,
)
from uavrl.training.interrupts import held_interrupts
from uavrl.training.log import MetricsLog, Reporter


class CollectConfig(BaseModel):
    """A run of online learning."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scenario: Scenario
    layouts: Literal["fixed", "random"] = Field(description="one layout throughout, or a new one each episode")
    agent: SacConfig = SacConfig()
    episodes: int = Field(700, ge=1, description="flights to log")
    environments: int = Field(8, ge=1, description="flights at a time")
    random_steps: int = Field(10_000, ge=0, description="steps of uniformly random actions at the start")
    steps_per_update: int = Field(8, ge=1, description="environment steps for each gradient step")
    centre_every: int = Field(500, ge=1, description="updates between re-centrings of the reward")
    seed: int = Field(0, ge=0, lt=EVALUATION_SEED, description="of layouts, starts, fading, exploration and weights")


class OnlineLearner:
    """Hybrid SAC with its environment and its log; `run` goes on from wherever it stands.

    Rewards are centred on the median of the newest ones and Q on its mean over the newest states (reward centring, Naik
    et al. 2024, arXiv:2405.09999): the policy improves faster than Q could travel to a new level, and only differences
    of Q matter to it. Not where an episode can terminate: there the level is what ending it is compared with.
    """

    def __init__(self, config: CollectConfig) -> None:
        self.config = config
        scenario = config.scenario
        how = config.agent.reward.transform
        if how in ("zscore", "robust"):
            raise ConfigError(f"reward.transform = '{how}' needs all data, allowed while collecting: 'centred', 'none'")
        self.kind = OBSERVATION_OF[config.agent.network.kind]
        environment = gymnasium.make_vec(
            ENVIRONMENT_ID,
            num_envs=config.environments,
            vectorization_mode="vector_entry_point",
            scenario=scenario,
            layout=fixed_layout(scenario) if config.layouts == "fixed" else None,
            observation=self.kind,
        )
        if not isinstance(environment.unwrapped, DataCollectionVectorEnv):
            raise ConfigError(f"{ENVIRONMENT_ID} is registered by another package")
        self.environment = environment.unwrapped
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.agent = Sac(spaces_of(scenario, config.agent.network.kind), config.agent)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.numbers = np.random.default_rng([config.seed, 1])
        self.log = ReplayLog(scenario.traffic.devices)
        self.observation, _ = self.environment.reset(seed=config.seed)
        self.episode = np.arange(config.environments)
        self.returns = np.zeros(config.environments)
        self.ended = np.zeros(config.environments, dtype=bool)
        self.finished = 0
        self.updates = 0
        self.saved: int | None = None  # the step of the last checkpoint
        reward = config.agent.reward
        self.seen = RewardTransform(0.0, reward.scale, reward.clip, config.agent.discount_per == "second")
        self.centres = reward.transform == "centred" and not may_terminate(scenario)

    def _act(self) -> FlightAction:
        reach = self.config.scenario.airframe.max_displacement_m
        count = self.config.environments
        if len(self.log) < self.config.random_steps:
            continuous = self.numbers.uniform(-1.0, 1.0, (count, 2))
            return FlightAction(continuous * reach, self.numbers.integers(0, self.agent.spaces.choices, count))
        action = self.agent.act(to_tensors(self.observation), generator=self.generator)
        return FlightAction(action.continuous.double().numpy() * reach, action.choice.numpy())

    def _fly(self) -> list[float]:
        """One step of every environment, logged; the returns of the flights that ended in it."""
        action, before = self._act(), self.environment.state
        self.observation, reward, terminated, truncated, info = self.environment.step(
            {"displacement_m": action.displacement_m, "device": action.device}
        )
        fresh = self.ended  # the environment reset these instead of stepping them
        live = ~fresh & (self.episode < self.config.episodes)
        outcome = Outcome(**{name: info[name] for name in Outcome._fields})
        columns = transition_columns(
            self.environment.layout_m, before, action, self.environment.state, outcome, self.episode, before.step
        )
        self.log.append(columns, keep=live)
        self.returns = np.where(fresh, 0.0, self.returns + reward)
        self.ended = terminated | truncated
        done = [float(value) for value in self.returns[self.ended & live]]
        self.finished += len(done)
        if self.ended.any():
            following = self.episode.max() + 1 + np.arange(self.ended.sum())
            self.episode = self.episode.copy()
            self.episode[self.ended] = following
        return done

    def _recentre(self) -> None:
        """Zero of the reward: the median of the newest rewards; zero of Q: its mean over the newest states."""
        newest = self.log.take(np.arange(max(0, len(self.log) - 5_000), len(self.log)))
        self.seen = RewardTransform.fitted(newest.reward, newest.duration_s, self.config.agent, terminates=False)
        batch = to_batch(newest.take(slice(-1_000, None)), self.kind, self.config.scenario)
        with torch.no_grad():
            critic = self.agent.critic
            q = critic.all_choices(critic.encode(batch.observation), batch.action.continuous)
            level = float(q.gather(2, batch.action.choice.expand(2, -1)[..., None]).mean())
        self.agent.critic.shift(-level)
        self.agent.target.shift(-level)

    def _learn(self) -> dict[str, torch.Tensor]:
        if self.updates == 0:
            first = self.log.take(np.arange(len(self.log)))
            fit_normalisers(self.agent.networks, to_tensors(first.observations(self.kind, self.config.scenario)[0]))
        if self.centres and self.updates % self.config.centre_every == 0:
            self._recentre()
        rows = self.numbers.integers(0, len(self.log), self.config.agent.batch_size)
        batch = to_batch(self.log.take(rows), self.kind, self.config.scenario)
        batch = replace(batch, reward=self.seen(batch.reward, batch.duration_s))
        self.updates += 1
        metrics = self.agent.update(batch, self.generator)
        for name in ("critic_loss", "actor_loss"):  # each time: the next action of a policy of NaN cannot be drawn
            if not metrics[name].isfinite():
                kept = "no checkpoint had been saved"
                if self.saved is not None:
                    kept = f"the checkpoint keeps step {self.saved}, the last good one"
                raise DivergenceError(
                    f"training diverged: {name} = {float(metrics[name])} after {self.updates} updates; {kept}; "
                    "try another run with a smaller learning_rate"
                )
        return metrics

    def run(
        self, directory: Path, report: Reporter, save_every: int = 20_000, *, tensorboard: bool = False
    ) -> Transitions:
        """Fly and learn until all episodes are logged; checkpoints every `save_every` steps and on interrupt.

        Raises:
            ConfigError: `tensorboard`, which is not installed.
            DivergenceError: a loss is not finite; the last checkpoint stays.
        """
        recent: list[float] = []
        board = directory / "tensorboard" if tensorboard else None
        with closing(MetricsLog(directory / "metrics.jsonl", board)) as log, held_interrupts() as interrupted:
            log.cut(len(self.log))
            while self.finished < self.config.episodes:
                for value in self._fly():
                    recent = [*recent[-19:], value]
                    log.write({"step": len(self.log), "episode": self.finished, "return": value})
                if len(self.log) >= self.config.random_steps:
                    while self.updates * self.config.steps_per_update < len(self.log) - self.config.random_steps:
                        metrics = self._learn()
                        if self.updates % 1000 == 0:
                            row = {name: float(value) for name, value in metrics.items()}
                            log.write({"step": len(self.log), "updates": self.updates, "centre": self.seen.level} | row)
                mean = f", return {np.mean(recent):.0f} (last {len(recent)})" if recent else ""
                report(self.finished, f"step {len(self.log):,}{mean}")
                stop = interrupted()
                if stop or len(self.log) - (self.saved or 0) >= save_every:
                    self.save(directory)
                if stop:
                    raise KeyboardInterrupt
        self.save(directory)
        return self.log.to_transitions()

    def save(self, directory: Path) -> None:
        """Everything that `resume` needs, into directory/checkpoint."""
        document = {
            "kind": "online",
            "agent": self.config.agent.name,
            "config": self.config.agent.model_dump(mode="json"),
            "spaces": self.agent.spaces.model_dump(),
            "scenario": self.config.scenario.model_dump(mode="json"),
            "collect": self.config.model_dump(mode="json"),
            "step": len(self.log),
            "finished": self.finished,
            "updates": self.updates,
            "centre": self.seen.level,
            "numbers": numpy_state(self.numbers),
            "environment": numpy_state(self.environment.np_random),
        }
        state = {
            f"state.{name}": torch.from_numpy(value.copy()) for name, value in self.environment.state._asdict().items()
        }
        loop = {
            "layout_m": torch.from_numpy(self.environment.layout_m.copy()),
            "episode": torch.from_numpy(self.episode.copy()),
            "returns": torch.from_numpy(self.returns.copy()),
            "ended": torch.from_numpy(self.ended.copy()),
            "generator": self.generator.get_state(),
        }
        rows = {name: torch.from_numpy(value) for name, value in self.log.state_dict().items()}
        tensors = agent_tensors(self.agent) | {"loop": state | loop, "log": rows}
        save_checkpoint(directory / "checkpoint", document, tensors)
        self.saved = len(self.log)

    @classmethod
    def resume(cls, directory: Path) -> OnlineLearner | None:
        """The learner as it stood at its last checkpoint, None where there is none.

        Raises:
            CheckpointError: a damaged checkpoint.
        """
        path = recover(directory / "checkpoint")
        if path is None:
            return None
        checkpoint = load_checkpoint(path)
        document, tensors = checkpoint.document, checkpoint.tensors
        if document.get("kind") != "online":
            raise CheckpointError(f"checkpoint '{path}' is of kind {document.get('kind')!r}, allowed: 'online'")
        try:
            learner = cls(CollectConfig.model_validate(document["collect"]))
        except (KeyError, ValidationError):
            raise CheckpointError(f"checkpoint '{path}' holds no run of this version of uavrl") from None
        restore_agent(learner.agent, tensors)
        loop = {name: tensor.numpy() for name, tensor in tensors["loop"].items()}
        learner.log.load_state_dict({name: tensor.numpy() for name, tensor in tensors["log"].items()})
        learner.environment.restore(
            SimState(**{name: loop[f"state.{name}"] for name in SimState._fields}),
            loop["layout_m"],
            loop["ended"],
        )
        set_numpy_state(learner.environment.np_random, document["environment"])
        set_numpy_state(learner.numbers, document["numbers"])
        learner.generator.set_state(tensors["loop"]["generator"])
        learner.episode, learner.returns, learner.ended = loop["episode"], loop["returns"], loop["ended"]
        learner.finished, learner.updates = document["finished"], document["updates"]
        learner.seen = learner.seen._replace(level=document["centre"])
        learner.saved = len(learner.log)
        learner.observation = learner.environment.observation()
        return learner
