from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.datasets.flights import fly
from uavrl.datasets import (
    Transitions,
    builtin_names,
    load_builtin,
    load_source,
    save_flat,
    select,
    sources,
    write_minari,
)
from uavrl.errors import DatasetError, ScenarioError
from uavrl.scenario import Scenario, load_scenario


def test_a_source_is_a_file_or_a_minari_dataset(
    log: Transitions, scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    save_flat(tmp_path / "log.parquet", log, scenario)
    write_minari("log-v0", log, scenario)
    for source in (tmp_path / "log.parquet", str(tmp_path / "log.parquet"), "log-v0"):
        transitions, stored = load_source(source)
        assert transitions.digest() == log.digest()
        assert stored == scenario
        renamed = scenario.replace(name="renamed")
        assert load_source(source, renamed)[1] == renamed
        with pytest.raises(DatasetError, match=r"K = 3 devices, allowed: 10|\(120, 6\), allowed: \(120, 20\)"):
            load_source(source, "released")


def test_a_source_without_a_scenario_needs_one(log: Transitions, scenario: Scenario, tmp_path: Path) -> None:
    np.savez(tmp_path / "mine.npz", **log.columns())  # type: ignore[arg-type]  # numpy's stub takes them for a flag
    with pytest.raises(DatasetError, match=r"mine\.npz: carries no scenario, name the one .*--scenario"):
        load_source(tmp_path / "mine.npz")
    (tmp_path / "mine.toml").write_text(scenario.to_toml())
    assert load_source(tmp_path / "mine.npz", str(tmp_path / "mine.toml"))[0].digest() == log.digest()
    with pytest.raises(ScenarioError, match="'mars' is no preset"):
        load_source(tmp_path / "mine.npz", "mars")


def test_unknown_sources_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        DatasetError, match=r"'layout' is no built-in data, no \.parquet, \.npz or \.mapped, and no Minari"
    ):
        load_source("layout")
    with pytest.raises(DatasetError, match="no such file"):
        load_source(tmp_path / "none.parquet")
    (tmp_path / "log.csv").write_text("reward\n1\n")
    with pytest.raises(DatasetError, match=r"suffix '\.csv', allowed: \.parquet, \.npz"):
        load_source(tmp_path / "log.csv")


def test_built_in_data_is_a_selection_of_the_installed_file(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "_BUILTIN", tmp_path)
    log = fly(scenario, environments=100, steps=60)
    with pytest.raises(DatasetError, match="'fixed' is not installed; make your own with `uavrl collect`"):
        load_builtin("fixed")
    fifty = select(log, 5000)
    save_flat(tmp_path / "fixed.parquet", fifty, scenario)
    assert load_builtin("fixed", 3000).digest() == select(log, 3000).digest()
    assert load_builtin("fixed", 100, "bad", seed=4).digest() == select(fifty, 100, "bad", seed=4).digest()
    assert load_source("fixed")[0].digest() == fifty.digest()
    with pytest.raises(DatasetError, match="size = 30000, allowed: 1 to 5000"):
        load_builtin("fixed")
    with pytest.raises(DatasetError, match="'other' does not exist, allowed: fixed, layouts"):
        load_builtin("other")


@pytest.mark.parametrize("name", builtin_names())
def test_installed_data_is_what_the_documentation_says(name: str) -> None:
    try:
        transitions, scenario = load_source(name)
    except DatasetError as error:
        pytest.skip(str(error))
    assert (len(transitions), scenario) == (50_000, load_scenario("realistic" if name == "realistic" else "released"))
    layouts = np.unique(transitions.layout_m.reshape(len(transitions), -1), axis=0)
    if name == "fixed":
        fixed = np.random.default_rng(0).uniform(0, 1000, (10, 2))
        np.testing.assert_allclose(layouts, fixed.reshape(1, -1), rtol=1e-6)
    else:
        assert len(layouts) == (150 if name == "realistic" else 700)
    assert len(load_builtin(name)) == 30_000
