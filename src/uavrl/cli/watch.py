"""`uavrl watch`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from uavrl.cli.policies import learned_in, resolve
from uavrl.cli.settings import check_writable
from uavrl.errors import ConfigError
from uavrl.scenario import load_scenario


@dataclass(frozen=True)
class Watch:
    """Fly a policy once and make a web page of the flight: one file, opened by any browser, no network needed."""

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY")]
    """a heuristic's name, a checkpoint's directory or pretrained:NAME (@solver=dpm,steps=3 behind it: decide so), an
    .onnx file, or your own module:Class"""
    scenario: str | None = None
    """a preset (paper, released, realistic) or a TOML file; by default a checkpoint's own, or released"""
    layouts: str = "random"
    """fixed (one layout), random (one an episode), or a JSON file with a list of K x 2 layouts in metres"""
    episode: int = 0
    """which environment of `uavrl evaluate` with the same seed, from 0"""
    seed: int = 1_000_000
    """of layout, start and draws; training stays below 1,000,000"""
    deterministic: bool = False
    """ask the policy for its deterministic action"""
    frames: int = 150
    """frames of the page, at least 2; a longer flight is shown in strides"""
    out: Path = Path("flight.html")
    """the page"""

    def run(self) -> None:
        if self.episode < 0:
            raise ConfigError(f"--episode {self.episode}, allowed: 0 or more")
        if self.frames < 2:
            raise ConfigError(f"--frames {self.frames}, allowed: 2 or more")
        check_writable(self.out)
        scenario = None if self.scenario is not None else learned_in(self.policy)
        scenario = scenario or load_scenario(self.scenario or "released")
        policy = resolve(self.policy, scenario)
        from uavrl.evaluation.rollouts import evaluation_set, fly
        from uavrl.viewer.page import write_page

        environments = evaluation_set(scenario, self.layouts, self.episode + 1, seed=self.seed).only(self.episode)
        flight = fly(policy, environments, deterministic=self.deterministic, show_progress=True).episode(0)
        write_page(flight, self.out, self.frames)
        print(f"{flight.policy}: return {flight.total_reward:.4g}, {flight.steps} steps, {flight.time_s[-1]:.1f} s")
        print(f"{self.out}  open it in a browser")
