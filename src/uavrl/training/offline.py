"""Learning from logged transitions alone."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Literal, Self

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from uavrl.agents.base import Batch, Metrics
from uavrl.agents.bc import BcConfig
from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.gaussian_bc import GaussianBcConfig
from uavrl.agents.registry import OfflineConfig, make_agent
from uavrl.datasets.mapped import MappedTransitions
from uavrl.datasets.transitions import Transitions
from uavrl.errors import CheckpointError, ConfigError, DivergenceError
from uavrl.evaluation.rollouts import EVALUATION_SEED
from uavrl.networks import fit_normalisers
from uavrl.scenario import Scenario
from uavrl.simulation.dynamics import may_terminate
from uavrl.training.batches import OBSERVATION_OF, MappedRows, RewardTransform, spaces_of, to_batch
from uavrl.training.checkpoint import (
    Checkpoint,
    agent_tensors,
    load_checkpoint,
    recover,
    restore_agent,
    save_checkpoint,
)
from uavrl.training.compilation import Compilation, compile_passes
from uavrl.training.fit import Rows, draw_rows
from uavrl.training.health import Expected
from uavrl.training.interrupts import held_interrupts
from uavrl.training.log import MetricsLog, Reporter
from uavrl.training.policy import AgentPolicy
from uavrl.training.relocation import Relocation, relocated
from uavrl.training.support import Support
from uavrl.training.symmetry import Turn, turned

__all__ = ["PRESET_UPDATES", "Evaluator", "OfflineLearner", "TrainConfig", "began_as", "run_all"]

Evaluator = Callable[[AgentPolicy], dict[str, float]]

# The paper: J = 150 passes over 30 k rows in batches of 64
PRESET_UPDATES = {"default": 12_000, "paper": 70_000}

SAMPLE_ROWS = 100_000  # of mapped data, for statistics: a mean is off by 0.3 % of the deviation


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
    symmetry: bool | None = Field(
        None,
        description="mirror and turn each row of a minibatch at random, as the physics allows; needs a set network. "
        "null: where it has one and discounts by the second",
    )
    relocation: float = Field(
        0.0,
        ge=0,
        le=1,
        description="share of a minibatch whose devices, but for the one that is served, lie elsewhere, as the physics "
        "allows; needs a set network",
    )
    compilation: Compilation = Field("none", description="of the networks' passes, see `compile_passes`")

    @property
    def turns(self) -> bool:
        """Whether rows are mirrored and turned."""
        usual = self.agent.network.kind == "devices" and self.agent.discount_per == "second"
        return usual if self.symmetry is None else self.symmetry

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.symmetry and self.agent.network.kind != "devices":
            raise ValueError(f"symmetry = true needs network.kind = 'devices', not {self.agent.network.kind!r}")
        if self.relocation > 0 and self.agent.network.kind != "devices":
            raise ValueError(
                f"relocation = {self.relocation:g} needs network.kind = 'devices', not {self.agent.network.kind!r}"
            )
        return self


class OfflineLearner:
    """An agent, its data, and the generator of data order and noise.

    Data in memory become tensors at once. Of mapped data each minibatch is read when it is drawn, and statistics (the
    reward's median, mean, deviations, the normalisers', the rows that `Support` knows) are of `SAMPLE_ROWS` rows, the
    same every time, or of all where there are fewer; least and largest reward and the shortest step are of all rows. So
    memory does not grow with mapped data, and up to `SAMPLE_ROWS` rows they train as in memory, bit for bit.

    Logging draws from generators of its own, so how often it happens changes nothing of what is learned.

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
        least, most = transitions.reward.min(), transitions.reward.max()  # first: mapped files are read in order
        self.shortest_s, longest_s = float(transitions.duration_s.min()), float(transitions.duration_s.max())
        known = transitions.sample(SAMPLE_ROWS) if isinstance(transitions, MappedTransitions) else transitions
        if config.agent.discount_per == "second" and self.shortest_s <= 0:
            raise ConfigError("discount_per = 'second', but the data have steps of 0 s; allowed then: 'step'")
        terminates = may_terminate(config.scenario) or bool(known.terminated.any())
        self.seen = RewardTransform.fitted(known.reward, known.duration_s, config.agent, terminates)

        def encode(rows: Transitions) -> Batch:
            batch = to_batch(rows, kind, config.scenario)
            return replace(batch, reward=self.seen(batch.reward, batch.duration_s))

        sample = encode(known)
        agent = config.agent
        if terminates and isinstance(agent, DiffusionSacConfig):
            agent = agent.model_copy(update={"pinned_level": False})  # as the shift: an end is compared with the level
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.agent = make_agent(spaces_of(config.scenario, config.agent.network.kind), agent)
        fit_normalisers(self.agent.networks, sample.observation)
        self.agent.networks.to(self.device)
        compile_passes(self.agent, config.compilation, self.device)
        self.sample = sample.to(self.device)  # what statistics are of
        self.data: Rows = self.sample
        if isinstance(transitions, MappedTransitions):
            self.data = MappedRows(transitions, encode)
        extremes = torch.tensor([least, least, most, most]), torch.tensor([self.shortest_s, longest_s] * 2)
        extreme = self.seen(*extremes)
        self.rewards = (float(extreme.min()), float(extreme.max()))  # no less and no more is the agent given
        self.generator = torch.Generator(self.device).manual_seed(config.seed)
        self.digest = transitions.digest()
        self.updates = 0
        self.saved: int | None = None  # the update of the last checkpoint
        self.support: Support | None = None  # made when first asked: it takes a moment
        self.expected = self._expected()
        # ten times beyond what is possible nothing is learned any more
        self.q_limit = 10.0 * max(1.0 / (1.0 - self._discount()), -self.expected.q[0], self.expected.q[1])

    def _discount(self) -> float:
        """The largest of any transition."""
        agent = self.config.agent
        return agent.discount if agent.discount_per == "step" else agent.discount**self.shortest_s

    def _expected(self) -> Expected:
        """What the settings and the data allow of the log's numbers."""
        agent, spaces = self.config.agent, self.agent.spaces
        cloning = None
        if isinstance(agent, BcConfig) or (isinstance(agent, DiffusionSacConfig) and agent.bc_weight > 0):
            cloning = 1.0  # the squared error of a denoiser that answers 0 to unit noise
        elif isinstance(agent, GaussianBcConfig):
            cloning = spaces.continuous * math.log(2.0) + math.log(spaces.choices)  # a uniform guess
        horizon = 1.0 / (1.0 - self._discount())
        return Expected(
            q=(min(self.rewards[0], 0.0) * horizon, max(self.rewards[1], 0.0) * horizon),
            reward_deviation=float(self.sample.reward.std(correction=0)),
            bc_loss=cloning,
            gradient_clip=agent.gradient_clip,
        )

    def _rate(self) -> float:
        base = self.config.agent.learning_rate
        if self.config.decay == "none":
            return base
        return base * 0.5 * (1.0 + math.cos(math.pi * self.updates / self.config.updates))

    def begin_step(self) -> None:
        """Set what changes over a run: the learning rate, and the agent's `progress`."""
        rate = self._rate()
        for optimiser in self.agent.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = rate
        self.agent.progress = self.updates / self.config.updates

    def step(self) -> Metrics:
        """One update on a fresh minibatch."""
        self.begin_step()
        if self.config.compilation == "graphs":
            torch.compiler.cudagraph_mark_step_begin()
        metrics = self.agent.update(self.encoded(*self.draw()), self.generator)
        self.updates += 1
        return metrics

    def draw(self) -> tuple[torch.Tensor, Turn | None, Relocation | None]:
        """Row numbers (B,) of a minibatch, how each row is turned, and where its devices lie instead."""
        config, generator = self.config, self.generator
        count, area, devices = self.agent.config.batch_size, config.scenario.area, config.scenario.traffic.devices
        rows = draw_rows(self.data, count, generator)
        turn = Turn.draw(count, area, generator) if config.turns else None
        share = config.relocation
        return rows, turn, Relocation.draw(count, devices, area, share, generator) if share > 0 else None

    def encoded(self, rows: torch.Tensor, turn: Turn | None, relocation: Relocation | None) -> Batch:
        """What the agent sees of these rows."""
        batch = self.data.take(rows)
        if relocation is not None:
            batch = relocated(batch, relocation)
        return batch if turn is None else turned(batch, turn, self.config.scenario.area)

    def support_distance(self) -> float:
        """How far the policy acts from the logged actions, see `Support`; the same rows and noise each time."""
        if self.support is None:
            self.support = Support(self.sample, seed=self.config.seed)
        generator = torch.Generator(self.device).manual_seed(self.config.seed)
        return float(self.support.distance(self.agent, generator))

    def run(
        self, directory: Path, report: Reporter, evaluate: Evaluator | None = None, *, tensorboard: bool = False
    ) -> AgentPolicy:
        """Update until the end, with checkpoints, metrics and trial flights; saves on interrupt.

        Raises:
            ConfigError: `tensorboard`, which is not installed.
            DivergenceError: a metric is not finite, or Q beyond any possible return; the last checkpoint stays.
        """
        return run_all([self], [directory], lambda: [self.step()], report, evaluate, tensorboard=tensorboard)[0]

    def check(self, row: dict[str, float], directory: Path) -> None:
        """Raise DivergenceError where a metric or a weight is not finite, or Q is beyond any possible return."""
        for name, value in row.items():
            if not math.isfinite(value):
                raise self._diverged(f"{name} = {value}", directory)
        for name, tensor in self.agent.networks.state_dict().items():
            if tensor.is_floating_point() and not tensor.isfinite().all():
                raise self._diverged(f"weights {name} are not finite", directory)
        if abs(row.get("q", 0.0)) > self.q_limit:
            raise self._diverged(f"q = {row['q']:.3g}, allowed: +-{self.q_limit:.3g}", directory)

    def _diverged(self, what: str, directory: Path) -> DivergenceError:
        kept = "no checkpoint had been saved"
        if self.saved is not None:
            kept = f"'{directory / 'checkpoint'}' keeps update {self.saved}, the last good one"
        weight = " or a larger bc_weight" if hasattr(self.config.agent, "bc_weight") else ""
        return DivergenceError(
            f"training diverged: {what} after {self.updates} updates; {kept}; "
            f"try another run with a smaller learning_rate{weight}"
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
            "data": {"rows": len(self.data), "sha256": self.digest},
            "step": self.updates,
            "device": self.device.type,
        }
        tensors = agent_tensors(self.agent) | {"loop": {"generator": self.generator.get_state()}}
        save_checkpoint(directory / "checkpoint", document, tensors)
        self.saved = self.updates

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
        config, made_on = began_as(checkpoint, path)
        if made_on != device:  # their generators differ
            raise CheckpointError(f"checkpoint '{path}' was made with device = '{made_on}', go on with the same")
        learner = cls(config, transitions, device)
        if learner.digest != checkpoint.document["data"]["sha256"]:
            raise CheckpointError(f"checkpoint '{path}' was trained on other data; give the same --data")
        restore_agent(learner.agent, checkpoint.tensors)
        learner.generator.set_state(checkpoint.tensors["loop"]["generator"])
        learner.updates = learner.saved = checkpoint.document["step"]
        return learner


