"""Logged flights in memory: flat columns, one row a transition."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavrl.errors import DatasetError
from uavrl.scenario import Scenario
from uavrl.simulation.environment import Observation, observe
from uavrl.simulation.observations import ObservationKind
from uavrl.simulation.state import FlightAction, Outcome, SimState

Float = NDArray[np.float32]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

PART_ROWS = 65_536  # of a log that is gone through piece by piece


class Column(NamedTuple):
    """What a column holds."""

    kind: Literal["float", "int", "bool"]
    shape: tuple[int | Literal["K"], ...]  # of one row
    meaning: str

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type in memory."""
        return np.dtype({"float": np.float32, "int": np.int64, "bool": np.bool_}[self.kind])

    def row_shape(self, devices: int) -> tuple[int, ...]:
        """Shape of one row for K = `devices`."""
        return tuple(devices if size == "K" else size for size in self.shape)


COLUMNS: dict[str, Column] = {
    "episode": Column("int", (), "number of the flight, 0 or more"),
    "step": Column("int", (), "number of the step in its flight, 0 or more"),
    "layout_m": Column("float", ("K", 2), "device positions x_1, y_1, x_2, y_2, ... (m)"),
    "position_m": Column("float", (2,), "aircraft before the step (m)"),
    "age_s": Column("float", ("K",), "age of each device's information before the step (s)"),
    "energy_j": Column("float", (), "energy of the step before, 0 at the start (J)"),
    "used_j": Column("float", (), "energy since the flight began, before the step (J)"),
    "displacement_m": Column("float", (2,), "move that was commanded (m)"),
    "executed_displacement_m": Column("float", (2,), "move that was flown (m)"),
    "device": Column("int", (), "device asked to send, 1 to K, 0 for none"),
    "reward": Column("float", (), "-(lambda age_term + (1 - lambda) energy_term)"),
    "age_term": Column("float", (), "age part of the reward, over age_reference_s"),
    "energy_term": Column("float", (), "energy part of the reward, over energy_reference_j"),
    "duration_s": Column("float", (), "duration of the step (s)"),
    "terminated": Column("bool", (), "the flight ended by itself: battery drained"),
    "truncated": Column("bool", (), "the flight was cut: limit of steps or time"),
    "next_position_m": Column("float", (2,), "aircraft after the step (m)"),
    "next_age_s": Column("float", ("K",), "ages after the step (s)"),
    "next_energy_j": Column("float", (), "energy of this step (J)"),
    "next_used_j": Column("float", (), "energy since the flight began, after the step (J)"),
}


