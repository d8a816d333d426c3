"""How a sentence of the paper is judged, by 95 % intervals over training seeds and environments.

It holds where the intervals are clear on its side, does not hold where one is clear on the other one, and is open where
it is neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import f as ratio_of_variances

from uavrl.evaluation.statistics import Estimate, Interval, combine
from uavrl.experiments.paper import ONLINE, OURS, PROTOCOLS, Protocol
from uavrl.experiments.runner import Row, grouped
from uavrl.experiments.tables import estimated, interval, scores

HOLDS, FAILS, OPEN, READING, MISSING = "holds", "does not hold", "open", "depends on the reading", "not measured yet"
BASELINES = ("CQL", "IQL", "BCQ")
NEAR = 0.05  # "nearly identical", "comparable": within this share of the cost


class Finding(NamedTuple):
    """What is said of a claim."""

    measured: str  # a line for each reading
    verdict: str


class MissingRuns(Exception):  # noqa: N818  # no error: a figure that has not been computed
    """A figure of the judgement has unfinished runs."""


class Results:
    """Finished figures."""

    def __init__(self, rows: Mapping[str, Sequence[Row]]) -> None:
        self.rows = rows
        self._known: dict[tuple[str, str, str], Estimate] = {}  # many claims ask for the same

    def groups(self, figure: str) -> dict[str, list[Row]]:
        """Rows of a figure by variant.

        Raises:
            MissingRuns: it is not finished.
        """
        if figure not in self.rows:
            raise MissingRuns(figure)
        return grouped(self.rows[figure])

    def estimate(self, figure: str, variant: str, metric: str = "return") -> Estimate:
        """Mean of a metric over seeds and environments."""
        asked = (figure, variant, metric)
        if asked not in self._known:
            self._known[asked] = estimated(scores(self.groups(figure)[variant], metric), variant)
        return self._known[asked]

    def ahead(self, figure: str, first: str, second: str, metric: str = "return", sign: float = 1.0) -> Interval:
        """sign x (first - second), paired over environments."""
        one, other = self.estimate(figure, first, metric), self.estimate(figure, second, metric)
        return combine(lambda a, b: sign * (a - b), one, other).interval()

    def ratio(self, figure: str, first: str, second: str, metric: str = "return") -> Interval:
        """first / second - 1."""
        one, other = self.estimate(figure, first, metric), self.estimate(figure, second, metric)
        return combine(lambda a, b: a / b - 1.0, one, other).interval()


Judge = Callable[[Results], Finding]


def _verdict(intervals: Sequence[Interval]) -> str:
    """All clear of zero above: holds; any clear below: does not; else open."""
    if all(one.low > 0 for one in intervals):
        return HOLDS
    return FAILS if any(one.high < 0 for one in intervals) else OPEN


def _listed(intervals: Mapping[str, Interval], scale: float = 1.0, unit: str = "") -> str:
    return "; ".join(f"{name} {interval(one, scale, signed=True)}{unit}" for name, one in intervals.items())


def beats(figure: str, metric: str, sign: float, others: Sequence[str], unit: str) -> Judge:
    """Ours against each of `others`."""

    def judge(results: Results) -> Finding:
        ahead = {name: results.ahead(figure, OURS, name, metric, sign) for name in others}
        return Finding(f"{_protocol(figure).name}: ahead of {_listed(ahead)}{unit}", _verdict([*ahead.values()]))

    return judge


def _protocol(figure: str) -> Protocol:
    """Under which a figure was computed, as its name says."""
    named = {"comparison-paper": "paper-objective", "comparison-realistic": "realistic"}
    return PROTOCOLS[named.get(figure, "published" if figure.endswith("published") else "layouts")]


def per(figure: str, step: str, flight: str) -> str:
    """The metric that the figure's objective counts: a mean over steps, or over flights that take equally long."""
    objective = _protocol(figure).scenario.objective
    return step if objective.reward == "per_step" else flight


def under_readings(verdicts: Sequence[str]) -> str:
    """Of one claim under several readings: it depends on the reading where it holds under some and not under all."""
    known = set(verdicts) - {MISSING}
    if not known:
        return MISSING
    if HOLDS in known:
        return HOLDS if known == {HOLDS} else READING
    return FAILS if FAILS in known else OPEN


def readings(*judges: Judge) -> Judge:
    """One claim under several readings."""

    def judge(results: Results) -> Finding:
        found = []
        for one in judges:
            try:
                found.append(one(results))
            except MissingRuns as missing:
                found.append(Finding(f"{missing}: not computed", MISSING))
        verdict = under_readings([finding.verdict for finding in found])
        return Finding("\n".join(f"{finding.measured} ({finding.verdict})" for finding in found), verdict)

    return judge


