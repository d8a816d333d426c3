"""The rollout planner, the yardstick of every table: it knows the model, and tries plans out before it acts.

It minimises the scenario's own undiscounted objective to the episode's end. A `Plan` waits, flies to a point and serves
by the index from there, but only what has aged enough; hover, index, TDM in place, idle, and idle-then-hover are plans.
A flight begins with the best of many plans, each rolled out to the episode's end under the expected channel. Then steps
compare the plan's own action with others, each followed by the plan, and now and then the plan with its neighbours. The
present plan wins ties, so that under the expected channel the flight is never worse than any plan of the first search.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from operator import itemgetter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from uavrl.physics import energy
from uavrl.policies.base import SimulatorView
from uavrl.policies.service import Float, service_model, towards
from uavrl.scenario import Scenario, hover_reference_j
from uavrl.simulation.state import FlightAction, SimState

Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

# The planner's settings. Changing one changes the yardstick: every table must then be made again.
FRACTIONS = np.linspace(0.0, 1.0, 11)  # targets: so much of the way to the best hover point,
PULLS_SPM = np.geomspace(1e-4, 2e-3, 8)  # and where age when hovering + pull x distance is least (s/m)
STRIDES = np.array([1.0, 0.4, 0.2, 0.1])  # of d_max
WAITS = np.array([0, 10, 20, 30, 40, 50, 60, 80, 100, 150])  # steps of idling first
LEVELS = np.array([0.0, 0.3, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0, np.inf])  # index / age when hovering
ROUNDS = 2  # the first search takes turns: targets and strides, then levels and waits
RINGS_M = np.array([10.0, 40.0, 120.0])  # neighbours: targets so far from the present one,
HEADINGS = np.arange(8) * (np.pi / 4.0)  # in these directions,
NEAR_WAITS = np.array([0, 5, 20])
NEAR_LEVELS = np.array([0.0, 0.5, 1.0, 2.0, np.inf])
NUDGES = np.array([0.7, 0.85, 1.2, 1.4])  # and factors of the present threshold
RANKS = 3  # a look tries the devices of highest index
LOOKS, SEARCHES = 800, 80  # at most so many looks and searches of neighbours in an episode, evenly spaced
TIE = 1e-9  # a relative gain below this is rounding


@dataclass(frozen=True)
class Plan:
    """What to do until the episode ends; R rows, or R x C where plans are compared."""

    wait: Int  # (R,) steps to idle where it is before anything else
    target_m: Float  # (R, 2) then fly there and stay
    stride_m: Float  # (R,) flying at most this far a step
    threshold_s: Float  # (R,) serve the device of highest index if its root reaches this, else idle
    in_turn: Bool  # (R,) serve round robin instead

    def map(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Plan:
        """The plan with every field changed."""
        return Plan(*(change(getattr(self, field.name)) for field in fields(self)))

    def spread(self, count: int, **changes: NDArray[Any]) -> Plan:
        """`count` plans a row: fields (R, count, ...), those of `changes` replaced by what broadcasts to it."""
        rows = len(self.wait)
        wide = {}
        for field in fields(self):
            value = getattr(self, field.name)
            shape = (rows, count, *value.shape[1:])
            wide[field.name] = np.broadcast_to(changes.get(field.name, value[:, None]), shape)
        return Plan(**wide)


class Rollouts:
    """The expected model of one scenario: rolls plans out to the episode's end, R at once.

    It is `advance` on the mean channel made lean: a service takes its expected time and leaves 1 - P(arrival) of the
    age, and the channel is looked up only for rows that move. A test holds it against `advance`.
    """

    def __init__(self, scenario: Scenario) -> None:
        frame, objective = scenario.airframe, scenario.objective
        self.model = service_model(scenario)
        self.limits = scenario.limits
        self.reach_m = frame.max_displacement_m
        self.speed_mps = frame.speed_mps
        self.decision_s = frame.decision_s
        self.min_idle_s = frame.min_idle_s
        self.per_second = objective.reward == "per_second"
        self.age_weight = objective.age_weight / objective.age_reference_s
        self.energy_weight = (1.0 - objective.age_weight) / hover_reference_j(scenario, energy.hover_power_w(frame))
        # energies are proportional to times; these are the powers
        self.move_w = float(energy.move_energy_j(1.0, frame))
        self.communication_w = float(energy.communication_energy_j(1.0, frame))
        self.idle_w = float(energy.idle_energy_j(1.0, frame))

    def most_steps(self) -> int:
        """About how many steps an episode can have: its limit, or as many services as close by fit its time."""
        steps, time_s = self.limits.max_steps, self.limits.time_budget_s
        shortest_s = float(self.model.shortest_s.min())
        by_time = math.inf if time_s is None else math.ceil(time_s / shortest_s)
        return int(min(math.inf if steps is None else steps, by_time))

    def _links(self, position_m: Float, layout_m: Float) -> list[Float]:
        """E[T_com], P(lost), c_k, and the factor that turns A_k + c_k into the root of the index, (R, K) each."""
        model = self.model
        cost = model.cost_s(position_m, layout_m)
        scale = np.where(cost <= model.max_age_s, np.sqrt(model.priority / (2.0 * cost)), 0.0)
        return [model.attempt_s(position_m, layout_m), 1.0 - model.arrival(position_m, layout_m), cost, scale]

    def cost(self, layout_m: Float, state: SimState, plan: Plan, first: FlightAction | None = None) -> Float:
        """Expected undiscounted cost (minus the return) of each row from `state` to the episode's end, (R,).

        Args:
            layout_m: (R, K, 2).
            state: R rows.
            plan: R rows.
            first: what to do in the first step instead of the plan's own action.
        """
        model, limits = self.model, self.limits
        priority, total_priority = model.priority, float(model.priority.sum())
        devices = layout_m.shape[1]
        position, age, time, used, step = (
            array.copy() for array in (state.position_m, state.age_s, state.time_s, state.used_j, state.step)
        )
        result, cost, rows = np.zeros(len(age)), np.zeros(len(age)), np.arange(len(age))
        alive, flying, start = np.ones(len(age), dtype=bool), np.ones(len(age), dtype=bool), rows * devices
        links = self._links(position, layout_m)
        waits, turns = int(plan.wait.max()), bool(plan.in_turn.any())
        oldest = float(age.max())  # no age is greater
        passed = 0
        while True:
            go = flying & (plan.wait <= passed)
            if first is not None:
                go, hop = np.ones_like(go), first.displacement_m
            move_s: Float | float = 0.0
            if go.any():
                some = np.flatnonzero(go)
                if first is None:
                    hop = towards(position[some], plan.target_m[some], plan.stride_m[some], model.size_m)
                    flying[some] = (np.abs(hop) > 1e-4).any(axis=1)
                position[some] += hop
                move_s = np.zeros(len(age))
                move_s[some] = np.sqrt((hop * hop).sum(axis=1)) / self.speed_mps
                for values, fresh in zip(links, self._links(position[some], layout_m[some]), strict=True):
                    values[some] = fresh
            seconds, lost, service, scale = links

            if first is not None:
                chosen, serve = np.maximum(first.device - 1, 0), first.device > 0
            else:
                root = (age + service) * scale
                chosen = root.argmax(axis=1)
                serve = root.take(start + chosen) >= plan.threshold_s
                if turns:
                    chosen = np.where(plan.in_turn, step % devices, chosen)
                    serve |= plan.in_turn
                if passed < waits:
                    serve &= plan.wait <= passed
            first = None
            served = start + chosen

            transmission_s = seconds.take(served) * serve
            quiet_s: Float | float = self.decision_s
            if self.min_idle_s > 0:
                quiet_s = np.where(serve, self.decision_s, np.maximum(self.decision_s, self.min_idle_s - move_s))
            duration = move_s + transmission_s + quiet_s
            oldest += float(duration.max())
            if self.per_second:
                age_cost = duration * (age @ priority) + (0.5 * total_priority) * duration * duration
                if oldest > model.max_age_s:
                    over = np.maximum(age + duration[:, None] - model.max_age_s, 0.0)
                    age_cost -= 0.5 * ((over * over) @ priority)
            age += duration[:, None]
            if oldest > model.max_age_s:
                np.minimum(age, model.max_age_s, out=age)
            age.reshape(-1)[served] *= np.where(serve, lost.take(served), 1.0)
            if not self.per_second:
                age_cost = age @ priority
            spent_j = move_s * self.move_w + transmission_s * self.communication_w + quiet_s * self.idle_w
            cost += alive * (self.age_weight * age_cost + self.energy_weight * spent_j)
            time += duration
            used += spent_j
            step += 1
            passed += 1

            if limits.max_steps is not None:
                alive &= step < limits.max_steps
            if limits.time_budget_s is not None:
                alive &= time <= limits.time_budget_s
            if limits.energy_budget_j is not None:
                alive &= used <= limits.energy_budget_j
            left = np.count_nonzero(alive)
            if left < 0.6 * len(alive):  # leave out what has ended
                result[rows] = cost
                if left == 0:
                    return result
                rows, cost, flying, layout_m = rows[alive], cost[alive], flying[alive], layout_m[alive]
                position, age, time, used, step = (array[alive] for array in (position, age, time, used, step))
                links = [values[alive] for values in links]
                plan = plan.map(itemgetter(alive))
                alive, start = np.ones(left, dtype=bool), np.arange(left) * devices


class Planner:
    """The rollout planner; see the module."""

    name = "planner"
    needs: Literal["paper", "devices", "state"] = "state"

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._passed = 0

    def reset(self, count: int) -> None:
        self._plan = None
        self._passed = 0

    def act(
        self, observation: SimulatorView, *, generator: np.random.Generator, deterministic: bool = False
    ) -> FlightAction:
        rollouts = Rollouts(observation.scenario)
        most = rollouts.most_steps()
        if self._plan is None:
            plan = best_plan(rollouts, observation)
        elif self._passed % math.ceil(most / SEARCHES) == 0:
            plan = better_plan(rollouts, observation, self._plan)
        else:
            plan = self._plan
        actions = possible_actions(rollouts, observation, plan)
        action = FlightAction(actions.displacement_m[:, 0], actions.device[:, 0])
        if self._passed % math.ceil(most / LOOKS) == 0:
            count = actions.device.shape[1]
            best = _cheapest(_costs(rollouts, observation, plan.spread(count), actions))
            rows = np.arange(len(best))
            action = FlightAction(actions.displacement_m[rows, best], actions.device[rows, best])
        self._passed += 1
        self._plan = replace(plan, wait=np.maximum(plan.wait - 1, 0))
        return action


def best_plan(rollouts: Rollouts, view: SimulatorView) -> Plan:
    """The best plan for the flights of `view` (N rows) from a wide search; it starts from staying and serving."""
    model, here = rollouts.model, view.state.position_m
    count = len(here)
    zero = np.zeros(count)
    plan = Plan(zero.astype(np.int64), here, zero + rollouts.reach_m, zero, zero > 0.0)

    hover = model.best_hover_m(view.layout_m)
    on_the_way = here[:, None] + FRACTIONS[:, None] * (hover - here)[:, None]
    grid, ages = model.hover_map(view.layout_m)
    far = np.sqrt(((grid - here[:, None]) ** 2).sum(axis=2))
    worth_it = np.stack([grid[(ages + pull * far).argmin(axis=1)] for pull in PULLS_SPM], axis=1)
    targets, strides = _pairs(np.concatenate([hover[:, None], on_the_way, worth_it], axis=1), STRIDES)

    in_turn = plan.spread(1, in_turn=np.ones((count, 1), dtype=bool))
    for _ in range(ROUNDS):
        there = plan.spread(targets.shape[1], target_m=targets, stride_m=strides * rollouts.reach_m)
        plan = _best(rollouts, view, [plan.spread(1), in_turn, there])
        age_s = model.hover_age_s(plan.target_m, view.layout_m)
        levels, waits = _pairs(np.sqrt(LEVELS * age_s[:, None]), WAITS)
        plan = _best(rollouts, view, [plan.spread(1), plan.spread(levels.shape[1], threshold_s=levels, wait=waits)])
    return plan


def better_plan(rollouts: Rollouts, view: SimulatorView, plan: Plan) -> Plan:
    """The best of `plan` and its neighbours, from where the flights are now."""
    model, here = rollouts.model, view.state.position_m
    ring = (RINGS_M[:, None, None] * np.stack([np.cos(HEADINGS), np.sin(HEADINGS)], axis=1)).reshape(-1, 2)
    around = np.clip(plan.target_m[:, None] + ring, 0.0, model.size_m)
    targets = np.concatenate([here[:, None], 0.5 * (here + plan.target_m)[:, None], around], axis=1)
    age_s = model.hover_age_s(plan.target_m, view.layout_m)
    levels = np.concatenate([np.sqrt(NEAR_LEVELS * age_s[:, None]), NUDGES * plan.threshold_s[:, None]], axis=1)
    candidates = [
        plan.spread(1),
        plan.spread(targets.shape[1], target_m=targets),
        plan.spread(len(NEAR_WAITS), wait=NEAR_WAITS),
        plan.spread(levels.shape[1], threshold_s=levels),
    ]
    if (np.abs(here - plan.target_m) > 1.0).any():
        candidates.append(plan.spread(len(STRIDES), stride_m=STRIDES * rollouts.reach_m))
    return _best(rollouts, view, candidates)


def possible_actions(rollouts: Rollouts, view: SimulatorView, plan: Plan) -> FlightAction:
    """What to do now, (N, C, 2) and (N, C): the plan's own action, idle, and serving those of highest index."""
    model, here = rollouts.model, view.state.position_m
    ready = plan.wait <= 0
    move = towards(here, plan.target_m, plan.stride_m, model.size_m) * ready[:, None]
    root = np.sqrt(model.index(view.state.age_s, model.cost_s(here + move, view.layout_m)))
    highest = np.argsort(-root, axis=1)[:, :RANKS]
    serve = ready & (np.take_along_axis(root, highest[:, :1], axis=1)[:, 0] >= plan.threshold_s)
    own = np.where(serve, highest[:, 0] + 1, 0)
    own = np.where(plan.in_turn & ready, view.state.step % root.shape[1] + 1, own)
    stay, idle = np.zeros_like(move), np.zeros_like(own)
    moves = [move, stay, move, stay] + [move] * highest.shape[1]
    devices = [own, idle, idle, highest[:, 0] + 1, *(highest.T + 1)]
    return FlightAction(np.stack(moves, axis=1), np.stack(devices, axis=1))


