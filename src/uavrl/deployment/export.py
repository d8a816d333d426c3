"""From an agent to one ONNX file: normalisation, chain, re-ranking and decoding inside, raw units at both ends."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim

from uavrl import __version__
from uavrl.agents.base import Agent
from uavrl.deployment.runtime import FORMAT, KEY
from uavrl.errors import ConfigError
from uavrl.networks import Observation
from uavrl.scenario import Scenario
from uavrl.simulation.observations import DEVICE_ENTRIES, UAV_ENTRIES

OPSET = 18
MARGIN = 10.0  # an entry this many times beyond its scenario's limit is taken for a mistaken unit

_EXAMPLE = 2  # rows of the traced example; a single one would be taken for a constant


class _Decision(nn.Module):
    """`agent.decide`, from plain tensors to metres and a device."""

    def __init__(self, agent: Agent, reach_m: float, sampled: bool) -> None:
        super().__init__()
        self.networks = agent.networks
        self.agent, self.reach_m, self.sampled = agent, reach_m, sampled

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """(observation[, noise]) or (uav, devices[, noise]) -> displacements (B, 2) (m), devices (B,)."""
        given, noise = (inputs[:-1], inputs[-1]) if self.sampled else (inputs, None)
        observation: Observation = given[0] if len(given) == 1 else {"uav": given[0], "devices": given[1]}
        action = self.agent.to_fly(self.agent.decide(observation, noise))
        return action.continuous * self.reach_m, action.choice


def export(
    agent: Agent, scenario: Scenario, path: Path, *, sampled: bool = False, facts: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Write `agent` to `path`, for `uavrl.deployment.Policy` to read, and return the metadata inside.

    Args:
        agent: on the CPU.
        scenario: its reach scales the displacements, its limits tell a mistaken unit.
        path: the file; an older one is replaced when the new one is complete.
        sampled: a sample of the policy, from noise (B, R, E) that is one more input; else its deterministic action.
        facts: further metadata.

    Raises:
        ConfigError: the extra `export` is not installed, or the file cannot be written.
    """
    missing = [name for name in ("onnx", "onnxscript") if find_spec(name) is None]
    if missing:
        raise ConfigError(f"export needs {' and '.join(missing)}, install them: pip install 'uavrl[export]'")
    choices = agent.spaces.choices
    batch, devices = Dim("batch"), Dim("devices")
    free: list[dict[int, Any]]
    if agent.spaces.observation is None:
        names, free = ["uav", "devices"], [{0: batch}, {0: batch, 1: devices}]
        example = [torch.ones((_EXAMPLE, len(UAV_ENTRIES))), torch.ones((_EXAMPLE, choices - 1, len(DEVICE_ENTRIES)))]
    else:
        names, free, example = ["observation"], [{0: batch}], [torch.ones((_EXAMPLE, agent.spaces.observation))]
    rows, entries, each = _noise(agent)
    if sampled:
        names.append("noise")
        example.append(torch.zeros((_EXAMPLE, rows, entries + each * (choices - 1))))
        grows = each > 0 and agent.spaces.observation is None
        free.append({0: batch, 2: devices + entries} if grows else {0: batch})
    info: dict[str, Any] = {
        "format": FORMAT,
        "uavrl": __version__,
        "agent": agent.config.name,  # type: ignore[attr-defined]  # every agent's own config names it
        "network": agent.config.network.kind,
        "devices": choices - 1,
        "reach_m": scenario.airframe.max_displacement_m,
        "sampled": sampled,
        "noise": {"rows": rows, "entries": entries, "entries_per_device": each} if sampled else None,
        "inputs": _inputs(scenario, agent),
        "outputs": {"displacement_m": "metres along x and y", "device": "0 idle, k = device k"},
        "scenario": scenario.model_dump(mode="json"),
        **(facts or {}),
    }
    model = _traced(_Decision(agent, scenario.airframe.max_displacement_m, sampled).eval(), names, example, free)
    entry = model.metadata_props.add()
    entry.key, entry.value = KEY, json.dumps(info)
    _write(Path(path), model.SerializeToString())
    return info


