"""An exported policy as one that `evaluate` can fly."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from uavrl.deployment.runtime import Policy, PolicyError
from uavrl.errors import ConfigError
from uavrl.scenario import Scenario, parse_scenario
from uavrl.simulation.state import FlightAction


def exported_scenario(path: Path) -> Scenario:
    """The scenario that what was exported learned in.

    Raises:
        ConfigError: the file cannot be read.
    """
    return parse_scenario(_read(path).info["scenario"])


def _read(path: Path) -> Policy:
    try:
        return Policy(path)
    except PolicyError as error:
        raise ConfigError(str(error)) from None


class ExportedPolicy:
    """Flies a file of `uavrl export` through `Policy.decide`, checks and all.

    Raises:
        ConfigError: no such file, or a perceptron for another number of devices than the scenario's.
    """

    def __init__(self, path: Path, scenario: Scenario) -> None:
        self.policy = _read(path)
        info, devices = self.policy.info, scenario.traffic.devices
        self.name = f"{info['agent']} (exported)"
        self.needs: Literal["paper", "devices", "state"] = "devices" if info["network"] == "devices" else "paper"
        if self.needs == "paper" and info["devices"] != devices:
            raise ConfigError(f"policy '{path}' takes devices = {info['devices']} alone, the scenario has {devices}")
        self.devices = devices

    def reset(self, count: int) -> None:
        """Nothing is remembered between steps."""

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        """One action a flight.

        Raises:
            ConfigError: `deterministic` is asked of a file exported with --sampled, or an observation is refused.
        """
        policy, noise = self.policy, None
        if policy.sampled:
            if deterministic:
                raise ConfigError(f"policy '{self.name}' was exported with --sampled, allowed: without --deterministic")
            first = next(iter(observation.values())) if isinstance(observation, dict) else observation
            noise = policy.draw_noise(len(first), self.devices, generator)
        try:
            displacement_m, device = policy.decide(observation, noise)
        except PolicyError as error:
            raise ConfigError(f"policy '{self.name}': {error}") from None
        return FlightAction(displacement_m.astype(np.float64), device)
