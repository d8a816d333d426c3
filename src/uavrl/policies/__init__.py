"""What needs no learning: heuristics and the rollout planner."""

from __future__ import annotations

from collections.abc import Callable

from uavrl.errors import ConfigError
from uavrl.policies.base import Policy, SimulatorView
from uavrl.policies.heuristics import HEURISTICS
from uavrl.policies.planner import Planner

__all__ = ["POLICIES", "Policy", "SimulatorView", "make_policy"]

POLICIES: dict[str, Callable[[], Policy]] = {**HEURISTICS, "planner": Planner}


def make_policy(name: str) -> Policy:
    """A new policy by its name.

    Raises:
        ConfigError: no policy has this name.
    """
    if name not in POLICIES:
        raise ConfigError(f"policy '{name}' does not exist, allowed: {', '.join(POLICIES)}")
    return POLICIES[name]()
