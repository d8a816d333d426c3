"""`uavrl evaluate`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from uavrl.cli.policies import learned_in, resolve_all
from uavrl.cli.settings import Many, check_writable
from uavrl.errors import ConfigError
from uavrl.scenario import Scenario, load_scenario, scenario_diff


@dataclass(frozen=True)
class Evaluate:
    """Fly policies on equal layouts, starts and fading draws, and compare them with 95 % bootstrap intervals."""

    policy: Many
    """a heuristic's name, a checkpoint's directory or pretrained:NAME (@solver=dpm,steps=3 behind it: decide so), an
    .onnx file, your module:Class; repeat it"""
    scenario: str = "released"
    """a preset (paper, released, realistic) or a TOML file"""
    layouts: str = "random"
    """fixed (one layout), random (one an episode), or a JSON file with a list of K x 2 layouts in metres"""
    episodes: int = 100
    """environments that every policy flies"""
    seed: int = 1_000_000
    """of layouts, starts and draws; training stays below 1,000,000"""
    fading_seeds: int = 1
    """flights in each environment, under other draws"""
    baseline: Many = ()
    """policies that all others are compared with; by default tdm, planner, data and bc where they take part"""
    data: str | None = None
    """logged flights whose own behaviour is reported as 'data': a built-in data set's name or a file"""
    deterministic: bool = False
    """ask the policies for their deterministic action"""
    json: Path | None = None
    """write the report here"""
    markdown: Path | None = None
    """write the tables here"""

    def run(self) -> None:
        # all that a user can have mistyped is looked at before anything is flown
        if not self.policy:
            raise ConfigError("--policy is missing, needed: 1 or more")
        for path in (self.json, self.markdown):
            if path is not None:
                check_writable(path)
        scenario = load_scenario(self.scenario)
        from uavrl.evaluation.report import judge, markdown_table, rich_table, write_json, write_text
        from uavrl.evaluation.rollouts import evaluation_set

        environments = evaluation_set(
            scenario, self.layouts, self.episodes, seed=self.seed, fading_seeds=self.fading_seeds
        )
        policies = resolve_all(self.policy, scenario, deterministic=self.deterministic)
        for spec in self.policy:
            learned = learned_in(spec)
            other = [] if learned is None else _other_than(learned, scenario)
            if other:
                print(f"{spec} learned in another scenario; {', '.join(other)} differ", file=sys.stderr)
        data = None
        if self.data is not None:
            from uavrl.datasets.sources import load_source

            data, _ = load_source(self.data, scenario)
        judgement = judge(
            policies,
            environments,
            baselines=self.baseline,
            data=data,
            deterministic=self.deterministic,
            command=shlex.join(["uavrl", *sys.argv[1:]]),
            show_progress=True,
        )
        if self.json is not None:
            write_json(self.json, judgement.report)
        if self.markdown is not None:
            write_text(self.markdown, markdown_table(judgement.report))
        Console(width=None if sys.stdout.isatty() else 160).print(rich_table(judgement.report))


def _other_than(learned: Scenario, flown: Scenario) -> list[str]:
    """Fields that differ, but for a flight's length and the devices' number, which policies may well be flown with."""
    fields = [name for name in scenario_diff(learned, flown) if not name.startswith(("name", "limits."))]
    fields = [name for name in fields if name != "traffic.devices"]
    return fields if len(fields) < 5 else [*fields[:4], f"{len(fields) - 4} more"]
