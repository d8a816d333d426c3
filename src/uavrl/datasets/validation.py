"""Do logged flights say what they should? The first row that does not is named."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavrl.datasets.objective import costs
from uavrl.datasets.transitions import COLUMNS, Transitions
from uavrl.errors import DatasetError
from uavrl.scenario import Scenario

RELATIVE_TOLERANCE = 2e-5  # some hundred roundings of float32
_ABSOLUTE = 1e-3  # metres, seconds, joules
_ABSOLUTE_TERM = 1e-6  # terms of the reward, which are small under some references


def _apart(values: NDArray[Any], others: NDArray[Any], absolute: float) -> NDArray[np.bool_]:
    values, others = values.astype(np.float64), others.astype(np.float64)  # no overflow, whatever a file holds
    limit = absolute + RELATIVE_TOLERANCE * np.maximum(np.abs(values), np.abs(others))
    apart: NDArray[np.bool_] = np.abs(values - others) > limit
    return apart


def validate(transitions: Transitions, scenario: Scenario, source: str = "transitions", *, first_row: int = 0) -> None:
    """Check transitions under a scenario.

    Numbers are finite and in their ranges; the reward is eq. (reward) of the scenario; moves lead from position to next
    position; ages grow by the duration, eq. (AoI), and none but the served device's is reset; rows are sorted by
    (episode, step), steps increase (gaps are allowed), one layout an episode, nothing follows an episode's end, which
    is `terminated` where a battery is empty; and the next state of a step is the state of the step after it.

    Args:
        transitions: n rows.
        scenario: what they were flown in.
        source: how the message names the data.
        first_row: what the message counts the first row as.

    Raises:
        DatasetError: one line with row (from `first_row`), column, value and what is allowed.
    """
    _devices(transitions, scenario, source)
    if not len(transitions):
        raise DatasetError(f"{source}: no rows, allowed: 1 or more")
    check = _Check(transitions, source, first_row)
    _ranges(check, transitions, scenario)
    _order(check, transitions, scenario)
    _reward(check, transitions, scenario)
    _continuity(check, transitions)
    _ages(check, transitions, scenario)


def validated(parts: Iterable[Transitions], scenario: Scenario, source: str = "transitions") -> Iterator[Transitions]:
    """The parts of one log as they come, each after `validate` has seen it together with the row before it.

    Memory is a few parts'. Each part goes on where the one before it ended; empty ones are left out.

    Raises:
        DatasetError: as of `validate`, with rows counted from the log's first.
    """
    rows, last = 0, None
    for part in parts:
        if not len(part):
            continue
        _devices(part, scenario, source)
        if last is None:
            validate(part, scenario, source)
        else:
            validate(_joined(last, part), scenario, source, first_row=rows - 1)
        yield part
        rows, last = rows + len(part), part.take(np.array([-1]))
    if last is None:
        raise DatasetError(f"{source}: no rows, allowed: 1 or more")


def _joined(first: Transitions, then: Transitions) -> Transitions:
    """Rows as they stand, unlike `concatenate`, which numbers the episodes on."""
    return Transitions(
        **{name: np.concatenate([values, then.columns()[name]]) for name, values in first.columns().items()}
    )


def _devices(transitions: Transitions, scenario: Scenario, source: str) -> None:
    if transitions.devices != scenario.traffic.devices:
        raise DatasetError(
            f"{source}: K = {transitions.devices} devices, allowed: {scenario.traffic.devices}, "
            f"as scenario '{scenario.name}' has"
        )


class _Check:
    def __init__(self, transitions: Transitions, source: str, first_row: int) -> None:
        self.transitions = transitions
        self.source = source
        self.first_row = first_row

    def refuse(self, name: str, bad: NDArray[np.bool_], allowed: str, other: NDArray[Any] | None = None) -> None:
        """Raise if any entry of `bad` is true, naming the first; `other` holds the values that {other} stands for."""
        if not bad.any():
            return
        index = tuple(int(i) for i in np.unravel_index(int(np.argmax(bad)), bad.shape))
        row, entry = index[0], "".join(f"[{i}]" for i in index[1:])
        value = getattr(self.transitions, name)[index]
        shown = ", ".join(f"{number:.7g}" for number in np.ravel(value))
        where = f"episode {self.transitions.episode[row]}, step {self.transitions.step[row]}"
        raise DatasetError(
            f"{self.source}: row {self.first_row + row} ({where}), column '{name}'{entry} = {shown}, allowed: "
            + (allowed if other is None else allowed.format(other=f"{other[index]:.7g}"))
        )


def _ranges(check: _Check, t: Transitions, scenario: Scenario) -> None:
    for name, column in COLUMNS.items():
        if column.kind == "float":
            check.refuse(name, ~np.isfinite(t.columns()[name]), "a finite number")
    check.refuse("episode", t.episode < 0, "0 or more")
    check.refuse("step", t.step < 0, "0 or more")
    check.refuse("device", (t.device < 0) | (t.device > t.devices), f"0 (idle) to {t.devices}")

    size = np.array([scenario.area.width_m, scenario.area.depth_m])
    for name in ("layout_m", "position_m", "next_position_m"):
        values = t.columns()[name]
        outside = (values < -_ABSOLUTE) | (values > size + _ABSOLUTE)
        check.refuse(name, outside, f"inside the area of {size[0]:g} x {size[1]:g} m")
    oldest = scenario.traffic.max_age_s
    for name in ("age_s", "next_age_s"):
        values = t.columns()[name]
        check.refuse(name, (values < 0) | (values > oldest + _ABSOLUTE), f"0 to {oldest:g} s (max_age_s)")
    for name in ("energy_j", "used_j", "next_energy_j", "next_used_j"):
        check.refuse(name, t.columns()[name] < 0, "0 J or more")
    check.refuse("duration_s", t.duration_s < 0, "0 s or more")

    longest = scenario.airframe.max_displacement_m
    within = f"entries of -{longest:g} to {longest:g} m (max_displacement_m)"
    check.refuse("displacement_m", np.abs(t.displacement_m) > longest + _ABSOLUTE, within)
    flown = np.linalg.norm(t.executed_displacement_m.astype(np.float64), axis=1)
    allowed = f"a move of at most {longest:g} m (max_displacement_m)"
    check.refuse("executed_displacement_m", flown > longest + _ABSOLUTE, allowed)


def _reward(check: _Check, t: Transitions, scenario: Scenario) -> None:
    age, energy, _ = costs(t, scenario)
    hint = (
        " or were they logged for another objective (name that one's scenario; uavrl data relabel changes it)? "
        "Reward and terms may be left out, all three"
    )
    reason = f"from the ages under scenario '{scenario.name}': are ages, durations or the term in other units,"
    check.refuse("age_term", _apart(t.age_term, age, _ABSOLUTE_TERM), "{other} " + reason + hint, age)
    reason = f"from next_energy_j under scenario '{scenario.name}': is the energy or the term in other units,"
    check.refuse("energy_term", _apart(t.energy_term, energy, _ABSOLUTE_TERM), "{other} " + reason + hint, energy)
    weight = scenario.objective.age_weight
    reward = -(weight * t.age_term + (1.0 - weight) * t.energy_term)
    reason = f"= -(lambda age_term + (1 - lambda) energy_term) with lambda = {weight:g}: is the reward in other units,"
    check.refuse("reward", _apart(t.reward, reward, _ABSOLUTE_TERM), "{other} " + reason + hint, reward)


def _after(bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The verdict of each row on the row before it, (n - 1, ...), as one of every row, (n, ...): the first has none."""
    return np.concatenate([np.zeros((1, *bad.shape[1:]), dtype=bool), bad])


