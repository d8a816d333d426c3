from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import paths
from uavrl.evaluation.episode import Episode
from uavrl.scenario import load_scenario


def test_the_policys_row_comes_before_the_planners_on_equal_layouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Episode] = []
    monkeypatch.setattr(paths, "load_scenario", lambda name: load_scenario(name, max_steps=3))
    monkeypatch.setattr(paths, "trajectories", lambda episodes, out: drawn.extend(episodes))
    paths.main("tdm", tmp_path / "out.png")
    assert [episode.policy for episode in drawn] == ["tdm"] * paths.LAYOUTS + ["planner"] * paths.LAYOUTS
    for own, planned in zip(drawn[: paths.LAYOUTS], drawn[paths.LAYOUTS :], strict=True):
        np.testing.assert_array_equal(own.layout_m, planned.layout_m)
        np.testing.assert_array_equal(own.position_m[0], planned.position_m[0])
