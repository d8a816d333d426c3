"""Each training seed of one algorithm by itself, beside policies that learn nothing, from rows of `uavrl reproduce`.

    python -m benchmarks.seeds results/paper/full.jsonl comparison Diffusion-SAC

The figure's scale is the file's name. A seed's intervals are over the environments; the last line's are over the
environments and the seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from benchmarks import script
from uavrl.errors import ConfigError
from uavrl.evaluation.statistics import Estimate, difference, excess_cost
from uavrl.experiments.paper import FIGURES, REFERENCES, ROUND_ROBIN, SCALES, YARDSTICK, Plan
from uavrl.experiments.runner import Row, finished, grouped
from uavrl.experiments.tables import estimated, interval, markdown, scores

PAIRED = (YARDSTICK, "index at best hover", ROUND_ROBIN)
HEADER = ["policy", "return", "over the planner, %", *(f"paired to {name}" for name in PAIRED), "age per step, s"]


def lines(rows: Sequence[Row], variant: str) -> list[list[str]]:
    """A header, what is paired with, the seeds in their order, and all of them together."""
    groups = grouped(rows)
    known = {name: estimated(scores(groups[name], "return")) for name in PAIRED}
    seeds = sorted(groups[variant], key=lambda row: row["seed"])

    def line(name: str, own: Sequence[Row], returned: Estimate) -> list[str]:
        return [
            name,
            interval(returned.interval(), digits=1),
            interval(excess_cost(returned, known[YARDSTICK]).interval(), 100.0, digits=1),
            *(
                "" if name == other else interval(difference(returned, estimate).interval(), digits=1, signed=True)
                for other, estimate in known.items()
            ),
            interval(estimated(scores(own, "age_per_step_s"), variant).interval(), digits=2),
        ]

    found = [line(name, groups[name], known[name]) for name in REFERENCES if name in known]
    found += [line(f"{variant}, seed {row['seed']}", [row], estimated(scores([row], "return"))) for row in seeds]
    return [HEADER, *found, line(f"{len(seeds)} seeds", seeds, estimated(scores(seeds, "return"), variant))]


def main(
    store: Annotated[Positional[Path], arg(metavar="SCALE.jsonl")],
    figure: Annotated[Positional[str], arg(metavar="FIGURE")],
    variant: Annotated[Positional[str], arg(metavar="VARIANT")],
) -> None:
    """Print the table.

    Args:
        store: rows of `uavrl reproduce`.
        figure: whose runs.
        variant: a line of the figure's table.

    Raises:
        ConfigError: no such file, scale, figure or variant, or a run that the table needs is missing.
    """
    if store.stem not in SCALES or not store.is_file():
        raise ConfigError(f"file '{store}', allowed: {', '.join(f'{name}.jsonl' for name in SCALES)} of a reproduction")
    if figure not in FIGURES:
        raise ConfigError(f"figure '{figure}' does not exist, allowed: {', '.join(FIGURES)}")
    done = finished(store)
    rows = [
        {**done[run.key], "variant": run.variant}
        for run in FIGURES[figure].runs(Plan(SCALES[store.stem]))
        if run.key in done
    ]
    names = {row["variant"] for row in rows}
    missing = [name for name in (*PAIRED, variant) if name not in names]
    if missing:
        raise ConfigError(
            f"'{missing[0]}' has no rows of figure '{figure}' in '{store}', there are: {', '.join(names)}"
        )
    print(markdown(lines(rows, variant)))


if __name__ == "__main__":
    script.run(main, "benchmarks.seeds")
