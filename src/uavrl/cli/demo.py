"""`uavrl demo`: the whole chain in minutes, from logged flights to a policy that is judged and shown."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from uavrl.cli.settings import output_directory, pydantic_config
from uavrl.errors import ConfigError

if TYPE_CHECKING:
    from uavrl.evaluation.report import Judgement
    from uavrl.evaluation.rollouts import EvaluationSet, Flights
    from uavrl.training.offline import TrainConfig

HEURISTICS = ("random_walk", "saver", "tdm", "max_age", "index", "hover", "planner")
DATA = "layouts"


@dataclass(frozen=True)
class Demo:
    """Learn from the built-in flights, judge on layouts that nobody has seen, and show the result."""

    out: Path = Path("out/demo")
    """directory for summary.json, the table, figures, the page of a flight and the policy"""
    updates: int = 4_000
    """gradient steps of Diffusion-SAC; behaviour cloning takes as many"""
    episodes: int = 100
    """unseen layouts to judge on"""
    seed: int = 0
    """of weights, data order and noise"""

    def run(self) -> None:
        from uavrl.datasets import load_builtin
        from uavrl.evaluation.report import judge
        from uavrl.evaluation.rollouts import evaluation_set, fly
        from uavrl.scenario import load_scenario

        if self.episodes < 2:
            raise ConfigError(f"--episodes {self.episodes}, allowed: 2 or more (an interval needs them)")
        configs = {agent: _config(agent, self.updates, self.seed) for agent in ("bc", "diffusion_sac")}
        output_directory(self.out)
        started = time.monotonic()
        transitions = load_builtin(DATA)
        scenario = load_scenario("released")
        environments = evaluation_set(scenario, "random", self.episodes)
        console = Console(stderr=True)
        console.print(
            f"Learning from {len(transitions):,} logged transitions; the planner flies meanwhile. "
            "About eight minutes on two cores."
        )
        # a fresh interpreter: torch's threads do not survive a fork
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context, initializer=_single_thread) as side:
            bc = side.submit(_train, configs["bc"], self.out / "bc", False)
            heuristics = {name: side.submit(_fly_heuristic, name, environments) for name in HEURISTICS}
            _single_thread()
            policy = _train(configs["diffusion_sac"], self.out / "policy", True)
            # each learned policy in its better form: the guided chain without noise, imitation with it
            flown = {"diffusion_sac": fly(policy, environments, name="diffusion_sac", deterministic=True)}
            flown["bc"] = fly(bc.result(), environments, name="bc")
            console.print("Waiting for the planner's flights.")
            flown |= {name: future.result() for name, future in heuristics.items()}
        order = [*HEURISTICS, "bc", "diffusion_sac"]
        judgement = judge(
            {},
            environments,
            flown={name: flown[name] for name in order},
            data=transitions,
            command="uavrl demo",
        )
        judgement.report["notes"].append(
            "diffusion_sac flies its deterministic action (DDIM from zero noise), bc a sample: each flies better so."
        )
        _write(self.out, judgement)
        _show(self.out, judgement, time.monotonic() - started)


def _single_thread() -> None:
    """Two processes share the machine: each keeps to one core."""
    import torch

    torch.set_num_threads(1)


def _config(agent: str, updates: int, seed: int) -> TrainConfig:
    """How the demo trains an agent.

    Raises:
        ConfigError: updates or a seed that is not allowed.
    """
    from uavrl.agents.registry import preset
    from uavrl.scenario import load_scenario
    from uavrl.training.offline import TrainConfig

    return pydantic_config(
        TrainConfig,
        scenario=load_scenario("released"),
        agent=preset(agent, "default"),
        updates=updates,
        seed=seed,
        save_every=max(1, updates // 4),
        evaluate_every=max(1, updates // 4),
        log_every=max(1, min(50, updates // 10)),
    )


def _train(config: TrainConfig, out: Path, visible: bool) -> Any:
    """Train afresh in `out` and return the policy; an earlier demo there is replaced when this one is saved."""
    from uavrl.cli.train import trial_flights
    from uavrl.datasets import load_builtin
    from uavrl.training.log import progress
    from uavrl.training.offline import OfflineLearner

    transitions = load_builtin(DATA)
    (out / "metrics.jsonl").unlink(missing_ok=True)
    learner = OfflineLearner(config, transitions)
    stream = sys.stderr if visible else open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # closed with its process
    with progress(f"train {config.agent.name}", config.updates, "update", stream) as report:
        return learner.run(out, report, trial_flights(transitions, config.scenario))


def _fly_heuristic(name: str, environments: EvaluationSet) -> Flights:
    from uavrl.evaluation.rollouts import fly
    from uavrl.policies import make_policy

    return fly(make_policy(name), environments, name=name)


def typical_flight(flights: Flights) -> int:
    """The flight that ends as far from its start as the median one; of an even number, the farther middle one."""
    import numpy as np

    ends = flights.position_m[flights.steps, np.arange(len(flights.steps))]
    order = np.argsort(np.linalg.norm(ends - flights.position_m[0], axis=1), kind="stable")
    return int(order[len(order) // 2])


def _write(out: Path, judgement: Judgement) -> None:
    """summary.json, the table, three figures and the page of a flight."""
    from uavrl.evaluation.report import markdown_table, write_json, write_text
    from uavrl.viewer.figures import age_bars, hero, objective_bars, training_curves, trajectories
    from uavrl.viewer.page import write_page

    write_json(out / "summary.json", judgement.report)
    write_text(out / "table.md", markdown_table(judgement.report))
    logs = {"diffusion_sac": out / "policy" / "metrics.jsonl", "bc": out / "bc" / "metrics.jsonl"}
    training_curves(logs, out / "training.png")
    age_bars(judgement.report, out / "age.png")
    objective_bars(judgement.report, out / "return.png")
    planned = judgement.flights["planner"]
    shown = typical_flight(planned)
    learned = judgement.flights["diffusion_sac"].episode(shown)
    trajectories([learned, planned.episode(shown)], out / "trajectory.png")
    hero(learned, out / "flight.png")
    write_page(learned, out / "flight.html")


def _show(out: Path, judgement: Judgement, seconds: float) -> None:
    """The table, what was learned in two sentences, and what to type next."""
    from uavrl.evaluation.report import rich_table

    console = Console()
    console.print(rich_table(judgement.report))
    policies, paired = judgement.report["policies"], judgement.report["paired"]["diffusion_sac"]
    own, excess = policies["diffusion_sac"]["return"], policies["diffusion_sac"]["excess_cost"]

    def beside(name: str) -> str:
        gap = paired[name]["return"]
        clear = "better" if gap["low"] > 0 else "worse" if gap["high"] < 0 else "no different (95 %)"
        return f"{clear} than {name} by {gap['mean']:+.0f} [{gap['low']:+.0f}, {gap['high']:+.0f}]"

    print()
    print(
        f"From logged flights alone, Diffusion-SAC learned a policy with a return of {own['mean']:.0f} "
        f"[{own['low']:.0f}, {own['high']:.0f}] on {judgement.report['episodes']} unseen layouts: {beside('tdm')}, "
        f"{beside('bc')}, {beside('data')}."
    )
    print(
        f"A planner that knows the physics returns {policies['planner']['return']['mean']:.0f}, so the learned policy "
        f"costs {100 * excess['mean']:.0f} % [{100 * excess['low']:.0f}, {100 * excess['high']:.0f}] more than it."
    )
    print(f"\n{seconds / 60:.1f} minutes. In {out}: summary.json, table.md, *.png, flight.html, policy")
    print(f"next: open {out / 'flight.html'} in a browser")
    print(f"      uavrl watch {out / 'policy'} --layouts fixed")
    print("      uavrl train diffusion_sac --out runs/longer")
