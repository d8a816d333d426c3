"""A point mass with drag that is to reach the origin and stay there: small, continuous, with a known good controller.

Each of two axes, with the action u in [-1, 1], is
    v' = (1 - drag dt) v + dt u + sigma e,   p' = p + dt v',   r = -dt sum_axes (p^2 + .1 v^2 + .1 u^2).
Episodes of 50 steps are cut, never terminated. NumPy alone, so that both environments can import it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Policy = Callable[[Array], Array]  # observations (E, 4) -> actions (E, 2)

DT_S = 0.2
DRAG = 0.5  # per second
NOISE = 0.05  # of the velocity, a step
SPEED_COST = 0.1
ACTION_COST = 0.1
STEPS = 50
OBSERVATION = 4  # p_x, p_y, v_x, v_y
ACTION = 2


@dataclass(frozen=True)
class Flights:
    """E episodes of T steps."""

    observation: Array  # (E, T + 1, 4), where the last is seen and not acted on
    action: Array  # (E, T, 2)
    reward: Array  # (E, T)

    @property
    def returns(self) -> Array:
        """Undiscounted, (E,)."""
        total: Array = self.reward.sum(axis=1)
        return total


def step(observation: Array, action: Array, noise: Array) -> tuple[Array, Array]:
    """Next observation (E, 4) and reward (E,) for actions (E, 2) and standard normal noise (E, 2)."""
    position, velocity = observation[:, :2], observation[:, 2:]
    push = np.clip(action, -1.0, 1.0)
    cost: Array = (position**2 + SPEED_COST * velocity**2 + ACTION_COST * push**2).sum(axis=1)
    velocity = (1.0 - DRAG * DT_S) * velocity + DT_S * push + NOISE * noise
    return np.concatenate([position + DT_S * velocity, velocity], axis=1), -DT_S * cost


def starts(episodes: int, generator: np.random.Generator) -> Array:
    """Positions in [-1, 1], velocities in [-.5, .5], (E, 4)."""
    half: Array = np.array([1.0, 1.0, 0.5, 0.5])
    return generator.uniform(-half, half, (episodes, OBSERVATION))


def fly(policy: Policy, episodes: int, seed: int) -> Flights:
    """Episodes of one policy; equal seeds give equal starts and gusts whatever the policy does."""
    generator = np.random.default_rng(seed)
    observation = starts(episodes, generator)
    gusts = generator.standard_normal((STEPS, episodes, ACTION))
    seen, acted, paid = [observation], [], []
    for noise in gusts:
        action = np.clip(policy(observation), -1.0, 1.0)
        observation, reward = step(observation, action, noise)
        seen.append(observation)
        acted.append(action)
        paid.append(reward)
    return Flights(np.stack(seen, axis=1), np.stack(acted, axis=1), np.stack(paid, axis=1))


def behaviour(episodes: int, seed: int) -> Policy:
    """What logs the data: a noisy PD controller, its gains drawn once an episode, three actions in ten uniform."""
    generator = np.random.default_rng(seed)
    stiffness = generator.uniform(0.0, 2.0, (episodes, 1))
    damping = generator.uniform(0.0, 1.5, (episodes, 1))

    def act(observation: Array) -> Array:
        wanted = -stiffness * observation[:, :2] - damping * observation[:, 2:]
        noisy = wanted + 0.3 * generator.standard_normal(wanted.shape)
        random = generator.uniform(-1.0, 1.0, wanted.shape)
        return np.where(generator.random((episodes, 1)) < 0.3, random, noisy)

    return act


def log(episodes: int, seed: int) -> Flights:
    """The data, from one seed."""
    return fly(behaviour(episodes, seed + 1), episodes, seed)


def save(path: Path, flights: Flights) -> None:
    """As .npz of float32, what both libraries compute in."""
    observation, action, reward = (a.astype(np.float32) for a in (flights.observation, flights.action, flights.reward))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, observation=observation, action=action, reward=reward)


def load(path: Path) -> Flights:
    """What `save` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return Flights(file["observation"], file["action"], file["reward"])


def transitions(flights: Flights) -> dict[str, Array]:
    """Observation, action, reward and next observation, one row a transition: what our side learns from."""
    return {
        "observation": flights.observation[:, :-1].reshape(-1, OBSERVATION),
        "action": flights.action.reshape(-1, ACTION),
        "reward": flights.reward.reshape(-1),
        "next_observation": flights.observation[:, 1:].reshape(-1, OBSERVATION),
    }


def cut_episodes(flights: Flights) -> list[dict[str, Array]]:
    """Episodes as d3rlpy takes them.

    It finds the next observation of a step in the row after it, and of an episode that was cut it leaves out the last
    row. So each gets one row more, with the last observation; its action and reward, zeros, are never learned from.
    """
    action = np.pad(flights.action, ((0, 0), (0, 1), (0, 0)))
    reward = np.pad(flights.reward, ((0, 0), (0, 1)))[..., None]
    rows = zip(flights.observation, action, reward, strict=True)
    return [{"observations": o, "actions": a, "rewards": r} for o, a, r in rows]
