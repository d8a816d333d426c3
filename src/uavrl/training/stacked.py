"""Several training seeds of Diffusion-SAC in one process, as `uavrl.agents.stacked` learns them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import torch

from uavrl.agents.base import Metrics
from uavrl.agents.diffusion_sac import DiffusionSac
from uavrl.agents.stacked import StackedDiffusionSac
from uavrl.errors import ConfigError
from uavrl.training.log import Reporter
from uavrl.training.offline import Evaluator, OfflineLearner, run_all
from uavrl.training.policy import AgentPolicy
from uavrl.training.relocation import Relocation
from uavrl.training.symmetry import Turn

Drawn = TypeVar("Drawn", Turn, Relocation)


def _joined(drawn: Sequence[Drawn | None]) -> Drawn | None:
    """What several learners drew, one after another; all of them have drawn such a thing, or none has."""
    some = [one for one in drawn if one is not None]
    return type(some[0])(*(torch.cat(parts) for parts in zip(*some, strict=True))) if some else None


class StackedLearner:
    """Learners whose runs differ in their seed alone, as one.

    Each keeps its own data order, noise, log and checkpoint, from which it goes on by itself or in a stack again.

    Raises:
        ConfigError: another algorithm than Diffusion-SAC, compiled passes, runs that differ in more than their seed, on
            other data, or at another update.
    """

    def __init__(self, learners: Sequence[OfflineLearner]) -> None:
        first = learners[0]
        for learner in learners:
            if learner.config != first.config.model_copy(update={"seed": learner.config.seed}):
                raise ConfigError("a stack of training seeds: the runs differ in more than their seed")
            if learner.digest != first.digest:
                raise ConfigError("a stack of training seeds: the runs learn from different data")
            if learner.updates != first.updates:
                raise ConfigError(
                    f"a stack of training seeds: seed {first.config.seed} stands at update {first.updates:,}, seed "
                    f"{learner.config.seed} at {learner.updates:,}"
                )
        if first.config.compilation != "none":
            raise ConfigError(f"compilation = {first.config.compilation!r}, allowed for a stack of seeds: 'none'")
        agents = [learner.agent for learner in learners if isinstance(learner.agent, DiffusionSac)]
        if len(agents) < len(learners):
            raise ConfigError(f"agent = {first.config.agent.name!r}, allowed for a stack of seeds: 'diffusion_sac'")
        for learner in learners:
            learner.sample, learner.data = first.sample, first.data  # the same rows, kept once from here on
        self.learners = list(learners)
        self.stack = StackedDiffusionSac(agents)

    def step(self) -> list[Metrics]:
        """One update of each on a minibatch of its own."""
        first = self.learners[0]
        first.begin_step()
        rows, turns, relocations = zip(*(learner.draw() for learner in self.learners), strict=True)
        batches = first.encoded(torch.cat(rows), _joined(turns), _joined(relocations)).grouped(len(self.learners))
        metrics = self.stack.update(batches, [learner.generator for learner in self.learners])
        for learner in self.learners:
            learner.updates += 1
        return metrics

    def run(
        self,
        directories: Sequence[Path],
        report: Reporter,
        evaluate: Evaluator | None = None,
        *,
        tensorboard: bool = False,
    ) -> list[AgentPolicy]:
        """`OfflineLearner.run` of each, in its own directory."""
        return run_all(self.learners, directories, self.step, report, evaluate, tensorboard=tensorboard)