@dataclass(frozen=True, repr=False)
class Transitions:
    """n transitions with K devices; columns as `COLUMNS` describes them. Truncation is not termination.

    The constructor converts types and checks shapes; `uavrl.datasets.validate` checks what the numbers say.

    Raises:
        DatasetError: a column has another shape than (n, ...) with one K throughout.
    """

    episode: Int  # (n,)
    step: Int  # (n,)
    layout_m: Float  # (n, K, 2)
    position_m: Float  # (n, 2)
    age_s: Float  # (n, K)
    energy_j: Float  # (n,)
    used_j: Float  # (n,)
    displacement_m: Float  # (n, 2)
    executed_displacement_m: Float  # (n, 2)
    device: Int  # (n,)
    reward: Float  # (n,)
    age_term: Float  # (n,)
    energy_term: Float  # (n,)
    duration_s: Float  # (n,)
    terminated: Bool  # (n,)
    truncated: Bool  # (n,)
    next_position_m: Float  # (n, 2)
    next_age_s: Float  # (n, K)
    next_energy_j: Float  # (n,)
    next_used_j: Float  # (n,)

    def __post_init__(self) -> None:
        ages = np.shape(self.age_s)
        if len(ages) != 2 or ages[1] < 1:
            raise DatasetError(f"column 'age_s' has shape {ages}, allowed: (n, K) with K of 1 or more")
        for name, column in COLUMNS.items():
            values = np.asarray(getattr(self, name), dtype=column.dtype)
            expected = (ages[0], *column.row_shape(ages[1]))
            if values.shape != expected:
                raise DatasetError(f"column '{name}' has shape {values.shape}, allowed: {expected}, as age_s {ages}")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.reward)

    def __repr__(self) -> str:
        flights = len(np.unique(self.episode))
        mean = f", reward {self.reward.mean():.4g} a step" if len(self) else ""
        return f"Transitions({len(self):,} rows of {flights:,} episodes, K = {self.devices}{mean})"

    @property
    def devices(self) -> int:
        """K."""
        return int(self.age_s.shape[1])

    def columns(self) -> dict[str, NDArray[Any]]:
        """Every column by name; the arrays themselves, not copies."""
        return {name: getattr(self, name) for name in COLUMNS}

    def observations(self, kind: ObservationKind, scenario: Scenario) -> tuple[Observation, Observation]:
        """What a policy saw before and after each step, float32, as `uavrl.simulation.environment.observe` gives it."""
        empty = np.zeros(len(self), dtype=np.float32)  # clocks, which no observation shows
        before = SimState(self.position_m, self.age_s, self.energy_j, self.used_j, empty, self.step)
        after = SimState(
            self.next_position_m, self.next_age_s, self.next_energy_j, self.next_used_j, empty, self.step + 1
        )
        layout: Any = self.layout_m  # observe is written for float64 and works in either
        return observe(kind, scenario, layout, before), observe(kind, scenario, layout, after)

    def take(self, indices: NDArray[Any] | slice) -> Transitions:
        """The rows of an integer or boolean index, or of a slice."""
        return Transitions(**{name: values[indices] for name, values in self.columns().items()})

    def parts(self, rows: int = PART_ROWS) -> Iterator[Transitions]:
        """All rows in turn, at most `rows` at a time; views, not copies."""
        for start in range(0, len(self), rows):
            yield self.take(slice(start, start + rows))

    def in_order(self) -> Transitions:
        """The rows sorted by (episode, step), as files hold them."""
        return self.take(np.lexsort((self.step, self.episode)))

    def digest(self) -> str:
        """SHA-256 of all columns, to name what was trained on."""
        content = hashlib.sha256()
        for name, values in self.columns().items():
            content.update(f"{name}{values.shape}".encode())
            for start in range(0, len(values), PART_ROWS):  # of a mapped column no more is copied
                content.update(np.ascontiguousarray(values[start : start + PART_ROWS]).data)
        return content.hexdigest()


def concatenate(parts: Sequence[Transitions]) -> Transitions:
    """Logs joined to one; the episodes of a later log are numbered on from those of the earlier ones.

    Raises:
        DatasetError: no part, or parts of different K.
    """
    if not parts:
        raise DatasetError("nothing to concatenate, allowed: one or more logs")
    counts = sorted({part.devices for part in parts})
    if len(counts) > 1:
        raise DatasetError(f"logs with K = {', '.join(map(str, counts))} devices, allowed: one K for all")
    columns = {name: np.concatenate([part.columns()[name] for part in parts]) for name in COLUMNS}
    used = [int(part.episode.max()) + 1 if len(part) else 0 for part in parts]
    first = np.cumsum([0, *used[:-1]])
    columns["episode"] = np.concatenate([part.episode + start for part, start in zip(parts, first, strict=True)])
    return Transitions(**columns)


def transition_columns(
    layout_m: NDArray[Any],
    before: SimState,
    action: FlightAction,
    after: SimState,
    outcome: Outcome,
    episode: NDArray[np.integer[Any]],
    step: NDArray[np.integer[Any]],
) -> dict[str, NDArray[Any]]:
    """One simulated step of N environments as columns of N rows.

    Args:
        layout_m: (N, K, 2).
        before: state in which `action` was taken.
        action: as commanded.
        after: state that the step led to, before any reset.
        outcome: what `advance` returned with it.
        episode: (N,) number of each environment's flight.
        step: (N,) number of the step in that flight.
    """
    return {
        "episode": episode,
        "step": step,
        "layout_m": layout_m,
        "position_m": before.position_m,
        "age_s": before.age_s,
        "energy_j": before.energy_j,
        "used_j": before.used_j,
        "displacement_m": action.displacement_m,
        "executed_displacement_m": outcome.displacement_m,
        "device": action.device,
        "reward": outcome.reward,
        "age_term": outcome.age_term,
        "energy_term": outcome.energy_term,
        "duration_s": outcome.duration_s,
        "terminated": outcome.terminated,
        "truncated": outcome.truncated,
        "next_position_m": after.position_m,
        "next_age_s": after.age_s,
        "next_energy_j": after.energy_j,
        "next_used_j": after.used_j,
    }