def order(figure: str) -> Judge:
    """BCQ worst, ours best, CQL and IQL between."""

    def judge(results: Results) -> Finding:
        steps = {
            "IQL over BCQ": results.ahead(figure, "IQL", "BCQ"),
            "CQL over BCQ": results.ahead(figure, "CQL", "BCQ"),
            f"{OURS} over IQL": results.ahead(figure, OURS, "IQL"),
            f"{OURS} over CQL": results.ahead(figure, OURS, "CQL"),
        }
        return Finding(f"{_protocol(figure).name}: {_listed(steps)}", _verdict([*steps.values()]))

    return judge


def comparable(figure: str, first: str, second: str) -> Judge:
    """Two costs within `NEAR` of each other."""

    def judge(results: Results) -> Finding:
        apart = results.ratio(figure, first, second)
        if max(abs(apart.low), abs(apart.high)) <= NEAR:
            verdict = HOLDS
        else:
            verdict = FAILS if min(abs(apart.low), abs(apart.high)) > NEAR and apart.low * apart.high > 0 else OPEN
        return Finding(f"{_protocol(figure).name}: {first} costs {_percent(apart)} more than {second}", verdict)

    return judge


def _percent(value: Interval) -> str:
    return f"{interval(value, 100.0, digits=1, signed=True)} %"


def throughput(figure: str) -> Judge:
    """35 % above each baseline's."""

    def judge(results: Results) -> Finding:
        more = {name: results.ratio(figure, OURS, name, "throughput_mbps") for name in BASELINES}
        text = "; ".join(f"{_percent(one)} against {name}" for name, one in more.items())
        clear = _verdict([Interval(*(value - 0.35 for value in one)) for one in more.values()])
        return Finding(f"{_protocol(figure).name}: throughput {text}", clear)

    return judge


def packet(figure: str) -> Judge:
    """Half of the packets within .15 s, as it is rounded."""

    def judge(results: Results) -> Finding:
        median = results.estimate(figure, OURS, "transmission_median_s").interval()
        mean = results.estimate(figure, OURS, "transmission_mean_s").interval()
        verdict = HOLDS if median.high <= 0.155 else FAILS if median.low > 0.155 else OPEN
        text = f"median {interval(median, digits=3)} s, mean {interval(mean, digits=3)} s a packet"
        return Finding(f"{_protocol(figure).name}: {text}", verdict)

    return judge


def data(results: Results) -> Finding:
    """Data in a flight, and what it would be over 400 s; the paper's number depends on which is meant."""
    sent = results.estimate("comparison", OURS, "data_mb").interval()
    lasted = results.estimate("comparison", OURS, "duration_s").interval()
    rate = results.estimate("comparison", OURS, "throughput_mbps").interval()
    gigabytes = 400.0 * rate.mean / 8e3
    return Finding(
        f"{interval(sent, digits=1)} MB in {interval(lasted, digits=0)} s; over 400 s at this rate {gigabytes:.2f} GB",
        READING,
    )


def sizes(figure: str, names: Sequence[str], near: bool) -> Judge:
    """The cost with the fewest rows over that with the most: `near` each other, or clearly more."""

    def judge(results: Results) -> Finding:
        at = list(dict.fromkeys(variant.split(" @ ")[1] for variant in results.groups(figure) if " @ " in variant))
        small, large = at[0], at[-1]
        worse = {name: results.ratio(figure, f"{name} @ {small}", f"{name} @ {large}") for name in names}
        text = "; ".join(f"{name} {_percent(one)}" for name, one in worse.items())
        if near:
            high, low = max(one.high for one in worse.values()), min(one.low for one in worse.values())
            verdict = HOLDS if high <= NEAR else FAILS if low > NEAR else OPEN
        else:
            verdict = _verdict([Interval(*(value - NEAR for value in one)) for one in worse.values()])
        return Finding(f"{_protocol(figure).name}: cost with {small} rows over that with {large}: {text}", verdict)

    return judge


def quality(better: str, worse: str, name: str, others: Sequence[str]) -> Judge:
    """`name` beats `others` on the log `better`, and not on `worse` where that is named."""
    return readings(*(_quality_in(figure, better, worse, name, others) for figure in ("quality", "quality-published")))


