from __future__ import annotations

from pathlib import Path

import minari
import numpy as np
import pytest

from tests.datasets.flights import fly, small_scenario
from uavrl.datasets import Transitions, read_minari, select, write_minari
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario
from uavrl.simulation.observations import ObservationKind


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


@pytest.mark.parametrize("kind", ["paper", "devices"])
def test_flights_come_back_equal(log: Transitions, scenario: Scenario, folder: Path, kind: ObservationKind) -> None:
    write_minari("uavrl/test-v0", log, scenario, kind)
    read, stored = read_minari("uavrl/test-v0")
    assert read.digest() == log.digest()
    assert stored == scenario
    assert (folder / "uavrl" / "test-v0").is_dir()


def test_others_read_whole_flights_with_minari_alone(log: Transitions, scenario: Scenario) -> None:
    write_minari("test-v0", log, scenario, "devices", algorithm="oldest first")
    dataset = minari.load_dataset("test-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (12, 120)
    assert dataset.storage.metadata["algorithm_name"] == "oldest first"
    before, after = log.observations("devices", scenario)
    start = 0
    for episode in dataset.iterate_episodes():
        rows = slice(start, start + len(episode))
        start += len(episode)
        for key in ("uav", "devices"):
            np.testing.assert_array_equal(episode.observations[key][:-1], before[key][rows])
            np.testing.assert_array_equal(episode.observations[key][-1], after[key][rows][-1])
        np.testing.assert_array_equal(episode.actions["displacement_m"], log.displacement_m[rows])
        np.testing.assert_array_equal(episode.actions["device"], log.device[rows])
        np.testing.assert_array_equal(episode.rewards, log.reward[rows])
        np.testing.assert_array_equal(episode.infos["duration_s"], [0, *log.duration_s[rows]])
        np.testing.assert_array_equal(episode.infos["age_s"][1:], log.next_age_s[rows])
        assert episode.truncations[-1] == (len(episode) == 12)
        assert dataset.observation_space.contains({key: value[0] for key, value in episode.observations.items()})
        action = {key: value[0] for key, value in episode.actions.items()}
        assert dataset.action_space["displacement_m"].contains(action["displacement_m"])
    assert start == 120


def test_flights_of_unequal_length_that_a_battery_ends(tmp_path: Path) -> None:
    scenario = small_scenario(energy_budget_j=120.0, max_steps=30)
    log = fly(scenario)
    lengths = np.bincount(log.episode)
    assert log.terminated.any()
    assert len(np.unique(lengths)) > 2
    write_minari("uneven-v3", log, scenario)
    assert read_minari("uneven-v3")[0].digest() == log.digest()


def test_the_environment_that_was_flown_is_recovered() -> None:
    scenario = small_scenario(packet_bits=(1e6, 2e6, 3e6), fading="none", time_budget_s=None).replace(name="mine")
    layout = np.array([[100.0, 200.0], [300.0, 400.0], [500.0, 600.0]])
    log = fly(scenario, layout=layout)
    write_minari("fixed-v0", log, scenario, "paper")
    environment = minari.load_dataset("fixed-v0").recover_environment()
    assert environment.unwrapped.scenario == scenario
    observation, info = environment.reset(seed=0, options={"position_m": log.position_m[0]})
    np.testing.assert_array_equal(info["layout_m"], layout)
    np.testing.assert_allclose(observation, log.observations("paper", scenario)[0][0], rtol=1e-6)
    _, reward, *_ = environment.step({"displacement_m": log.displacement_m[0], "device": log.device[0]})
    assert reward == pytest.approx(log.reward[0], rel=1e-5)


def test_a_selection_with_gaps_is_no_minari_dataset(log: Transitions, scenario: Scenario, folder: Path) -> None:
    with pytest.raises(DatasetError, match=r"row 5, column 'step' = 7, allowed: 5: Minari keeps whole episodes"):
        write_minari("gap-v0", log.take(np.r_[0:5, 7:20]), scenario)
    assert not (folder / "gap-v0").exists()
    with pytest.raises(DatasetError, match="Minari keeps whole episodes"):
        write_minari("gap-v0", select(log, 60), scenario)


@pytest.mark.parametrize("name", ["no version", "noversion", "a/../b-v0", "-v"])
def test_a_malformed_id_is_refused(log: Transitions, scenario: Scenario, name: str) -> None:
    with pytest.raises(DatasetError, match=r"allowed: 'name-v0' or 'namespace/name-v0'"):
        write_minari(name, log, scenario)


def test_a_dataset_is_not_written_over(log: Transitions, scenario: Scenario) -> None:
    write_minari("twice-v0", log, scenario)
    with pytest.raises(DatasetError, match="dataset id 'twice-v0' exists"):
        write_minari("twice-v0", log, scenario)
    assert read_minari("twice-v0")[0].digest() == log.digest()


def test_what_cannot_be_read_is_refused(log: Transitions, scenario: Scenario, folder: Path) -> None:
    with pytest.raises(
        DatasetError, match=r"'none-v0' is no built-in data, no \.parquet, \.npz or \.mapped, and no Minari"
    ):
        read_minari("none-v0")
    with pytest.raises(DatasetError, match="'a b' is no built-in data"):
        read_minari("a b")
    write_minari("cut-v0", log, scenario)
    data = folder / "cut-v0" / "data"
    whole = (data / "main_data.hdf5").read_bytes()
    (data / "main_data.hdf5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DatasetError, match="dataset 'cut-v0' cannot be read, damaged or of other origin"):
        read_minari("cut-v0")
    metadata = (data / "metadata.json").read_text()
    (data / "metadata.json").write_text(metadata.replace("uavrl_scenario", "other"))
    with pytest.raises(DatasetError, match="'cut-v0' carries no uavrl scenario: of other origin, or not finished"):
        read_minari("cut-v0")