def facts_of(document: dict[str, Any]) -> dict[str, Any]:
    """What the metadata tell of a training, from its checkpoint's document."""
    return {
        "seed": document.get("train", {}).get("seed"),
        "updates": document.get("step"),
        "data_sha256": document.get("data", {}).get("sha256"),
        "trained_with": document.get("versions"),
    }


def _noise(agent: Agent) -> tuple[int, int, int]:
    """Rows of noise, entries of a row without devices, and with each device."""
    choices = agent.spaces.choices
    rows, entries = agent.noise_shape(choices)
    each = agent.noise_shape(choices + 1)[1] - entries
    return rows, entries - each * (choices - 1), each


def _inputs(scenario: Scenario, agent: Agent) -> dict[str, Any]:
    """Names, shapes, bounds and caps of the inputs, in the order of their entries."""
    traffic, area = scenario.traffic, scenario.area
    extent_m = MARGIN * max(area.width_m, area.depth_m)
    place_m, age_s = (-extent_m, extent_m), (0.0, MARGIN * traffic.max_age_s)
    energy_j = (0.0, torch.finfo(torch.float32).max)  # a packet can take any time in fading
    mbit = (0.0, MARGIN * max(traffic.packet_bits_each) / 1e6)

    def described(entries: tuple[str, ...], shape: list[int | None], bounds: list[tuple[float, float]]) -> Any:
        low, high = zip(*bounds, strict=True)
        # an age above A_max counts as A_max, where it stops in the simulator
        cap = [traffic.max_age_s if bound is age_s else bound[1] for bound in bounds]
        return {"entries": entries, "shape": shape, "low": low, "high": high, "cap": cap}

    if agent.spaces.observation is not None:
        ages = tuple(f"age_s of device {device}" for device in range(1, traffic.devices + 1))
        bounds = [place_m, place_m, *[age_s] * traffic.devices, energy_j]
        return {"observation": described(("x_m", "y_m", *ages, "energy_j"), [len(bounds)], bounds)}
    token = [place_m, place_m, age_s, (0.0, MARGIN * traffic.devices), mbit, (0.0, 1.0)]
    return {
        "uav": described(UAV_ENTRIES, [len(UAV_ENTRIES)], [place_m, place_m, energy_j, (0.0, 1.0)]),
        "devices": described(DEVICE_ENTRIES, [None, len(DEVICE_ENTRIES)], token),
    }


def _traced(module: nn.Module, names: list[str], example: list[Tensor], free: list[dict[int, Any]]) -> Any:
    """The model of onnx; what the exporter says meanwhile is for its own developers."""
    with torch.no_grad(), warnings.catch_warnings(), _silence():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            tuple(example),
            dynamo=True,
            external_data=False,
            verbose=False,
            opset_version=OPSET,
            input_names=names,
            output_names=["displacement_m", "device"],
            dynamic_shapes={"inputs": tuple(free)},
            custom_translation_table={torch.ops.aten.sort.stable: _sort},
        )
    if program is None:
        raise RuntimeError("torch.onnx.export returned no program")
    model = program.model_proto
    graph = model.graph
    del graph.value_info[:]  # this and the next: shapes and stack traces of the tracing, larger than the weights
    for part in (*graph.node, *graph.input, *graph.output, *graph.initializer, graph, model):
        del part.metadata_props[:]
        part.ClearField("doc_string")
    return model


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def _sort(x: Any, stable: bool, dim: int, descending: bool) -> Any:
    """aten.sort.stable, which torch.onnx does not know: TopK of all, of equal values the first first."""
    from onnxscript import opset18 as op

    every = op.Gather(op.Shape(x), op.Constant(value_ints=[dim]))
    return op.TopK(x, every, axis=dim, largest=int(descending))


def _write(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise ConfigError(f"file '{path}' cannot be written: {error.strerror}") from None
