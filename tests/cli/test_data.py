from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.datasets.flights import fly, small_scenario
from uavrl.cli import main
from uavrl.datasets import Transitions, load_flat, load_source, save_flat, select
from uavrl.scenario import Scenario, load_scenario


@pytest.fixture
def flown(tmp_path: Path) -> tuple[Path, Transitions, Scenario]:
    scenario = small_scenario()
    log = fly(scenario)
    save_flat(tmp_path / "log.parquet", log, scenario)
    return tmp_path / "log.parquet", log, scenario


def test_show_reports_and_writes_figures(
    flown: tuple[Path, Transitions, Scenario], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["data", "show", str(flown[0]), "--json", str(tmp_path / "figures.json")]) == 0
    assert "12, of which complete 9" in capsys.readouterr().out
    assert json.loads((tmp_path / "figures.json").read_text())["rows"] == 120


def test_select_writes_the_selection(flown: tuple[Path, Transitions, Scenario], tmp_path: Path) -> None:
    path, log, scenario = flown
    words = ["data", "select", str(path), "--size", "40", "--quality", "bad", "--seed", "7", "--out"]
    assert main([*words, str(tmp_path / "bad.npz")]) == 0
    assert load_flat(tmp_path / "bad.npz", scenario).digest() == select(log, 40, "bad", 7).digest()


