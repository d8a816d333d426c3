"""Where an update's time goes, by kind of operation: `python -m benchmarks.profile [paper|default]`."""

from __future__ import annotations

from collections import Counter
from typing import Literal

from torch.profiler import ProfilerActivity, profile
from tyro.conf import Positional

from benchmarks import script
from uavrl.benchmarks.train import learner

UPDATES = 20
KINDS = {
    "products": ("aten::mm", "aten::addmm", "aten::bmm", "aten::addmm_"),
    "activations": ("mish", "silu", "sigmoid", "tanh", "_Layers", "threshold", "relu"),
    "optimiser": ("adam", "Optimizer", "foreach", "lerp"),
}


def kind(name: str) -> str:
    """Which of `KINDS` an operation belongs to."""
    for found, parts in KINDS.items():
        if any(name == part if part.startswith("aten::") else part in name for part in parts):
            return found
    return "other operations"


def measure(preset: str) -> dict[str, float]:
    """Milliseconds an update in each kind of operation, Python's own time between them left out."""
    made = learner(preset)
    with profile(activities=[ProfilerActivity.CPU]) as found:
        for _ in range(UPDATES):
            made.step()
    spent: Counter[str] = Counter()
    for event in found.key_averages():
        spent[kind(event.key)] += event.self_cpu_time_total / 1000.0 / UPDATES
    return dict(spent)


def main(presets: Positional[tuple[Literal["paper", "default"], ...]] = ("paper", "default")) -> None:
    """Print a table each.

    Args:
        presets: of Diffusion-SAC.
    """
    for preset in presets:
        found = measure(preset)
        print(f"| preset {preset} | ms an update |\n|---|---|")
        for name, milliseconds in sorted(found.items(), key=lambda entry: -entry[1]):
            print(f"| {name} | {milliseconds:.1f} |")
        print(f"| all | {sum(found.values()):.1f} |")


if __name__ == "__main__":
    script.run(main, "benchmarks.profile")
