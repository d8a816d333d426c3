"""Judge policies on one evaluation set, and say it as JSON, as Markdown and in the terminal."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from uavrl import __version__
from uavrl.datasets.transitions import Transitions
from uavrl.errors import ConfigError
from uavrl.evaluation.behaviour import behaviour
from uavrl.evaluation.bounds import fades, mean_age_bound_s, step_mean_age_bound_s
from uavrl.evaluation.metrics import PERCENTILE, flight_metrics
from uavrl.evaluation.rollouts import EvaluationSet, Flights, fly
from uavrl.evaluation.statistics import (
    RESAMPLES,
    Estimate,
    decimals,
    difference,
    estimate_mean,
    excess_cost,
    normalised_return,
    resampling,
    unit_means,
)
from uavrl.policies.base import Policy
from uavrl.scenario import Scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.state import Draws, FlightAction

DATA = "data"  # what the data's own behaviour is called
BASELINES = ("tdm", "planner", DATA, "bc")  # compared with wherever they take part
Report = dict[str, Any]


class Shown(NamedTuple):
    """A column of a table."""

    title: str
    digits: int  # significant ones
    scale: float = 1.0


TABLES: dict[str, dict[str, Shown]] = {
    "Objective": {
        "return": Shown("return", 4),
        "excess_cost": Shown("excess cost %", 3, 100.0),
        "normalised_return": Shown("0 TDM .. 100 planner", 3),
        "steps": Shown("steps", 4),
        "duration_s": Shown("duration s", 4),
    },
    "Age of information": {
        "age_per_step_s": Shown("per step s", 3),
        "age_per_second_s": Shown("per second s", 3),
        "worst_device_age_s": Shown("worst device s", 3),
        "age_p95_s": Shown("95th percentile s", 3),
        "jain_age": Shown("Jain 1/age", 3),
    },
    "Energy": {
        "energy_per_step_j": Shown("UAV per step J", 3),
        "energy_per_episode_j": Shown("UAV per episode J", 4),
        "device_energy_j": Shown("devices per episode J", 3),
        "decision_ms": Shown("decision ms", 3),
        "decision_p95_ms": Shown("95th percentile ms", 3),
    },
    "Link": {
        "throughput_mbps": Shown("Mbit/s", 3),
        "data_mb": Shown("MB per episode", 3),
        "transmission_mean_s": Shown("packet, mean s", 3),
        "transmission_median_s": Shown("packet, median s", 3),
        "jain_bits": Shown("Jain bits", 3),
        "outage_rate": Shown("lost %", 3, 100.0),
    },
}


@dataclass(frozen=True)
class Judgement:
    """The report, ready for JSON, and the flights that it was made from."""

    report: Report
    flights: dict[str, Flights]


def judge(
    policies: Mapping[str, Policy],
    environments: EvaluationSet,
    *,
    flown: Mapping[str, Flights] | None = None,
    baselines: Sequence[str] = (),
    data: Transitions | None = None,
    deterministic: bool = False,
    command: str = "",
    show_progress: bool = False,
) -> Judgement:
    """Fly every policy on the same environments and compare them.

    Args:
        policies: name -> policy; the names "tdm" and "planner" are the ends of `normalised_return`, and "planner" the
            yardstick of `excess_cost`.
        environments: what all of them fly.
        flown: flights of further policies on these environments, name -> flights; they come first.
        baselines: names that every policy is compared with; empty: those of `BASELINES` that take part.
        data: logged transitions whose own behaviour is reported as "data".
        deterministic: ask the policies for their deterministic action.
        command: how to make this report again, kept in it.
        show_progress: bars on stderr where that is a terminal.

    Raises:
        ConfigError: no policy, two of one name, a baseline that does not take part, flights of other environments, or
            a policy that cannot be flown.
        DatasetError: the data's K is not the scenario's.
    """
    flown = flown or {}
    names = [*flown, *policies, *([DATA] if data is not None else [])]
    if not (flown or policies):
        raise ConfigError("policies is empty, needed: 1 or more")
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigError(
            f"policy '{twice[0]}' takes part twice, allowed: one of each name ('{DATA}' is the data's own)"
        )
    elsewhere = [name for name, flights in flown.items() if not flights.evaluation_set.equals(environments)]
    if elsewhere:
        raise ConfigError(f"policy '{elsewhere[0]}' was flown in other environments, allowed: those it is judged on")
    unknown = [name for name in baselines if name not in names]
    if unknown:
        raise ConfigError(f"baseline '{unknown[0]}' does not take part, allowed: {', '.join(names)}")
    observed = {} if data is None else {DATA: behaviour(data, environments.scenario, seed=environments.seed + 1)}
    flights = dict(flown)
    for name, policy in policies.items():
        flights[name] = fly(policy, environments, name=name, deterministic=deterministic, show_progress=show_progress)
    estimates = {**estimate(flights, environments), **observed}
    report = {
        "policies": {name: _intervals(values) for name, values in estimates.items()},
        "paired": {name: _paired(name, estimates, baselines) for name in estimates},
        "unpaired": sorted(observed),
        "scenario": environments.scenario.model_dump(mode="json"),
        "layouts": environments.layouts,
        "episodes": environments.episodes,
        "fading_seeds": environments.fading_seeds,
        "seed": environments.seed,
        "deterministic": deterministic,
        "bootstrap": {"resamples": RESAMPLES, "units": int(environments.unit.max()) + 1},
        "notes": list(notes(environments.scenario, estimates)),
        "versions": versions(),
        "command": command,
    }
    return Judgement(report, flights)


def estimate(flights: Mapping[str, Flights], environments: EvaluationSet) -> dict[str, dict[str, Estimate]]:
    """Metric estimates of each policy, all from one resampling of the environments, so that they are paired.

    The fading repeats of an environment are averaged first. Decision times come from calls of their own and are
    resampled by themselves.
    """
    unit = np.repeat(environments.unit, environments.fading_seeds)
    counts = resampling(int(unit.max()) + 1, environments.seed)
    estimates: dict[str, dict[str, Estimate]] = {}
    for name, flown in flights.items():
        metrics = flight_metrics(flown)
        estimates[name] = {key: estimate_mean(unit_means(values, unit), counts) for key, values in metrics.items()}
        estimates[name] |= _decision_times(flown, environments.seed)
    planner, tdm = estimates.get("planner"), estimates.get("tdm")
    for values in estimates.values():
        if planner is not None:
            values["excess_cost"] = excess_cost(values["return"], planner["return"])
        if planner is not None and tdm is not None:
            values["normalised_return"] = normalised_return(values["return"], tdm["return"], planner["return"])
    return estimates


def _decision_times(flights: Flights, seed: int) -> dict[str, Estimate]:
    """decision_ms and decision_p95_ms, of one decision for one flight."""
    calls_ms = flights.latency_s * 1e3
    drawn = calls_ms[np.random.default_rng(seed).integers(len(calls_ms), size=(RESAMPLES, len(calls_ms)))]
    return {
        "decision_ms": Estimate(float(calls_ms.mean()), drawn.mean(axis=1)),
        "decision_p95_ms": Estimate(
            float(np.quantile(calls_ms, PERCENTILE)), np.quantile(drawn, PERCENTILE, axis=1).astype(np.float64)
        ),
    }


def _intervals(values: Mapping[str, Estimate]) -> Report:
    """{metric: {mean, low, high}}; a number that does not exist is null, as JSON has no NaN."""
    return {
        metric: {key: value if math.isfinite(value) else None for key, value in one.interval()._asdict().items()}
        for metric, one in values.items()
    }


def _paired(name: str, estimates: Mapping[str, Mapping[str, Estimate]], baselines: Sequence[str]) -> Report:
    """{baseline: {metric: {mean, low, high}}} of name - baseline."""
    own = estimates[name]
    return {
        baseline: _intervals(
            {metric: difference(own[metric], other) for metric, other in estimates[baseline].items() if metric in own}
        )
        for baseline in (baselines or BASELINES)
        if baseline in estimates and baseline != name
    }


def notes(scenario: Scenario, estimates: Mapping[str, Mapping[str, Estimate]]) -> Iterator[str]:
    """What a reader of the tables must know: the scenario's reading of the paper, and what its numbers cannot say."""
    limits, objective = scenario.limits, scenario.objective
    ends = [f"{limits.max_steps} steps"] if limits.max_steps is not None else []
    ends += [f"{limits.time_budget_s:g} s"] if limits.time_budget_s is not None else []
    yield (
        f"Scenario '{scenario.name}': objective {objective.reward}, a flight ends after {' or '.join(ends)}, "
        f"fading {scenario.channel.fading}."
    )
    if fades(scenario) and scenario.channel.max_transmission_s is None:
        yield (
            "Fading drawn once a packet and no limit on a transmission: the mean transmission time is infinite, "
            "so the mean shown depends on the sample; read the median."
        )
    least = _least_age_s(scenario)
    if least is not None:
        who = "In the mean over the fading, whoever flies" if fades(scenario) else "Whoever flies"
        yield f"{who}, the mean age is at least {least} (docs/bounds.md)."
    if objective.reward == "per_step":  # time integrals cannot be had cheaper by taking shorter steps
        always, seldom = returns_of_duty(scenario, (1, 5))
        if seldom > always:
            yield (
                "This objective pays for serving rarely: with every device overhead, serving in each step returns "
                f"{always:.4g}, in one step of five {seldom:.4g}."
            )
    if DATA in estimates:
        yield (
            "'data' is the mean of its transitions times the mean length of an episode, "
            "on layouts of its own: differences to it are unpaired."
        )


