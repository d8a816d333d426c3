"""The paper's claims, one by one: where each stands, what was measured, whether it holds, and why.

How they are judged is in `judges`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from uavrl.experiments import judges
from uavrl.experiments.judges import BASELINES, FAILS, HOLDS, MISSING, OPEN, READING, Finding, Results
from uavrl.experiments.paper import OURS


class Claim(NamedTuple):
    """A sentence of the paper; `why` is what the model and our settings say of it, whatever was measured."""

    text: str
    where: str
    judge: judges.Judge
    why: str


_COMPARISONS = ("comparison", "comparison-published", "comparison-paper", "comparison-realistic")
_VARIANTS = ("variants", "variants-published")
_BEST = "alpha = 0, eta = 0.5"

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "Online SAC significantly outperforms TDM, Saver and random walk",
        "V-C, Fig. Online_perf a",
        judges.online("return", 1.0),
        "TDM stays where it starts, Saver keeps to one device, the walk knows nothing: none of them chooses a place "
        "and a device",
    ),
    Claim(
        "... with a lower age than all three",
        "V-C, Fig. Online_perf b",
        judges.online("age_per_step_s", -1.0),
        "Saver resets the age of one device; the others' grow for the whole flight",
    ),
    Claim(
        "... and a lower energy than all three",
        "V-C, Fig. Online_perf c",
        judges.online("energy_per_step_j", -1.0),
        "Saver never moves and serves for ever the device that is nearest to where it starts; the others' ages are the "
        "price",
    ),
    Claim(
        "Diffusion-SAC achieves the highest return, ahead of CQL, IQL and BCQ",
        "Abstract; V-D, Fig. Baselines a",
        judges.readings(*(judges.beats(figure, "return", 1.0, BASELINES, "") for figure in _COMPARISONS)),
        "what the published settings lack: docs/what-matters.md. Under scenario paper energy outweighs age 2 to 1 "
        "at a good hover, so idling pays (docs/model.md). Under realistic our preset learns slowly: after 12,000 "
        "updates four seeds of five are clear of TDM (results/realistic)",
    ),
    Claim(
        "Diffusion-SAC has the lowest age",
        "V-D, Fig. Baselines b",
        judges.readings(
            *(
                judges.beats(figure, judges.per(figure, "age_per_step_s", "age_per_second_s"), -1.0, BASELINES, " s")
                for figure in _COMPARISONS
            )
        ),
        "as the return, of which age is nearly all under released (500 to 1, docs/model.md)",
    ),
    Claim(
        "Diffusion-SAC has the lowest energy",
        "V-D, Fig. Baselines c",
        judges.readings(
            *(
                judges.beats(
                    figure, judges.per(figure, "energy_per_step_j", "energy_per_episode_j"), -1.0, BASELINES, " J"
                )
                for figure in _COMPARISONS
            )
        ),
        "energy is a 500th of the return under released (docs/model.md): what an algorithm spends there is what its "
        "ages happen to leave",
    ),
    Claim(
        "BCQ < IQL, CQL < Diffusion-SAC",
        "V-D, Fig. Baselines a",
        judges.readings(*map(judges.order, _COMPARISONS)),
        "the baselines' settings were tuned here, too, each in 3 to 8 trials, ours in many more (results/quality); the "
        "paper does not say how its were found",
    ),
    Claim(
        "IQL and CQL perform comparably",
        "V-D, Fig. Baselines a",
        judges.readings(*(judges.comparable(figure, "IQL", "CQL") for figure in _COMPARISONS)),
        "comparable: within 5 % of the cost",
    ),
    Claim(
        "IQL and CQL fall short of the optimal policy, Diffusion-SAC does not",
        "V-D",
        judges.near_planner,
        "the optimum is not known: the planner, which knows the physics, stands for it, and within 5 % of its cost "
        "is not short of it",
    ),
    Claim(
        "35 % more throughput",
        "Abstract; V-D; VI",
        judges.readings(*map(judges.throughput, _COMPARISONS[:2])),
        "a step sends one packet of 2 Mbit at most, so throughput is that over a step's mean time: 35 % more needs "
        "steps shorter by 1 - 1/1.35, a quarter, of policies that serve at every step",
    ),
    Claim(
        "0.15 s to send a packet",
        "V-D, Fig. Rates a",
        judges.readings(*map(judges.packet, _COMPARISONS[:2])),
        "2 Mbit in 0.15 s are 13.3 Mbit/s over 1 MHz; without fading a packet takes 0.108 s overhead, 0.124 s from "
        "200 m and 0.179 s from 406 m (docs/model.md), and the devices lie over 1 km",
    ),
    Claim(
        "More than 0.65 GB in one episode",
        "V-D, Fig. Rates b",
        judges.data,
        "400 steps of one 2 Mbit packet are at most 0.1 GB, whatever the policy; 400 s / 0.15 s x 2 Mbit = 0.67 GB "
        "where an episode lasts 400 s and neither decisions nor moves take time",
    ),
    Claim(
        "alpha = 0, eta = .5 is the best variant",
        "V-D, Fig. diff_only a",
        judges.readings(*(judges.variant(figure, _BEST) for figure in _VARIANTS)),
        "guidance cost more than it brought after 2,000 updates on one layout (two seeds) and was worth 11 after 4,000 "
        "on many (one seed): docs/what-matters.md, What guidance is worth",
    ),
    Claim(
        "... also in age",
        "V-D, Fig. diff_only b",
        judges.readings(*(judges.variant(figure, _BEST, "age_per_step_s", -1.0) for figure in _VARIANTS)),
        "as the return, of which age is nearly all",
    ),
    Claim(
        "... and in energy",
        "V-D, Fig. diff_only c",
        judges.readings(*(judges.variant(figure, _BEST, "energy_per_step_j", -1.0) for figure in _VARIANTS)),
        "energy is a 500th of the return (docs/model.md)",
    ),
    Claim(
        "alpha = 0, eta = 0 is competitive",
        "V-D",
        judges.readings(*map(judges.competitive, _VARIANTS)),
        "competitive: at most 10 % more cost",
    ),
    Claim(
        "CQL over-constrains: alpha = 1 is worse, with cloning or without",
        "V-D",
        judges.readings(*map(judges.penalty, _VARIANTS)),
        "our penalty is on the choice of device alone, and its default a weak one, which keeps long trainings from "
        "idling (docs/what-matters.md, a rare choice)",
    ),
    Claim(
        "Cloning alone (alpha = 0, eta = 1) is worse on a mixed log",
        "V-D",
        judges.readings(*map(judges.imitation, _VARIANTS)),
        "with our settings the critic has its say in the device at a decision, whatever eta is: only the move is a "
        "clone's",
    ),
    Claim(
        "10 k rows are as good as 50 k for Diffusion-SAC",
        "V-D, Fig. Datasets a",
        judges.readings(judges.sizes("sizes", (OURS,), True), judges.sizes("sizes-published", (OURS,), True)),
        "nearly identical: within 5 % of the cost. Rows are drawn one by one from the log of a whole training, so "
        "10,000 come from as many flights as 50,000",
    ),
    Claim(
        "CQL, IQL and BCQ degrade significantly with fewer rows",
        "V-D, Fig. Datasets a",
        judges.readings(
            judges.sizes("sizes", BASELINES, False),
            judges.sizes("sizes-published", BASELINES, False),
        ),
        "significantly: clear of 5 % of the cost; rows as above",
    ),
    Claim(
        "On a bad log CQL is relatively strong",
        "V-D, Fig. Datasets c",
        judges.quality("bad", "", "CQL", ("IQL", "BCQ")),
        "good and bad are rows of the last and of the first third of one learner's log, half as many as usual",
    ),
    Claim(
        "... and fails to exploit a good one",
        "V-D, Fig. Datasets b",
        judges.quality("bad", "good", "CQL", ("IQL", "BCQ")),
        "as above",
    ),
    Claim(
        "BCQ is better than CQL on a good log and worse on a bad one",
        "V-D, Fig. Datasets b, c",
        judges.quality("good", "bad", "BCQ", ("CQL",)),
        "as above",
    ),
    Claim(
        "Diffusion-SAC is ahead of the baselines on a bad log, too",
        "V-D, Fig. Datasets c",
        judges.quality("bad", "", OURS, BASELINES),
        "as above",
    ),
    Claim(
        "Fewer than 10 denoising steps fail to surpass the baselines",
        "V-D, Fig. Denoising_steps a",
        judges.steps(True),
        "judged by the deterministic action; few steps blur several modes of a log into one (docs/what-matters.md, "
        "the hybrid bandit)",
    ),
    Claim(
        "More than 20 steps outperform all baselines",
        "V-D, Fig. Denoising_steps a",
        judges.steps(False),
        "judged by the largest M",
    ),
    Claim(
        "Decision time grows linearly with the steps",
        "V-D, Fig. Denoising_steps b",
        judges.linear_time,
        "a decision is M passes of one network, and what is done once: the observation's part of them, and Q; linear: "
        "within 10 % of the longest time",
    ),
    Claim(
        "2 ms a decision for the baselines, 12 ms for Diffusion-SAC",
        "V-D, Fig. Denoising_steps b",
        judges.times,
        "theirs are of a V100, these of one CPU core, M = 20 for 'more than 20'; on either, M passes cost M times one",
    ),
    Claim(
        "lambda does not change the order of the algorithms",
        "V-D",
        judges.same_order,
        "judged by ours being ahead at each lambda. Scenario paper with another lambda: at a good hover energy "
        "outweighs age 2 to 1 at .5, so 18 to 1 at .1 and 2 to 9 at .9",
    ),
    Claim(
        "Fairness among devices improves",
        "Abstract; VI",
        judges.fair,
        "judged by the worst device: an index near 1 can also mean that all devices are equally old",
    ),
    Claim(
        "More stable than the baselines",
        "Abstract; VI",
        judges.stable,
        "a spread over n seeds is itself uncertain by 1 in sqrt(2 (n - 1)), 35 % with five; clear is a ratio of "
        "two beyond its 95 % interval (F)",
    ),
    Claim(
        "A severely biased log degrades it",
        "V-D, last paragraph",
        judges.biased,
        "services of two devices are missing from the log; a network over the set of devices sees where a device is "
        "and how old its news are, not its number, so what it learned of the others holds for them",
    ),
)


def judged(results: Results) -> list[tuple[Claim, Finding]]:
    """Every claim with what is said of it."""
    found = []
    for claim in CLAIMS:
        try:
            found.append((claim, claim.judge(results)))
        except judges.MissingRuns as missing:
            found.append((claim, Finding(f"{missing}: not computed", MISSING)))
    return found


def counted(found: Sequence[tuple[Claim, Finding]]) -> str:
    """How many claims have each verdict."""
    counts = {verdict: sum(finding.verdict == verdict for _, finding in found) for verdict in _VERDICTS}
    return ", ".join(f"{verdict}: {count}" for verdict, count in counts.items() if count)


def table(found: Sequence[tuple[Claim, Finding]]) -> list[list[str]]:
    """A header, then a line a claim, numbered."""
    lines = [["", "claim", "where", "measured", "verdict", "why"]]
    for number, (claim, finding) in enumerate(found, start=1):
        lines.append([str(number), claim.text, claim.where, finding.measured, finding.verdict, claim.why])
    return lines


_VERDICTS = (HOLDS, FAILS, READING, OPEN, MISSING)
