"""Policies whose every action is known, and an evaluation set whose every duration is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from uavrl.evaluation.rollouts import EvaluationSet
from uavrl.physics.channel import link_snr, rate_bps
from uavrl.scenario import Scenario, load_scenario
from uavrl.simulation.state import FlightAction


@dataclass
class Scripted:
    """Commands the same devices and displacement in every flight, from the first step on, round and round."""

    devices: Sequence[int]
    displacement_m: tuple[float, float] = (0.0, 0.0)
    name: str = "scripted"
    needs: Literal["paper", "devices", "state"] = "state"
    resets: list[int] = field(default_factory=list)
    _step: int = 0

    def reset(self, count: int) -> None:
        self.resets.append(count)
        self._step = 0

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        count = self.resets[-1]
        device = self.devices[self._step % len(self.devices)]
        self._step += 1
        return FlightAction(np.tile(self.displacement_m, (count, 1)), np.full(count, device))


@dataclass
class Wanderer:
    """Uniform moves and devices: uses the generator."""

    name: str = "wanderer"
    needs: Literal["paper", "devices", "state"] = "paper"
    count: int = 0

    def reset(self, count: int) -> None:
        self.count = count

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        devices = observation.shape[1] - 3
        return FlightAction(
            generator.uniform(-20, 20, (self.count, 2)), generator.integers(devices + 1, size=self.count)
        )


def timed_scenario(**overrides: Any) -> Scenario:
    """Two devices; right below, device 1 sends for 1 s and device 2 for 2 s; a decision takes 0.5 s; 4 steps."""
    base = load_scenario("released", devices=2, fading="none", decision_s=0.5, max_steps=4)
    snr = link_snr(np.zeros(1), base.channel)[2]
    rate = float(rate_bps(snr, base.channel.bandwidth_hz)[0])
    return base.replace(packet_bits=(rate, 2.0 * rate), **overrides)


def overhead(scenario: Scenario, episodes: int = 1) -> EvaluationSet:
    """All devices and the start at one point."""
    devices = scenario.traffic.devices
    return EvaluationSet(
        scenario=scenario,
        layouts="overhead",
        layout_m=np.full((episodes, devices, 2), 500.0),
        start_m=np.full((episodes, 2), 500.0),
        unit=np.arange(episodes),
        seed=1_000_000,
        fading_seeds=1,
    )
