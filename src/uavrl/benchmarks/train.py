"""Updates a second of Diffusion-SAC, beside the time that its own matrix products take alone."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from uavrl.agents.registry import preset
from uavrl.benchmarks.timing import bf16_units, rate
from uavrl.datasets import load_builtin
from uavrl.scenario import load_scenario
from uavrl.training.offline import OfflineLearner, TrainConfig

PRESETS = {"paper": "fixed", "default": "layouts"}  # preset -> built-in data it is timed on
_ATEN = torch.ops.aten
_PRODUCTS = {_ATEN.mm.default, _ATEN.addmm.default, _ATEN.bmm.default, _ATEN.mv.default}


@dataclass(frozen=True)
class Operand:
    """Shape and strides of a factor: a transposed one is not as fast as one that lies in order."""

    shape: tuple[int, ...]
    stride: tuple[int, ...]

    @classmethod
    def of(cls, tensor: Tensor) -> Operand:
        """A tensor's."""
        return cls(tuple(tensor.shape), tuple(tensor.stride()))

    def filled(self, dtype: torch.dtype) -> Tensor:
        """A tensor of ones like it."""
        return torch.empty_strided(self.shape, self.stride, dtype=dtype).fill_(1.0)


class Products(TorchDispatchMode):
    """Counts the matrix products of whatever runs inside, those of gradients included."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch's own
        self.found: Counter[tuple[Operand, Operand]] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note a product's factors, and run it."""
        if func in _PRODUCTS:
            first, second = args[-2:]
            self.found[Operand.of(first), Operand.of(second[:, None] if second.dim() == 1 else second)] += 1
        return func(*args, **(kwargs or {}))

    @property
    def flop(self) -> float:
        """Multiplications and additions of all products."""
        return float(sum(2 * torch.Size(a.shape).numel() * b.shape[-1] * times for (a, b), times in self.found.items()))

    def seconds(self, dtype: torch.dtype, each_s: float = 0.1) -> float:
        """All of them one after another, each kind timed alone for `each_s`."""
        total = 0.0
        for (first, second), times in self.found.items():
            a, b = first.filled(dtype), second.filled(dtype)
            result = torch.matmul(a, b)
            once = rate(lambda a=a, b=b, out=result: torch.matmul(a, b, out=out), seconds=each_s)  # type: ignore[misc]  # bound now
            total += times / once.per_s
        return total


def learner(name: str) -> OfflineLearner:
    """A preset of Diffusion-SAC on its built-in data, a few updates in."""
    plan = TrainConfig(scenario=load_scenario("released"), agent=preset("diffusion_sac", name), updates=1_000_000)
    made = OfflineLearner(plan, load_builtin(PRESETS[name]))
    for _ in range(3):
        made.step()
    return made


def measure(name: str, seconds: float) -> dict[str, float]:
    """Updates a second of a preset on the CPU, what its products allow, and how many operations those are.

    In bf16, too, where the processor has units for it.
    """
    made = learner(name)
    products = Products()
    with products:
        made.step()
    found = {
        **rate(made.step, seconds=seconds).named(f"{name}_updates"),
        f"{name}_updates_floor_per_s": 1.0 / products.seconds(torch.float32),
        f"{name}_gflop_per_update": products.flop / 1e9,
    }
    if bf16_units():
        found[f"{name}_updates_bf16_floor_per_s"] = 1.0 / products.seconds(torch.bfloat16)
    return found
