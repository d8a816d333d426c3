"""`uavrl distill`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from uavrl.cli.settings import Many, differing, output_directory, pydantic_config, with_settings
from uavrl.errors import ConfigError

UPDATES = 3_000


@dataclass(frozen=True)
class Distill:
    """Teach a policy of one network pass what a Diffusion-SAC decides. Interrupted, it goes on with --resume."""

    checkpoint: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CHECKPOINT")]
    """directory of a run of diffusion_sac, or of its checkpoint"""
    out: Path
    """directory of the student's run: checkpoint and metrics.jsonl"""
    data: str = "layouts"
    """flights to practise on, of the teacher's scenario: layouts, fixed or realistic (built in), a file, a Minari id"""
    updates: int = UPDATES
    """gradient steps, some 25 ms each on one core"""
    seed: int = 0
    """of data order and noise"""
    set: Many = ()
    """a setting as name=value, such as q_weight=0.01; repeat it for more"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where to compute"""
    evaluate_every: int = 0
    """updates between trial flights on 20 layouts of their own; 0: none"""
    resume: bool = False
    """go on from the checkpoint in --out"""

    def run(self) -> None:
        from uavrl.agents.diffusion_sac import DiffusionSac
        from uavrl.agents.one_step import OneStep, OneStepConfig
        from uavrl.cli.train import LOG_EVERY, trial_flights
        from uavrl.datasets import load_source
        from uavrl.training.checkpoint import checkpoint_in, load_checkpoint, recover
        from uavrl.training.log import progress
        from uavrl.training.offline import OfflineLearner, TrainConfig
        from uavrl.training.policy import load_agent, trained_scenario

        place = checkpoint_in(self.checkpoint)
        checkpoint = load_checkpoint(place)
        teacher = load_agent(checkpoint, place)
        if not isinstance(teacher, DiffusionSac):
            agent = checkpoint.document["agent"]
            raise ConfigError(f"'{self.checkpoint}' is of agent '{agent}', allowed: diffusion_sac")
        transitions, scenario = load_source(self.data, trained_scenario(place))
        alike = ("network", "reward", "batch_size", "shortest_move")
        shared = {name: getattr(teacher.config, name) for name in alike}
        student = with_settings(OneStepConfig(teacher=teacher.config, **shared), self.set)
        for part in ("network", "diffusion"):  # with another it would not be the trained one
            if getattr(student.teacher, part) != getattr(teacher.config, part):
                raise ConfigError(f"teacher.{part} is set, allowed: as '{self.checkpoint}' was trained")
        config = pydantic_config(
            TrainConfig,
            scenario=scenario,
            agent=student,
            updates=self.updates,
            seed=self.seed,
            log_every=min(LOG_EVERY, max(1, self.updates // 50)),
            evaluate_every=self.evaluate_every,
        )
        output_directory(self.out)
        learner = OfflineLearner.resume(self.out, transitions, self.device) if self.resume else None
        if learner is None:
            if self.resume:
                raise ConfigError(f"--resume: '{self.out}' holds no checkpoint")
            if recover(self.out / "checkpoint") is not None:
                raise ConfigError(f"--out '{self.out}' holds a run already; give --resume or another directory")
            learner = OfflineLearner(config, transitions, self.device)
            assert isinstance(learner.agent, OneStep)  # noqa: S101  # for the type checker
            learner.agent.learn_from(teacher)
        elif not isinstance(learner.agent, OneStep):
            agent = learner.config.agent.name
            raise ConfigError(f"--resume: '{self.out}' holds a run of agent '{agent}', give another directory")
        elif learner.config != config:
            other = differing(learner.config, config)
            raise ConfigError(f"--resume: '{self.out}' was started with other settings, give the same ones: {other}")
        elif not learner.agent.learns_from(teacher):
            raise ConfigError(f"--resume: '{self.out}' was started with another teacher than '{self.checkpoint}'")
        else:
            print(f"going on from update {learner.updates:,}", file=sys.stderr)
        trial = trial_flights(transitions, scenario) if self.evaluate_every else None
        try:
            with progress("distill", config.updates, "update") as report:
                learner.run(self.out, report, trial)
        except KeyboardInterrupt:
            if learner.saved is not None:
                print(f"saved update {learner.saved:,}; the same command with --resume goes on", file=sys.stderr)
            raise
        print(f"{learner.updates:,} updates; policy of one step in {self.out}")
        where = "" if scenario.name == "released" else f" --scenario {scenario.name}"
        print(f"next: uavrl evaluate --policy {self.checkpoint} --policy {self.out} --deterministic{where}")
