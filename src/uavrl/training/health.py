"""Whether a finished run is healthy, from its log: a few rules, each of which is rarely wrong.

What is looked at is the last fifth of the rows, when the learning rate is low and things have settled or will not.

- bc_loss at what an actor reaches that has learned nothing.
- Q outside what any sequence of rewards in the data adds up to; or still moving: by more than 15 % of its whole range
  (at an even pace it would be 20 %), and clearly more than its noise and a tenth of the rewards' deviation.
- A gradient of nothing, or a hundred times the clip. A clip that always binds is no fault by itself: Adam divides by
  the gradient's size, and our own default actor is clipped throughout.
- Actions far from the data's: `FAR` of the longest move, see `uavrl.training.support`.
- A last trial a tenth worse than the best one. Trials are of equal flights, so that chance is much less than this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rows = Sequence[Mapping[str, Any]]

FEWEST = 10  # rows to judge anything by; of the last fifth, to judge a movement by
FAR = 0.4  # our policies end below 0.1; moves drawn at random lie at 0.6, the corners at 1.3


@dataclass(frozen=True)
class Expected:
    """What the settings and the data of a run allow."""

    q: tuple[float, float]  # least and largest discounted sum of rewards
    reward_deviation: float  # of the rewards as the agent sees them
    bc_loss: float | None  # of an actor that has learned nothing; None where it is no measure of this agent
    gradient_clip: float | None


def complaints(rows: Rows, expected: Expected) -> list[str]:
    """What is wrong with a run, in words; nothing where it is healthy."""
    learned = [row for row in rows if "return" not in row]
    last = learned[-max(1, len(learned) // 5) :]
    found = []

    cloning = _values(last, "bc_loss")
    if expected.bc_loss is not None and cloning.size and np.median(cloning) >= expected.bc_loss:
        found.append(
            f"bc_loss {np.median(cloning):.3g} is no better than knowing nothing ({expected.bc_loss:.3g}): "
            "the actor does not learn the data's actions"
        )

    q, (low, high) = _values(last, "q"), expected.q
    if q.size and not low <= np.median(q) <= high:
        found.append(
            f"Q {np.median(q):.3g} is outside [{low:.3g}, {high:.3g}], all that rewards and discount allow: "
            "lower learning_rate or discount"
        )
    elif (moved := _movement(_values(learned, "q"), len(last), expected.reward_deviation)) is not None:
        found.append(f"Q still moves, by {moved:+.3g} over the last fifth: more updates")

    for name in sorted({key for row in last for key in row if key.endswith("_gradient")}):
        norm = float(np.median(_values(last, name)))
        if norm == 0.0:
            found.append(f"{name} is 0: nothing reaches that network")
        elif expected.gradient_clip is not None and norm >= 100.0 * expected.gradient_clip:
            found.append(f"{name} {norm:.3g} is a hundred times gradient_clip: lower learning_rate")

    distance = _values(last, "support_distance")
    if distance.size and np.median(distance) > FAR:
        found.append(
            f"actions are {np.median(distance):.2g} of a longest move from any logged nearby: "
            "more updates, or more weight on what holds the actor to the data"
        )

    trials = [row for row in rows if row.get("return") is not None]
    if len(trials) > 1:
        returns = np.array([row["return"] for row in trials])
        best = int(returns.argmax())
        if returns[best] - returns[-1] > 0.1 * np.median(np.abs(returns)):
            found.append(
                f"the trial return fell from {returns[best]:.4g} after {trials[best]['step']:,} updates to "
                f"{returns[-1]:.4g}: stop earlier or lower learning_rate"
            )
    return found


def summary(rows: Rows, expected: Expected) -> str:
    """One line: healthy, with the numbers that say so; unhealthy, with what is wrong; or too short to say."""
    learned = [row for row in rows if "return" not in row]
    if len(learned) < FEWEST:
        return f"health unknown: {len(learned)} rows in the log, at least {FEWEST} are needed"
    found = complaints(rows, expected)
    if found:
        return "unhealthy: " + "; ".join(found)
    last = learned[-max(1, len(learned) // 5) :]
    facts = [
        f"{label} {np.median(values):.3g}"
        for name, label in (("q", "Q"), ("bc_loss", "bc_loss"), ("support_distance", "distance to logged actions"))
        if (values := _values(last, name)).size
    ]
    trials = [row["return"] for row in rows if row.get("return") is not None]
    facts += [f"trial return {trials[-1]:.4g} (best {max(trials):.4g})"] if trials else []
    return "healthy: " + ", ".join(facts)


def _values(rows: Rows, name: str) -> NDArray[np.float64]:
    return np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64)


def _movement(q: NDArray[np.float64], count: int, reward_deviation: float) -> float | None:
    """How far a straight line through the last `count` values goes, where that is a movement; else None."""
    if count < FEWEST or len(q) < count:
        return None
    time, last = np.linspace(-0.5, 0.5, count), q[-count:]
    slope = float(time @ last / (time @ time))
    noise = float(np.std(last - last.mean() - slope * time)) / float(np.sqrt(time @ time))  # of the slope
    whole = float(max(q.max(), 0.0) - min(q.min(), 0.0))  # from where a network starts, too
    moves = abs(slope) > max(0.15 * whole, 6.0 * noise, 0.1 * reward_deviation)
    return slope if moves else None