def _least_age_s(scenario: Scenario) -> str | None:
    """Of a flight as long as the first limit allows; a shorter one can be fresher, since ages start at 0.

    None where no bound is known.
    """
    steps, time_s = scenario.limits.max_steps, scenario.limits.time_budget_s
    shares = sum(scenario.traffic.priority_each)  # tables weigh ages by shares of the priorities
    try:
        if steps is not None:
            return f"{step_mean_age_bound_s(scenario, steps) / shares:.3f} s a step over {steps} steps"
        assert time_s is not None  # noqa: S101  # a scenario has one limit or the other
        time_s = min(time_s, scenario.traffic.max_age_s)
        return f"{float(mean_age_bound_s(scenario, time_s)) / shares:.3f} s a second over {time_s:g} s"
    except ConfigError:  # of random or measured service times
        return None


def returns_of_duty(scenario: Scenario, every: Sequence[int]) -> list[float]:
    """Returns of flights right above all devices that serve, in turn, in one step of each `every`, idle in the others.

    Fading is averaged (`ergodic`), so that one flight tells.
    """
    calm = scenario if scenario.channel.fading == "none" else scenario.replace(fading="ergodic")
    count, devices = len(every), scenario.traffic.devices
    layout_m, state = np.zeros((count, devices, 2)), initial_state(np.zeros((count, 2)), devices)
    draws = Draws(scatter=np.ones((count, 2)), sight=np.zeros(count))
    period, active, total = np.array(every), np.ones(count, dtype=bool), np.zeros(count)
    step = 0
    while active.any():
        device = np.where(step % period == 0, step // period % devices + 1, 0)
        state, outcome = advance(calm, layout_m, state, FlightAction(np.zeros((count, 2)), device), draws)
        total += np.where(active, outcome.reward, 0.0)
        active = active & ~(outcome.terminated | outcome.truncated)
        step += 1
    return [float(value) for value in total]


def versions() -> dict[str, str | None]:
    """What made the report; `commit` is None outside a git checkout of uavrl."""
    return {
        "uavrl": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": metadata.version("torch"),
        "commit": _commit(),
    }


def _commit() -> str | None:
    package = Path(__file__).resolve().parents[1]
    git = ["git", "-C", str(package)]
    try:
        top = subprocess.run([*git, "rev-parse", "--show-toplevel", "HEAD"], capture_output=True, text=True, check=True)
        folder, commit = top.stdout.split()
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--untracked-files=no"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError, ValueError):
        return None
    if Path(folder) / "src" / "uavrl" != package:
        return None  # installed within somebody else's checkout
    return f"{commit}-dirty" if changed.stdout.strip() else commit


def write_text(path: Path, text: str) -> None:
    """Replace a file in one move: whoever reads it sees the old text or the new one, never a part.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o666 & ~_umask())  # mkstemp's files are private
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        raise ConfigError(f"file '{path}' cannot be written: {error.strerror}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_json(path: Path, report: Report) -> None:
    """Write the report as JSON, in one move.

    Raises:
        ConfigError: the file cannot be written.
    """
    write_text(path, json.dumps(report, indent=2, allow_nan=False) + "\n")


def markdown_table(report: Report) -> str:
    """All tables and notes of a report as Markdown."""
    parts = []
    for title, header, rows in _tables(report):
        lines = [f"### {title}", "", "| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
        parts.append("\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]))
    parts.append("\n".join(f"- {note}" for note in report["notes"]))
    return "\n\n".join([*parts, _caption(report)]) + "\n"


def rich_table(report: Report) -> RenderableType:
    """All tables and notes of a report for the terminal."""
    parts: list[RenderableType] = []
    for title, header, rows in _tables(report):
        table = Table(title=title, title_justify="left", title_style="bold")
        for index, name in enumerate(header):
            table.add_column(name, justify="right" if index else "left")
        for row in rows:
            table.add_row(*row)
        parts.append(table)
    return Group(*parts, *(Text(f"- {note}") for note in report["notes"]), Text(_caption(report)))


def _caption(report: Report) -> str:
    return (
        f"{report['episodes']} episodes x {report['fading_seeds']} fading seeds, layouts {report['layouts']}, "
        f"seed {report['seed']}; mean [95 % bootstrap interval over {report['bootstrap']['units']} environments]; "
        "* an interval clear of zero."
    )


def _tables(report: Report) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """(title, header, rows of text) of each table."""
    policies = report["policies"]
    for title, columns in TABLES.items():
        shown = {metric: form for metric, form in columns.items() if any(metric in p for p in policies.values())}
        rows = [[name, *(_cell(values.get(metric), form) for metric, form in shown.items())] for name, values in
                policies.items()]  # fmt: skip
        yield title, ["policy", *(form.title for form in shown.values())], rows
    compared = [name for name in policies if any(name in row for row in report["paired"].values())]
    if compared:
        form = TABLES["Objective"]["return"]
        rows = [
            [name, *(_cell(row.get(baseline, {}).get("return"), form, mark=True) for baseline in compared)]
            for name, row in report["paired"].items()
        ]
        header = [f"- {name}{' (unpaired)' if name in report['unpaired'] else ''}" for name in compared]
        yield "Difference in return on equal flights", ["policy", *header], rows


def _cell(value: Mapping[str, float | None] | None, form: Shown, *, mark: bool = False) -> str:
    if value is None:
        return ""
    numbers = [number for number in (value["mean"], value["low"], value["high"]) if number is not None]
    if len(numbers) < 3:
        return "-"
    mean, low, high = (number * form.scale for number in numbers)
    largest = max(abs(mean), abs(low), abs(high))
    places = decimals(largest, form.digits)
    clear = mark and (low > 0 or high < 0)
    return f"{mean:.{places}f} [{low:.{places}f}, {high:.{places}f}]{' *' if clear else ''}"
