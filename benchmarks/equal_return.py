"""How long until our default returns what the paper's configuration returns in the end, over training seeds.

    python -m benchmarks.equal_return OUT RATES.json [ROWS.jsonl]

Both learn from the built-in data of one layout and are judged in the evaluation's environments. RATES are those of
`uavrl bench train --json`, measured in one run: a curve's axis is updates over updates a second, flights left out.
ROWS of `uavrl reproduce` may hold the paper's runs already. Writes OUT/equal-return.jsonl, .md and .png; interrupted,
it goes on with what is missing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tyro.conf import Positional

from benchmarks import script
from uavrl.errors import ConfigError
from uavrl.evaluation.report import write_text
from uavrl.evaluation.statistics import Interval, over_seeds
from uavrl.experiments.flights import flown, measure
from uavrl.experiments.paper import OURS, PROTOCOLS, ROUND_ROBIN, SCALES, YARDSTICK, Plan
from uavrl.experiments.runner import Row, Run, finished, run_all
from uavrl.experiments.tables import interval, markdown
from uavrl.training.log import progress

Float = NDArray[np.float64]

WORKERS = 2
SHARE = 0.95  # of the final gain over TDM
UPDATES, POINTS = 1_000, 20  # of our default
PAPER, DEFAULT = "the paper's configuration", "our default"


def runs() -> list[Run]:
    """References, then both configurations; the paper's are the comparison's own runs."""
    plan, published = Plan(SCALES["standard"]), PROTOCOLS["published"]
    paper = plan.learned(OURS, published, headline=True, variant=PAPER)
    ours = plan.learned(OURS, published._replace(preset="default"), headline=True, variant=DEFAULT)
    short = {"updates": UPDATES}
    ours = [run.model_copy(update=short | {"options": run.options | {"points": POINTS}}) for run in ours]
    return plan.references(published) + [run for pair in zip(ours, paper, strict=True) for run in pair]


class Curves(NamedTuple):
    """Returns of R seeds after P times of training."""

    seconds: Float  # (P,)
    returned: Float  # (R, P)


def curves(rows: Sequence[Row], variant: str, per_s: float) -> Curves:
    """From the rows of a variant, each seed's curve at the same updates."""
    every = sorted((row for row in rows if row["variant"] == variant), key=lambda row: row["seed"])
    own = [row for row in every if "diverged" not in row["scores"]]  # whose curve is shorter
    if not own:
        raise ConfigError(f"every run of {variant} diverged")
    at = np.array(own[0]["scores"]["curve"]["at"], dtype=np.float64)
    return Curves(at / per_s, np.array([row["scores"]["curve"]["return"] for row in own], dtype=np.float64))


def asked_for(paper: Curves, tdm: float) -> float:
    """TDM's return and `SHARE` of what the paper's configuration gains over it in the end, mean over seeds.

    Where it gains nothing there is no share of a gain: then its own return in the end.
    """
    end = float(paper.returned[:, -1].mean())
    return tdm + SHARE * (end - tdm) if end > tdm else end


def seconds_to(curves: Curves, wanted: float) -> Float:
    """Each seed's time (R,) to its first point as high as `wanted` whose mean from there on is, too; else infinite."""
    taken = []
    for curve in curves.returned:
        onwards = np.cumsum(curve[::-1])[::-1] / np.arange(len(curve), 0, -1)
        there = np.flatnonzero((curve >= wanted) & (onwards >= wanted))
        taken.append(curves.seconds[there[0]] if len(there) else np.inf)
    return np.array(taken)


