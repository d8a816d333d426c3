"""What a service costs from where, whom to serve next, and where best to hover. N flights, K devices."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from uavrl.physics import channel
from uavrl.scenario import Scenario

Float = NDArray[np.float64]

_TABLE = 1024  # distances in a table: 1.4 m apart on the default area
_PART = 64  # distances computed at once, to bound the memory
_GRID = 41  # points a side of the first search for a hover point
_HALVINGS = 6  # of the grid's spacing around its best point: 0.4 m on the default area


class ServiceModel:
    """Expected time and success of an attempt to serve, tabulated over the horizontal distance.

    Args:
        scenario: what is flown; its mean channel, packet sizes and T_exec are read.
    """

    def __init__(self, scenario: Scenario) -> None:
        traffic = scenario.traffic
        self.decision_s = scenario.airframe.decision_s
        self.priority = np.array(traffic.priority_each)  # (K,)
        self.max_age_s = traffic.max_age_s
        self.size_m = np.array([scenario.area.width_m, scenario.area.depth_m])
        sizes, self._row = np.unique(traffic.packet_bits_each, return_inverse=True)  # one row a packet size
        distance_m = np.linspace(0.0, float(np.hypot(*self.size_m)), _TABLE)
        self._per_m = (_TABLE - 1) / distance_m[-1]
        parts = [np.broadcast_arrays(part, sizes[:, None]) for part in np.split(distance_m, _TABLE // _PART)]
        services = [channel.expected_service(part, bits, scenario.channel) for part, bits in parts]
        seconds, arrival = (np.concatenate(values, axis=1) for values in zip(*services, strict=True))
        with np.errstate(divide="ignore", over="ignore"):  # hardly a packet may arrive, or none
            cost = np.minimum((seconds + self.decision_s) / arrival, 1e9)  # finite, for interpolation
        self.shortest_s = cost.min(axis=1)[self._row]  # (K,) c_k from the best place
        self._tables = np.stack([seconds, arrival, cost])  # (3, sizes, _TABLE)

    def _look_up(self, table: Float, position_m: Float, layout_m: Float) -> Float:
        offset = layout_m - position_m[..., None, :]
        place = np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2) * self._per_m
        low = np.minimum(place.astype(np.int64), _TABLE - 2)
        low_value = table[self._row, low]
        result: Float = low_value + (table[self._row, low + 1] - low_value) * (place - low)
        return result

    def attempt_s(self, position_m: Float, layout_m: Float) -> Float:
        """E[T_com] (E[min(T_com, limit)] with outages) of each device (..., K) from `position_m` (..., 2) (s)."""
        return self._look_up(self._tables[0], position_m, layout_m)

    def arrival(self, position_m: Float, layout_m: Float) -> Float:
        """Probability that a packet arrives, (..., K)."""
        return self._look_up(self._tables[1], position_m, layout_m)

    def cost_s(self, position_m: Float, layout_m: Float) -> Float:
        """c_k(x): expected time per packet that arrives, lost ones and T_exec included (..., K) (s)."""
        return self._look_up(self._tables[2], position_m, layout_m)

    def index(self, age_s: Float, cost_s: Float) -> Float:
        """delta_k (A_k + c_k)^2 / (2 c_k), (..., K); zero for a device whose service takes longer than A_max.

        Serving k every P_k seconds costs delta_k P_k / 2 on average and c_k / P_k of the time; at the best periods
        delta_k P_k^2 / (2 c_k) is the same for all devices, and A_k + c_k is the period that serving k now completes.
        """
        value = self.priority * (age_s + cost_s) ** 2 / (2.0 * cost_s)
        return np.where(cost_s <= self.max_age_s, value, 0.0)

    def hover_age_s(self, position_m: Float, layout_m: Float) -> Float:
        """Weighted mean age that ideal periods reach hovering at `position_m`: (sum_k sqrt(delta_k c_k))^2 / 2 (s)."""
        root = np.sqrt(self.priority * self.cost_s(position_m, layout_m))
        result: Float = 0.5 * root.sum(axis=-1) ** 2
        return result

    def hover_map(self, layout_m: Float) -> tuple[Float, Float]:
        """Points of a grid over the area (G, 2) (m), and `hover_age_s` at each for each layout (N, G)."""
        axis = np.linspace(0.0, 1.0, _GRID)
        grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2) * self.size_m
        # a column of the grid at a time keeps the arrays at N x 41 x K
        ages = [self.hover_age_s(column[None], layout_m[:, None]) for column in np.split(grid, _GRID)]
        return grid, np.concatenate(ages, axis=1)

    def best_hover_m(self, layout_m: Float) -> Float:
        """x* = argmin_x (sum_k sqrt(delta_k c_k(x)))^2 of each layout, (N, 2) (m): a grid, then ever finer ones."""
        grid, ages = self.hover_map(layout_m)
        best: Float = grid[ages.argmin(axis=1)]
        steps = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 2)
        spacing = self.size_m / (_GRID - 1)
        for _ in range(_HALVINGS):
            spacing = spacing / 2.0
            near = np.clip(best[:, None] + steps * spacing, 0.0, self.size_m)
            ages = self.hover_age_s(near, layout_m[:, None])
            best = np.take_along_axis(near, ages.argmin(axis=1)[:, None, None], axis=1)[:, 0]
        return best


@lru_cache(maxsize=16)
def service_model(scenario: Scenario) -> ServiceModel:
    """The ServiceModel of a scenario, made once."""
    return ServiceModel(scenario)


def geometric_median_m(layout_m: Float, weight: Float) -> Float:
    """argmin_x sum_k weight_k |x - x_k| of each layout (N, K, 2), by Weiszfeld's iteration, (N, 2) (m)."""
    point: Float = np.average(layout_m, axis=1, weights=weight)
    for _ in range(200):
        distance = np.linalg.norm(layout_m - point[:, None], axis=2)
        pull = weight / np.maximum(distance, 1e-6)  # a point on a device stays there
        point = (layout_m * pull[:, :, None]).sum(axis=1) / pull.sum(axis=1)[:, None]
    return point


def towards(position_m: Float, target_m: Float, reach_m: float | Float, size_m: Float) -> Float:
    """Displacement (..., 2) towards `target_m`, at most `reach_m`, a number or (...), long (m).

    It ends a micrometre inside the area: rounding on the border must not cancel the move.
    """
    offset: Float = np.clip(target_m, 1e-6, size_m - 1e-6) - position_m
    length = np.linalg.norm(offset, axis=-1, keepdims=True)
    move: Float = offset * np.minimum(1.0, np.expand_dims(reach_m, -1) / np.maximum(length, 1e-12))
    return move
