"""What logged steps cost, worked out from ages, energies and durations; the same flights under another objective."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavrl.datasets.transitions import Transitions
from uavrl.errors import DatasetError
from uavrl.physics.energy import hover_power_w
from uavrl.scenario import Scenario, hover_reference_j
from uavrl.simulation.dynamics import age_term

Float = NDArray[np.float64]


class Costs(NamedTuple):
    """Eq. (reward) of n steps and its parts."""

    age_term: Float  # (n,)
    energy_term: Float  # (n,)
    reward: Float  # (n,)


def costs(transitions: Transitions, scenario: Scenario) -> Costs:
    """What the scenario's objective makes of each row's ages, energy and duration.

    Raises:
        DatasetError: the data's K is not the scenario's.
    """
    devices = transitions.devices
    if devices != scenario.traffic.devices:
        raise DatasetError(f"data has {devices} devices, the scenario {scenario.traffic.devices}: they must agree")
    seen = (transitions.age_s, transitions.next_age_s, transitions.duration_s)
    age = age_term(scenario, *(values.astype(np.float64) for values in seen))
    reference_j = hover_reference_j(scenario, hover_power_w(scenario.airframe))
    energy = transitions.next_energy_j.astype(np.float64) / reference_j
    weight = scenario.objective.age_weight
    return Costs(age, energy, -(weight * age + (1.0 - weight) * energy))


def relabelled(transitions: Transitions, scenario: Scenario) -> Transitions:
    """The rows with the reward, and its terms, that `scenario` gives them.

    What happened in the air stays as it was, so the scenario should differ from the one flown in its objective and its
    priorities alone.

    Raises:
        DatasetError: the data's K is not the scenario's.
    """
    rows = transitions.take(slice(None))  # mapped ones are not the mapped ones any more
    return replace(rows, **costs(rows, scenario)._asdict())


def with_objective(flown: Scenario, wanted: Scenario) -> Scenario:
    """`flown` with the objective and the priorities of `wanted`: what `relabelled` may be given for its flights.

    Raises:
        ScenarioError: priorities of another number of devices.
    """
    changed = flown.replace(objective=wanted.objective, priority=wanted.traffic.priority, name=wanted.name)
    return changed if changed == wanted else changed.replace(name=f"{flown.name}-{wanted.name}")
