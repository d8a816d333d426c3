"""`uavrl export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from uavrl.cli.evaluate import check_writable
from uavrl.errors import ConfigError

EPISODES = 100  # of --verify
TOLERANCE = 0.01  # of the mean return


@dataclass(frozen=True)
class Export:
    """Write a trained policy as one ONNX file, which numpy and onnxruntime run without torch."""

    checkpoint: tyro.conf.Positional[Path]
    """directory of a run or of a checkpoint"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("policy.onnx")
    """the file"""
    sampled: bool = False
    """samples of the policy, from noise that is an input; without, its deterministic action"""
    candidates: int | None = None
    """with --sampled, of an agent that re-ranks: actions that each decision chooses from; none: as trained"""
    verify: bool = False
    """fly 100 episodes with the file and with the checkpoint, and compare the returns"""

    def run(self) -> None:
        check_writable(self.out)
        if self.candidates is not None and not (self.sampled and self.candidates >= 1):
            raise ConfigError(f"--candidates {self.candidates}, allowed: 1 or more, with --sampled")
        from uavrl.deployment.export import export
        from uavrl.training.policy import load_policy, trained_scenario

        scenario = trained_scenario(self.checkpoint)
        policy = load_policy(self.checkpoint, scenario, self.candidates)
        info = export(policy.agent, scenario, self.out, sampled=self.sampled, facts=policy.facts)
        size = self.out.stat().st_size
        kind = "sampled, noise is an input" if self.sampled else "deterministic"
        devices = "any K" if "devices" in info["inputs"] else f"K = {info['devices']}"
        print(f"{self.out}: {info['agent']}, {devices}, {kind}, {size / 1e3:,.0f} kB")
