"""A directory of memory-mapped columns: logged flights that need not fit into memory.

    flights.columns/
        columns.json     rows, K, SHA-256 of all columns, the version that wrote them
        scenario.toml    what they were flown in
        reward.npy ...   one file a column of `COLUMNS`, of the type that it has in memory

It is validated while it is written, under a temporary name, then renamed. Opening it reads the headers alone.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uavrl import __version__
from uavrl.datasets.transitions import COLUMNS, Column, Transitions
from uavrl.datasets.validation import validated
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario

MANIFEST = "columns.json"
_SCENARIO = "scenario.toml"


class _Manifest(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    format: Literal[1] = 1
    rows: int = Field(ge=1)
    devices: int = Field(ge=1)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    uavrl: str = __version__


@dataclass(frozen=True, repr=False)
class MappedTransitions(Transitions):
    """Transitions whose columns lie on disk; rows come into memory when they are taken by an index."""

    sha256: str  # of all columns, as they were written

    def __repr__(self) -> str:
        return f"MappedTransitions({len(self):,} rows, K = {self.devices})"

    def digest(self) -> str:
        """As of the same rows in memory; nothing is read for it."""
        return self.sha256

    def verify(self, source: str) -> None:
        """Read every byte and compare with the digest.

        Raises:
            DatasetError: it is another one; `source` is how the message names the data.
        """
        if super().digest() != self.sha256:
            raise DatasetError(f"{source}: damaged, its columns are not those that were written; convert it again")

    def sample(self, size: int, seed: int = 0) -> Transitions:
        """`size` rows in their order, drawn without replacement, all where there are fewer; in memory."""
        drawn = np.random.default_rng(seed).choice(len(self), min(size, len(self)), replace=False)
        return self.take(np.sort(drawn))


def save_columns(
    path: str | Path, parts: Iterable[Transitions], scenario: Scenario, source: str | None = None
) -> MappedTransitions:
    """Write a log that comes part by part, each validated, in memory of a few parts; whole or not at all.

    Args:
        path: directory to make, suffix .columns.
        parts: rows sorted by (episode, step) throughout, as `validated` takes them.
        scenario: what they were flown in.
        source: how a message names the parts; None: by `path`.

    Returns:
        What was written, mapped.

    Raises:
        DatasetError: another suffix, a path that exists or cannot be written, or what `validate` refuses.
    """
    path = Path(path)
    if path.suffix != ".columns":
        raise DatasetError(f"{path}: suffix '{path.suffix}', allowed: .columns")
    if path.exists():  # one directory cannot take another's place in one step
        raise DatasetError(f"{path}: exists, choose another name or remove it first")
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)  # left by a writer that was killed
        temporary.mkdir(parents=True)
        rows = _write(temporary, validated(parts, scenario, source or str(path)), scenario.traffic.devices)
        (temporary / _SCENARIO).write_text(scenario.to_toml(), encoding="utf-8")
        written = Transitions(**{name: np.load(temporary / f"{name}.npy", mmap_mode="r") for name in COLUMNS})
        manifest = _Manifest(rows=rows, devices=written.devices, sha256=written.digest())
        (temporary / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        for entry in (*temporary.iterdir(), temporary):
            _sync(entry)
        temporary.rename(path)
        _sync(path.parent)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return open_columns(path)


def _write(directory: Path, parts: Iterable[Transitions], devices: int) -> int:
    """Append each part to the columns' files; the number of rows."""
    rows = 0
    with ExitStack() as stack:
        files = {name: stack.enter_context((directory / f"{name}.npy").open("wb")) for name in COLUMNS}
        for name, column in COLUMNS.items():
            _write_header(files[name], column, 0, devices)
        for part in parts:
            for name, values in part.columns().items():
                files[name].write(np.ascontiguousarray(values).data)
            rows += len(part)
        for name, column in COLUMNS.items():
            files[name].seek(0)
            _write_header(files[name], column, rows, devices)  # as long as before: NumPy leaves room for the rows
    return rows


def _write_header(file: BinaryIO, column: Column, rows: int, devices: int) -> None:
    shape = (rows, *column.row_shape(devices))
    header = {"descr": np.lib.format.dtype_to_descr(column.dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def load_columns(path: str | Path, scenario: Scenario) -> MappedTransitions:
    """As `open_columns`; all rows are validated, part by part, only under another scenario than they were written with.

    Raises:
        DatasetError: as of `open_columns` and `validate`.
    """
    transitions = open_columns(path)
    if scenario.to_toml() != scenario_text(path):
        for _ in validated(transitions.parts(), scenario, str(path)):
            pass
    return transitions


def open_columns(path: str | Path) -> MappedTransitions:
    """Map what `save_columns` wrote.

    Names, types, shapes and lengths are checked, and no row is read: `MappedTransitions.verify` does that.

    Raises:
        DatasetError: no such directory, or one that is not whole.
    """
    path = Path(path)
    try:
        manifest = _Manifest.model_validate_json(_read(path, MANIFEST))
    except ValidationError as error:
        reason = error.errors()[0]
        field = ".".join(str(place) for place in reason["loc"])
        raise DatasetError(f"{path / MANIFEST}: damaged or of another version: {field} {reason['msg']}") from None
    columns = {name: _map(path, name, column, manifest) for name, column in COLUMNS.items()}
    return MappedTransitions(**columns, sha256=manifest.sha256)


def scenario_text(path: str | Path) -> str:
    """The TOML of the scenario that the columns were flown in.

    Raises:
        DatasetError: no such directory, or one that is not whole.
    """
    return _read(Path(path), _SCENARIO)


def _read(path: Path, name: str) -> str:
    if not path.exists():
        raise DatasetError(f"{path}: no such directory")
    try:
        return (path / name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: no whole directory of columns: {name} cannot be read: {error}") from None


def _map(path: Path, name: str, column: Column, manifest: _Manifest) -> NDArray[Any]:
    file = path / f"{name}.npy"
    try:
        values = np.load(file, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise DatasetError(f"{path}: column '{name}' is missing: {column.meaning}") from None
    except (OSError, ValueError, EOFError) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{path}: column '{name}' is cut short or damaged: {reason}") from None
    shape = (manifest.rows, *column.row_shape(manifest.devices))
    found = f"{values.dtype} {values.shape}" if isinstance(values, np.memmap) else "no array"
    if found != f"{column.dtype} {shape}":
        raise DatasetError(
            f"{path}: column '{name}' holds {found}, allowed: {column.dtype} {shape}, as {MANIFEST} says"
        )
    if file.stat().st_size != values.offset + values.nbytes:
        raise DatasetError(f"{path}: column '{name}' has more bytes than its {manifest.rows:,} rows")
    return np.asarray(values)
