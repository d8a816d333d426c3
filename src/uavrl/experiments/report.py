"""What a reproduction leaves behind: figures, tables, and what was run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from uavrl.evaluation.report import write_text
from uavrl.experiments import claims, plots, tables
from uavrl.experiments.paper import FIGURES
from uavrl.experiments.runner import Run

Row = Mapping[str, Any]

ABOUT = (
    "Made by `uavrl reproduce`. Differences and their 95 % intervals are over training seeds and test environments, "
    "paired over the environments; positive is in the claim's favour. A claim holds where its intervals are clear of "
    "zero, or of the number it names, on its side; it does not where one is clear on the other side; else it is open. "
    "The figures beside this file, each with its table, say what was run."
)


def rows_of(runs: Sequence[Run], rows: Mapping[str, Row]) -> list[Row]:
    """Finished rows of `runs`, named as this figure names them."""
    return [{**rows[run.key], "variant": run.variant} for run in runs if run.key in rows]


def write_results(figures: Mapping[str, Sequence[Run]], rows: Mapping[str, Row], out: Path) -> list[str]:
    """Draw every figure of which all runs are done, with its table; says a line for each.

    Raises:
        ConfigError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    said: list[str] = []
    finished: dict[str, Sequence[Row]] = {}
    for name, runs in figures.items():
        done = rows_of(runs, rows)
        if len(done) < len(runs):
            said.append(f"{name}: {len(runs) - len(done)} of {len(runs)} runs are missing, not drawn")
            continue
        plots.draw(name, done, out)
        write_text(out / f"{name}.md", page(name, runs, done))
        finished[name] = done
        said.append(f"{name}: {out / name}.png, .pdf, .csv, .md")
    write_text(out / "CLAIMS.md", claims.markdown(claims.Results(finished), ABOUT))
    return [*said, f"claims: {out / 'CLAIMS.md'}"]


def page(name: str, runs: Sequence[Run], rows: Sequence[Row]) -> str:
    """A figure with its numbers and how it was made."""
    learned = [row for row in rows if row["problem"] != "policy"]
    setting, machines = rows[0]["options"], {(row["machine"]["processor"], row["machine"]["commit"]) for row in rows}
    made = [
        "Training seeds " + ", ".join(str(seed) for seed in sorted({row["seed"] for row in learned})),
        "updates " + ", ".join(f"{count:,}" for count in sorted({row["updates"] for row in learned})),
        f"{setting['episodes']} environments x {setting['fading_seeds']} fading seeds, seed {setting['seed']:,}",
        "last checkpoints",
        f"{sum(row['seconds'] for row in rows) / 3600:.1f} core-hours",
        *(f"{processor}, commit {(commit or 'unknown')[:9]}" for processor, commit in sorted(machines)),
    ]
    text = [
        f"# {FIGURES[name].title}",
        f"![{FIGURES[name].title}]({name}.png)",
        tables.markdown(rows),
        "; ".join(made) + ".",
    ]
    return "\n\n".join(text) + "\n"
