"""How well the flights went that a policy learns from, as far as loose transitions tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavrl.datasets.objective import costs
from uavrl.datasets.transitions import Transitions
from uavrl.errors import DatasetError
from uavrl.evaluation.statistics import Estimate, combine, estimate_mean, resampling
from uavrl.physics.age import age_integral_s2
from uavrl.scenario import Scenario

Float = NDArray[np.float64]


def behaviour(transitions: Transitions, scenario: Scenario, *, seed: int) -> dict[str, Estimate]:
    """The data's own metrics, those of `flight_metrics` that transitions can tell, with a bootstrap over episodes.

    A selection of transitions holds few whole flights, so a flight's total is the mean of a row times the mean length
    of an episode. Lengths are those of the episodes whose last row was selected; without any, those of the
    longest step seen. Rewards are the scenario's own, worked out from ages and energies. The flights met
    layouts, starts and fading of their own: differences to them are unpaired.

    Args:
        transitions: n rows.
        scenario: whose objective rates them.
        seed: of the bootstrap.

    Raises:
        DatasetError: the data's K is not the scenario's, or there is no row.
    """
    if not len(transitions):
        raise DatasetError("data has 0 rows, its behaviour needs 1 or more")
    cost = costs(transitions, scenario)
    age_s, next_age_s = transitions.age_s.astype(np.float64), transitions.next_age_s.astype(np.float64)
    duration_s, energy_j = transitions.duration_s.astype(np.float64), transitions.next_energy_j.astype(np.float64)
    priority = np.array(scenario.traffic.priority_each)
    weight = priority / priority.sum()

    episodes, episode = np.unique(transitions.episode, return_inverse=True)
    counts = resampling(len(episodes), seed)

    def total(values: Float) -> Estimate:
        return estimate_mean(np.bincount(episode, weights=values).astype(np.float64), counts)

    last = transitions.terminated | transitions.truncated
    if not last.any():
        last = transitions.step == transitions.step.max()
    length = np.full(len(episodes), np.nan)
    length[episode[last]] = transitions.step[last] + 1.0
    steps = estimate_mean(length, counts)
    rows = total(np.ones(len(episode)))
    per_step = {
        "return": total(cost.reward),
        "age_per_step_s": total(next_age_s @ weight),
        "energy_per_step_j": total(energy_j),
        "duration_s": total(duration_s),
    }
    means = {name: combine(_ratio, estimate, rows) for name, estimate in per_step.items()}
    integral_s2 = age_integral_s2(age_s, duration_s, scenario.traffic.max_age_s) @ weight
    return {
        "return": combine(_product, means["return"], steps),
        "age_per_step_s": means["age_per_step_s"],
        "age_per_second_s": combine(_ratio, total(integral_s2), per_step["duration_s"]),
        "energy_per_step_j": means["energy_per_step_j"],
        "energy_per_episode_j": combine(_product, means["energy_per_step_j"], steps),
        "steps": steps,
        "duration_s": combine(_product, means["duration_s"], steps),
    }


def _ratio(top: Float, bottom: Float) -> Float:
    return top / bottom


def _product(first: Float, second: Float) -> Float:
    return first * second
