"""Checkpoints: a directory of JSON and safetensors, written under a temporary name and renamed.

    checkpoint.json   what was saved: kind, step, any JSON; size and SHA-256 of every other file
    *.safetensors     tensors: networks, optimisers, generators, whatever the caller names

Nothing in it is pickled. A directory cannot replace another in one step, so saving to NAME goes through three names:

    .NAME.tmp   is written; never read
    NAME        is renamed to .NAME.old, then .NAME.tmp to NAME
    .NAME.old   is deleted; read only while there is no NAME, that is, between the two renames

So a writer that is killed at any byte leaves a whole checkpoint: the new one, or the one before it. The names are the
same for every process, so whatever one leaves behind the next clears away, and no older checkpoint can come back.
One writer at a time.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from uavrl import __version__
from uavrl.agents.base import Agent
from uavrl.datasets.files import sync
from uavrl.errors import CheckpointError

MANIFEST = "checkpoint.json"
PRETRAINED = "pretrained:"  # opens the name of a policy that is installed with the package
_INSTALLED = Path(__file__).parent / "installed"
Tensors = dict[str, Tensor]


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint in memory."""

    document: dict[str, Any]  # JSON
    tensors: dict[str, Tensors]  # one entry a file


def save_checkpoint(directory: Path, document: dict[str, Any], tensors: dict[str, Tensors]) -> None:
    """Write a checkpoint to `directory`, replacing an older one there only when the new one is complete."""
    directory = Path(directory)
    temporary, old = _temporary(directory), _old(directory)
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    files = {}
    for name, entries in tensors.items():
        path = temporary / f"{name}.safetensors"
        save_file({key: value.detach().contiguous().cpu().clone() for key, value in entries.items()}, path)
        sync(path)
        files[path.name] = {"bytes": path.stat().st_size, "sha256": _sha256(path)}
    versions = {"uavrl": __version__, "python": platform.python_version(), "torch": torch.__version__}
    path = temporary / MANIFEST
    path.write_text(json.dumps({**document, "files": files, "versions": versions}, indent=1), encoding="utf-8")
    sync(path)
    sync(temporary)
    if directory.exists():
        shutil.rmtree(old, ignore_errors=True)  # left by a writer killed while deleting it
        directory.rename(old)
    temporary.rename(directory)
    sync(directory.parent)
    shutil.rmtree(old, ignore_errors=True)


def load_checkpoint(directory: Path) -> Checkpoint:
    """Read a checkpoint; where a writer is, or was killed, between its two renames, the one that was being replaced.

    Raises:
        CheckpointError: nothing there, a file missing, cut short or altered.
    """
    directory = Path(directory)
    if not directory.exists() and _old(directory).exists():
        directory = _old(directory)
    if not directory.exists():
        raise CheckpointError(f"checkpoint '{directory}' does not exist")
    path = directory / MANIFEST
    if not path.is_file():
        raise CheckpointError(f"'{directory}' is no checkpoint: it has no {MANIFEST}")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        files = dict(document["files"])
    except (OSError, ValueError, KeyError, TypeError):
        raise CheckpointError(f"checkpoint file '{path}' is damaged: no valid JSON manifest") from None
    tensors = {}
    for name, facts in files.items():
        file = directory / name
        if not file.is_file():
            raise CheckpointError(f"checkpoint '{directory}' lacks its file '{name}'")
        size = file.stat().st_size
        if size != facts["bytes"] or _sha256(file) != facts["sha256"]:
            raise CheckpointError(f"checkpoint file '{file}' is damaged: {size} bytes, written were {facts['bytes']}")
        try:
            tensors[file.stem] = load_file(file)
        except SafetensorError as error:
            raise CheckpointError(f"checkpoint file '{file}' is damaged: {error}") from None
    return Checkpoint(document, tensors)


def recover(directory: Path) -> Path | None:
    """The checkpoint at `directory`, putting back one that was being replaced when its writer was killed.

    For the next writer alone: one that is still at work would find its second rename barred.
    """
    directory = Path(directory)
    if not directory.exists() and _old(directory).exists():
        _old(directory).rename(directory)
    return directory if directory.exists() else None


def checkpoint_in(path: Path) -> Path:
    """Where the checkpoint is, of a run's directory, of the checkpoint's own, or of `pretrained:NAME`.

    Raises:
        CheckpointError: no such pretrained policy.
    """
    if str(path).startswith(PRETRAINED):
        return pretrained(str(path).removeprefix(PRETRAINED))
    place = Path(path) / "checkpoint"
    return place if place.is_dir() or _old(place).is_dir() else Path(path)


def pretrained_names() -> tuple[str, ...]:
    """Policies installed with the package."""
    return tuple(sorted(path.parent.name for path in _INSTALLED.glob(f"*/{MANIFEST}")))


def pretrained(name: str) -> Path:
    """Directory of an installed policy's checkpoint, its model card in README.md beside it.

    Raises:
        CheckpointError: there is none of this name.
    """
    if name not in pretrained_names():
        allowed = ", ".join(PRETRAINED + known for known in pretrained_names())
        raise CheckpointError(f"pretrained policy '{name}' does not exist, allowed: {allowed}")
    return _INSTALLED / name


def agent_tensors(agent: Agent) -> dict[str, Tensors]:
    """Networks and optimisers of an agent, as files of a checkpoint."""
    optimiser: Tensors = {}
    for name, one in agent.optimisers.items():
        for index, state in one.state_dict()["state"].items():
            for key, value in state.items():
                optimiser[f"{name}.{index}.{key}"] = torch.as_tensor(value)
    return {"networks": dict(agent.networks.state_dict()), "optimisers": optimiser}


def restore_agent(agent: Agent, tensors: dict[str, Tensors]) -> None:
    """Inverse of `agent_tensors`, into an agent made from the same configuration.

    Raises:
        CheckpointError: the tensors belong to other networks.
    """
    restore_networks(agent, tensors["networks"])
    for name, one in agent.optimisers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors["optimisers"].items():
            owner, index, entry = key.split(".", 2)
            if owner == name:
                state.setdefault(int(index), {})[entry] = value
        one.load_state_dict({"state": state, "param_groups": one.state_dict()["param_groups"]})


def restore_networks(agent: Agent, networks: Tensors) -> None:
    """Weights alone, enough to act."""
    try:
        agent.networks.load_state_dict(networks)
    except RuntimeError as error:
        reason = str(error).split("\n")[1].strip() if "\n" in str(error) else str(error)
        raise CheckpointError(f"checkpoint does not fit its own configuration: {reason}") from None


def numpy_state(generator: np.random.Generator) -> dict[str, Any]:
    """A NumPy generator's state as JSON."""
    return dict(generator.bit_generator.state)


def set_numpy_state(generator: np.random.Generator, state: dict[str, Any]) -> None:
    """Inverse of `numpy_state`."""
    generator.bit_generator.state = state


def _temporary(directory: Path) -> Path:
    return directory.with_name(f".{directory.name}.tmp")


def _old(directory: Path) -> Path:
    return directory.with_name(f".{directory.name}.old")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
