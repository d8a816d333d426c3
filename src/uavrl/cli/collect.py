"""`uavrl collect`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from uavrl.cli.settings import Many, differing, output_directory, pydantic_config, with_settings
from uavrl.errors import ConfigError
from uavrl.scenario import load_scenario


@dataclass(frozen=True)
class Collect:
    """Let hybrid SAC learn online in the simulator and log all of its flights. Interrupted, it goes on where it was."""

    out: Path
    """directory of the run: checkpoint, metrics.jsonl and, at the end, flights.parquet"""
    layouts: Literal["fixed", "random"] = "fixed"
    """one layout throughout, or a new one each episode"""
    scenario: str = "released"
    """a preset (paper, released, realistic) or a TOML file"""
    network: Literal["devices", "mlp"] = "devices"
    """a network over the set of devices, or the paper's perceptron on its K + 3 entries"""
    episodes: int = 700
    """flights to log"""
    steps_per_update: int = 8
    """environment steps for each gradient step; more where flights are long"""
    seed: int = 0
    """of layouts, starts, fading, exploration and weights; below 1,000,000"""
    set: Many = ()
    """a setting of the learner as name=value, such as discount=0.99; repeat it for more"""
    minari: str | None = None
    """id of the Minari dataset to write at the end, such as uavrl/fixed-v0"""
    tensorboard: bool = False
    """write the log for TensorBoard as well; needs the extra 'tracking'"""

    def run(self) -> None:
        from uavrl.agents.sac import SacConfig
        from uavrl.datasets import free_minari_folder, save_flat, write_minari
        from uavrl.networks import NetworkConfig
        from uavrl.training.log import progress, require_tensorboard
        from uavrl.training.online import CollectConfig, OnlineLearner
        from uavrl.training.scenario_settings import for_scenario

        if self.tensorboard:
            require_tensorboard()
        width = 256 if self.network == "mlp" else 64
        scenario = load_scenario(self.scenario)
        agent = for_scenario(SacConfig(network=NetworkConfig(kind=self.network, width=width)), scenario, self.set)
        config = pydantic_config(
            CollectConfig,
            scenario=scenario,
            layouts=self.layouts,
            agent=with_settings(agent, self.set),
            episodes=self.episodes,
            steps_per_update=self.steps_per_update,
            seed=self.seed,
        )
        if self.minari is not None:
            free_minari_folder(self.minari)
        output_directory(self.out)
        learner = OnlineLearner.resume(self.out)
        if learner is None:
            learner = OnlineLearner(config)
        elif learner.config != config:
            raise ConfigError(
                f"--out '{self.out}' holds a run of other settings, give another directory or the same ones: "
                + differing(learner.config, config)
            )
        else:
            print(f"going on from step {len(learner.log):,}", file=sys.stderr)
        try:
            with progress("collect", config.episodes, "flight") as report:
                transitions = learner.run(self.out, report, tensorboard=self.tensorboard)
        except KeyboardInterrupt:
            if learner.saved is not None:
                print(f"saved step {learner.saved:,}; the same command goes on", file=sys.stderr)
            raise
        save_flat(self.out / "flights.parquet", transitions, config.scenario)
        print(f"{self.out / 'flights.parquet'}: {transitions!r}")
        if self.minari is not None:
            write_minari(self.minari, transitions, config.scenario, learner.kind)
            print(f"Minari dataset {self.minari}")
        print(f"next: uavrl data show {self.out / 'flights.parquet'}")
