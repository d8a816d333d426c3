"""`uavrl data`: show, select, convert and relabel logged flights."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from uavrl.cli.settings import check_writable
from uavrl.datasets.flat import SUFFIXES, save_flat
from uavrl.datasets.mapped import MappedTransitions, save_mapped
from uavrl.datasets.minari_io import write_minari
from uavrl.datasets.objective import relabelled, with_objective
from uavrl.datasets.report import describe, render
from uavrl.datasets.selection import Quality, select
from uavrl.datasets.sources import load_parts, load_source
from uavrl.datasets.transitions import Transitions
from uavrl.scenario import load_scenario
from uavrl.simulation.observations import ObservationKind

Source = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|PATH|MINARI_ID")]


@dataclass(frozen=True)
class DataShow:
    """Report what logged flights hold: behaviour, coverage, choices."""

    source: Source
    """fixed, layouts or realistic, a .parquet or .npz file, a .mapped directory, or the id of a Minari dataset"""
    scenario: str | None = None
    """preset or .toml file that it was flown in; none: the one it carries"""
    json: Path | None = None
    """file to write the figures to"""

    def run(self) -> None:
        if self.json is not None:
            check_writable(self.json)
        transitions, scenario = load_source(self.source, self.scenario)
        if isinstance(transitions, MappedTransitions):
            transitions.verify(self.source)
        summary = describe(transitions, scenario)
        Console().print(render(summary, self.source))
        if self.json is not None:
            self.json.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class DataSelect:
    """Write a seeded part of a training's log to a flat file."""

    source: Source
    """fixed, layouts or realistic, a .parquet or .npz file, a .mapped directory, or the id of a Minari dataset"""
    out: Path
    """.parquet or .npz file, or .mapped directory, to write"""
    size: int = 30_000
    """transitions"""
    quality: Quality = "mixed"
    """mixed: uniform over training; good: its last third; bad: its first third"""
    seed: int = 0
    """seed of the draw; for one seed, a smaller set is part of a larger one"""
    scenario: str | None = None
    """preset or .toml file that it was flown in; none: the one it carries"""

    def run(self) -> None:
        transitions, scenario = load_source(self.source, self.scenario)
        selected = select(transitions, self.size, self.quality, self.seed)
        save_flat(self.out, selected, scenario)
        Console().print(f"{self.out}: {selected!r}", highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class DataConvert:
    """Write logged flights in another form."""

    source: Source
    """fixed, layouts or realistic, a .parquet or .npz file, a .mapped directory, or the id of a Minari dataset"""
    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PATH|MINARI_ID")]
    """.parquet or .npz file, .mapped directory, or the id of a new Minari dataset (whole episodes only)"""
    scenario: str | None = None
    """preset or .toml file that it was flown in; none: the one it carries"""
    observation: ObservationKind = "devices"
    """observations of a Minari dataset"""

    def run(self) -> None:
        transitions: Transitions
        if Path(self.target).suffix == ".mapped":  # part by part: the log need not fit into memory
            parts, scenario = load_parts(self.source, self.scenario)
            transitions = save_mapped(self.target, parts, scenario, self.source)
        else:
            transitions, scenario = load_source(self.source, self.scenario)
            if Path(self.target).suffix in SUFFIXES:
                save_flat(self.target, transitions, scenario)
            else:
                write_minari(self.target, transitions, scenario, self.observation)
        Console().print(f"{self.target}: {transitions!r}", highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class DataRelabel:
    """Write the same flights with the rewards of another objective, worked out from logged ages and energies."""

    source: Source
    """fixed, layouts or realistic, a .parquet or .npz file, a .mapped directory, or the id of a Minari dataset"""
    objective: str
    """preset or .toml file whose objective and priorities count; all else stays as it was flown"""
    out: Path
    """.parquet or .npz file, or .mapped directory, to write"""
    scenario: str | None = None
    """preset or .toml file that it was flown in; none: the one it carries"""

    def run(self) -> None:
        wanted = load_scenario(self.objective)
        transitions, flown = load_source(self.source, self.scenario)  # a log that is not valid is not made to look so
        scenario = with_objective(flown, wanted)
        if self.out.suffix == ".mapped":  # part by part: a mapped log need not fit into memory
            parts = (relabelled(part, scenario) for part in transitions.parts())
            save_mapped(self.out, parts, scenario, self.source)
        else:
            save_flat(self.out, relabelled(transitions, scenario), scenario)
        Console().print(f"{self.out}: rewards of scenario {scenario.name}", highlight=False, soft_wrap=True)
