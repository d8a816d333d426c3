from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from tests.datasets.flights import fly, small_scenario
from uavrl.datasets import COLUMNS, Transitions, load_flat, save_flat, select, stored_scenario
from uavrl.datasets.flat import WORKED_OUT
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario

SUFFIXES = (".parquet", ".npz")


def flat(log: Transitions) -> dict[str, NDArray[Any]]:
    """As a user has them: float64, vectors in rows of 2K."""
    return {
        name: values.reshape(len(log), -1).astype(float) if values.ndim > 1 else values
        for name, values in log.columns().items()
    }


def write(path: Path, columns: dict[str, Any]) -> Path:
    """A user's file, made without this package: lists in Parquet, plain arrays in npz."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
    else:
        pq.write_table(pa.table({name: np.asarray(values).tolist() for name, values in columns.items()}), path)
    return path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_comes_back_equal_with_its_scenario(
    log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str
) -> None:
    selected = select(log, 50)
    save_flat(tmp_path / "new" / f"log{suffix}", selected, scenario)
    assert load_flat(tmp_path / "new" / f"log{suffix}", scenario).digest() == selected.digest()
    assert stored_scenario(tmp_path / "new" / f"log{suffix}") == scenario
    assert [path.name for path in (tmp_path / "new").iterdir()] == [f"log{suffix}"]  # nothing left beside it


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_users_file_reads_the_same(log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str) -> None:
    columns = flat(log) | {"comment": np.arange(len(log)), "terminated": log.terminated.astype(np.int8)}
    columns |= {"device": log.device.astype(float), "episode": log.episode.astype(np.uint16)}
    path = write(tmp_path / f"mine{suffix}", columns)
    assert load_flat(path, scenario).digest() == log.digest()
    assert stored_scenario(path) is None


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_layouts_may_be_nested(log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"nested{suffix}", flat(log) | {"layout_m": log.layout_m})
    assert load_flat(path, scenario).digest() == log.digest()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_used_energy_may_be_left_out_unless_a_battery_counts_it(tmp_path: Path, suffix: str) -> None:
    scenario = small_scenario()
    log = fly(scenario)
    columns = {name: values for name, values in flat(log).items() if name not in ("used_j", "next_used_j")}
    path = write(tmp_path / f"unused{suffix}", columns)
    assert not load_flat(path, scenario).next_used_j.any()
    with pytest.raises(DatasetError, match="column 'used_j' is missing: energy since the flight began"):
        load_flat(path, scenario.replace(energy_budget_j=1e6))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", [name for name in COLUMNS if name != "used_j"])
def test_a_missing_column_is_named(
    log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str, name: str
) -> None:
    path = write(tmp_path / f"short{suffix}", {key: values for key, values in flat(log).items() if key != name})
    with pytest.raises(DatasetError) as caught:
        load_flat(path, scenario)
    assert str(caught.value) == f"{path}: column '{name}' is missing: {COLUMNS[name].meaning}"


WRONG: dict[str, tuple[str, Any, str]] = {
    "nan in a list": ("next_age_s", (20, 1, np.nan), r"row 20 \(episode 1, step 8\), column 'next_age_s'\[1\] = nan"),
    "no whole device": ("device", (20, None, 1.5), "row 20, column 'device' = 1.5, allowed: whole numbers"),
    "nan device": ("device", (20, None, np.nan), "row 20, column 'device' = nan, allowed: whole numbers"),
    "time in ms as a number": (
        "episode",
        (20, None, 1.7e12),
        "row 20, column 'episode' = 1.7e.12, allowed: whole numbers to 2147483647",
    ),
    "no truth": ("terminated", (20, None, 2.0), "row 20, column 'terminated' = 2, allowed: true or false"),
    "too large": ("reward", (20, None, 1e300), r"row 20 .*, column 'reward' = inf, allowed: a finite number"),
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("case", WRONG)
def test_wrong_values_are_named(log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str, case: str) -> None:
    name, (row, entry, value), message = WRONG[case]
    columns = flat(log)
    columns[name] = columns[name].astype(float)
    columns[name][row if entry is None else (row, entry)] = value
    path = write(tmp_path / f"wrong{suffix}", columns)
    with pytest.raises(DatasetError, match=message) as caught:
        load_flat(path, scenario)
    assert str(caught.value).startswith(f"{path}: row 20")


@pytest.mark.parametrize(("hole", "where"), [("reward", None), ("terminated", None), ("device", None), ("age_s", 2)])
def test_an_empty_cell_is_named(
    log: Transitions, scenario: Scenario, tmp_path: Path, hole: str, where: int | None
) -> None:
    columns = {name: values.tolist() for name, values in flat(log).items()}
    if where is None:
        columns[hole][31] = None
    else:
        columns[hole][31][where] = None
    pq.write_table(pa.table(columns), tmp_path / "hole.parquet")
    with pytest.raises(DatasetError, match=f"row 31, column '{hole}' = nothing, allowed: "):
        load_flat(tmp_path / "hole.parquet", scenario)


def test_lists_of_unequal_length_are_named(log: Transitions, scenario: Scenario, tmp_path: Path) -> None:
    columns = {name: values.tolist() for name, values in flat(log).items()}
    columns["age_s"][31] = [1.0, 2.0]
    pq.write_table(pa.table(columns), tmp_path / "ragged.parquet")
    with pytest.raises(DatasetError, match="row 31, column 'age_s' = 2 values, allowed: 3, as in row 0"):
        load_flat(tmp_path / "ragged.parquet", scenario)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_wrong_shape_or_type_is_named(log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"k{suffix}", flat(log))
    with pytest.raises(DatasetError, match=r"'layout_m' has shape \(120, 6\), allowed: \(120, 8\) .* K = 4 devices"):
        load_flat(path, small_scenario(devices=4))
    path = write(path, flat(log) | {"device": log.device.astype(str)})
    with pytest.raises(DatasetError, match=r"column 'device' holds .*, allowed: numbers: device asked to send"):
        load_flat(path, scenario)
    path = write(path, flat(log) | {"energy_j": log.position_m})
    with pytest.raises(DatasetError, match=r"column 'energy_j' has shape \(120, 2\), allowed: \(120,\)"):
        load_flat(path, scenario)


def test_columns_of_unequal_length_are_named(log: Transitions, scenario: Scenario, tmp_path: Path) -> None:
    path = write(tmp_path / "uneven.npz", flat(log) | {"duration_s": log.duration_s[:-1]})
    with pytest.raises(DatasetError, match=r"column 'duration_s' has shape \(119,\), allowed: \(120,\)"):
        load_flat(path, scenario)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.999])
def test_a_file_cut_short_is_refused(
    log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str, share: float
) -> None:
    path = tmp_path / f"log{suffix}"
    save_flat(path, log, scenario)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    for read in (lambda: load_flat(path, scenario), lambda: stored_scenario(path)):
        with pytest.raises(DatasetError, match=f"no readable {suffix[1:]} file, cut short or damaged") as caught:
            read()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_damaged_file_is_never_read_as_another(
    log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"log{suffix}"
    save_flat(path, log, scenario)
    whole = bytearray(path.read_bytes())
    for place in np.random.default_rng(0).integers(0, len(whole), 60):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            read = load_flat(path, scenario)
        except DatasetError:
            continue
        assert read.digest() == log.digest()  # what was hit matters to nobody


def test_files_that_are_something_else_are_refused(log: Transitions, scenario: Scenario, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such file"):
        load_flat(tmp_path / "none.npz", scenario)
    with pytest.raises(DatasetError, match=r"suffix '\.csv', allowed: \.parquet, \.npz"):
        load_flat(tmp_path / "log.csv", scenario)
    with pytest.raises(DatasetError, match=r"suffix '\.csv'"):
        save_flat(tmp_path / "log.csv", log, scenario)
    np.save(tmp_path / "one.npy", log.reward)
    (tmp_path / "one.npy").rename(tmp_path / "one.npz")
    with pytest.raises(DatasetError, match="no readable npz"):
        load_flat(tmp_path / "one.npz", scenario)
    path = write(tmp_path / "pickled.npz", flat(log) | {"reward": np.array([{}] * len(log))})
    with pytest.raises(DatasetError, match="no readable npz"):
        load_flat(path, scenario)


def test_an_interrupted_write_leaves_the_old_file(
    log: Transitions, scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.parquet"
    save_flat(path, log, scenario)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DatasetError, match="cannot be written: No space left"):
        save_flat(path, select(log, 20), scenario)
    assert load_flat(path, scenario).digest() == log.digest()
    assert [entry.name for entry in tmp_path.iterdir()] == ["log.parquet"]


def test_what_is_not_valid_is_not_written(log: Transitions, scenario: Scenario, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="'age_term'"):
        save_flat(tmp_path / "log.parquet", log, scenario.replace(age_reference_s=2.0))
    assert not list(tmp_path.iterdir())


def test_fifty_thousand_rows_are_small_and_quick(tmp_path: Path) -> None:
    from time import process_time

    scenario = small_scenario(devices=10, max_steps=400)
    log = fly(scenario, environments=400, steps=125)
    save_flat(tmp_path / "log.parquet", log, scenario)
    assert (tmp_path / "log.parquet").stat().st_size < 6e6  # 11.7 MB of plain numbers
    started = process_time()
    load_flat(tmp_path / "log.parquet", scenario)
    assert process_time() - started < 2.0  # about 0.3 on a free core


def test_a_column_that_is_one_number_is_named(log: Transitions, scenario: Scenario, tmp_path: Path) -> None:
    path = write(tmp_path / "one.npz", flat(log) | {"reward": np.array(1.0)})
    with pytest.raises(DatasetError, match="column 'reward' is one number, allowed: one or more a row"):
        load_flat(path, scenario)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_reward_that_is_left_out_is_what_the_objective_makes_of_the_rest(
    log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str
) -> None:
    columns = {name: values for name, values in flat(log).items() if name not in WORKED_OUT}
    found = load_flat(write(tmp_path / f"plain{suffix}", columns), scenario)
    for name in WORKED_OUT:
        np.testing.assert_allclose(found.columns()[name], log.columns()[name], rtol=1e-5, atol=1e-6)
        assert found.columns()[name].dtype == log.columns()[name].dtype
    with pytest.raises(DatasetError, match="column 'age_term' is missing"):
        load_flat(write(tmp_path / f"half{suffix}", columns | {"reward": flat(log)["reward"]}), scenario)