def _quality_in(figure: str, better: str, worse: str, name: str, others: Sequence[str]) -> Judge:
    def judge(results: Results) -> Finding:
        here = {other: results.ahead(figure, f"{name} @ {better}", f"{other} @ {better}") for other in others}
        text, verdicts = (
            f"{_protocol(figure).name}: {better} log: {name} ahead of {_listed(here)}",
            [_verdict([*here.values()])],
        )
        if worse:
            there = {other: results.ahead(figure, f"{other} @ {worse}", f"{name} @ {worse}") for other in others}
            text += f"; {worse} log: behind by {_listed(there)}"
            verdicts.append(_verdict([*there.values()]))
        verdict = verdicts[0] if len(set(verdicts)) == 1 else FAILS if FAILS in verdicts else OPEN
        return Finding(text, verdict)

    return judge


def variant(figure: str, best: str, metric: str = "return", sign: float = 1.0) -> Judge:
    """One of the six (alpha, eta) against all others."""

    def judge(results: Results) -> Finding:
        others = [name for name in results.groups(figure) if name.startswith("alpha") and name != best]
        ahead = {name: results.ahead(figure, best, name, metric, sign) for name in others}
        return Finding(f"{_protocol(figure).name}: {best} ahead of {_listed(ahead)}", _verdict([*ahead.values()]))

    return judge


def penalty(figure: str) -> Judge:
    """No penalty against the penalty, with cloning and without."""

    def judge(results: Results) -> Finding:
        pairs = {
            f"eta = {eta}": results.ahead(figure, f"alpha = 0, eta = {eta}", f"alpha = 1, eta = {eta}")
            for eta in ("0", "0.5")
        }
        return Finding(
            f"{_protocol(figure).name}: alpha = 0 ahead of alpha = 1 at {_listed(pairs)}", _verdict([*pairs.values()])
        )

    return judge


def competitive(figure: str) -> Judge:
    """Guidance alone within twice `NEAR` of guidance with cloning."""

    def judge(results: Results) -> Finding:
        apart = results.ratio(figure, "alpha = 0, eta = 0", "alpha = 0, eta = 0.5")
        verdict = HOLDS if apart.high <= 2 * NEAR else FAILS if apart.low > 2 * NEAR else OPEN
        text = f"eta = 0 costs {_percent(apart)} more than eta = .5 (competitive: at most 10 %)"
        return Finding(f"{_protocol(figure).name}: {text}", verdict)

    return judge


def steps(few: bool) -> Judge:
    """The fewest steps behind the baselines (`few`), or the most steps ahead of them, by schedule."""

    def judge(results: Results) -> Finding:
        groups = results.groups("denoising")
        found = []
        for schedule in ("linear", "vp"):
            at = [int(name.split(" @ ")[1]) for name in groups if name.startswith(f"{schedule} @ ")]
            steps = min(at) if few else max(at)
            ahead = {name: results.ahead("denoising", f"{schedule} @ {steps}", name) for name in BASELINES}
            verdict = _verdict([*ahead.values()])
            if few:  # fewer than ten should fail to pass the baselines
                verdict = {HOLDS: FAILS, FAILS: HOLDS}.get(verdict, OPEN)
            found.append(Finding(f"{schedule}, M = {steps}: ahead of {_listed(ahead)}", verdict))
        measured = "\n".join(f"{finding.measured} ({finding.verdict})" for finding in found)
        return Finding(measured, under_readings([finding.verdict for finding in found]))

    return judge


def _decision_ms(rows: Sequence[Row]) -> float:
    """Mean over seeds."""
    return float(np.mean([row["scores"]["decision_ms"] for row in rows]))


def linear_time(results: Results) -> Finding:
    """Decision times on a line within 10 % of the longest."""
    groups = results.groups("denoising")
    pairs = []
    for name, rows in groups.items():
        if name.startswith("vp @ "):
            pairs.append((int(name.split(" @ ")[1]), _decision_ms(rows)))
    steps, times = np.array(sorted(pairs)).T
    slope, offset = np.polyfit(steps, times, 1)
    error = float(np.abs(slope * steps + offset - times).max() / times.max())
    text = ", ".join(f"M = {step:.0f}: {time:.2f} ms" for step, time in zip(steps, times, strict=True))
    verdict = HOLDS if error < 0.1 and slope > 0 else FAILS
    return Finding(f"{text}; {slope:.3f} ms a step + {offset:.2f} ms, off by at most {100 * error:.0f} %", verdict)


