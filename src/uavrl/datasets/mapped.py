"""A directory of memory-mapped columns: logged flights that need not fit into memory.

    flights.mapped/
        rows.npy         an array of rows, each with all of `COLUMNS` in their types in memory
        manifest.json    rows, K, SHA-256 of all columns, the version that wrote them
        scenario.toml    what they were flown in

A row lies in one piece: a random one costs one read of the disk or one miss of the caches, where a file a column would
take twenty. A column of the mapped array is a view of it.

All is validated while it is written, under a temporary name, then renamed. Opening it reads no row.
"""

from __future__ import annotations

import mmap
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uavrl import __version__
from uavrl.datasets.files import sync
from uavrl.datasets.transitions import COLUMNS, Transitions
from uavrl.datasets.validation import validated
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario

MANIFEST = "manifest.json"
_ROWS = "rows.npy"
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
    pages: mmap.mmap  # that the columns are views of

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

    def expect_random_rows(self) -> None:
        """From now on read the page that holds a row, and not, as files are read, megabytes around it."""
        self.pages.madvise(mmap.MADV_RANDOM)

    def sample(self, size: int, seed: int = 0) -> Transitions:
        """`size` rows in their order, drawn without replacement, all where there are fewer; in memory."""
        drawn = np.random.default_rng(seed).choice(len(self), min(size, len(self)), replace=False)
        return self.take(np.sort(drawn))


def save_mapped(
    path: str | Path, parts: Iterable[Transitions], scenario: Scenario, source: str | None = None
) -> MappedTransitions:
    """Write a log that comes part by part, each validated, in memory of a few parts; whole or not at all.

    Args:
        path: directory to make, suffix .mapped.
        parts: rows sorted by (episode, step) throughout, as `validated` takes them.
        scenario: what they were flown in.
        source: how a message names the parts; None: by `path`.

    Returns:
        What was written, mapped.

    Raises:
        DatasetError: another suffix, a path that exists or cannot be written, or what `validate` refuses.
    """
    path = Path(path)
    if path.suffix != ".mapped":
        raise DatasetError(f"{path}: suffix '{path.suffix}', allowed: .mapped")
    if path.exists():  # one directory cannot take another's place in one step
        raise DatasetError(f"{path}: exists, choose another name or remove it first")
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)  # left by a writer that was killed
        temporary.mkdir(parents=True)
        devices = scenario.traffic.devices
        count = _write(temporary / _ROWS, validated(parts, scenario, source or str(path)), devices)
        (temporary / _SCENARIO).write_text(scenario.to_toml(), encoding="utf-8")
        rows = np.lib.format.open_memmap(temporary / _ROWS, mode="r")
        digest = Transitions(**{name: rows[name] for name in COLUMNS}).digest()
        manifest = _Manifest(rows=count, devices=devices, sha256=digest)
        (temporary / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        for entry in (*temporary.iterdir(), temporary):
            sync(entry)
        temporary.rename(path)
        sync(path.parent)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return open_mapped(path)


def _record(devices: int) -> np.dtype[Any]:
    """A row, K = `devices`: 256 bytes for 10."""
    fields = [(name, column.dtype, column.row_shape(devices)) for name, column in COLUMNS.items()]
    return np.dtype(fields, align=True)


def _write(path: Path, parts: Iterable[Transitions], devices: int) -> int:
    """Append each part to the file of rows; their number."""
    record, count = _record(devices), 0
    with path.open("wb") as file:
        _write_header(file, record, 0)
        for part in parts:
            rows = np.zeros(len(part), record)  # zeros also between the columns
            for name, values in part.columns().items():
                rows[name] = values
            file.write(rows.view(np.uint8).data)
            count += len(part)
        file.seek(0)
        _write_header(file, record, count)  # as long as before: NumPy leaves room for the number of rows
    return count


def _write_header(file: BinaryIO, record: np.dtype[Any], count: int) -> None:
    header = {"descr": np.lib.format.dtype_to_descr(record), "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(file, header)


def open_mapped(path: str | Path) -> MappedTransitions:
    """Map what `save_mapped` wrote.

    Columns, types and lengths are checked, and no row is read: `MappedTransitions.verify` does that.

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
    rows = _map(path / _ROWS, manifest)
    columns: dict[str, NDArray[Any]] = {name: rows[name] for name in COLUMNS}
    return MappedTransitions(**columns, sha256=manifest.sha256, pages=rows.base)


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
        raise DatasetError(f"{path}: no whole directory of mapped flights: {name} cannot be read: {error}") from None


def _map(file: Path, manifest: _Manifest) -> Any:
    """The rows (n,), an array on a map of the file, which is its `base`."""
    try:
        rows = np.lib.format.open_memmap(file, mode="r")
    except (OSError, ValueError, EOFError) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{file}: missing, cut short or damaged: {reason}") from None
    expected = _record(manifest.devices)
    if (rows.dtype, rows.shape) != (expected, (manifest.rows,)):
        raise DatasetError(f"{file}: holds other columns or rows than {MANIFEST} says")
    if file.stat().st_size != rows.offset + rows.nbytes:
        raise DatasetError(f"{file}: has more bytes than its {manifest.rows:,} rows")
    return rows
