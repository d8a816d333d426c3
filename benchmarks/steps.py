"""Fewer denoising steps: what a decision costs in time, and what it loses, steps x solver x candidates, and a student.

    for s in 0 1 2 3 4; do
      M50="--set diffusion.steps=50 --set shortest_move=0"
      uavrl train diffusion_sac --out RUNS/teacher-$s $M50 --updates 4000 --seed $s
      uavrl distill RUNS/teacher-$s --out RUNS/student-$s --set teacher.greedy_choice=false --seed $s
    done
    python -m benchmarks.steps fly RUNS OUT [SEED ...]    # the evaluation's 100 layouts x 3 fadings
    python -m benchmarks.steps time RUNS OUT              # exported policies of seed 0, on an otherwise idle machine
    python -m benchmarks.steps charge RUNS OUT [SEED ...] # flights that are charged those times
    python -m benchmarks.steps draw OUT COMPARISON        # COMPARISON: rows of `uavrl reproduce comparison`

Rows in OUT/steps.jsonl, times in OUT/steps-times.json, tables in OUT/steps.md and OUT/charged.md, the figure in
OUT/steps.png. What is in them is not computed again: with other policies begin another OUT.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from uavrl.agents.registry import changed, make_agent, preset
from uavrl.benchmarks.decide import Exported
from uavrl.benchmarks.timing import machine
from uavrl.evaluation.report import write_json, write_text
from uavrl.evaluation.rollouts import EvaluationSet, evaluation_set, fly
from uavrl.evaluation.statistics import Estimate, excess_cost, over_seeds
from uavrl.experiments.flights import kept
from uavrl.experiments.paper import ALGORITHMS, CHEAPER, PROTOCOLS, SCALES, YARDSTICK, Plan
from uavrl.experiments.runner import append, finished
from uavrl.experiments.tables import estimated, interval, markdown
from uavrl.scenario import Scenario, load_scenario
from uavrl.training.batches import spaces_of
from uavrl.training.policy import Decision, load_policy

SEEDS = (0, 1, 2, 3, 4)
EPISODES, FADINGS = SCALES["standard"].episodes, SCALES["standard"].fading_seeds
ROUNDS, ROUND_S = 10, 0.5


class Way(NamedTuple):
    """A way to decide."""

    name: str
    run: str  # teacher or student
    decision: Decision = Decision()
    deterministic: bool = True


def _ways() -> Iterator[Way]:
    yield Way("one-step student", "student")
    for steps in (1, 2, 3, 5, 10, 50):
        yield Way(f"DDIM, {steps}", "teacher", Decision(solver="ddim", steps=steps))
    for steps in (3, 5, 10):  # with one step or two DPM-Solver++(2M) is DDIM
        yield Way(f"DPM-Solver++(2M), {steps}", "teacher", Decision(solver="dpm", steps=steps))
    for steps in (1, 5, 50):  # no critic is asked
        yield Way(f"DDIM, {steps}, own choice", "teacher", Decision(solver="ddim", steps=steps, greedy_choice=False))
    for steps in (1, 5):
        for candidates in (1, 10):
            decided = Decision(solver="ddim", steps=steps, candidates=candidates)
            best = "a sample" if candidates == 1 else f"best of {candidates} samples"
            yield Way(f"DDIM, {steps}, {best}", "teacher", decided, deterministic=False)
    yield Way("ancestral, 50, a sample (the paper's)", "teacher", deterministic=False)


WAYS = {way.name: way for way in _ways()}
TEACHER = "DDIM, 50, own choice"  # the student's
CHARGED = ("one-step student", "DDIM, 5, own choice", "DDIM, 5", TEACHER)
SLOWER = {"this machine": 1.0, "ten times slower": 10.0}  # of machines

FAMILIES = {  # of the figure: colour, marker, line, where the note stands: over or under the interval
    "one-step student": ("#D55E00", "D", "", True),
    "DDIM": ("#0072B2", "o", "-", True),
    "DDIM, own choice": ("#CC79A7", "v", "-", True),
    "DPM-Solver++(2M)": ("#009E73", "s", "-", False),
    "samples": ("#56B4E9", "^", "", True),
    "other algorithms": ("#000000", "X", "", False),
}


def environments(scenario: Scenario) -> EvaluationSet:
    """Those of the comparison."""
    return evaluation_set(scenario, "random", EPISODES, fading_seeds=FADINGS)


def flown(runs: Path, way: Way, seed: int, scenario: Scenario) -> dict[str, Any]:
    """Metrics of each environment, means over its fadings."""
    policy = load_policy(runs / f"{way.run}-{seed}", scenario, way.decision)
    return kept(fly(policy, environments(scenario), deterministic=way.deterministic))


def keep(out: Path, rows: list[tuple[Way, int, str, Scenario]], runs: Path) -> None:
    """Fly what OUT/steps.jsonl lacks; a row is named by way, seed and what it was charged."""
    out.mkdir(parents=True, exist_ok=True)
    store = out / "steps.jsonl"
    done = finished(store)
    for way, seed, charged, scenario in rows:
        decision_s = scenario.airframe.decision_s
        key = f"{way.name}, seed {seed}, {charged or 'as in the scenario'}, {decision_s:.6g} s"
        if key not in done:
            row = {"key": key, "way": way.name, "seed": seed, "charged": charged, "decision_s": decision_s}
            append(store, row | {"flown": flown(runs, way, seed, scenario), "machine": machine()})
            print(key, flush=True)


def times(runs: Path, out: Path) -> None:
    """Of each way with seed 0, exported; and of the algorithms beside it, untrained, which changes no time.

    In rounds, since a machine's speed sways: each round times every one of them.
    """
    scenario = load_scenario("released")
    files: dict[str, Exported] = {}
    for name, way in WAYS.items():
        agent = load_policy(runs / f"{way.run}-0", scenario, way.decision).agent
        files[name] = Exported(agent, scenario, sampled=not way.deterministic)
    for name, agent_name in ALGORITHMS.items():
        config = changed(preset(agent_name, "default"), CHEAPER.get(name, {}))
        agent = make_agent(spaces_of(scenario, config.network.kind), config)
        files[name] = Exported(agent, scenario, sampled=not PROTOCOLS["layouts"].deterministic(name))
    rounds = [{name: file.times_s(ROUND_S) for name, file in files.items()} for _ in range(ROUNDS)]
    found: dict[str, Any] = {"machine": machine()}
    for name, file in files.items():
        found |= file.figures(name, np.concatenate([each[name] for each in rounds]), ROUND_S)
    write_json(out / "steps-times.json", found)


def charges(out: Path) -> Iterator[tuple[Way, str, Scenario]]:
    """Each way of `CHARGED` with its measured time as T_exec, and on slower machines.

    Who idles holds its place for as long as in the scenario, or a flight's 400 steps might be over in 30 ms of waiting.
    """
    known = json.loads((out / "steps-times.json").read_text(encoding="utf-8"))
    scenario = load_scenario("released")
    idle = {"min_idle_s": scenario.airframe.decision_s}
    for name in CHARGED:
        for charged, factor in SLOWER.items():
            spent = {"decision_s": 1e-3 * factor * known[f"{name}_ms"]}
            airframe = scenario.airframe.model_copy(update=spent | idle)
            yield WAYS[name], charged, scenario.model_copy(update={"airframe": airframe})


def gathered(rows: Sequence[dict[str, Any]], way: str, metric: str, charged: str = "") -> np.ndarray[Any, Any]:
    """A metric over seeds and environments (R, E), seeds in order."""
    own = sorted((row for row in rows if (row["way"], row["charged"]) == (way, charged)), key=lambda row: row["seed"])
    if len({row["seed"] for row in own}) < len(own):
        sys.exit(f"the rows of '{way}' hold a seed twice, charged otherwise: begin another OUT")
    return np.array([row["flown"][metric] for row in own])


def tables(out: Path, comparison: Path) -> None:
    """Write both tables and the figure."""
    rows, known = (
        [*finished(out / "steps.jsonl").values()],
        json.loads((out / "steps-times.json").read_text(encoding="utf-8")),
    )
    beside = _beside(comparison)
    planner = estimated(beside[YARDSTICK])
    # one name for all: ways of a seed's teacher and student share its luck, so seeds are resampled together
    returns = {name: gathered(rows, name, "return") for name in WAYS}
    if len({len(values) for values in returns.values()}) > 1:
        sys.exit(f"{out / 'steps.jsonl'} has not the same seeds of every way: let `fly` finish")
    teacher = estimated(returns[TEACHER], "teacher")
    lines = [
        ["decision", "seeds", "return", "over the planner, %", "over the 50-step teacher, %", "median, ms", "99 %, ms",
         "floor, ms", "10,000 at once, decisions/s"],
    ]  # fmt: skip
    points: dict[str, tuple[float, Estimate]] = {}
    for name in [*WAYS, *ALGORITHMS]:
        values = returns[name] if name in WAYS else beside[name]
        if not len(values):
            continue
        own = estimated(values, "teacher" if name in WAYS else name)
        excess = excess_cost(own, planner)
        points[name] = known[f"{name}_ms"], excess
        lost = interval(excess_cost(own, teacher).interval(), 100.0, digits=1, signed=True) if name in WAYS else ""
        milliseconds = [f"{known[f'{name}_{key}']:.3g}" for key in ("ms", "p99_ms", "floor_ms")]
        batch = f"{known[f'{name}_batch_decisions_per_s']:,.0f}"
        found = [interval(own.interval(), digits=0), interval(excess.interval(), 100.0, digits=1), lost]
        lines.append([name, str(len(values)), *found, *milliseconds, batch])
    write_text(out / "steps.md", markdown(lines))
    write_text(out / "charged.md", markdown(_charged_table(rows)))
    _figure(points, out / "steps.png")


def _beside(comparison: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Returns (R, E) of the planner and of the algorithms, from the comparison's rows, as far as they are there."""
    store = finished(comparison)
    found: dict[str, list[Any]] = {name: [] for name in (YARDSTICK, *ALGORITHMS)}
    for run in Plan(SCALES["standard"]).comparison(PROTOCOLS["layouts"]):
        if run.variant in found and run.key in store:
            found[run.variant].append(store[run.key]["scores"]["flown"]["return"])
    return {name: np.array(values) for name, values in found.items()}


