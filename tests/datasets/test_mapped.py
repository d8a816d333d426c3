from __future__ import annotations

import json
import os
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.datasets.flights import fly
from uavrl.datasets import COLUMNS, MappedTransitions, Transitions, flat, load_source, save_flat, save_mapped, sources
from uavrl.datasets.mapped import open_mapped
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario


@pytest.fixture
def path(log: Transitions, scenario: Scenario, tmp_path: Path) -> Path:
    """The log as a directory."""
    save_flat(tmp_path / "log.mapped", log, scenario)
    return tmp_path / "log.mapped"


def test_rows_come_back_equal_and_stay_on_disk(path: Path, log: Transitions, scenario: Scenario) -> None:
    mapped, stored = load_source(path)
    assert isinstance(mapped, MappedTransitions)
    assert stored == scenario
    assert (len(mapped), mapped.devices, repr(mapped)) == (120, 3, "MappedTransitions(120 rows, K = 3)")
    for name, values in mapped.columns().items():
        assert not (values.flags.owndata or values.flags.writeable)
        assert values.flags.aligned
        np.testing.assert_array_equal(values, log.columns()[name], strict=True)
    assert mapped.digest() == mapped.sha256 == log.digest()
    taken = mapped.take(np.array([7, 3, 7]))
    assert taken.digest() == log.take(np.array([7, 3, 7])).digest()
    assert taken.reward.flags.owndata
    assert [entry.name for entry in path.parent.iterdir()] == ["log.mapped"]  # nothing left beside it


def test_a_program_that_knows_nothing_of_this_package_reads_the_rows(path: Path, log: Transitions) -> None:
    rows = np.load(path / "rows.npy", mmap_mode="r")
    assert rows.dtype.names == tuple(COLUMNS)
    np.testing.assert_array_equal(rows["layout_m"], log.layout_m)
    assert json.loads((path / "manifest.json").read_text())["rows"] == 120


@pytest.mark.parametrize("rows", [1, 7, 120])
def test_parts_are_put_together_whatever_their_size(
    log: Transitions, scenario: Scenario, tmp_path: Path, rows: int
) -> None:
    written = save_mapped(tmp_path / "new" / "log.mapped", log.parts(rows), scenario)
    assert written.digest() == log.digest()
    written.verify("log")


@pytest.mark.parametrize("suffix", [".parquet", ".npz"])
def test_a_log_goes_from_a_file_to_a_map_and_back(
    log: Transitions, scenario: Scenario, tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flat, "PART_ROWS", 50)
    save_flat(tmp_path / f"log{suffix}", log, scenario)
    parts, stored = sources.load_parts(tmp_path / f"log{suffix}")
    written = save_mapped(tmp_path / "log.mapped", parts, stored)
    assert written.digest() == log.digest()
    save_flat(tmp_path / "back.parquet", written, scenario)
    assert load_source(tmp_path / "back.parquet")[0].digest() == log.digest()


def test_parquet_is_read_in_parts_and_its_bad_cells_are_named(
    log: Transitions, scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flat, "PART_ROWS", 50)
    file = tmp_path / "log.parquet"
    save_flat(file, log, scenario)
    assert [len(part) for part in flat.read_parts(file, scenario)] == [50, 50, 20]

    table = pq.read_table(file)
    for name, value, message in (
        ("reward", None, "row 70, column 'reward' = nothing"),
        ("device", 1.5, "row 70, column 'device' = 1.5, allowed: whole numbers"),
        ("age_s", [1.0, 2.0], "row 70, column 'age_s' = 2 values, allowed: 3, as in row 50"),
        ("age_s", [1.0, 2.0, -1.0], r"row 70 \(episode 5, step 10\), column 'age_s'\[2\] = -1, allowed: 0 to 400 s"),
    ):
        values = table[name].to_pylist()
        values[70] = value
        columns = {key: values if key == name else table[key].to_pylist() for key in COLUMNS}
        pq.write_table(pa.table(columns), file)
        with pytest.raises(DatasetError, match=rf"^{file}: {message}"):
            save_mapped(tmp_path / "log.mapped", sources.load_parts(file, scenario)[0], scenario, str(file))
        assert [entry.name for entry in tmp_path.iterdir()] == ["log.parquet"]

    save_flat(file, log, scenario)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(DatasetError, match="no readable parquet file, cut short or damaged"):
        list(flat.read_parts(file, scenario))


def test_of_parquet_one_row_group_is_held_at_a_time(scenario: Scenario, tmp_path: Path) -> None:
    file = tmp_path / "log.parquet"
    save_flat(file, fly(scenario, environments=1000, steps=40), scenario)
    pq.write_table(pq.read_table(file), file, row_group_size=2_000)
    before, held = pa.total_allocated_bytes(), []
    for part in flat.read_parts(file, scenario):
        held.append(pa.total_allocated_bytes() - before)
        assert len(part) == 2_000
    assert len(held) == 20
    assert max(held) < 0.3 * file.stat().st_size


def test_what_is_written_in_parts_needs_memory_for_parts(scenario: Scenario, tmp_path: Path) -> None:
    part = fly(scenario, environments=50, steps=40)  # 2,000 rows
    episodes, size = int(part.episode.max()) + 1, sum(values.nbytes for values in part.columns().values())

    def parts() -> Iterator[Transitions]:
        for number in range(50):
            yield Transitions(**part.columns() | {"episode": part.episode + number * episodes})

    tracemalloc.start()
    try:
        written = save_mapped(tmp_path / "log.mapped", parts(), scenario)
        load_source(tmp_path / "log.mapped")
        assert len(written.sample(100)) == 100
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(written) == 50 * len(part)
    assert peak < 10 * size  # of 50


