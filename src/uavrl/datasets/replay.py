"""The log that grows while a learner flies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavrl.datasets.transitions import COLUMNS, Transitions
from uavrl.errors import DatasetError

_FIRST_ROWS = 4_096  # there is room for these from the start


class ReplayLog:
    """Transitions in the order in which they were flown, in arrays that double when they are full.

    Args:
        devices: K.
    """

    def __init__(self, devices: int) -> None:
        if devices < 1:
            raise DatasetError(f"log with devices = {devices}, allowed: 1 or more")
        self.devices = devices
        self._length = 0
        self._columns: dict[str, NDArray[Any]] = {
            name: np.zeros((_FIRST_ROWS, *column.row_shape(devices)), dtype=column.dtype)
            for name, column in COLUMNS.items()
        }

    def __len__(self) -> int:
        return self._length

    def __repr__(self) -> str:
        return f"ReplayLog({self._length:,} rows, K = {self.devices})"

    def append(self, columns: Mapping[str, NDArray[Any]], keep: NDArray[np.bool_] | None = None) -> None:
        """Add N rows, all columns of `transition_columns`; only those of `keep` (N,) where given.

        Raises:
            DatasetError: a column is missing, unknown or of another shape.
        """
        if columns.keys() != COLUMNS.keys():
            raise DatasetError(f"columns {sorted(columns.keys() ^ COLUMNS.keys())} are missing or unknown in the log")
        rows = {name: np.asarray(values) if keep is None else values[keep] for name, values in columns.items()}
        start, stop = self._length, self._length + len(rows["reward"])
        for name, values in rows.items():  # all before the first is written: a refused batch leaves the log as it was
            expected = (stop - start, *COLUMNS[name].row_shape(self.devices))
            if values.shape != expected:
                raise DatasetError(f"column '{name}' has shape {values.shape}, allowed: {expected}")
        self._make_room(stop)
        for name, values in rows.items():
            self._columns[name][start:stop] = values
        self._length = stop

    def _make_room(self, rows: int) -> None:
        held = len(self._columns["reward"])
        if rows > held:
            for name, values in self._columns.items():
                grown = np.zeros((max(rows, 2 * held), *values.shape[1:]), dtype=values.dtype)
                grown[: self._length] = values[: self._length]
                self._columns[name] = grown

    def take(self, indices: NDArray[np.integer[Any]]) -> Transitions:
        """Rows by their place in the order of flying; a minibatch of a learner."""
        if len(indices) and not (indices.min() >= 0 and indices.max() < self._length):
            raise DatasetError(f"row {indices.max()} of the log, allowed: 0 to {self._length - 1}")
        return Transitions(**{name: values[indices] for name, values in self._columns.items()})

    def to_transitions(self) -> Transitions:
        """A copy of all rows, sorted by (episode, step)."""
        filled = Transitions(**{name: values[: self._length] for name, values in self._columns.items()})
        return filled.in_order()

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """The filled rows as plain contiguous arrays, for a checkpoint."""
        return {name: values[: self._length].copy() for name, values in self._columns.items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take the place of what the log holds with the rows of `state_dict`.

        Raises:
            DatasetError: arrays of another log: names or K.
        """
        held, self._length = self._length, 0
        try:
            self.append(state)
        except DatasetError:
            self._length = held
            raise
