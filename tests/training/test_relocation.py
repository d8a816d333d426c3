from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.datasets.flights import fly, small_scenario
from tests.training.test_offline import config
from tests.training.test_symmetry import leaves, train_stacked_as_alone
from uavrl.datasets import Transitions
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.environment import draw
from uavrl.simulation.state import FlightAction
from uavrl.training.batches import to_batch
from uavrl.training.offline import OfflineLearner
from uavrl.training.relocation import Relocation, relocated

OBLONG = small_scenario(depth_m=600.0)


def drawn(count: int, devices: int, share: float) -> Relocation:
    return Relocation.draw(count, devices, OBLONG.area, share, torch.Generator().manual_seed(0))


def elsewhere(layout_m: NDArray[Any], device: NDArray[Any], place_m: NDArray[Any]) -> NDArray[Any]:
    """Layouts (B, K, 2) with all devices at other places but the served ones."""
    served = device[:, None] == np.arange(1, layout_m.shape[1] + 1)
    return np.where(served[..., None], layout_m, place_m)


def test_a_relocated_row_is_the_row_of_the_other_layout() -> None:
    rows = fly(OBLONG, steps=20)
    relocation = drawn(len(rows), rows.devices, 1.0)
    columns = {name: getattr(rows, name) for name in Transitions.__dataclass_fields__}
    layout_m = np.broadcast_to(rows.layout_m, (len(rows), rows.devices, 2))
    columns["layout_m"] = elsewhere(layout_m, rows.device, relocation.place_m.numpy())
    expected = leaves(to_batch(Transitions(**columns), "devices", OBLONG))
    for name, value in leaves(relocated(to_batch(rows, "devices", OBLONG), relocation)).items():
        torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-3, msg=name)


def test_the_physics_allows_each_other_layout() -> None:
    generator = np.random.default_rng(0)
    layout, position = generator.random((4, 3, 2)) * 600.0, generator.random((4, 2)) * 600.0
    device, random = np.array([0, 1, 2, 3]), draw(generator, 4)
    action = FlightAction(generator.uniform(-25.0, 25.0, (4, 2)), device)
    other = elsewhere(layout, device, generator.random((4, 3, 2)) * 600.0)
    assert (other != layout).any(axis=2).sum() == 9
    flown = [advance(OBLONG, where, initial_state(position, 3), action, random) for where in (layout, other)]
    np.testing.assert_array_equal(flown[0][0].age_s, flown[1][0].age_s)
    np.testing.assert_array_equal(flown[0][1].reward, flown[1][1].reward)


def test_a_share_of_the_rows_has_its_devices_moved_all_over_the_area() -> None:
    relocation = drawn(8_000, 3, 0.3)
    assert 0.27 < float(relocation.moved.float().mean()) < 0.33
    assert relocation.moved.shape == (8_000, 1)
    low, high = relocation.place_m.amin(dim=(0, 1)), relocation.place_m.amax(dim=(0, 1))
    assert (low >= 0).all() and (low < 5).all()
    assert 995 < high[0] <= 1000 and 595 < high[1] <= 600


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_minibatch_is_relocated_where_the_settings_say_so(share: float) -> None:
    learner = OfflineLearner(config(relocation=share), fly(small_scenario(), steps=20))
    rows, turn, relocation = learner.draw()
    assert turn is None and (relocation is not None) == (share > 0)
    plain, seen = leaves(learner.data.take(rows)), leaves(learner.encoded(rows, turn, relocation))
    unequal = {name for name, value in seen.items() if not torch.equal(value, plain[name])}
    assert unequal == ({"observation.devices", "next_observation.devices"} if share > 0 else set())


def test_who_does_not_see_the_devices_is_refused() -> None:
    with pytest.raises(ValueError, match=r"relocation = 0.5 needs network.kind = 'devices', not 'mlp'"):
        config(kind="mlp", relocation=0.5)
    batch = to_batch(fly(OBLONG, steps=5), "paper", OBLONG)
    with pytest.raises(TypeError, match="where the devices are"):
        relocated(batch, drawn(len(batch), 3, 1.0))


def test_relocated_rows_train_stacked_as_alone() -> None:
    train_stacked_as_alone(relocation=0.5)
