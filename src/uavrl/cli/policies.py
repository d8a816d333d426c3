"""From what a user typed after `--policy` to a policy that can be flown."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from uavrl.errors import ConfigError
from uavrl.policies import POLICIES, make_policy
from uavrl.policies.base import Policy
from uavrl.scenario import Scenario


def resolve(spec: str, scenario: Scenario) -> Policy:
    """A heuristic by name, a checkpoint by its directory or as pretrained:NAME, an exported file, your module:Class.

    Raises:
        ConfigError: there is no such policy, or `module:Class` cannot be imported or is no policy.
        CheckpointError: the checkpoint cannot be read, or was made for another scenario's devices.
    """
    if spec in POLICIES:
        return make_policy(spec)
    installed = spec.startswith("pretrained:")
    if installed or Path(spec).is_dir():
        from uavrl.training.policy import load_policy  # here: torch is slow to import

        policy = load_policy(Path(spec), scenario)
        if installed:
            policy.name = spec
        return policy
    if spec.endswith(".onnx"):
        if find_spec("onnxruntime") is None:
            raise ConfigError(f"policy '{spec}' needs onnxruntime, install it: pip install 'uavrl[deploy]'")
        from uavrl.deployment.flight import ExportedPolicy  # here: onnxruntime is an extra

        return ExportedPolicy(Path(spec), scenario)
    if ":" in spec:
        return _import(spec, scenario)
    raise ConfigError(
        f"policy '{spec}' does not exist, allowed: {', '.join(POLICIES)}, the directory of a checkpoint, "
        "pretrained:NAME, an .onnx file, module:Class"
    )


def resolve_all(specs: Sequence[str], scenario: Scenario) -> dict[str, Policy]:
    """Policies by the names that a report gives them: their own, with -2, -3 ... where several share one."""
    policies: dict[str, Policy] = {}
    for spec in specs:
        policy = resolve(spec, scenario)
        name, number = policy.name, 1
        while name in policies:
            number += 1
            name = f"{policy.name}-{number}"
        policies[name] = policy
    return policies


def _import(spec: str, scenario: Scenario) -> Policy:
    """Instantiate `module:Class`, found from the current directory too; given the scenario if it takes an argument."""
    module, _, attribute = spec.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)  # where a user's own file is; an installed command does not look there
    try:
        kind = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever the user's module raises
        raise ConfigError(f"policy '{spec}' cannot be imported: {type(error).__name__}: {error}") from None
    try:
        policy: Any = kind(scenario) if _takes_one(kind) else kind()
    except Exception as error:  # as above
        raise ConfigError(f"policy '{spec}' cannot be made: {type(error).__name__}: {error}") from None
    missing = [name for name in ("name", "needs", "reset", "act") if not hasattr(policy, name)]
    if missing:
        raise ConfigError(f"policy '{spec}' has no '{missing[0]}', needed: name, needs, reset, act")
    flyable: Policy = policy
    return flyable


def _takes_one(kind: Any) -> bool:
    try:
        inspect.signature(kind).bind(None)
    except (TypeError, ValueError):
        return False
    return True
