from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from uavrl.evaluation.episode import Episode
from uavrl.scenario import load_scenario


def episode() -> Episode:
    return Episode(
        policy="tdm",
        scenario=load_scenario("released", devices=2),
        layout_m=np.zeros((2, 2)),
        position_m=np.zeros((4, 2)),
        age_s=np.zeros((4, 2)),
        time_s=np.array([0.0, 1.0, 2.0, 4.5]),
        device=np.array([1, 2, 0]),
        served=np.array([True, True, False]),
        energy_j=np.ones(3),
        reward=np.array([-1.0, -2.0, -4.0]),
    )


def test_totals_and_their_words() -> None:
    assert (episode().steps, episode().total_reward) == (3, -7.0)
    assert repr(episode()) == (
        "Episode('tdm', scenario='released', devices=2, steps=3, seconds=4.5, total_reward=-7.0)"
    )


@pytest.mark.parametrize("name", [field.name for field in fields(Episode) if field.name not in ("policy", "scenario")])
def test_an_array_of_another_flight_is_refused(name: str) -> None:
    longer: dict[str, Any] = {name: np.concatenate([getattr(episode(), name)] * 2)}
    with pytest.raises(ValueError, match="needed"):
        replace(episode(), **longer)
