from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.agents.problems import network
from tests.datasets.flights import fly, small_scenario
from tests.training.test_offline import config
from uavrl.agents.base import Batch
from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.datasets import Transitions
from uavrl.scenario import Scenario
from uavrl.simulation.dynamics import advance, initial_state
from uavrl.simulation.environment import draw
from uavrl.simulation.state import FlightAction
from uavrl.training.batches import to_batch
from uavrl.training.offline import OfflineLearner, TrainConfig
from uavrl.training.stacked import StackedLearner
from uavrl.training.symmetry import Turn, turned

SQUARE = small_scenario()
OBLONG = small_scenario(depth_m=600.0)


def every_turn(scenario: Scenario) -> list[tuple[tuple[int, int], bool]]:
    swaps = (False, True) if scenario is SQUARE else (False,)
    return [((x, y), swap) for x, y, swap in product((1, -1), (1, -1), swaps)]


def moved(points: NDArray[Any], signs: tuple[int, int], swap: bool, middle: NDArray[Any]) -> NDArray[Any]:
    """Points, or with middle 0 vectors, in the area as seen from elsewhere."""
    there = (points - middle) * np.array(signs)
    seen: NDArray[Any] = (there[..., ::-1] if swap else there) + middle
    return seen


def same_turn(count: int, signs: tuple[int, int], swap: bool) -> Turn:
    return Turn(torch.tensor([signs] * count, dtype=torch.float32), torch.full((count, 1), swap))


def leaves(batch: Batch) -> dict[str, torch.Tensor]:
    found: dict[str, torch.Tensor] = {"continuous": batch.action.continuous, "choice": batch.action.choice}
    for name, value in vars(batch).items():
        if isinstance(value, dict):
            found |= {f"{name}.{key}": part for key, part in value.items()}
        elif name != "action":
            found[name] = value
    return found


@pytest.mark.parametrize("scenario", [SQUARE, OBLONG])
def test_a_turned_row_is_the_row_of_the_turned_flight(scenario: Scenario) -> None:
    rows = fly(scenario, steps=20)
    middle = np.array([scenario.area.width_m, scenario.area.depth_m]) / 2
    batch = to_batch(rows, "devices", scenario)
    for signs, swap in every_turn(scenario):
        points = ("layout_m", "position_m", "next_position_m")
        vectors = ("displacement_m", "executed_displacement_m")
        columns = {name: getattr(rows, name) for name in Transitions.__dataclass_fields__}
        columns |= {name: moved(columns[name], signs, swap, middle) for name in points}
        columns |= {name: moved(columns[name], signs, swap, np.zeros(2)) for name in vectors}
        expected = to_batch(Transitions(**columns), "devices", scenario)
        found = turned(batch, same_turn(len(rows), signs, swap), scenario.area)
        for name, value in leaves(found).items():
            torch.testing.assert_close(
                value, leaves(expected)[name], rtol=1e-5, atol=1e-3, msg=f"{name} {signs} {swap}"
            )


@pytest.mark.parametrize("scenario", [SQUARE, OBLONG])
def test_the_physics_allows_each_turn(scenario: Scenario) -> None:
    generator = np.random.default_rng(0)
    extent = np.array([scenario.area.width_m, scenario.area.depth_m])
    layout, position = generator.random((4, 3, 2)) * extent, generator.random((4, 2)) * extent
    position[0] = [1.0, extent[1] - 1.0]  # at the border, which its move would cross
    displacement = generator.uniform(-25.0, 25.0, (4, 2))
    displacement[0] = [-20.0, 20.0]
    device, random = np.array([0, 1, 2, 3]), draw(generator, 4)

    def fly_once(signs: tuple[int, int], swap: bool) -> tuple[Any, Any]:
        state = initial_state(moved(position, signs, swap, extent / 2), 3)
        action = FlightAction(moved(displacement, signs, swap, np.zeros(2)), device)
        return advance(scenario, moved(layout, signs, swap, extent / 2), state, action, random)

    straight, outcome = fly_once((1, 1), False)
    for signs, swap in every_turn(scenario):
        after, turned_outcome = fly_once(signs, swap)
        np.testing.assert_allclose(after.position_m, moved(straight.position_m, signs, swap, extent / 2), atol=1e-9)
        np.testing.assert_allclose(after.age_s, straight.age_s)
        np.testing.assert_allclose(turned_outcome.reward, outcome.reward)


def test_every_symmetry_is_drawn_alike_and_an_oblong_is_not_swapped() -> None:
    turn = Turn.draw(8_000, SQUARE.area, torch.Generator().manual_seed(0))
    assert turn.sign.unique().tolist() == [-1.0, 1.0]
    which = (turn.sign > 0).long() @ torch.tensor([1, 2]) + 4 * turn.swap.squeeze(1)
    counts = torch.bincount(which, minlength=8)
    assert counts.shape == (8,)
    assert 900 < int(counts.min()) < int(counts.max()) < 1_100
    assert not Turn.draw(100, OBLONG.area, torch.Generator().manual_seed(0)).swap.any()


def test_a_flat_observation_cannot_be_turned() -> None:
    batch = to_batch(fly(SQUARE, steps=5), "paper", SQUARE)
    with pytest.raises(TypeError, match="where the devices are"):
        turned(batch, same_turn(len(batch), (1, -1), False), SQUARE.area)


@pytest.mark.parametrize(
    ("kind", "per", "symmetry", "turns"),
    [
        ("devices", "second", None, True),
        ("devices", "step", None, False),
        ("mlp", "second", None, False),
        ("devices", "step", True, True),
        ("devices", "second", False, False),
    ],
)
def test_rows_are_turned_where_the_settings_say_so(kind: Any, per: Any, symmetry: bool | None, turns: bool) -> None:
    agent = DiffusionSacConfig(network=network(kind, width=8), discount_per=per, batch_size=8)
    plan = TrainConfig(scenario=SQUARE, agent=agent, symmetry=symmetry)
    assert plan.turns is turns
    learner = OfflineLearner(plan, fly(SQUARE, steps=20))
    rows, turn, none = learner.draw()
    assert (turn is not None) is turns
    plain, seen = leaves(learner.data.take(rows)), leaves(learner.encoded(rows, turn, none))
    unequal = {name for name, value in seen.items() if not torch.equal(value, plain[name])}
    moving = {f"{when}observation.{what}" for when in ("", "next_") for what in ("uav", "devices")} | {"continuous"}
    assert unequal == (moving if turns else set())


def test_a_perceptron_is_refused() -> None:
    with pytest.raises(ValueError, match=r"symmetry = true needs network.kind = 'devices', not 'mlp'"):
        config(kind="mlp", symmetry=True)


def train_stacked_as_alone(**settings: Any) -> None:
    """Two seeds in a stack learn what each learns alone, up to rounding."""
    flown = fly(SQUARE, steps=20)
    alone, stacked = ([OfflineLearner(config(seed=seed, **settings), flown) for seed in (3, 4)] for _ in range(2))
    stack = StackedLearner(stacked)
    for _ in range(2):
        expected, found = [learner.step() for learner in alone], stack.step()
    for mine, theirs in zip(found, expected, strict=True):
        values = {name: float(value) for name, value in theirs.items()}
        assert {name: float(value) for name, value in mine.items()} == pytest.approx(values, rel=5e-3, abs=1e-3)


def test_turned_rows_train_stacked_as_alone() -> None:
    train_stacked_as_alone(symmetry=True)
