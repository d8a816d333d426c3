"""The paper's claims, one by one: where each stands, what was measured, and whether it holds.

A claim is judged by 95 % intervals over training seeds and environments: it holds where the interval is clear on the
claim's side, does not hold where it is clear on the other one, and is open where it is neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import f

from uavrl.evaluation.statistics import Estimate, Interval, combine
from uavrl.experiments.paper import ONLINE, OURS, PROTOCOLS
from uavrl.experiments.runner import Row, grouped
from uavrl.experiments.tables import estimated, interval, scores

HOLDS, FAILS, OPEN, READING, MISSING = "holds", "does not hold", "open", "depends on the reading", "not measured yet"
BASELINES = ("CQL", "IQL", "BCQ")
NEAR = 0.05  # "nearly identical", "comparable": within this share of the cost


class Finding(NamedTuple):
    """What is said of a claim."""

    measured: str  # a line for each reading
    verdict: str


class Claim(NamedTuple):
    """A sentence of the paper; `why` is what the model and our settings say of it, whatever was measured."""

    text: str
    where: str
    judge: Callable[[Results], Finding]
    why: str


class _MissingRuns(Exception):  # noqa: N818  # no error: a figure that has not been computed
    """A figure of the judgement has unfinished runs."""


class Results:
    """Finished figures."""

    def __init__(self, rows: Mapping[str, Sequence[Row]]) -> None:
        self.rows = rows
        self._known: dict[tuple[str, str, str], Estimate] = {}  # many claims ask for the same

    def groups(self, figure: str) -> dict[str, list[Row]]:
        """Rows of a figure by variant.

        Raises:
            _MissingRuns: it is not finished.
        """
        if figure not in self.rows:
            raise _MissingRuns(figure)
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


def _verdict(intervals: Sequence[Interval]) -> str:
    """All clear of zero above: holds; any clear below: does not; else open."""
    if all(one.low > 0 for one in intervals):
        return HOLDS
    return FAILS if any(one.high < 0 for one in intervals) else OPEN


def _listed(intervals: Mapping[str, Interval], scale: float = 1.0, unit: str = "") -> str:
    return "; ".join(f"{name} {interval(one, scale, signed=True)}{unit}" for name, one in intervals.items())


def _beats(figure: str, metric: str, sign: float, others: Sequence[str], unit: str) -> Callable[[Results], Finding]:
    """Ours against each of `others`."""

    def judge(results: Results) -> Finding:
        ahead = {name: results.ahead(figure, OURS, name, metric, sign) for name in others}
        return Finding(
            f"{PROTOCOLS[_protocol(figure)].name}: ahead of {_listed(ahead)}{unit}", _verdict([*ahead.values()])
        )

    return judge


def _protocol(figure: str) -> str:
    return _COMPARED_UNDER[figure]


def _per(figure: str, step: str, flight: str) -> str:
    """The metric that the figure's objective counts: a mean over steps, or over flights that take equally long."""
    objective = PROTOCOLS[_protocol(figure)].scenario.objective
    return step if objective.reward == "per_step" else flight


def _both(*judges: Callable[[Results], Finding]) -> Callable[[Results], Finding]:
    """One claim under several readings."""

    def judge(results: Results) -> Finding:
        found = []
        for one in judges:
            try:
                found.append(one(results))
            except _MissingRuns as missing:
                found.append(Finding(f"{missing}: not computed", MISSING))
        known = {finding.verdict for finding in found} - {MISSING}
        verdict = MISSING if not known else known.pop() if len(known) == 1 else READING
        return Finding("\n".join(f"{finding.measured} ({finding.verdict})" for finding in found), verdict)

    return judge


