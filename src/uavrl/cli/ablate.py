"""`uavrl ablate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from uavrl.cli.settings import Many, output_directory
from uavrl.errors import ConfigError


@dataclass(frozen=True)
class Ablate:
    """Change one setting of Diffusion-SAC at a time and measure. Interrupted, it goes on with what is missing."""

    problem: tyro.conf.Positional[Literal["bandit", "fixed"]]
    """the hybrid bandit, or flights on one layout"""
    out: Path = Path("runs/ablation")
    """directory of the rows (PROBLEM.jsonl) and of the table (PROBLEM.md)"""
    seeds: int = 2
    """training seeds, 0 to seeds - 1"""
    variant: Many = ()
    """a line of the table; repeat it for more; by default all"""
    workers: int = 2
    """processes at a time, each on one core"""

    def run(self) -> None:
        from uavrl.evaluation.report import write_text
        from uavrl.experiments.ablation import VARIANTS, measure, runs, table
        from uavrl.experiments.runner import finished, run_all
        from uavrl.training.log import progress

        for name, value in (("seeds", self.seeds), ("workers", self.workers)):
            if value < 1:
                raise ConfigError(f"--{name} {value}, allowed: 1 or more")
        for name in self.variant:
            if name not in VARIANTS:
                raise ConfigError(f"--variant '{name}', allowed: {', '.join(VARIANTS)}")
        output_directory(self.out)
        wanted = runs(self.problem, range(self.seeds), self.variant or VARIANTS)
        store = self.out / f"{self.problem}.jsonl"
        known = finished(store)
        print(f"{len(wanted)} runs, {sum(run.key in known for run in wanted)} of them done already")
        with progress(f"ablate {self.problem}", len(wanted), "run") as report:
            rows = run_all(wanted, measure, store, self.workers, report)
        text = table(rows)
        write_text(self.out / f"{self.problem}.md", text)
        print(text, end="")
        print(f"{sum(row['seconds'] for row in rows) / 3600:.1f} core-hours in all; rows and table in {self.out}")