def _order(check: _Check, t: Transitions, scenario: Scenario) -> None:
    check.refuse("episode", _after(np.diff(t.episode) < 0), "no less than in the row before (sort by episode and step)")
    same = np.diff(t.episode) == 0
    rising = "more than in the row before of this episode (sort by episode and step)"
    check.refuse("step", _after(same & (np.diff(t.step) <= 0)), rising)
    moved = _apart(t.layout_m[1:], t.layout_m[:-1], _ABSOLUTE) & same[:, None, None]
    check.refuse("layout_m", _after(moved), "one layout an episode, as in the row before")
    for name in ("terminated", "truncated"):
        followed = np.append(t.columns()[name][:-1] & same, False)
        check.refuse(name, followed, "false, as the next row goes on with this episode")
    if scenario.limits.energy_budget_j is None:
        ends = "false where nothing but time ends a flight (energy_budget_j is null): log that as 'truncated'"
        check.refuse("terminated", t.terminated, ends)


def _continuity(check: _Check, t: Transitions) -> None:
    target = t.position_m + t.executed_displacement_m
    where = "{other} = position_m + executed_displacement_m"
    check.refuse("next_position_m", _apart(t.next_position_m, target, _ABSOLUTE), where, target)
    follows = (np.diff(t.episode) == 0) & (np.diff(t.step) == 1)
    for name in ("position_m", "age_s", "energy_j", "used_j"):
        now, before = t.columns()[name][1:], t.columns()[f"next_{name}"][:-1]
        broken = _apart(now, before, _ABSOLUTE) & (follows if now.ndim == 1 else follows[:, None])
        padded = np.concatenate([t.columns()[name][:1], before])
        check.refuse(name, _after(broken), "{other}, " + f"the next_{name} of the step before", padded)


def _ages(check: _Check, t: Transitions, scenario: Scenario) -> None:
    grown = np.minimum(t.age_s.astype(np.float64) + t.duration_s[:, None], scenario.traffic.max_age_s)
    served = t.device[:, None] == np.arange(1, t.devices + 1)  # whose packet may have been lost
    wrong = _apart(t.next_age_s, grown, _ABSOLUTE) & ~(served & (t.next_age_s <= _ABSOLUTE))
    meant = (
        "{other} = age_s + duration_s, or 0 for the served device (1 to K; 0: nobody): duration_s or device is wrong"
    )
    check.refuse("next_age_s", wrong, meant, grown)
