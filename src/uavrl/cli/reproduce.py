"""`uavrl reproduce`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from uavrl.cli.settings import output_directory
from uavrl.errors import ConfigError


@dataclass(frozen=True)
class Reproduce:
    """Make the paper's figures from nothing, and say of its claims whether they hold. Interrupted, it goes on."""

    figure: tyro.conf.Positional[tuple[str, ...]] = ()
    """names of figures; by default all of them"""
    scale: Literal["smoke", "standard", "full"] = "smoke"
    """minutes; under twenty core-hours; or five seeds of everything and the paper's 150 passes over the data"""
    out: Path = Path("runs/paper")
    """directory of the rows (SCALE.jsonl), and under SCALE/ of figures, tables and claims"""
    workers: int = 2
    """processes at a time on this machine, each on one core"""
    cluster: str | None = None
    """address of a Ray cluster, or auto: compute there; --out must be on storage that its nodes share"""
    plan: bool = False
    """say what would be computed, and stop"""
    draw: bool = False
    """compute nothing: draw what is there"""

    def run(self) -> None:
        from uavrl.experiments.paper import FIGURES, SCALES, wanted

        if self.workers < 1:
            raise ConfigError(f"--workers {self.workers}, allowed: 1 or more")
        for name in self.figure:
            if name not in FIGURES:
                raise ConfigError(f"figure '{name}' does not exist, allowed: {', '.join(FIGURES)}")
        from rich.console import Console

        from uavrl.experiments.flights import measure
        from uavrl.experiments.report import write_results
        from uavrl.experiments.runner import finished, run_all
        from uavrl.experiments.schedule import schedule
        from uavrl.training.log import progress

        store = self.out / f"{self.scale}.jsonl"
        figures = wanted(SCALES[self.scale])
        chosen = {name: figures[name] for name in self.figure or FIGURES}
        table, runs = schedule(chosen, finished(store), self.workers)
        Console(width=None, highlight=False).print(table)
        if self.plan:
            return
        output_directory(self.out)
        if not self.draw:
            with progress(f"reproduce {self.scale}", len(runs), "run") as report:
                run_all(runs, measure, store, self.workers, report, self.cluster)
        print("\n".join(write_results(figures, finished(store), self.out / self.scale, self.scale, [*chosen])))