def test_convert_goes_to_minari_and_back(
    flown: tuple[Path, Transitions, Scenario], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    assert main(["data", "convert", str(flown[0]), "mine/log-v0", "--observation", "paper"]) == 0
    assert main(["data", "convert", "mine/log-v0", str(tmp_path / "back.npz")]) == 0
    back, scenario = load_source(tmp_path / "back.npz")
    assert back.digest() == flown[1].digest()
    assert scenario == flown[2]


def test_convert_makes_a_map_and_show_reads_every_byte_of_it(
    flown: tuple[Path, Transitions, Scenario], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "log.mapped"
    assert main(["data", "convert", str(flown[0]), str(target)]) == 0
    assert capsys.readouterr().out == f"{target}: MappedTransitions(120 rows, K = 3)\n"
    assert load_source(target)[0].digest() == flown[1].digest()
    words = ["data", "select", str(target), "--size", "40", "--quality", "bad", "--out", str(tmp_path / "bad.mapped")]
    assert main(words) == 0
    assert load_source(tmp_path / "bad.mapped")[0].digest() == select(flown[1], 40, "bad").digest()
    assert main(["data", "show", str(target)]) == 0
    rows = target / "rows.npy"
    rows.write_bytes(rows.read_bytes()[:-1] + b"?")
    capsys.readouterr()
    assert main(["data", "show", str(target)]) == 2
    complaint = capsys.readouterr().err
    assert "log.mapped: damaged" in complaint
    assert complaint.count("\n") == 1


@pytest.mark.parametrize("out", ["other.parquet", "other.npz", "other.mapped"])
@pytest.mark.parametrize("source", ["log.parquet", "log.mapped"])
def test_relabel_changes_rewards_and_the_objective_that_comes_with_them(
    flown: tuple[Path, Transitions, Scenario], tmp_path: Path, source: str, out: str
) -> None:
    path, log, scenario = flown
    save_flat(tmp_path / "log.mapped", log, scenario)
    objective = tmp_path / "energy.toml"
    objective.write_text(scenario.replace(name="energy", age_weight=0.0, energy_reference_j=1.0).to_toml())
    words = ["data", "relabel", str(tmp_path / source), "--objective", str(objective), "--out", str(tmp_path / out)]
    assert main(words) == 0
    rows, carried = load_source(tmp_path / out)
    assert carried == load_scenario(objective)
    np.testing.assert_allclose(rows.reward, -log.next_energy_j, rtol=1e-5)
    np.testing.assert_array_equal(rows.next_age_s, log.next_age_s)
    assert load_source(path)[0].digest() == log.digest()


@pytest.mark.parametrize("out", ["other.npz", "other.mapped"])
def test_relabel_takes_only_what_is_valid_as_it_was_flown(
    flown: tuple[Path, Transitions, Scenario], tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    path, log, scenario = flown
    energy = {name: 1e3 * log.columns()[name] for name in ("energy_j", "next_energy_j", "used_j", "next_used_j")}
    table = pq.read_table(path)
    for name, values in energy.items():
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(values.astype(np.float32)))
    pq.write_table(table, tmp_path / "millijoules.parquet")
    other = tmp_path / "other.toml"
    other.write_text(scenario.replace(name="other", age_reference_s=7.0).to_toml())
    for words, column in (
        ([str(tmp_path / "millijoules.parquet")], "energy_term"),
        ([str(path), "--scenario", str(other)], "age_term"),
    ):
        assert main(["data", "relabel", *words, "--objective", str(other), "--out", str(tmp_path / out)]) == 2
        complaint = capsys.readouterr().err
        assert f"column '{column}'" in complaint
        assert complaint.count("\n") == 1
        assert not (tmp_path / out).exists()


def test_a_bad_value_stops_a_conversion_with_the_sources_name_and_leaves_nothing(
    flown: tuple[Path, Transitions, Scenario], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = flown[1].columns()
    wrong = columns["reward"].copy()
    wrong[70] = 3.0
    np.savez(tmp_path / "wrong.npz", **columns | {"reward": wrong})  # type: ignore[arg-type]  # taken for a flag
    pq.write_table(
        pa.table({name: (wrong if name == "reward" else values).tolist() for name, values in columns.items()}),
        tmp_path / "wrong.parquet",
    )
    (tmp_path / "my.toml").write_text(flown[2].to_toml())
    for name in ("wrong.parquet", "wrong.npz"):
        words = [str(tmp_path / name), str(tmp_path / "log.mapped"), "--scenario", str(tmp_path / "my.toml")]
        assert main(["data", "convert", *words]) == 2
        complaint = capsys.readouterr().err
        assert f"{name}: row 70 (episode 5, step 10), column 'reward' = 3, allowed: -" in complaint
        assert complaint.count("\n") == 1
        assert not list(tmp_path.glob("*log.mapped*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show", "nothing"], "data 'nothing' is no built-in data"),
        (["show", "LOG", "--scenario", "released"], "allowed: "),
        (["select", "LOG", "--size", "121", "--out", "out.npz"], "size = 121, allowed: 1 to 120"),
        (["select", "LOG", "--size", "10", "--out", "out.csv"], "suffix '.csv', allowed: .parquet, .npz"),
        (["convert", "LOG", "OUT/full.mapped"], "full.mapped: exists, choose another name or remove it first"),
        (["show", "OUT/full.mapped"], "full.mapped: no whole directory of mapped flights: scenario.toml"),
        (["show", "OUT/none.mapped"], "none.mapped: no such directory"),
        (["relabel", "LOG", "--objective", "papr", "--out", "OUT/x.npz"], "scenario 'papr'"),
        (["relabel", "LOG", "--objective", "released", "--out", "OUT/x.csv"], "allowed: .parquet, .npz"),
        (["relabel", "nothing", "--objective", "paper", "--out", "OUT/x.npz"], "data 'nothing' is no built-in data"),
        (["convert", "LOG", "no version"], "dataset id 'no version', allowed"),
        (["show", "LOG", "--json", "LOG/figures.json"], "figures.json"),
        (["show", "LOG", "--json", "gone/figures.json"], "'gone' does not exist"),
    ],
)
def test_wrong_input_gets_one_line_and_code_2(
    flown: tuple[Path, Transitions, Scenario], words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = flown[0].parent
    (out / "full.mapped").mkdir()
    assert main(["data", *(word.replace("LOG", str(flown[0])).replace("OUT", str(out)) for word in words)]) == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
