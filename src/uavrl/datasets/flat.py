"""Flat data: Parquet, npz or a .mapped directory, with the columns of `COLUMNS`, one row a transition."""

from __future__ import annotations

import os
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from uavrl.datasets.mapped import open_mapped, save_mapped, scenario_text
from uavrl.datasets.objective import relabelled
from uavrl.datasets.transitions import COLUMNS, PART_ROWS, Transitions
from uavrl.datasets.validation import validate, validated
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario, parse_scenario

SUFFIXES = (".parquet", ".npz", ".mapped")
OPTIONAL = ("used_j", "next_used_j")  # both or neither; left out, they are 0
WORKED_OUT = (
    "reward",
    "age_term",
    "energy_term",
)  # all or none; left out, the objective says

_SCENARIO = "uavrl_scenario"  # TOML: metadata of a Parquet file, an array of npz
_UNREADABLE = (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error, pa.ArrowException)
_LISTS = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
_STORED: dict[str, type[np.generic]] = {"int": np.int32, "float": np.float32, "bool": np.bool_}


def save_flat(path: str | Path, transitions: Transitions, scenario: Scenario) -> None:
    """Write what the suffix says, with the scenario inside; all of it or nothing, never half.

    Raises:
        DatasetError: another suffix, transitions that `validate` refuses, or a path that cannot be written.
    """
    path = Path(path)
    _check_suffix(path)
    if path.suffix == ".mapped":
        save_mapped(path, transitions.parts(), scenario)
        return
    validate(transitions, scenario, str(path))
    arrays: dict[str, NDArray[Any]] = {
        name: np.ascontiguousarray(values.reshape(len(values), -1) if values.ndim > 1 else values).astype(
            _STORED[COLUMNS[name].kind], copy=False
        )
        for name, values in transitions.columns().items()
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _replacing(path) as temporary:
            if path.suffix == ".npz":
                with temporary.open("wb") as file:
                    named: dict[str, Any] = arrays | {_SCENARIO: np.array(scenario.to_toml())}
                    np.savez_compressed(file, **named)
            else:
                _write_parquet(temporary, arrays, scenario)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written: {error.strerror or error}") from None


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`, which takes its place once it is written to disk."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_parquet(path: Path, arrays: dict[str, NDArray[Any]], scenario: Scenario) -> None:
    table: dict[str, pa.Array] = {}
    split: dict[str, str] = {}
    for name, values in arrays.items():
        flat = pa.array(values.reshape(-1))
        table[name] = flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        # a layout repeats all through its episode; other floats hardly ever, but share their leading bytes
        if COLUMNS[name].kind == "float" and name != "layout_m":
            split[name if values.ndim == 1 else f"{name}.list.element"] = "BYTE_STREAM_SPLIT"
    others = [name if arrays[name].ndim == 1 else f"{name}.list.element" for name in arrays]
    pq.write_table(
        pa.table(table).replace_schema_metadata({_SCENARIO: scenario.to_toml()}),
        path,
        compression="zstd",
        compression_level=9,
        use_dictionary=[name for name in others if name not in split and COLUMNS[name.split(".")[0]].kind != "bool"],
        column_encoding=split,
        write_page_checksum=True,
    )


def load_flat(path: str | Path, scenario: Scenario) -> Transitions:
    """Read and validate Parquet or npz, of ours or of a user; numbers may be of any type and width.

    `layout_m` holds x and y of each device in turn, 2K a row; (n, K, 2) is read as well. Other columns are ignored.
    A .mapped directory was validated when it was written; it is again, part by part, under another scenario than then.

    Raises:
        DatasetError: a file that cannot be read, a missing column, or what `validate` refuses: file, row and column.
    """
    path = Path(path)
    if path.suffix == ".mapped":
        mapped = open_mapped(path)
        if scenario != stored_scenario(path):
            for _ in validated(mapped.parts(), scenario, str(path)):
                pass
        return mapped
    columns, _ = _read(path)
    transitions = _transitions(path, columns, scenario)
    validate(transitions, scenario, str(path))
    return transitions


def read_parts(path: str | Path, scenario: Scenario) -> Iterator[Transitions]:
    """The rows of Parquet in turn, at most `PART_ROWS` a part; not validated: that is left to who takes them.

    Memory is a part's and a row group's, as it is in the file.

    Raises:
        DatasetError: a file that cannot be read, a missing column, a wrong shape or type.
    """
    path = Path(path)
    with _named_errors(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        names, first = [name for name in COLUMNS if name in file.schema_arrow.names], 0
        for group in range(file.num_row_groups):  # one at a time: Arrow keeps what it has read of all it was asked for
            for batch in file.iter_batches(PART_ROWS, row_groups=[group], columns=names):
                columns = {name: _unnest(path, name, batch[name], 1, first) for name in names}
                yield _transitions(path, columns, scenario, first)
                first += len(batch)


def _transitions(path: Path, columns: dict[str, NDArray[Any]], scenario: Scenario, first: int = 0) -> Transitions:
    """Columns as they are in a file, in their types in memory; `first` is the number of the first row."""
    missing = [name for name in COLUMNS if name not in columns]
    single = [name for name in COLUMNS if name in columns and not columns[name].ndim]
    if single:
        raise DatasetError(f"{path}: column '{single[0]}' is one number, allowed: one or more a row")
    zero: list[str] = []
    for together, allowed in ((OPTIONAL, scenario.limits.energy_budget_j is None), (WORKED_OUT, True)):
        if allowed and set(together) <= set(missing):
            zero += together
    needed = [name for name in missing if name not in zero]
    if needed:
        raise DatasetError(f"{path}: column '{needed[0]}' is missing: {COLUMNS[needed[0]].meaning}")
    count, devices = len(columns["step"]), scenario.traffic.devices
    columns = columns | {name: np.zeros(count) for name in zero}
    read = Transitions(**{name: _fit(path, name, columns[name], count, devices, first) for name in COLUMNS})
    return relabelled(read, scenario) if WORKED_OUT[0] in zero else read


def stored_scenario(path: str | Path) -> Scenario | None:
    """The scenario that flat data carry; None where a user's file carries none.

    Raises:
        DatasetError: a file that cannot be read.
        ScenarioError: a scenario that is not valid.
    """
    path = Path(path)
    text = scenario_text(path) if path.suffix == ".mapped" else _read(path, only_scenario=True)[1]
    if text is None:
        return None
    try:
        return parse_scenario(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise DatasetError(f"{path}: its scenario is not valid TOML: {error}") from None


def _check_suffix(path: Path) -> None:
    if path.suffix not in SUFFIXES:
        raise DatasetError(f"{path}: suffix '{path.suffix}', allowed: {', '.join(SUFFIXES)}")


def _read(path: Path, *, only_scenario: bool = False) -> tuple[dict[str, NDArray[Any]], str | None]:
    """The known columns of a file as they are, and its scenario's TOML."""
    _check_suffix(path)
    wanted = () if only_scenario else tuple(COLUMNS)
    with _named_errors(path):
        if path.suffix == ".npz":
            with path.open("rb") as opened, NpzFile(opened, allow_pickle=False) as archive:
                text = str(archive[_SCENARIO]) if _SCENARIO in archive else None
                return {name: np.asarray(archive[name]) for name in wanted if name in archive}, text
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            stored = (file.schema_arrow.metadata or {}).get(_SCENARIO.encode())
            text = None if stored is None else stored.decode()
            names = [name for name in wanted if name in file.schema_arrow.names]
            table = file.read(columns=names)
        return {name: _unnest(path, name, table[name].combine_chunks(), 1) for name in names}, text


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """What goes wrong inside while `path` is read, as one line that names it."""
    try:
        yield
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except _UNREADABLE as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{path}: no readable {path.suffix[1:]} file, cut short or damaged: {reason}") from None


def _refuse(path: Path, row: int, name: str, shown: str, allowed: str) -> NoReturn:
    raise DatasetError(f"{path}: row {row}, column '{name}' = {shown}, allowed: {allowed}")


def _unnest(path: Path, name: str, array: Any, per_row: int, first: int = 0) -> NDArray[Any]:
    """An Arrow column of numbers or of equally long lists of them as (n,) or (n, length, ...) array."""
    if array.null_count:
        row = int(np.argmax(array.is_null().to_numpy(zero_copy_only=False))) // per_row
        _refuse(path, first + row, name, "nothing", COLUMNS[name].meaning)
    if not any(is_list(array.type) for is_list in _LISTS):
        return np.asarray(array.to_numpy(zero_copy_only=False))
    lengths = pc.list_value_length(array).to_numpy(zero_copy_only=False)
    length = int(lengths[0]) if len(lengths) else 0
    if (lengths != length).any():
        row = int(np.argmax(lengths != length))
        _refuse(path, first + row // per_row, name, f"{lengths[row]} values", f"{length}, as in row {first}")
    inner = _unnest(path, name, array.flatten(), per_row * max(length, 1), first)
    return inner.reshape(len(array), length, *inner.shape[1:])


def _fit(path: Path, name: str, values: NDArray[Any], count: int, devices: int, first: int) -> NDArray[Any]:
    """A column as its shape and type in memory demand."""
    column = COLUMNS[name]
    shape = column.row_shape(devices)
    flat = (int(np.prod(shape)),) if shape else ()
    if values.shape not in {(count, *shape), (count, *flat)}:
        wanted = f"({count}, {flat[0]})" if flat else f"({count},)"
        raise DatasetError(
            f"{path}: column '{name}' has shape {values.shape}, allowed: {wanted} for the rows of 'step' and "
            f"the scenario's K = {devices} devices: {column.meaning}"
        )
    if values.dtype.kind not in "biuf":
        raise DatasetError(f"{path}: column '{name}' holds {values.dtype}, allowed: numbers: {column.meaning}")
    if column.kind != "float" and values.dtype.kind != "b":
        limit = 2.0**31 - 1 if column.kind == "int" else 1.0
        odd = ~np.isfinite(values) | (values != np.floor(values)) | (np.abs(values) > limit)
        odd = odd | (values < 0) if column.kind == "bool" else odd
        if odd.any():
            row = int(np.argmax(odd))
            whole = f"whole numbers to {limit:.0f}" if column.kind == "int" else "true or false, 1 or 0"
            _refuse(path, first + row, name, f"{values[row]:g}", f"{whole}: {column.meaning}")
    with np.errstate(over="ignore"):  # becomes infinite, which validate names
        return values.astype(column.dtype, copy=False).reshape(count, *shape)
