"""What both sides are given: one set of numbers for the data, the learners and the trial. NumPy alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.peers.point_mass import Flights, Policy, fly, load

EPISODES = 400
DATA_SEED = 0
TRIAL_EPISODES = 200
TRIAL_SEED = 1_000_000
SEEDS = (0, 1, 2)
DATA = "data.npz"
LOSSES = "losses.npz"
PENALTY_SAMPLES = 20_000  # of each kind where losses are compared
WIDE_LOG_STD = 0.5  # of CQL's policy there: importance weights of a narrow one have no finite variance

WIDTH = 64
DEPTH = 2
BATCH = 64
LEARNING_RATE = 1e-3
DISCOUNT = 0.99
POLYAK = 0.005
UPDATES = {"cql": 1_000, "iql": 1_500}

CQL_WEIGHT = 1.0  # of the penalty, where a Bellman error counts with its plain square
CQL_SAMPLES = 10
INITIAL_TEMPERATURE = 0.1
EXPECTILE = 0.7
INVERSE_TEMPERATURE = 3.0
WEIGHT_LIMIT = 100.0

Learn = Callable[[str, Flights, int, int], Policy]  # algorithm, data, seed, updates -> what its policy does at its best


def compare(side: str, learn: Learn, out: Path, *seeds: str) -> None:
    """Learn and fly what `out` lacks: one .npz an algorithm and seed, with the returns (E,) and the processor time."""
    data = load(out / DATA)
    for seed in map(int, seeds or SEEDS):
        for name, updates in UPDATES.items():
            path = out / f"{side}-{name}-{seed}.npz"
            if path.exists():
                continue
            started = time.process_time()
            policy = learn(name, data, seed, updates)
            seconds = time.process_time() - started
            returns = fly(policy, TRIAL_EPISODES, TRIAL_SEED).returns
            np.savez(path, returns=returns, seconds=np.array(seconds))
            print(f"{path.stem}: return {returns.mean():.3f}, {seconds:.0f} s", flush=True)