def test_a_sample_is_the_same_each_time_in_order_and_never_twice_a_row(path: Path, log: Transitions) -> None:
    mapped = open_mapped(path)
    found = mapped.sample(30)
    assert found.digest() == mapped.sample(30).digest() != mapped.sample(30, seed=1).digest()
    rows = found.episode * 1000 + found.step
    assert (np.diff(rows) > 0).all()
    assert mapped.sample(500).digest() == log.digest()


def test_another_scenario_is_validated_and_the_stored_one_is_not_again(
    path: Path, scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DatasetError, match=r"log\.mapped: row 0 .*'age_term' = "):
        load_source(path, scenario.replace(age_reference_s=2.0))
    with pytest.raises(DatasetError, match="K = 3 devices, allowed: 10"):
        load_source(path, "released")
    assert load_source(path, scenario.replace(name="renamed"))[1].name == "renamed"
    monkeypatch.setattr("uavrl.datasets.flat.validated", None)
    load_source(path, scenario)
    load_source(path)


def test_nothing_is_written_over_and_half_a_directory_is_never_left(
    path: Path, log: Transitions, scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DatasetError, match=r"log\.mapped: exists, choose another name or remove it first"):
        save_flat(path, log, scenario)
    with pytest.raises(DatasetError, match=r"suffix '\.csv', allowed: \.mapped"):
        save_mapped(path.with_suffix(".csv"), [log], scenario)
    with pytest.raises(DatasetError, match=r"new\.mapped: row 0 .*'age_term'"):
        save_flat(path.with_name("new.mapped"), log, scenario.replace(age_reference_s=2.0))
    (path.parent / "file").touch()
    with pytest.raises(DatasetError, match="cannot be written: "):
        save_flat(path.parent / "file" / "new.mapped", log, scenario)
    left = path.with_name(".new.mapped.tmp")  # by a writer that was killed
    left.mkdir()
    (left / "rows.npy").touch()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(DatasetError, match="cannot be written: No space left"):
            save_flat(path.with_name("new.mapped"), log, scenario)
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["file", "log.mapped"]
    assert open_mapped(path).digest() == log.digest()


def change(name: str, how: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda path: (path / name).write_bytes(how((path / name).read_bytes()))


def archive(path: Path) -> None:
    with (path / "rows.npy").open("wb") as file:
        np.savez(file, reward=np.zeros(120))


DAMAGED: dict[str, tuple[Callable[[Path], object], str]] = {
    "manifest missing": (lambda path: (path / "manifest.json").unlink(), "manifest.json cannot be read"),
    "scenario missing": (lambda path: (path / "scenario.toml").unlink(), "scenario.toml cannot be read"),
    "scenario cut": (change("scenario.toml", lambda text: text[:50]), "scenario"),
    "manifest cut": (change("manifest.json", lambda text: text[:20]), "manifest.json: damaged or of another version"),
    "a later format": (change("manifest.json", lambda text: text.replace(b"1,", b"2,", 1)), "another version: format"),
    "no rows": (change("manifest.json", lambda text: text.replace(b"120", b"0")), "another version: rows"),
    "more rows": (
        change("manifest.json", lambda text: text.replace(b"120", b"121")),
        "rows.npy: holds other columns or",
    ),
    "no text": (change("manifest.json", lambda text: b"\xff\xfe"), "manifest.json cannot be read"),
    "rows missing": (lambda path: (path / "rows.npy").unlink(), "rows.npy: missing, cut short or damaged"),
    "rows empty": (change("rows.npy", lambda text: b""), "rows.npy: missing, cut short or damaged"),
    "header cut": (change("rows.npy", lambda text: text[:70]), "rows.npy: missing, cut short or damaged"),
    "rows cut": (change("rows.npy", lambda text: text[:-1]), "rows.npy: missing, cut short or damaged"),
    "rows added": (change("rows.npy", lambda text: text + b"0"), "rows.npy: has more bytes than its 120 rows"),
    "no record": (lambda path: np.save(path / "rows.npy", np.zeros(120)), "rows.npy: holds other columns or rows"),
    "renamed": (
        change("rows.npy", lambda text: text.replace(b"reward", b"rewarm")),
        "rows.npy: holds other columns or",
    ),
    "pickled": (
        lambda path: np.save(path / "rows.npy", np.array([{}] * 120)),
        "rows.npy: missing, cut short or damaged",
    ),
    "an archive": (archive, "rows.npy: missing, cut short or damaged"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_what_is_not_whole_is_refused_in_one_line(path: Path, damage: str) -> None:
    alter, message = DAMAGED[damage]
    alter(path)
    with pytest.raises(DatasetError, match=message) as caught:
        load_source(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_what_is_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.mapped: no such directory"):
        load_source(tmp_path / "none.mapped")
    (tmp_path / "file.mapped").write_text("rows")
    (tmp_path / "empty.mapped").mkdir()
    for name in ("file.mapped", "empty.mapped"):
        with pytest.raises(
            DatasetError, match=f"{name}: no whole directory of mapped flights: scenario.toml cannot be read"
        ):
            load_source(tmp_path / name)


def test_a_flipped_bit_is_found_when_all_is_read(path: Path) -> None:
    change("rows.npy", lambda text: text[:-100] + bytes([text[-100] ^ 1]) + text[-99:])(path)
    mapped, _ = load_source(path)
    assert isinstance(mapped, MappedTransitions)
    with pytest.raises(DatasetError, match=r"log\.mapped: damaged, its columns are not those that were written"):
        mapped.verify("log.mapped")
