"""`uavrl report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from uavrl.cli.policies import resolve_all
from uavrl.cli.settings import Many, check_writable
from uavrl.errors import ConfigError


@dataclass(frozen=True)
class Report:
    """Put what `uavrl reproduce` has computed on one web page: claims, figures, tables, flights to play."""

    results: Path = Path("runs/paper")
    """what was --out of `uavrl reproduce`"""
    scale: Literal["smoke", "standard", "full"] = "smoke"
    """which of its scales"""
    policy: Many = ("pretrained:layouts", "planner", "tdm")
    """whose flight on the first layout of the evaluation is played; repeat it at will"""
    out: Path = Path("report.html")
    """the page: one file, opened by any browser, no network needed"""

    def run(self) -> None:
        check_writable(self.out)
        store = self.results / f"{self.scale}.jsonl"
        if not store.is_file():
            raise ConfigError(
                f"--results '{self.results}' holds no {store.name}; make it: uavrl reproduce --scale {self.scale}"
            )
        from uavrl.evaluation.report import write_text
        from uavrl.evaluation.rollouts import evaluation_set, fly
        from uavrl.experiments.paper import SCALES, wanted
        from uavrl.experiments.report import report_page, write_results
        from uavrl.experiments.runner import finished
        from uavrl.scenario import load_scenario

        scenario = load_scenario("released")
        policies = resolve_all(self.policy, scenario, deterministic=True)
        figures, rows, drawn = wanted(SCALES[self.scale]), finished(store), self.results / self.scale
        write_results(figures, rows, drawn, self.scale)
        tests = evaluation_set(scenario, "random", 1)
        flights = [fly(one, tests, name=name, deterministic=True).episode(0) for name, one in policies.items()]
        write_text(self.out, report_page(figures, rows, drawn, self.scale, flights))
        print(f"{self.out}  open it in a browser")
