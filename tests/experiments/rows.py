"""Finished rows as `uavrl reproduce` keeps them, without any run: what learning returned is made up."""

from __future__ import annotations

from typing import Any

import numpy as np

from uavrl.experiments.flights import KEPT, SHOWN
from uavrl.experiments.paper import FIGURES, SCALES, Plan
from uavrl.experiments.runner import Run

ENVIRONMENTS = 12
PLAN = Plan(SCALES["smoke"])
# worse from left to right; what every sentence of the paper is measured on follows from it
COST = {"planner": 200.0, "Diffusion-SAC": 210.0, "index at best hover": 215.0, "online SAC": 220.0, "CQL": 240.0,
        "IQL": 245.0, "BC": 260.0, "TDM": 300.0, "BCQ": 320.0, "random walk": 1900.0, "Saver": 5000.0}  # fmt: skip


def cost_of(variant: str) -> float:
    """Cost of a variant, by the first name of COST in it; of the six (alpha, eta) by their numbers."""
    if variant.startswith("alpha"):
        alpha, eta = (float(part.split("= ")[1]) for part in variant.split(", "))
        return 210.0 + 30.0 * alpha + 20.0 * abs(eta - 0.5)
    if variant.startswith(("linear", "vp")):
        return 210.0
    return next((cost for name, cost in COST.items() if variant.startswith(name)), 230.0)


def row(run: Run, cost: float | None = None) -> dict[str, Any]:
    """A finished run whose environments cost `cost` and a little more or less, by seed and environment."""
    cost = cost_of(run.variant) if cost is None else cost
    numbers = np.random.default_rng(run.seed)
    costs = cost * (1.0 + 0.02 * numbers.standard_normal(ENVIRONMENTS) + np.linspace(-0.1, 0.1, ENVIRONMENTS))
    flown = {name: list(costs / 200.0) for name in KEPT} | {"return": list(-costs)}
    flown["throughput_mbps"] = flown["data_mb"] = flown["jain_age"] = list(200.0 / costs)
    scores: dict[str, Any] = {"flown": flown, "decision_ms": 1.0}
    if run.problem != "policy":
        scores["other_return"] = list(-2.0 * costs)
        scores["curve"] = {"at": [5, 10]} | {name: [-2.0 * cost, -cost] for name in SHOWN}
    machine = {"processor": "a core", "commit": "0123456789abcdef"}
    return {"key": run.key, **run.model_dump(mode="json"), "scores": scores, "seconds": 60.0, "machine": machine}


def finished_figures() -> dict[str, list[dict[str, Any]]]:
    """Every figure of the smallest scale, finished."""
    return {name: [row(run) for run in figure.runs(PLAN)] for name, figure in FIGURES.items()}