def _charged_table(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    lines = [["decision", "T_exec", "ms", "age per step, s", "age per second, s", "flight, s", "return"]]
    for name in CHARGED:
        for charged in ("", *SLOWER):
            own = [row for row in rows if (row["way"], row["charged"]) == (name, charged)]
            if not own:
                continue
            cells = [
                interval(over_seeds(gathered(rows, name, metric, charged).mean(axis=1).tolist()), digits=digits)
                for metric, digits in (("age_per_step_s", 3), ("age_per_second_s", 3), ("duration_s", 0), ("return", 0))
            ]
            spent = 1e3 * float(np.mean([row["decision_s"] for row in own]))
            lines.append([name, charged or "as in the scenario", f"{spent:.3g}", *cells])
    return lines


def _figure(points: dict[str, tuple[float, Estimate]], path: Path) -> None:
    """Excess cost over decision time."""
    figure = Figure(figsize=(7.16, 4.2), layout="constrained")
    axes = figure.subplots()
    for label, (colour, marker, line, over) in FAMILIES.items():
        own = {name: point for name, point in points.items() if _family(name) == label}
        x = np.array([time for time, _ in own.values()])
        found = [100.0 * np.array(excess.interval()) for _, excess in own.values()]
        y, low, high = np.array(found).T if found else np.empty((3, 0))
        axes.errorbar(
            x, y, yerr=[y - low, high - y], color=colour, marker=marker, linestyle=line, markersize=4, capsize=2,
            linewidth=0.9, label=label,
        )  # fmt: skip
        for name, time, end in zip(own, x, high if over else low, strict=True):
            axes.annotate(
                _note(name), (time, end), xytext=(0, 3 if over else -3), textcoords="offset points", fontsize=6,
                color=colour, ha="center", va="bottom" if over else "top",
            )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="time of a decision, median (ms)", ylabel="cost over the planner (%)")
    axes.set(yticks=(10, 15, 20, 30, 60, 120))
    axes.xaxis.set_major_locator(FixedLocator([0.05, 0.1, 0.2, 0.5, 1.0, 2.0]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.grid(visible=True, alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=200)


def _family(name: str) -> str:
    if name in ALGORITHMS:
        return "other algorithms"
    if name.startswith("one-step"):
        return "one-step student"
    if "sample" in name:
        return "samples"
    return "DDIM, own choice" if name.endswith("own choice") else name.partition(",")[0]


def _note(name: str) -> str:
    if name in ALGORITHMS:
        return name
    return (
        name.partition(", ")[2]
        .replace(" (the paper's)", "")
        .replace("best of 10 samples", "best of 10")
        .replace(", own choice", "")
    )


def main(task: str, *words: str) -> None:
    """See the module."""
    torch.set_num_threads(1)
    if task == "draw" and len(words) == 2:
        return tables(Path(words[0]), Path(words[1]))
    if task == "time" and len(words) == 2:
        return times(Path(words[0]), Path(words[1]))
    if task not in ("fly", "charge") or len(words) < 2:
        sys.exit(__doc__)
    runs, out = Path(words[0]), Path(words[1])
    seeds = [int(word) for word in words[2:]] or SEEDS
    scenario = load_scenario("released")
    every = [(way, "", scenario) for way in WAYS.values()] if task == "fly" else list(charges(out))
    return keep(out, [(way, seed, charged, other) for seed in seeds for way, charged, other in every], runs)


if __name__ == "__main__":
    main(*sys.argv[1:] or ("",))
