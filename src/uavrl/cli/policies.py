"""From what a user typed after `--policy` to a policy that can be flown."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavrl.cli.settings import pydantic_config
from uavrl.errors import ConfigError
from uavrl.policies import POLICIES, make_policy
from uavrl.policies.base import Policy
from uavrl.scenario import Scenario

if TYPE_CHECKING:
    from uavrl.training.policy import Decision

SETTINGS = (
    "candidates=N",
    "null_candidate=true|false",
    "greedy_choice=true|false",
    "choice_prior=X",
    "shortest_move=X",
    "solver=ddim|dpm",
    "steps=N",
)


def resolve(spec: str, scenario: Scenario) -> Policy:
    """A heuristic by name, a checkpoint (see `checkpoint_and_decision`), an exported file, your module:Class.

    Raises:
        ConfigError: there is no such policy, or `module:Class` cannot be imported or is no policy.
        CheckpointError: the checkpoint cannot be read, or was made for another scenario's devices.
    """
    if spec in POLICIES:
        return make_policy(spec)
    place, settings = _split(spec)
    installed = place.startswith("pretrained:")
    if installed or Path(place).is_dir():
        from uavrl.training.policy import load_policy  # here: torch is slow to import

        path, decision = checkpoint_and_decision(spec)
        policy = load_policy(path, scenario, decision)
        policy.name = (place if installed else policy.name) + (f"@{settings}" if settings else "")
        return policy
    if spec.endswith(".onnx"):
        _require_onnxruntime(spec)
        from uavrl.deployment.flight import ExportedPolicy  # here: onnxruntime is an extra

        return ExportedPolicy(Path(spec), scenario)
    if ":" in spec:
        return _import(spec, scenario)
    raise ConfigError(
        f"policy '{spec}' does not exist, allowed: {', '.join(POLICIES)}, the directory of a checkpoint, "
        f"pretrained:NAME, either with @{','.join(SETTINGS)}, an .onnx file, module:Class"
    )


def learned_in(spec: str) -> Scenario | None:
    """The scenario that a checkpoint, or what an exported file was made of, was trained in; None for any other policy.

    Raises:
        ConfigError: an exported file that cannot be read.
        CheckpointError: a checkpoint that cannot be read.
    """
    place, _ = _split(spec)
    if spec not in POLICIES and (place.startswith("pretrained:") or Path(place).is_dir()):
        from uavrl.training.policy import trained_scenario  # here: torch is slow to import

        return trained_scenario(Path(place))
    if spec not in POLICIES and spec.endswith(".onnx"):
        _require_onnxruntime(spec)
        from uavrl.deployment.flight import exported_scenario  # here: onnxruntime is an extra

        return exported_scenario(Path(spec))
    return None


def checkpoint_and_decision(spec: str) -> tuple[Path, Decision]:
    """`runs/mine`, `pretrained:NAME`, or either followed by how it is to decide: `runs/mine@solver=dpm,steps=3`.

    Raises:
        ConfigError: no such setting of a decision, or a value that it does not allow.
    """
    from uavrl.training.policy import Decision  # here: torch is slow to import

    place, settings = _split(spec)
    values: dict[str, str] = {}
    for setting in settings.split(",") if settings else ():
        name, equals, value = setting.partition("=")
        if not equals or name not in Decision.model_fields or name in values:
            raise ConfigError(f"policy '{spec}': '{setting}', allowed: {', '.join(SETTINGS)}, each once")
        values[name] = value
    try:
        return Path(place), pydantic_config(Decision, **values)
    except ConfigError as error:
        raise ConfigError(f"policy '{spec}': {error}") from None


def _require_onnxruntime(spec: str) -> None:
    if find_spec("onnxruntime") is None:
        raise ConfigError(f"policy '{spec}' needs onnxruntime, install it: pip install 'uavrl[deploy]'")


def _split(spec: str) -> tuple[str, str]:
    """What stands before the last @ and after it; a directory's own name may hold one."""
    place, _, settings = (spec, "", "") if Path(spec).is_dir() or "@" not in spec else spec.rpartition("@")
    return place, settings


def resolve_all(specs: Sequence[str], scenario: Scenario, *, deterministic: bool = False) -> dict[str, Policy]:
    """Policies by the names that a report gives them: their own, with -2, -3 ... where several share one.

    Raises:
        ConfigError: as of `resolve`; or candidates to choose from in a `deterministic` flight, which has but one.
    """
    policies: dict[str, Policy] = {}
    for spec in specs:
        if deterministic and "candidates=" in _split(spec)[1]:
            raise ConfigError(f"policy '{spec}' has candidates to choose from, allowed: without --deterministic")
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
