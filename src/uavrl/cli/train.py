"""`uavrl train`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro

from uavrl.cli.settings import Many, differing, output_directory, pydantic_config, with_settings
from uavrl.errors import ConfigError, DivergenceError
from uavrl.scenario import PRESETS, Scenario

if TYPE_CHECKING:
    from uavrl.datasets import Transitions
    from uavrl.training.offline import Evaluator, OfflineLearner, TrainConfig


LOG_EVERY = 200  # updates between rows of the log, at most


@dataclass(frozen=True)
class Train:
    """Learn a policy from logged flights alone. Interrupted, it goes on where it was with --resume."""

    agent: tyro.conf.Positional[
        Literal["diffusion_sac", "diffusion-sac", "cql", "iql", "bcq", "bc", "gaussian_bc", "gaussian-bc"]
    ]
    """algorithm"""
    out: Path
    """directory of the run: checkpoint, metrics.jsonl, scenario.toml where that of the data has no name, and, where
    asked for, tensorboard"""
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
    """training seeds, from --seed on; two or more each have a directory of their own, OUT/seed0, OUT/seed1, ..., and
    learn one after another, or on a GPU all at once (diffusion_sac)"""
    set: Many = ()
    """a setting as name=value, such as bc_weight=0.3 or diffusion.steps=10; repeat it for more"""
    symmetry: Literal["auto", "on", "off"] = "auto"
    """mirror and turn each logged step at random, which the physics allows; auto: where a set network discounts by the
    second"""
    relocate: float | None = None
    """share of the logged steps, drawn anew each time, whose devices lie elsewhere, but for the one that is served, as
    the physics allows; by default 0.5 where diffusion_sac learns from a log of one layout, for released's objective"""
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
        from uavrl.agents.registry import acts_best_deterministically, preset
        from uavrl.datasets import builtin_names, load_source, select
        from uavrl.training.log import require_tensorboard
        from uavrl.training.offline import PRESET_UPDATES, TrainConfig
        from uavrl.training.scenario_settings import for_scenario, relocation_for

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
            agent = for_scenario(agent, scenario, self.set)
        agent = with_settings(agent, self.set)
        relocation = self.relocate
        if relocation is None:
            relocation = relocation_for(agent, scenario, transitions) if self.preset == "default" else 0.0
        config = pydantic_config(
            TrainConfig,
            scenario=scenario,
            agent=agent,
            updates=updates,
            seed=self.seed,
            log_every=min(LOG_EVERY, max(1, updates // 50)),  # enough rows to judge a short run by
            evaluate_every=self.evaluate_every,
            symmetry={"auto": None, "on": True, "off": False}[self.symmetry],
            relocation=relocation,
            compilation=self.compile,
        )
        places = self._places(config)
        trial = trial_flights(transitions, scenario) if self.evaluate_every else None
        diverged: dict[str, DivergenceError] = {}
        for learners in self._groups(places, transitions):
            try:
                self._learn(learners, trial)
            except DivergenceError as error:  # the other seeds' turn is still to come
                diverged[", ".join(directory.name for directory in learners)] = error
        if diverged and self.seeds == 1:
            raise next(iter(diverged.values()))
        if diverged:
            raise DivergenceError("; ".join(f"{name}: {error}" for name, error in diverged.items()))
        print(f"{updates:,} updates on {len(transitions):,} transitions; policy in {', '.join(map(str, places))}")
        judged = " ".join(f"--policy {directory}" for directory in places)
        how = " --deterministic" if acts_best_deterministically(config.agent) else ""
        print(f"next: uavrl evaluate --policy tdm {judged} --scenario {self._named(scenario, next(iter(places)))}{how}")

    def _named(self, scenario: Scenario, directory: Path) -> str:
        """What `--scenario` takes to mean it; a file in `directory` where it has no name."""
        from uavrl.evaluation.report import write_text

        if self.scenario is not None:
            return self.scenario
        if PRESETS.get(scenario.name) == scenario:
            return scenario.name
        write_text(directory / "scenario.toml", scenario.to_toml())
        return str(directory / "scenario.toml")

    def _places(self, config: TrainConfig) -> dict[Path, TrainConfig]:
        """Each run's directory: free, or with --resume, at least one of them, begun with these settings."""
        from uavrl.training.checkpoint import load_checkpoint, recover
        from uavrl.training.offline import TrainConfig, began_as

        if self.seeds < 1:
            raise ConfigError(f"--seeds {self.seeds}, allowed: at least 1")
        places = {self.out: config}
        if self.seeds > 1:
            if recover(self.out / "checkpoint") is not None:
                raise ConfigError(f"--out '{self.out}' holds a single run, allowed with --seeds: another directory")
            seeds = range(self.seed, self.seed + self.seeds)
            places = {
                self.out / f"seed{seed}": pydantic_config(TrainConfig, **dict(config) | {"seed": seed})
                for seed in seeds
            }
        begun = [directory for directory in places if recover(directory / "checkpoint") is not None]
        if self.resume and not begun:
            several = sorted(self.out.glob("seed*/checkpoint"))
            hint = f" of its own, but several seeds' ({several[0].parent}): give --seeds" if several else ""
            raise ConfigError(f"--resume: '{self.out}' holds no checkpoint{hint}")
        if begun and not self.resume:
            raise ConfigError(f"--out '{begun[0]}' holds a run already; give --resume or another directory")
        for directory in begun:
            began, _ = began_as(load_checkpoint(directory / "checkpoint"), directory / "checkpoint")
            if began != places[directory]:
                other = differing(began, places[directory])
                raise ConfigError(
                    f"--resume: '{directory}' was started with other settings, give the same ones: {other}"
                )
        for directory in places:
            output_directory(directory)
        return places

    def _groups(
        self, places: dict[Path, TrainConfig], transitions: Transitions
    ) -> Iterator[dict[Path, OfflineLearner]]:
        """Learners by their directories, those together that learn in one stack; each made when its turn comes."""
        from uavrl.training.offline import OfflineLearner

        def learner(directory: Path, config: TrainConfig) -> OfflineLearner:
            found = OfflineLearner.resume(directory, transitions, self.device) if self.resume else None
            if found is not None:
                of = f"{directory.name}: " if self.seeds > 1 else ""
                print(f"{of}going on from update {found.updates:,}", file=sys.stderr)
            return found or OfflineLearner(config, transitions, self.device)

        if not at_once(next(iter(places.values())), self.device):
            for place in places.items():
                yield {place[0]: learner(*place)}
            return
        standing: dict[int, dict[Path, OfflineLearner]] = {}
        for place in places.items():
            made = learner(*place)
            standing.setdefault(made.updates, {})[place[0]] = made
        yield from standing.values()

    def _learn(self, learners: dict[Path, OfflineLearner], trial: Evaluator | None) -> None:
        """To the end, and say how healthy each is."""
        from uavrl.training.health import summary
        from uavrl.training.log import progress, read_metrics
        from uavrl.training.stacked import StackedLearner

        (directory, first), *others = learners.items()
        title = f"train {self.agent}" + (f" {directory.name}" if self.seeds > len(learners) else "")
        try:
            with progress(title, first.config.updates, "update") as report:
                if others:
                    stack = StackedLearner(list(learners.values()))
                    stack.run(list(learners), report, trial, tensorboard=self.tensorboard)
                else:
                    first.run(directory, report, trial, tensorboard=self.tensorboard)
        except KeyboardInterrupt:
            saved = [learner.saved for learner in learners.values()]
            least = min((updates for updates in saved if updates is not None), default=None)
            if least is not None:
                print(f"saved update {least:,}; the same command with --resume goes on", file=sys.stderr)
            raise
        for directory, learner in learners.items():
            of = f"{directory.name}: " if self.seeds > 1 else ""
            print(of + summary(read_metrics(directory / "metrics.jsonl"), learner.expected))


def at_once(config: TrainConfig, device: str) -> bool:
    """Whether training seeds learn in one stack: where a GPU would idle beside a single one."""
    from uavrl.agents.diffusion_sac import DiffusionSacConfig

    return device == "cuda" and config.compilation == "none" and isinstance(config.agent, DiffusionSacConfig)


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