def report(rows: Sequence[Row], rates: dict[str, Any], out: Path) -> None:
    """The table and the figure."""
    paper, ours = (
        curves(rows, name, rates[f"{key}_updates_per_s"]) for name, key in ((PAPER, "paper"), (DEFAULT, "default"))
    )
    known = {row["variant"]: float(flown(row, "return").mean()) for row in rows if row["updates"] == 0}
    wanted = asked_for(paper, known[ROUND_ROBIN])
    lines = [["configuration", "seeds", "updates", "time, s", "updates/s", "of its floor, %", "return at the end"]]
    for name, key, curve in ((PAPER, "paper", paper), (DEFAULT, "default", ours)):
        per_s = rates[f"{key}_updates_per_s"]
        floor = 100.0 * per_s / rates[f"{key}_updates_floor_per_s"]
        ends = interval(over_seeds(curve.returned[:, -1].tolist()), digits=0)
        cells = [f"{per_s * curve.seconds[-1]:,.0f}", f"{curve.seconds[-1]:.0f}", f"{per_s:.3g}", f"{floor:.0f}", ends]
        lines.append([name, str(len(curve.returned)), *cells])
    gains = f"{SHARE:.0%} of what the paper's configuration gains over TDM in the end"
    meaning = gains if wanted > known[ROUND_ROBIN] else "what the paper's configuration, below TDM, returns in the end"
    text = markdown(lines) + (
        f"\nTDM returns {known[ROUND_ROBIN]:.0f}, the planner {known[YARDSTICK]:.0f}. "
        f"Asked for: {wanted:.0f}, {meaning}. "
        f"Seconds to it, each seed: our default {_listed(seconds_to(ours, wanted))}; "
        f"the paper's configuration {_listed(seconds_to(paper, wanted))}, and {paper.seconds[-1]:.0f} for all of its "
        "updates. The paper's is judged by samples, ours by its deterministic action.\n"
    )
    write_text(out / "equal-return.md", text)
    _figure(paper, ours, known, wanted, out / "equal-return.png")


def _listed(seconds: Float) -> str:
    return ", ".join("not reached" if np.isinf(one) else f"{one:.0f}" for one in seconds)


def _figure(paper: Curves, ours: Curves, known: dict[str, float], wanted: float, path: Path) -> None:
    figure = Figure(figsize=(7.16, 3.2), layout="constrained")
    axes = figure.subplots()
    cheapest = -0.8 * known[YARDSTICK]

    def cost(returned: Float) -> Float:
        return np.maximum(-returned, cheapest)  # an interval may reach beyond the planner

    for label, curve, colour in ((PAPER, paper, "#D55E00"), (DEFAULT, ours, "#0072B2")):
        bands: list[Interval] = [over_seeds(point.tolist()) for point in curve.returned.T]
        mean, low, high = cost(np.array(bands)).T
        axes.plot(curve.seconds, cost(curve.returned).T, color=colour, linewidth=0.4, alpha=0.5)
        axes.plot(curve.seconds, mean, color=colour, linewidth=1.5, label=label)
        axes.fill_between(curve.seconds, low, high, color=colour, alpha=0.15, linewidth=0)
    for name in (ROUND_ROBIN, YARDSTICK):
        axes.axhline(-known[name], color="0.4", linewidth=0.8, linestyle="--")
        axes.annotate(name, (paper.seconds[-1], -known[name]), fontsize=7, ha="right", va="bottom")
    axes.axhline(-wanted, color="#009E73", linewidth=0.8, linestyle=":", label="asked for")
    axes.set(xscale="log", yscale="log", xlabel="training on one core (s)", ylabel="cost (minus the return)")
    axes.set_ylim(-1.5 * min(known[ROUND_ROBIN], float(paper.returned.min())), cheapest)  # best on top
    axes.grid(visible=True, alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=200)


def main(out: Positional[Path], rates: Positional[Path], rows: Positional[Path | None] = None) -> None:
    """Learn what is missing and write the table.

    Args:
        out: directory of equal-return.jsonl, .md and .png.
        rates: what `uavrl bench train --json` has written.
        rows: of `uavrl reproduce`, which may hold the paper's runs already.

    Raises:
        ConfigError: rates that are missing, or not those of that command.
    """
    try:
        measured = json.loads(rates.read_text(encoding="utf-8"))  # now, not after hours of learning
        float(measured["paper_updates_per_s"]), float(measured["default_updates_per_s"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"rates = '{rates}', allowed: a file of `uavrl bench train --json`") from error
    store, wanted = out / "equal-return.jsonl", runs()
    if rows is not None and not store.exists():
        known = finished(rows)
        out.mkdir(parents=True, exist_ok=True)
        found = [json.dumps(known[run.key]) for run in wanted if run.key in known]
        write_text(store, "".join(line + "\n" for line in found))
    with progress("equal return", len(wanted), "run") as told:
        done = run_all(wanted, measure, store, WORKERS, told)
    report(done, measured, out)


if __name__ == "__main__":
    script.run(main, "benchmarks.equal_return")
