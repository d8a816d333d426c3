"""Policies of a line each. Those of the paper (Section VI): TDM, Saver, random walk; the others are ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from uavrl.policies.base import SimulatorView
from uavrl.policies.service import geometric_median_m, service_model, towards
from uavrl.simulation.state import FlightAction

Float = NDArray[np.float64]
Int = NDArray[np.int64]


class Choose(Protocol):
    """Whom to serve: (view, position after the move (N, 2)) -> device (N,), 0 being idle."""

    def __call__(self, view: SimulatorView, position_m: Float, /) -> Int: ...


class Aim(Protocol):
    """Where to fly: (view, wanted device (N,)) -> point (N, 2) (m)."""

    def __call__(self, view: SimulatorView, device: Int, /) -> Float: ...


def nobody(view: SimulatorView, position_m: Float, /) -> Int:
    """Serves nobody."""
    return np.zeros(len(position_m), dtype=np.int64)


def round_robin(view: SimulatorView, position_m: Float, /) -> Int:
    """Device 1, 2, ..., K, 1, ... by the number of the step."""
    turn: Int = view.state.step % view.layout_m.shape[1] + 1
    return turn


def nearest(view: SimulatorView, position_m: Float, /) -> Int:
    """The device nearest to where the step begins."""
    closest: Int = np.linalg.norm(view.layout_m - view.state.position_m[:, None], axis=2).argmin(axis=1) + 1
    return closest


def oldest(view: SimulatorView, position_m: Float, /) -> Int:
    """The device of greatest age."""
    eldest: Int = view.state.age_s.argmax(axis=1) + 1
    return eldest


def highest_index(view: SimulatorView, position_m: Float, /) -> Int:
    """argmax_k delta_k (A_k + c_k)^2 / (2 c_k), c_k as seen after the move."""
    model = service_model(view.scenario)
    best: Int = model.index(view.state.age_s, model.cost_s(position_m, view.layout_m)).argmax(axis=1) + 1
    return best


def served_device(view: SimulatorView, device: Int, /) -> Float:
    """Where the served device lies."""
    return view.layout_m[np.arange(len(device)), np.maximum(device - 1, 0)]


def median_point(view: SimulatorView, device: Int, /) -> Float:
    """The devices' geometric median, weighted by priority."""
    return geometric_median_m(view.layout_m, service_model(view.scenario).priority)


def best_hover_point(view: SimulatorView, device: Int, /) -> Float:
    """The point of least weighted age when hovering."""
    return service_model(view.scenario).best_hover_m(view.layout_m)


class Heuristic:
    """Chooses a device, flies towards a point as fast as it can, and serves on the way.

    Args:
        name: what a table calls it.
        choose: whom to serve.
        aim: where to fly; None stays where the flight began.
        fixed: the point depends on the layout alone, and is found once a flight.
    """

    needs: Literal["paper", "devices", "state"] = "state"

    def __init__(self, name: str, choose: Choose, aim: Aim | None = None, *, fixed: bool = False) -> None:
        self.name = name
        self._choose = choose
        self._aim = aim
        self._fixed = fixed
        self._point_m: Float | None = None

    def reset(self, count: int) -> None:
        self._point_m = None

    def act(
        self, observation: SimulatorView, *, generator: np.random.Generator, deterministic: bool = False
    ) -> FlightAction:
        here = observation.state.position_m
        if self._aim is None:
            return FlightAction(np.zeros_like(here), self._choose(observation, here))
        point = self._point_m
        if point is None:
            point = self._aim(observation, self._choose(observation, here))
            self._point_m = point if self._fixed else None
        scenario = observation.scenario
        move = towards(here, point, scenario.airframe.max_displacement_m, service_model(scenario).size_m)
        return FlightAction(move, self._choose(observation, here + move))


class RandomWalk:
    """A uniform displacement in the box of the action space and a uniform choice among idle and the K devices."""

    name = "random_walk"
    needs: Literal["paper", "devices", "state"] = "state"

    def reset(self, count: int) -> None:
        pass

    def act(
        self, observation: SimulatorView, *, generator: np.random.Generator, deterministic: bool = False
    ) -> FlightAction:
        count, devices = observation.state.age_s.shape
        reach = observation.scenario.airframe.max_displacement_m
        return FlightAction(generator.uniform(-reach, reach, (count, 2)), generator.integers(0, devices + 1, count))


HEURISTICS: dict[str, Callable[[], Heuristic | RandomWalk]] = {
    "tdm": lambda: Heuristic("tdm", round_robin),  # as in the paper's text: stays where it starts
    "saver": lambda: Heuristic("saver", nearest),  # likewise
    "random_walk": RandomWalk,
    "tdm_flying": lambda: Heuristic("tdm_flying", round_robin, served_device),
    "saver_flying": lambda: Heuristic("saver_flying", nearest, served_device),
    "max_age": lambda: Heuristic("max_age", oldest, median_point, fixed=True),
    "index": lambda: Heuristic("index", highest_index),  # the index alone: from where the flight starts
    "hover": lambda: Heuristic("hover", highest_index, best_hover_point, fixed=True),
    "idle": lambda: Heuristic("idle", nobody),
}