def times(results: Results) -> Finding:
    """Decision times beside the baselines'; the paper's are of other hardware."""
    groups = results.groups("denoising")
    steps = sorted(int(name.split(" @ ")[1]) for name in groups if name.startswith("vp @ "))
    enough = next((count for count in steps if count >= 20), steps[-1])  # "more than 20 steps"
    named = {**{name: name for name in BASELINES}, f"{OURS}, M = {enough}": f"vp @ {enough}"}
    times = {label: _decision_ms(groups[name]) for label, name in named.items()}
    text = ", ".join(f"{label} {value:.2f} ms" for label, value in times.items())
    return Finding(text, READING)


def same_order(results: Results) -> Finding:
    """Ours ahead of each baseline at every lambda."""
    found: dict[str, Interval] = {}
    for name in results.groups("lambda"):
        algorithm, _, weight = name.partition(" @ ")
        if algorithm in BASELINES:
            found[f"{algorithm} at {weight}"] = results.ahead("lambda", f"{OURS} @ {weight}", name)
    return Finding(f"ahead of {_listed(found)}", _verdict([*found.values()]))


def fair(results: Results) -> Finding:
    """The worst device's age against each baseline's."""
    ahead = {name: results.ahead("comparison", OURS, name, "jain_age") for name in BASELINES}
    worst = {name: results.ahead("comparison", OURS, name, "worst_device_age_s", -1.0) for name in BASELINES}
    jain = "; ".join(f"{name} {interval(one, digits=3, signed=True)}" for name, one in ahead.items())
    return Finding(
        f"Jain's index of 1/age against {jain}; the worst device's age lower by {_listed(worst)} s",
        _verdict([*worst.values()]),
    )


def stable(results: Results) -> Finding:
    """The spread over training seeds against each baseline's, by the ratio's F interval."""
    spreads = {}
    for name in (OURS, *BASELINES):
        means = scores(results.groups("comparison")[name], "return").mean(axis=1)
        if len(means) < 3:
            return Finding(f"{len(means)} training seeds, where a spread needs three or more", OPEN)
        spreads[name] = float(means.std(ddof=1))
    text = "; ".join(f"{name} {value:.1f}" for name, value in spreads.items())
    freedom = len(means) - 1
    steadier = []  # log of the baseline's deviation over ours; of normal means its square's ratio is distributed as F
    for name in BASELINES:
        apart = float(np.log(spreads[name] / spreads[OURS]))
        half = 0.5 * float(np.log(ratio_of_variances.ppf(0.975, freedom, freedom)))
        steadier.append(Interval(apart, apart - half, apart + half))
    return Finding(f"standard deviation of the final return over training seeds: {text}", _verdict(steadier))


def biased(results: Results) -> Finding:
    """The cost after a log without two devices' services over that after the whole log."""
    whole, part = f"{OURS} @ whole log", f"{OURS} @ two devices never served"
    worse = results.ratio("biased", part, whole)
    ahead = {name: results.ahead("biased", part, f"{name} @ two devices never served") for name in (*BASELINES, "BC")}
    text = f"{OURS} costs {_percent(worse)} more than with the whole log; there ahead of {_listed(ahead)}"
    return Finding(text, HOLDS if worse.low > NEAR else FAILS if worse.high < NEAR else OPEN)


def online(metric: str, sign: float) -> Judge:
    """Online SAC against the heuristics."""

    def judge(results: Results) -> Finding:
        ahead = {name: results.ahead("online", ONLINE, name, metric, sign) for name in ("TDM", "Saver", "random walk")}
        return Finding(f"ahead of {_listed(ahead)}", _verdict([*ahead.values()]))

    return judge


def imitation(figure: str) -> Judge:
    """Guidance with cloning against cloning alone."""

    def judge(results: Results) -> Finding:
        ahead = results.ahead(figure, "alpha = 0, eta = 0.5", "alpha = 0, eta = 1")
        return Finding(
            f"{_protocol(figure).name}: eta = .5 ahead of cloning by {interval(ahead, signed=True)}", _verdict([ahead])
        )

    return judge


def near_planner(results: Results) -> Finding:
    """Ours within `NEAR` of the planner's cost, IQL and CQL not."""
    over = {name: results.ratio("comparison", name, "planner") for name in (OURS, "IQL", "CQL")}
    text = "; ".join(f"{name} {_percent(one)}" for name, one in over.items())
    short = [Interval(*(value - NEAR for value in over[name])) for name in ("IQL", "CQL")]
    mean, low, high = over[OURS]
    near = Interval(NEAR - mean, NEAR - high, NEAR - low)
    return Finding(f"cost over the planner's: {text}", _verdict([near, *short]))