def _order(figure: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        steps = {
            "IQL over BCQ": results.ahead(figure, "IQL", "BCQ"),
            "CQL over BCQ": results.ahead(figure, "CQL", "BCQ"),
            f"{OURS} over IQL": results.ahead(figure, OURS, "IQL"),
            f"{OURS} over CQL": results.ahead(figure, OURS, "CQL"),
        }
        return Finding(f"{PROTOCOLS[_protocol(figure)].name}: {_listed(steps)}", _verdict([*steps.values()]))

    return judge


def _comparable(figure: str, first: str, second: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        apart = results.ratio(figure, first, second)
        if max(abs(apart.low), abs(apart.high)) <= NEAR:
            verdict = HOLDS
        else:
            verdict = FAILS if min(abs(apart.low), abs(apart.high)) > NEAR and apart.low * apart.high > 0 else OPEN
        return Finding(
            f"{PROTOCOLS[_protocol(figure)].name}: {first} costs {_percent(apart)} more than {second}", verdict
        )

    return judge


def _percent(value: Interval) -> str:
    return f"{interval(value, 100.0, digits=1, signed=True)} %"


def _throughput(figure: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        more = {name: results.ratio(figure, OURS, name, "throughput_mbps") for name in BASELINES}
        text = "; ".join(f"{_percent(one)} against {name}" for name, one in more.items())
        clear = _verdict([Interval(*(value - 0.35 for value in one)) for one in more.values()])
        return Finding(f"{PROTOCOLS[_protocol(figure)].name}: throughput {text}", clear)

    return judge


def _packet(figure: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        median = results.estimate(figure, OURS, "transmission_median_s").interval()
        mean = results.estimate(figure, OURS, "transmission_mean_s").interval()
        verdict = HOLDS if median.high <= 0.155 else FAILS if median.low > 0.155 else OPEN
        text = f"median {interval(median, digits=3)} s, mean {interval(mean, digits=3)} s a packet"
        return Finding(f"{PROTOCOLS[_protocol(figure)].name}: {text}", verdict)

    return judge


def _data(results: Results) -> Finding:
    sent = results.estimate("comparison", OURS, "data_mb").interval()
    lasted = results.estimate("comparison", OURS, "duration_s").interval()
    rate = results.estimate("comparison", OURS, "throughput_mbps").interval()
    gigabytes = 400.0 * rate.mean / 8e3
    return Finding(
        f"{interval(sent, digits=1)} MB in {interval(lasted, digits=0)} s; over 400 s at this rate {gigabytes:.2f} GB",
        READING,
    )


def _sizes(figure: str, protocol: str, names: Sequence[str], near: bool) -> Callable[[Results], Finding]:
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
        return Finding(f"{PROTOCOLS[protocol].name}: cost with {small} rows over that with {large}: {text}", verdict)

    return judge


def _quality(better: str, worse: str, name: str, others: Sequence[str]) -> Callable[[Results], Finding]:
    """`name` beats `others` on the log `better`, and not on `worse` where that is named."""
    return _both(*(_quality_in(figure, better, worse, name, others) for figure in ("quality", "quality-published")))


def _quality_in(figure: str, better: str, worse: str, name: str, others: Sequence[str]) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        here = {other: results.ahead(figure, f"{name} @ {better}", f"{other} @ {better}") for other in others}
        text, verdicts = (
            f"{_where(figure)}: {better} log: {name} ahead of {_listed(here)}",
            [_verdict([*here.values()])],
        )
        if worse:
            there = {other: results.ahead(figure, f"{other} @ {worse}", f"{name} @ {worse}") for other in others}
            text += f"; {worse} log: behind by {_listed(there)}"
            verdicts.append(_verdict([*there.values()]))
        verdict = verdicts[0] if len(set(verdicts)) == 1 else FAILS if FAILS in verdicts else OPEN
        return Finding(text, verdict)

    return judge


def _variant(figure: str, best: str, metric: str = "return", sign: float = 1.0) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        others = [name for name in results.groups(figure) if name.startswith("alpha") and name != best]
        ahead = {name: results.ahead(figure, best, name, metric, sign) for name in others}
        return Finding(f"{_where(figure)}: {best} ahead of {_listed(ahead)}", _verdict([*ahead.values()]))

    return judge


def _where(figure: str) -> str:
    return PROTOCOLS["published" if figure.endswith("published") else "layouts"].name


def _penalty(figure: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        pairs = {
            f"eta = {eta}": results.ahead(figure, f"alpha = 0, eta = {eta}", f"alpha = 1, eta = {eta}")
            for eta in ("0", "0.5")
        }
        return Finding(
            f"{_where(figure)}: alpha = 0 ahead of alpha = 1 at {_listed(pairs)}", _verdict([*pairs.values()])
        )

    return judge


def _competitive(figure: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        apart = results.ratio(figure, "alpha = 0, eta = 0", "alpha = 0, eta = 0.5")
        verdict = HOLDS if apart.high <= 2 * NEAR else FAILS if apart.low > 2 * NEAR else OPEN
        text = f"eta = 0 costs {_percent(apart)} more than eta = .5 (competitive: at most 10 %)"
        return Finding(f"{_where(figure)}: {text}", verdict)

    return judge


def _steps(few: bool) -> Callable[[Results], Finding]:
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
        verdicts = {finding.verdict for finding in found}
        verdict = verdicts.pop() if len(verdicts) == 1 else READING
        return Finding("; ".join(finding.measured for finding in found), verdict)

    return judge


def _decision_ms(rows: Sequence[Row]) -> float:
    """Mean over seeds."""
    return float(np.mean([row["scores"]["decision_ms"] for row in rows]))


def _linear_time(results: Results) -> Finding:
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


def _times(results: Results) -> Finding:
    groups = results.groups("denoising")
    steps = sorted(int(name.split(" @ ")[1]) for name in groups if name.startswith("vp @ "))
    enough = next((count for count in steps if count >= 20), steps[-1])  # "more than 20 steps"
    named = {**{name: name for name in BASELINES}, f"{OURS}, M = {enough}": f"vp @ {enough}"}
    times = {label: _decision_ms(groups[name]) for label, name in named.items()}
    text = ", ".join(f"{label} {value:.2f} ms" for label, value in times.items())
    return Finding(text, READING)


def _same_order(results: Results) -> Finding:
    found: dict[str, Interval] = {}
    for name in results.groups("lambda"):
        algorithm, _, weight = name.partition(" @ ")
        if algorithm in BASELINES:
            found[f"{algorithm} at {weight}"] = results.ahead("lambda", f"{OURS} @ {weight}", name)
    return Finding(f"ahead of {_listed(found)}", _verdict([*found.values()]))


def _fair(results: Results) -> Finding:
    ahead = {name: results.ahead("comparison", OURS, name, "jain_age") for name in BASELINES}
    worst = {name: results.ahead("comparison", OURS, name, "worst_device_age_s", -1.0) for name in BASELINES}
    jain = "; ".join(f"{name} {interval(one, digits=3, signed=True)}" for name, one in ahead.items())
    return Finding(
        f"Jain's index of 1/age against {jain}; the worst device's age lower by {_listed(worst)} s",
        _verdict([*worst.values()]),
    )


def _stable(results: Results) -> Finding:
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
        half = 0.5 * float(np.log(f.ppf(0.975, freedom, freedom)))
        steadier.append(Interval(apart, apart - half, apart + half))
    return Finding(f"standard deviation of the final return over training seeds: {text}", _verdict(steadier))


def _biased(results: Results) -> Finding:
    whole, part = f"{OURS} @ whole log", f"{OURS} @ two devices never served"
    worse = results.ratio("biased", part, whole)
    ahead = {name: results.ahead("biased", part, f"{name} @ two devices never served") for name in (*BASELINES, "BC")}
    text = f"{OURS} costs {_percent(worse)} more than with the whole log; there ahead of {_listed(ahead)}"
    return Finding(text, HOLDS if worse.low > NEAR else FAILS if worse.high < NEAR else OPEN)


def _online(metric: str, sign: float) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        ahead = {name: results.ahead("online", ONLINE, name, metric, sign) for name in ("TDM", "Saver", "random walk")}
        return Finding(f"ahead of {_listed(ahead)}", _verdict([*ahead.values()]))

    return judge


def _imitation(figure: str) -> Callable[[Results], Finding]:
    def judge(results: Results) -> Finding:
        ahead = results.ahead(figure, "alpha = 0, eta = 0.5", "alpha = 0, eta = 1")
        return Finding(
            f"{_where(figure)}: eta = .5 ahead of cloning by {interval(ahead, signed=True)}", _verdict([ahead])
        )

    return judge


def _near_planner(results: Results) -> Finding:
    over = {name: results.ratio("comparison", name, "planner") for name in (OURS, "IQL", "CQL")}
    text = "; ".join(f"{name} {_percent(one)}" for name, one in over.items())
    short = [Interval(*(value - NEAR for value in over[name])) for name in ("IQL", "CQL")]
    mean, low, high = over[OURS]
    near = Interval(NEAR - mean, NEAR - high, NEAR - low)
    return Finding(f"cost over the planner's: {text}", _verdict([near, *short]))


_COMPARED_UNDER = {  # figure -> protocol
    "comparison": "layouts",
    "comparison-published": "published",
    "comparison-paper": "paper-objective",
    "comparison-realistic": "realistic",
}
_COMPARISONS = tuple(_COMPARED_UNDER)
_VARIANTS = ("variants", "variants-published")
_BEST = "alpha = 0, eta = 0.5"

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "Online SAC significantly outperforms TDM, Saver and random walk",
        "V-C, Fig. Online_perf a",
        _online("return", 1.0),
        "TDM stays where it starts, Saver keeps to one device, the walk knows nothing: none of them chooses a place "
        "and a device",
    ),
    Claim(
        "... with a lower age than all three",
        "V-C, Fig. Online_perf b",
        _online("age_per_step_s", -1.0),
        "Saver resets the age of one device; the others' grow for the whole flight",
    ),
    Claim(
        "... and a lower energy than all three",
        "V-C, Fig. Online_perf c",
        _online("energy_per_step_j", -1.0),
        "Saver never moves and serves for ever the device that is nearest to where it starts; the others' ages are the "
        "price",
    ),
    Claim(
        "Diffusion-SAC achieves the highest return, ahead of CQL, IQL and BCQ",
        "Abstract; V-D, Fig. Baselines a",
        _both(*(_beats(figure, "return", 1.0, BASELINES, "") for figure in _COMPARISONS)),
        "what the published settings lack: docs/what-matters.md. Under scenario paper energy outweighs age 2 to 1 "
        "at a good hover, so idling pays (docs/model.md). Under realistic our preset learns slowly: after 12,000 "
        "updates it is clear of TDM (results/realistic)",
    ),
    Claim(
        "Diffusion-SAC has the lowest age",
        "V-D, Fig. Baselines b",
        _both(
            *(
                _beats(figure, _per(figure, "age_per_step_s", "age_per_second_s"), -1.0, BASELINES, " s")
                for figure in _COMPARISONS
            )
        ),
        "as the return, of which age is nearly all under released (500 to 1, docs/model.md)",
    ),
    Claim(
        "Diffusion-SAC has the lowest energy",
        "V-D, Fig. Baselines c",
        _both(
            *(
                _beats(figure, _per(figure, "energy_per_step_j", "energy_per_episode_j"), -1.0, BASELINES, " J")
                for figure in _COMPARISONS
            )
        ),
        "energy is a 500th of the return under released (docs/model.md): what an algorithm spends there is what its "
        "ages happen to leave",
    ),
    Claim(
        "BCQ < IQL, CQL < Diffusion-SAC",
        "V-D, Fig. Baselines a",
        _both(*map(_order, _COMPARISONS)),
        "the baselines' settings were tuned here, too, each in 3 to 8 trials, ours in many more (results/quality); the "
        "paper does not say how its were found",
    ),
    Claim(
        "IQL and CQL perform comparably",
        "V-D, Fig. Baselines a",
        _both(*(_comparable(figure, "IQL", "CQL") for figure in _COMPARISONS)),
        "comparable: within 5 % of the cost",
    ),
    Claim(
        "IQL and CQL fall short of the optimal policy, Diffusion-SAC does not",
        "V-D",
        _near_planner,
        "the optimum is not known: the planner, which knows the physics, stands for it, and within 5 % of its cost "
        "is not short of it",
    ),
    Claim(
        "35 % more throughput",
        "Abstract; V-D; VI",
        _both(*map(_throughput, _COMPARISONS[:2])),
        "a step sends one packet of 2 Mbit at most, so throughput is that over a step's mean time: 35 % more needs "
        "steps shorter by 1 - 1/1.35, a quarter, of policies that serve at every step",
    ),
    Claim(
        "0.15 s to send a packet",
        "V-D, Fig. Rates a",
        _both(*map(_packet, _COMPARISONS[:2])),
        "2 Mbit in 0.15 s are 13.3 Mbit/s over 1 MHz; without fading a packet takes 0.108 s overhead, 0.124 s from "
        "200 m and 0.179 s from 406 m (docs/model.md), and the devices lie over 1 km",
    ),
    Claim(
        "More than 0.65 GB in one episode",
        "V-D, Fig. Rates b",
        _data,
        "400 steps of one 2 Mbit packet are at most 0.1 GB, whatever the policy; 400 s / 0.15 s x 2 Mbit = 0.67 GB "
        "where an episode lasts 400 s and neither decisions nor moves take time",
    ),
    Claim(
        "alpha = 0, eta = .5 is the best variant",
        "V-D, Fig. diff_only a",
        _both(*(_variant(figure, _BEST) for figure in _VARIANTS)),
        "after 2,000 updates guidance costs more than it brings, after 4,000 it was worth 11, one seed each "
        "(docs/what-matters.md, What guidance is worth)",
    ),
    Claim(
        "... also in age",
        "V-D, Fig. diff_only b",
        _both(*(_variant(figure, _BEST, "age_per_step_s", -1.0) for figure in _VARIANTS)),
        "as the return, of which age is nearly all",
    ),
    Claim(
        "... and in energy",
        "V-D, Fig. diff_only c",
        _both(*(_variant(figure, _BEST, "energy_per_step_j", -1.0) for figure in _VARIANTS)),
        "energy is a 500th of the return (docs/model.md)",
    ),
    Claim(
        "alpha = 0, eta = 0 is competitive",
        "V-D",
        _both(*map(_competitive, _VARIANTS)),
        "competitive: at most 10 % more cost",
    ),
    Claim(
        "CQL over-constrains: alpha = 1 is worse, with cloning or without",
        "V-D",
        _both(*map(_penalty, _VARIANTS)),
        "our penalty is on the choice of device alone, and its default a weak one, which keeps long trainings from "
        "idling (docs/what-matters.md, a rare choice)",
    ),
    Claim(
        "Cloning alone (alpha = 0, eta = 1) is worse on a mixed log",
        "V-D",
        _both(*map(_imitation, _VARIANTS)),
        "with our settings the critic has its say in the device at a decision, whatever eta is: only the move is a "
        "clone's",
    ),
    Claim(
        "10 k rows are as good as 50 k for Diffusion-SAC",
        "V-D, Fig. Datasets a",
        _both(_sizes("sizes", "layouts", (OURS,), True), _sizes("sizes-published", "published", (OURS,), True)),
        "nearly identical: within 5 % of the cost. Rows are drawn one by one from the log of a whole training, so "
        "10,000 come from as many flights as 50,000",
    ),
    Claim(
        "CQL, IQL and BCQ degrade significantly with fewer rows",
        "V-D, Fig. Datasets a",
        _both(_sizes("sizes", "layouts", BASELINES, False), _sizes("sizes-published", "published", BASELINES, False)),
        "significantly: clear of 5 % of the cost; rows as above",
    ),
    Claim(
        "On a bad log CQL is relatively strong",
        "V-D, Fig. Datasets c",
        _quality("bad", "", "CQL", ("IQL", "BCQ")),
        "good and bad are rows of the last and of the first third of one learner's log, half as many as usual",
    ),
    Claim(
        "... and fails to exploit a good one",
        "V-D, Fig. Datasets b",
        _quality("bad", "good", "CQL", ("IQL", "BCQ")),
        "as above",
    ),
    Claim(
        "BCQ is better than CQL on a good log and worse on a bad one",
        "V-D, Fig. Datasets b, c",
        _quality("good", "bad", "BCQ", ("CQL",)),
        "as above",
    ),
    Claim(
        "Diffusion-SAC is ahead of the baselines on a bad log, too",
        "V-D, Fig. Datasets c",
        _quality("bad", "", OURS, BASELINES),
        "as above",
    ),
    Claim(
        "Fewer than 10 denoising steps fail to surpass the baselines",
        "V-D, Fig. Denoising_steps a",
        _steps(True),
        "judged by the deterministic action; few steps blur several modes of a log into one (docs/what-matters.md, "
        "the hybrid bandit)",
    ),
    Claim(
        "More than 20 steps outperform all baselines",
        "V-D, Fig. Denoising_steps a",
        _steps(False),
        "judged by the largest M",
    ),
    Claim(
        "Decision time grows linearly with the steps",
        "V-D, Fig. Denoising_steps b",
        _linear_time,
        "a decision is M passes of one network, and what is done once: the observation's part of them, and Q; linear: "
        "within 10 % of the longest time",
    ),
    Claim(
        "2 ms a decision for the baselines, 12 ms for Diffusion-SAC",
        "V-D, Fig. Denoising_steps b",
        _times,
        "theirs are of a V100, these of one CPU core, M = 20 for 'more than 20'; on either, M passes cost M times one",
    ),
    Claim(
        "lambda does not change the order of the algorithms",
        "V-D",
        _same_order,
        "scenario paper with another lambda: at a good hover energy outweighs age 2 to 1 at .5, so 18 to 1 at .1 "
        "and 2 to 9 at .9",
    ),
    Claim(
        "Fairness among devices improves",
        "Abstract; VI",
        _fair,
        "judged by the worst device: an index near 1 can also mean that all devices are equally old",
    ),
    Claim(
        "More stable than the baselines",
        "Abstract; VI",
        _stable,
        "a spread over n seeds is itself uncertain by 1 in sqrt(2 (n - 1)), 35 % with five; clear is a ratio of "
        "two beyond its 95 % interval (F)",
    ),
    Claim(
        "A severely biased log degrades it",
        "V-D, last paragraph",
        _biased,
        "services of two devices are missing from the log: what the critic says of serving them is extrapolated",
    ),
)


def judged(results: Results) -> list[tuple[Claim, Finding]]:
    """Every claim with what is said of it."""
    found = []
    for claim in CLAIMS:
        try:
            found.append((claim, claim.judge(results)))
        except _MissingRuns as missing:
            found.append((claim, Finding(f"{missing}: not computed", MISSING)))
    return found


def counted(found: Sequence[tuple[Claim, Finding]]) -> str:
    """How many claims have each verdict."""
    counts = {verdict: sum(finding.verdict == verdict for _, finding in found) for verdict in _VERDICTS}
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)


def table(found: Sequence[tuple[Claim, Finding]]) -> list[list[str]]:
    """A header, then a line a claim, numbered."""
    lines = [["", "claim", "where", "measured", "verdict", "why"]]
    for number, (claim, finding) in enumerate(found, start=1):
        lines.append([str(number), claim.text, claim.where, finding.measured, finding.verdict, claim.why])
    return lines


_VERDICTS = (HOLDS, FAILS, READING, OPEN, MISSING)
