"""torch.compile of the networks' passes, each alone: compiling a whole chain takes longer than it saves."""

from __future__ import annotations

import shutil
from typing import Literal

import torch
from torch import nn

from uavrl.agents.base import Agent
from uavrl.errors import ConfigError
from uavrl.networks import Critic, Denoiser

Compilation = Literal["none", "step", "graphs"]

_PASSES: dict[type[nn.Module], tuple[str, ...]] = {Denoiser: ("predict",), Critic: ("all_choices", "value")}


def compile_passes(agent: Agent, compilation: Compilation, device: torch.device) -> None:
    """Compile a step of the denoisers and a pass of the critics, in place; weights and their names stay as they are.

    Args:
        agent: its networks are on `device`.
        compilation: "step": by torch's Inductor, with gradients; "graphs": in CUDA graphs as well; "none": nothing.
        device: where it computes.

    Raises:
        ConfigError: "graphs" on a CPU, no C++ compiler for one, or an agent of neither kind of network.
    """
    if compilation == "none":
        return
    if compilation == "graphs" and device.type != "cuda":
        raise ConfigError("--compile graphs needs --device cuda, allowed on a CPU: none, step")
    if device.type == "cpu" and not any(map(shutil.which, ("g++", "clang++"))):
        raise ConfigError("--compile step needs a C++ compiler, g++ or clang++, and there is none")
    mode = "reduce-overhead" if compilation == "graphs" else "default"
    passes = [
        (module, name)
        for module in agent.networks.modules()
        for kind, names in _PASSES.items()
        if isinstance(module, kind)
        for name in names
    ]
    for module, name in passes:
        setattr(module, name, torch.compile(getattr(module, name), mode=mode))
    if not passes:
        raise ConfigError(f"--compile {compilation}: this agent has no denoiser and no critic, allowed: none")
