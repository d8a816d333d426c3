"""What a policy sees: values, units, shapes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from uavrl.errors import ScenarioError
from uavrl.scenario import load_scenario
from uavrl.simulation.environment import observation_space, observe
from uavrl.simulation.observations import DEVICE_ENTRIES, UAV_ENTRIES, devices_observation, paper_observation
from uavrl.simulation.state import SimState

SCENARIO = load_scenario(
    "released", devices=3, packet_bits=(1e6, 2e6, 3e6), priority=(0.5, 0.3, 0.2), energy_budget_j=100.0
)
LAYOUT = np.array([[[10.0, 20.0], [500.0, 600.0], [990.0, 0.0]]] * 2)
STATE = SimState(
    position_m=np.array([[100.0, 200.0], [0.0, 1000.0]]),
    age_s=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
    energy_j=np.array([7.0, 8.0]),
    used_j=np.array([25.0, 130.0]),
    time_s=np.array([9.0, 10.0]),
    step=np.array([11, 12]),
)


def test_paper_is_position_ages_and_energy_of_the_last_step() -> None:
    seen = observe("paper", SCENARIO, LAYOUT, STATE)
    assert seen.tolist() == [[100.0, 200.0, 1.0, 2.0, 3.0, 7.0], [0.0, 1000.0, 4.0, 5.0, 6.0, 8.0]]
    assert seen.dtype == np.float32
    assert seen.shape == (2, 3 + 3)


def test_devices_are_seen_from_the_aircraft() -> None:
    seen = observe("devices", SCENARIO, LAYOUT, STATE)
    assert seen["uav"].dtype == seen["devices"].dtype == np.float32
    uav = [dict(zip(UAV_ENTRIES, row, strict=True)) for row in seen["uav"].tolist()]
    assert uav[0] == {"x_m": 100.0, "y_m": 200.0, "energy_j": 7.0, "energy_left": 0.75}
    assert uav[1]["energy_left"] == 0.0, "a battery is not less than empty"
    assert seen["devices"].shape == (2, 3, 6)
    second = dict(zip(DEVICE_ENTRIES, seen["devices"][0, 1].tolist(), strict=True))
    assert second == {
        "dx_m": 400.0,
        "dy_m": 400.0,
        "age_s": 2.0,
        "priority": pytest.approx(0.9),  # delta_k K: 1 is the usual share, whatever K
        "packet_mbit": 2.0,
        "valid": 1.0,
    }
    assert seen["devices"][1, 2].tolist() == pytest.approx([990.0, -1000.0, 6.0, 0.6, 3.0, 1.0])


def test_equal_priorities_read_one_and_no_battery_reads_full() -> None:
    scenario = load_scenario("released", devices=3)
    seen = observe("devices", scenario, LAYOUT, STATE)
    assert seen["devices"][..., 3] == pytest.approx(np.ones((2, 3)))
    assert seen["uav"][:, 3].tolist() == [1.0, 1.0]


def test_torch_sees_the_same() -> None:
    tensors = {name: torch.from_numpy(np.asarray(value)) for name, value in STATE._asdict().items()}
    layout = torch.from_numpy(LAYOUT)
    paper = paper_observation(tensors["position_m"], tensors["age_s"], tensors["energy_j"])
    assert paper.numpy() == pytest.approx(observe("paper", SCENARIO, LAYOUT, STATE))
    rest = (tensors[name] for name in ("position_m", "age_s", "energy_j", "used_j"))
    seen = devices_observation(SCENARIO, layout, *rest)
    expected = observe("devices", SCENARIO, LAYOUT, STATE)
    assert seen.uav.numpy() == pytest.approx(expected["uav"])
    assert seen.devices.numpy() == pytest.approx(expected["devices"])


@pytest.mark.parametrize("kind", ["paper", "devices"])
def test_space_holds_what_is_seen_up_to_its_bounds(kind: str) -> None:
    space = observation_space(kind, SCENARIO)  # type: ignore[arg-type]  # a test's parameter is a plain string
    edge = STATE._replace(age_s=np.full((2, 3), 400.0), position_m=np.array([[1e3, 1e3], [0, 0.0]]))
    layout = np.array([[[0.0, 0.0], [1000.0, 1000.0], [0.0, 1000.0]]] * 2)
    for state in (STATE, edge):
        seen = observe(kind, SCENARIO, layout, state)  # type: ignore[arg-type]  # as above
        for n in range(2):
            row = {key: value[n] for key, value in seen.items()} if isinstance(seen, dict) else seen[n]
            assert space.contains(row)


def test_an_unknown_kind_names_the_known_ones() -> None:
    with pytest.raises(ScenarioError, match="observation = 'pixels', allowed: 'paper', 'devices'"):
        observation_space("pixels", SCENARIO)  # type: ignore[arg-type]  # what must fail
