"""Data by name: what is installed with the package, a flat file, or a Minari dataset."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import resources
from pathlib import Path

from uavrl.datasets.flat import SUFFIXES, load_flat, read_parts, stored_scenario
from uavrl.datasets.minari_io import read_minari
from uavrl.datasets.selection import Quality, select
from uavrl.datasets.transitions import Transitions
from uavrl.datasets.validation import validate
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario, load_scenario

_BUILTIN = resources.files("uavrl.datasets") / "builtin"


def builtin_names() -> tuple[str, ...]:
    """Names of the data installed with the package: one layout, many, and many under the scenario `realistic`."""
    return ("fixed", "layouts", "realistic")


def load_builtin(name: str, size: int = 30_000, quality: Quality = "mixed", seed: int = 0) -> Transitions:
    """A seeded selection of installed data: 50,000 transitions, uniform over an online learner's training.

    Raises:
        DatasetError: unknown name, data not installed, or more rows wanted than there are.
    """
    return select(_read_builtin(name, None)[0], size, quality, seed)


def _read_builtin(name: str, scenario: Scenario | None) -> tuple[Transitions, Scenario]:
    if name not in builtin_names():
        raise DatasetError(f"built-in data '{name}' does not exist, allowed: {', '.join(builtin_names())}")
    file = _BUILTIN / f"{name}.parquet"
    if not file.is_file():
        raise DatasetError(f"built-in data '{name}' is not installed; make your own with `uavrl collect`")
    with resources.as_file(file) as path:
        return _read_file(path, scenario)


def _read_file(path: Path, scenario: Scenario | None) -> tuple[Transitions, Scenario]:
    scenario = _flown_in(path, scenario)
    return load_flat(path, scenario), scenario


def _flown_in(path: Path, scenario: Scenario | None) -> Scenario:
    scenario = stored_scenario(path) if scenario is None else scenario
    if scenario is None:
        raise DatasetError(f"{path}: carries no scenario, name the one it was flown in (--scenario)")
    return scenario


def load_source(source: str | Path, scenario: str | Scenario | None = None) -> tuple[Transitions, Scenario]:
    """All transitions of a source, and the scenario they were flown in.

    Args:
        source: a name of `builtin_names`, a .parquet or .npz file, a .mapped directory, or the id of a Minari dataset.
        scenario: preset, TOML file or Scenario to read them under; None: the one that the source carries.

    Raises:
        DatasetError: a source that does not exist, cannot be read, is not valid, or carries no scenario.
        ScenarioError: a scenario that does not exist or is not valid.
    """
    named = None if scenario is None else load_scenario(scenario)
    if str(source) in builtin_names():
        return _read_builtin(str(source), named)
    path = Path(source)
    if path.suffix in SUFFIXES or path.is_file():
        return _read_file(path, named)
    transitions, stored = read_minari(str(source))
    if named is not None:
        validate(transitions, named, str(source))
    return transitions, stored if named is None else named


def load_parts(source: str | Path, scenario: str | Scenario | None = None) -> tuple[Iterator[Transitions], Scenario]:
    """As `load_source`, part by part: of a Parquet file a part at a time is in memory, and none is validated yet."""
    if Path(source).suffix == ".parquet":
        flown_in = _flown_in(Path(source), None if scenario is None else load_scenario(scenario))
        return read_parts(source, flown_in), flown_in
    transitions, flown_in = load_source(source, scenario)
    return transitions.parts(), flown_in
