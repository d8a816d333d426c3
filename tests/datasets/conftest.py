"""A small log and its scenario, for every test of the room."""

from __future__ import annotations

import pytest

from tests.datasets.flights import fly, small_scenario
from uavrl.datasets import Transitions
from uavrl.scenario import Scenario


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return small_scenario()


@pytest.fixture(scope="session")
def log(scenario: Scenario) -> Transitions:
    """120 rows: nine complete episodes of 12 steps, three unfinished ones of 4; new layouts throughout."""
    return fly(scenario)