def _pairs(first: Float, second: NDArray[Any]) -> tuple[Float, NDArray[Any]]:
    """Every pair of `first` (N, A, ...) and `second` (B,): (N, A B, ...) and (A B,)."""
    return np.repeat(first, len(second), axis=1), np.tile(second, first.shape[1])


def _costs(rollouts: Rollouts, view: SimulatorView, plans: Plan, first: FlightAction | None = None) -> Float:
    """Expected cost of C plans a flight (fields (N, C, ...)), each after its first action, (N, C)."""
    count, each = plans.wait.shape
    state = SimState(**{key: np.repeat(value, each, axis=0) for key, value in view.state._asdict().items()})
    flat = plans.map(lambda value: value.reshape(count * each, *value.shape[2:]))
    if first is not None:
        first = FlightAction(first.displacement_m.reshape(-1, 2), first.device.reshape(-1))
    return rollouts.cost(np.repeat(view.layout_m, each, axis=0), state, flat, first).reshape(count, each)


def _cheapest(cost: Float) -> Int:
    """Column of the least cost (N, C), the first one unless another is better by more than rounding, (N,)."""
    best = cost.argmin(axis=1)
    gain = cost[:, 0] - np.take_along_axis(cost, best[:, None], axis=1)[:, 0]
    return np.where(gain > TIE * np.abs(cost[:, 0]), best, 0)


def _best(rollouts: Rollouts, view: SimulatorView, candidates: list[Plan]) -> Plan:
    """The cheapest of candidates (fields (N, C_i, ...)); the first wins ties."""
    plans = Plan(
        *(np.concatenate([getattr(plan, field.name) for plan in candidates], axis=1) for field in fields(Plan))
    )
    best = _cheapest(_costs(rollouts, view, plans))
    rows = np.arange(len(best))
    return plans.map(itemgetter((rows, best)))
