"""`uavrl export`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import tyro

from uavrl.cli.policies import checkpoint_and_decision
from uavrl.cli.settings import check_writable
from uavrl.errors import ConfigError


@dataclass(frozen=True)
class Export:
    """Write a trained policy as one ONNX file, which flies with numpy and onnxruntime alone."""

    checkpoint: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="CHECKPOINT")]
    """directory of a run or of a checkpoint, or pretrained:NAME; behind it
    @candidates=N,greedy_choice=false,solver=ddim|dpm,steps=N changes how it decides"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("policy.onnx")
    """the file"""
    sampled: bool = False
    """sample the policy, from noise that is an input; without, its deterministic action"""
    verify: bool = False
    """fly the file and the checkpoint on equal flights and compare the returns"""
    episodes: int = 100
    """of --verify"""

    def run(self) -> None:
        check_writable(self.out)
        path, decision = checkpoint_and_decision(self.checkpoint)
        if decision.candidates is not None and not self.sampled:
            raise ConfigError(f"candidates = {decision.candidates}, allowed with --sampled")
        if self.episodes < 1:
            raise ConfigError(f"--episodes {self.episodes}, allowed: 1 or more")
        if self.verify and find_spec("onnxruntime") is None:
            raise ConfigError("--verify needs onnxruntime, install it: pip install 'uavrl[deploy]'")
        from uavrl.deployment.export import export, facts_of
        from uavrl.training.checkpoint import checkpoint_in, load_checkpoint
        from uavrl.training.policy import load_policy, trained_scenario

        scenario = trained_scenario(path)
        trained = load_policy(path, scenario, decision)
        facts = facts_of(load_checkpoint(checkpoint_in(path)).document) | {
            "decision": decision.model_dump(exclude_none=True)
        }
        info = export(trained.agent, scenario, self.out, sampled=self.sampled, facts=facts)
        devices = "any number of devices" if "devices" in info["inputs"] else f"K = {info['devices']}"
        kind = "samples from noise" if self.sampled else "deterministic"
        print(f"{self.out}: {info['agent']}, {devices}, {kind}, {self.out.stat().st_size / 1e3:,.0f} kB")
        if not self.verify:
            return
        from uavrl.deployment.flight import ExportedPolicy
        from uavrl.deployment.verify import verify
        from uavrl.evaluation.rollouts import evaluation_set

        environments = evaluation_set(scenario, "random", self.episodes)
        found = verify(trained, ExportedPolicy(self.out, scenario), environments, deterministic=not self.sampled)
        line = (
            f"returns over {self.episodes} flights: {found.trained.mean():.4f} of the checkpoint, "
            f"{found.exported.mean():.4f} of the file, {found.equal} flights equal"
        )
        if not found.agrees:
            raise ConfigError(f"{self.out} does not fly as its checkpoint: {line}")
        print(f"verified: {line}")
