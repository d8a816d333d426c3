"""Fly an exported policy: `uavrl export pretrained:layouts -o policy.onnx`.

Then `python examples/fly_exported.py policy.onnx`.
"""

from __future__ import annotations

import sys

import gymnasium

import uavrl  # noqa: F401  # registers the environment
from uavrl.deployment import Policy


def main(path: str, scenario: str = "released") -> float:
    policy, total, over = Policy(path), 0.0, False
    kind = "devices" if policy.info["network"] == "devices" else "paper"
    env = gymnasium.make("uavrl/DataCollection-v0", scenario=scenario, observation=kind)
    seen, _ = env.reset(seed=0)
    while not over:
        seen, reward, terminated, truncated, _ = env.step(policy.decide(seen)._asdict())
        total, over = total + float(reward), terminated or truncated
    print(f"{policy}: return {total:.1f}")
    return total


if __name__ == "__main__":
    main(sys.argv[1])
