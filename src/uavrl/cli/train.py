"""`uavrl train`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from uavrl.cli.settings import output_directory, pydantic_config, with_settings
from uavrl.errors import ConfigError
from uavrl.scenario import Scenario

if TYPE_CHECKING:
    from uavrl.datasets import Transitions
    from uavrl.training.offline import Evaluator, OfflineLearner, TrainConfig

Many = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]

LOG_EVERY = 200  # updates between rows of the log, at most


@dataclass(frozen=True)
class Train:
    """Learn a policy from logged flights alone. Interrupted, it goes on where it was with --resume."""

    agent: tyro.conf.Positional[
        Literal["diffusion_sac", "diffusion-sac", "cql", "iql", "bcq", "bc", "gaussian_bc", "gaussian-bc"]
    ]
    """algorithm"""
    out: Path
    """directory of the run: checkpoint, metrics.jsonl and, where asked for, tensorboard"""
    data: str = "layouts"
    """layouts, fixed or realistic, a .parquet or .npz file, a .mapped directory, or the id of a Minari dataset"""
    size: int | None = None
    """transitions to draw and learn from, in memory; by default 30,000 of a built-in data set, all of any other"""
    quality: Literal["mixed", "good", "bad"] = "mixed"
    """part of the log that --size draws from: all, the last third, the first third"""
    data_seed: int = 0
    """of the draw"""
    scenario: str | None = None
    """preset or TOML file; by default the one that the data carry"""
    preset: Literal["default", "paper"] = "default"
    """the settings that we recommend (about a quarter of an hour on one core), or the paper's as printed"""
    updates: int | None = None
    """gradient steps; by default what the preset says"""
    seed: int = 0
    """of weights, data order and noise"""
    seeds: int = 1
    """training seeds, from --seed on, each in a directory of its own, OUT/seed0, OUT/seed1, ...: one after another, or
    on a GPU all at once (diffusion_sac)"""
    set: Many = ()
    """a setting as name=value, such as bc_weight=0.3 or diffusion.steps=10; repeat it for more"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where to compute"""
    compile: Literal["none", "step", "graphs"] = "none"
    """compile the networks' passes, which takes half a minute once; graphs: in CUDA graphs, too"""
    evaluate_every: int = 0
    """updates between trial flights on 20 layouts of their own; 0: none"""
    resume: bool = False
    """go on from the checkpoint in --out"""
    tensorboard: bool = False
    """write the log for TensorBoard as well; needs the extra 'tracking'"""

    def run(self) -> None:
        from uavrl.agents.registry import preset
        from uavrl.datasets import builtin_names, load_source, select
        from uavrl.training.health import summary
        from uavrl.training.log import progress, read_metrics, require_tensorboard
        from uavrl.training.objective import for_objective
        from uavrl.training.offline import PRESET_UPDATES, TrainConfig
        from uavrl.training.stacked import StackedLearner

        if self.tensorboard:
            require_tensorboard()  # before anything that takes long
        transitions, scenario = load_source(self.data, self.scenario)
        size = self.size if self.size is not None else (30_000 if self.data in builtin_names() else None)
        if size is not None:
            transitions = select(transitions, size, self.quality, self.data_seed)
        elif self.quality != "mixed":
            raise ConfigError(f"--quality {self.quality} needs --size")
        updates = PRESET_UPDATES[self.preset] if self.updates is None else self.updates
        agent = preset(self.agent, self.preset)
        if self.preset == "default":
            agent = for_objective(agent, scenario, self.set)
        config = pydantic_config(
            TrainConfig,
            scenario=scenario,
            agent=with_settings(agent, self.set),
            updates=updates,
            seed=self.seed,
            log_every=min(LOG_EVERY, max(1, updates // 50)),  # enough rows to judge a short run by
            evaluate_every=self.evaluate_every,
            compilation=self.compile,
        )
        output_directory(self.out)
        places = self._places(config)
        trial = trial_flights(transitions, scenario) if self.evaluate_every else None
        every = [list(places)] if at_once(config, self.device) else [[directory] for directory in places]
        for directories in every:
            learners = [self._learner(directory, places[directory], transitions) for directory in directories]
            title = f"train {self.agent}" + (f" {directories[0].name}" if self.seeds > len(learners) else "")
            try:
                with progress(title, config.updates, "update") as report:
                    if len(learners) > 1:
                        StackedLearner(learners).run(directories, report, trial, tensorboard=self.tensorboard)
                    else:
                        learners[0].run(directories[0], report, trial, tensorboard=self.tensorboard)
            except KeyboardInterrupt:
                if learners[0].saved is not None:
                    print(
                        f"saved update {learners[0].saved:,}; the same command with --resume goes on", file=sys.stderr
                    )
                raise
            for directory, learner in zip(directories, learners, strict=True):
                of = f"{directory.name}: " if self.seeds > 1 else ""
                print(of + summary(read_metrics(directory / "metrics.jsonl"), learner.expected))
        print(f"{updates:,} updates on {len(transitions):,} transitions; policy in {', '.join(map(str, places))}")
        judged = " ".join(f"--policy {directory}" for directory in places)
        print(f"next: uavrl evaluate --policy tdm {judged} --scenario {scenario.name}")

    def _places(self, config: TrainConfig) -> dict[Path, TrainConfig]:
        """Each run's directory, free to begin in or, with --resume, begun."""
        from uavrl.training.checkpoint import recover
        from uavrl.training.offline import TrainConfig

        if self.seeds < 1:
            raise ConfigError(f"--seeds {self.seeds}, allowed: at least 1")
        places = {self.out: config}
        if self.seeds > 1:
            seeds = range(self.seed, self.seed + self.seeds)
            places = {
                self.out / f"seed{seed}": pydantic_config(TrainConfig, **dict(config) | {"seed": seed})
                for seed in seeds
            }
        begun = [directory for directory in places if recover(directory / "checkpoint") is not None]
        if self.resume and not begun:
            raise ConfigError(f"--resume: '{self.out}' holds no checkpoint")
        if begun and not self.resume:
            raise ConfigError(f"--out '{begun[0]}' holds a run already; give --resume or another directory")
        return places

    def _learner(self, directory: Path, config: TrainConfig, transitions: Transitions) -> OfflineLearner:
        """Of one run, going on from its checkpoint with --resume."""
        from uavrl.training.offline import OfflineLearner

        learner = OfflineLearner.resume(directory, transitions, self.device) if self.resume else None
        if learner is None:
            return OfflineLearner(config, transitions, self.device)
        if learner.config != config:
            began = ", ".join(_differing(learner.config.model_dump(), config.model_dump()))
            raise ConfigError(f"--resume: '{directory}' was started with other settings, give the same ones: {began}")
        print(f"going on from update {learner.updates:,}", file=sys.stderr)
        return learner


def at_once(config: TrainConfig, device: str) -> bool:
    """Whether training seeds learn in one stack: where a GPU would idle beside a single one."""
    from uavrl.agents.diffusion_sac import DiffusionSacConfig

    return device == "cuda" and config.compilation == "none" and isinstance(config.agent, DiffusionSacConfig)


def _differing(began: dict[str, Any], asked: dict[str, Any], section: str = "") -> Iterator[str]:
    """Each setting of `began` that is another one in `asked`, as name=value."""
    for name, value in began.items():
        other = asked.get(name)
        if isinstance(value, dict) and isinstance(other, dict):
            yield from _differing(value, other, f"{section}{name}.")
        elif other != value:
            yield f"{section.removeprefix('agent.')}{name}={json.dumps(value)}"  # as --set names it


def trial_flights(transitions: Transitions, scenario: Scenario, episodes: int = 20) -> Evaluator:
    """Flies a policy on trial layouts: the data's own where they hold a single one, else new ones."""
    from dataclasses import replace

    from uavrl.evaluation.rollouts import TRIAL_SEED, evaluation_set, fly
    from uavrl.training.policy import AgentPolicy

    environments = evaluation_set(scenario, "random", episodes, seed=TRIAL_SEED)
    layout = transitions.layout_m[:1].astype(np.float64)
    if all((part.layout_m == layout).all() for part in transitions.parts()):
        environments = replace(environments, layout_m=np.repeat(layout, episodes, axis=0))

    def evaluate(policy: AgentPolicy) -> dict[str, float]:
        flown = fly(policy, environments, deterministic=policy.agent.acts_best_deterministically)
        returns = (flown.reward * flown.active).sum(axis=0)
        return {"return": float(returns.mean()), "return_median": float(np.median(returns))}

    return evaluate