def began_as(checkpoint: Checkpoint, path: Path) -> tuple[TrainConfig, str]:
    """Settings and device of the run that saved a checkpoint at `path`.

    Raises:
        CheckpointError: it holds none of this version.
    """
    try:
        return TrainConfig.model_validate(checkpoint.document["train"]), str(checkpoint.document["device"])
    except (KeyError, ValidationError):
        raise CheckpointError(f"checkpoint '{path}' holds no run of this version of uavrl") from None


def run_all(
    learners: Sequence[OfflineLearner],
    directories: Sequence[Path],
    step: Callable[[], Sequence[Metrics]],
    report: Reporter,
    evaluate: Evaluator | None = None,
    *,
    tensorboard: bool = False,
) -> list[AgentPolicy]:
    """`OfflineLearner.run` of learners that `step` updates together, each in a directory of its own."""
    config, text = learners[0].config, ""
    policies = [AgentPolicy(one.config.agent.name, one.agent, one.config.scenario) for one in learners]
    with ExitStack() as stack:
        logs = [
            stack.enter_context(
                closing(MetricsLog(directory / "metrics.jsonl", directory / "tensorboard" if tensorboard else None))
            )
            for directory in directories
        ]
        interrupted = stack.enter_context(held_interrupts())
        for learner, log in zip(learners, logs, strict=True):
            log.cut(learner.updates)
        while (done := learners[0].updates) < config.updates:
            metrics, done = step(), done + 1
            stop = interrupted()
            logged = done % config.log_every == 0 or done == config.updates
            saved = done % config.save_every == 0 or stop
            tried = evaluate is not None and config.evaluate_every and done % config.evaluate_every == 0
            if logged or saved or tried:  # nothing is saved or flown that has not been looked at, nor beside it
                each = [{name: float(value) for name, value in values.items()} for values in metrics]
                for learner, directory, row in zip(learners, directories, each, strict=True):
                    learner.check(row, directory)
            if logged:
                for learner, log, row in zip(learners, logs, each, strict=True):
                    log.write({"step": done} | row | {"support_distance": learner.support_distance()})
                shown = ("q", "critic_loss", "bc_loss")
                text = ", ".join(f"{name} {each[0][name]:.3g}" for name in shown if name in each[0])
            if evaluate is not None and tried:
                for log, policy in zip(logs, policies, strict=True):
                    log.write({"step": done} | evaluate(policy))
            if saved:
                _save_all(learners, directories)
            if stop:
                raise KeyboardInterrupt
            report(done, text)
        _save_all(learners, directories)
    return policies


def _save_all(learners: Sequence[OfflineLearner], directories: Sequence[Path]) -> None:
    for learner, directory in zip(learners, directories, strict=True):
        if learner.saved != learner.updates:
            learner.save(directory)
