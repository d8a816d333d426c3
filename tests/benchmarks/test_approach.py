from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import approach


def made(reward: float, x_m: list[float]) -> Any:
    """Two starts of 4 steps, the second reward twice the first; idle in every second step after the first two."""
    steps = len(x_m) - 1
    position = np.zeros((steps + 1, 2, 2))
    position[:, :, 0] = np.array(x_m)[:, None]
    device = np.ones((steps, 2), dtype=int)
    device[3::2] = 0
    return SimpleNamespace(
        reward=np.full((steps, 2), reward) * [1.0, 2.0],
        active=np.ones((steps, 2), dtype=bool),
        device=device,
        position_m=position,
    )


def test_a_line_is_paired_to_hover_and_says_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(approach, "FADINGS", 1)
    monkeypatch.setattr(approach, "LATER", 2)
    monkeypatch.setattr(approach, "AT", (0, 2, 400))
    hover, policy = made(-1.0, [0, 10, 20, 20, 20]), made(-1.5, [0, 1, 2, 3, 4])
    # -2 and -4 behind, +-1.96 * 1.414 / sqrt 2; one step of the last two idle
    assert approach.line("one", policy, hover) == "| one | -3.0 \u00b1 2.0 | 50.0 | 20 | 18 | 16 |"
