"""What there is to compute, what is done already, and how long the rest will take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from rich.table import Table

from uavrl.experiments.flights import Setting
from uavrl.experiments.paper import FIGURES
from uavrl.experiments.runner import Row, Run
from uavrl.training.scenario_settings import STEP_S

# Seconds of one core (AMD EPYC without AVX-512) an update, by agent and network, until a run of the kind has finished
_UPDATE_S = {
    ("diffusion_sac", "devices"): 0.08,
    ("diffusion_sac", "mlp"): 0.14,
    ("cql", "devices"): 0.14,
    ("bcq", "devices"): 0.14,
    ("iql", "devices"): 0.06,
}
_OTHER_UPDATE_S = 0.02
_FLIGHT_S = 2.0  # of an online learner
_FLOWN_S = 0.06  # a flight of 400 steps of the evaluation, learned policies
_PLANNED_S = 0.4  # and the planner's


def kind(run: Run) -> tuple[Any, ...]:
    """Runs of one kind take equally long for each update."""
    network = run.settings.get("network", {}).get("kind")
    diffusion = run.settings.get("diffusion", {})
    name = run.settings.get("name", run.settings.get("policy"))
    chain = (diffusion.get("steps"), run.settings.get("gradient"), run.settings.get("cql_weight", 0) > 0)
    return (run.problem, name, network, *chain)


def estimated_s(run: Run) -> float:
    """Core-seconds of a run of which nothing is known."""
    setting, settings = Setting.model_validate(run.options), run.settings
    limits = setting.scenario.limits
    length = (limits.max_steps or (limits.time_budget_s or 0.0) / STEP_S) / 400
    flights = length * setting.episodes * (setting.fading_seeds + setting.points + 1)
    if run.problem == "policy":
        a_flight = _PLANNED_S if settings["policy"] == "planner" else _FLOWN_S
        return setting.episodes * setting.fading_seeds * length * a_flight
    if run.problem == "online":
        return run.updates * _FLIGHT_S + flights * _FLOWN_S
    an_update = _UPDATE_S.get((settings["name"], settings["network"]["kind"]), _OTHER_UPDATE_S)
    return run.updates * an_update + flights * _FLOWN_S


def schedule(figures: Mapping[str, Sequence[Run]], rows: Mapping[str, Row], workers: int) -> tuple[Table, list[Run]]:
    """A table with a line a figure, and all runs, each once, in the figures' order.

    What is left is estimated from finished runs of the same kind, or else from constants of one machine.
    """
    known: dict[tuple[Any, ...], list[float]] = {}
    for row in rows.values():
        run = Run(**{name: row[name] for name in Run.model_fields})
        known.setdefault(kind(run), []).append(row["seconds"] / estimated_s(run))
    table = Table("figure", "runs", "done", "new", "core-minutes left")
    for column in table.columns[1:]:
        column.justify = "right"
    every: dict[str, Run] = {}
    total = 0.0
    for name, runs in figures.items():
        new = {run.key: run for run in runs if run.key not in every}
        every |= new
        left = [run for key, run in new.items() if key not in rows]
        seconds = sum(estimated_s(run) * median(known.get(kind(run), [1.0])) for run in left)
        total += seconds
        done = sum(run.key in rows for run in runs)
        table.add_row(
            f"{name}: {FIGURES[name].title}", f"{len(runs)}", f"{done}", f"{len(left)}", f"{seconds / 60:.0f}"
        )
    hours = total / 3600
    table.caption = (
        f"{len(every)} runs, {sum(key in rows for key in every)} done; about {hours:.1f} core-hours left, "
        f"{hours / workers:.1f} hours with {workers} workers"
    )
    return table, list(every.values())
