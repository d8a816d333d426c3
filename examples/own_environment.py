"""Any agent on an environment of your own, from logged random actions: uavrl's agents know nothing of UAVs.

    python examples/own_environment.py [bc|bcq|cql|diffusion_sac|gaussian_bc|iql]

A cart on a rail is handed parcels of three kinds. At each step it drives (continuous) and throws the parcel into one of
three bins (choice), which stand at three places. It is paid for the right bin, less the distance that it threw.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np
import torch

from uavrl.actions import HybridAction
from uavrl.agents.base import Agent, Batch
from uavrl.agents.registry import make_agent, preset
from uavrl.networks import NetworkConfig, Spaces
from uavrl.training.fit import fit

BINS = np.array([-0.5, 0.0, 0.5])


class Cart(gymnasium.Env[Any, Any]):
    """Observation: place, and kind of the parcel as a one-hot; 25 steps an episode."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))
    action_space = gymnasium.spaces.Tuple((gymnasium.spaces.Box(-1.0, 1.0, (1,)), gymnasium.spaces.Discrete(3)))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time, self.place, self.kind = 0, float(self.np_random.uniform(-1, 1)), int(self.np_random.integers(3))
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time, self.place = self.time + 1, float(np.clip(self.place + action[0][0], -1.0, 1.0))
        reward = float(action[1] == self.kind) - abs(self.place - BINS[self.kind])
        self.kind = int(self.np_random.integers(3))
        return self._observation(), reward, False, self.time == 25, {}

    def _observation(self) -> Any:
        return np.array([self.place, *np.eye(3)[self.kind]], dtype=np.float32)


def log(env: Cart, steps: int) -> Batch:
    """Transitions of random actions."""
    env.action_space.seed(0)
    seen, rows = env.reset(seed=0)[0], []
    for _ in range(steps):
        action = env.action_space.sample()
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((seen, action[0], action[1], reward, terminated, following))
        seen = env.reset()[0] if truncated else following
    before, w, d, rewards, ends, after = (torch.from_numpy(np.array(column)) for column in zip(*rows, strict=True))
    rewards = (rewards - rewards.median()).float()  # Q is near 0 then, where a network begins
    return Batch(before, HybridAction(w.float(), d.long()), rewards, torch.ones(steps), ends.float(), after)


def mean_reward(env: Cart, agent: Agent | None, steps: int = 250) -> float:
    """Of an agent, or of random actions."""
    generator, total = torch.Generator().manual_seed(1), 0.0
    seen, _ = env.reset(seed=1)
    for _ in range(steps):
        action = env.action_space.sample()
        if agent is not None:
            chosen = agent.act(torch.from_numpy(seen)[None], generator=generator, deterministic=True)
            action = chosen.continuous[0].numpy(), int(chosen.choice[0])
        seen, reward, _, truncated, _ = env.step(action)
        total += reward
        seen = env.reset()[0] if truncated else seen
    return total / steps


def main(name: str = "iql", updates: int = 300) -> tuple[float, float]:
    env = Cart()
    batch = log(env, 4_000)
    torch.manual_seed(0)  # of the weights
    network = NetworkConfig(kind="mlp", width=64, depth=2)
    config = preset(name, "default").model_copy(update={"network": network, "discount": 0.5, "batch_size": 128})
    agent = make_agent(Spaces(observation=4, continuous=1, choices=3), config)
    fit(agent, batch, updates, torch.Generator().manual_seed(0))
    random, learned = mean_reward(env, None), mean_reward(env, agent)
    print(f"reward a step: {random:.2f} of random actions, as logged; {learned:.2f} of {name}; 1.00 at best")
    return random, learned


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "iql")
