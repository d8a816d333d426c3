"""The paper's experiments as data: protocols, scales, and for each figure the runs that it is drawn from.

A run learns once and is drawn in every figure that asks for it. What a figure looks like is in `plots`, what the runs
say about the paper's sentences in `claims`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from uavrl.agents.registry import acts_best_deterministically, changed, preset
from uavrl.agents.sac import SacConfig
from uavrl.experiments.flights import Data, Setting
from uavrl.experiments.runner import Run
from uavrl.scenario import Scenario, load_scenario
from uavrl.training.scenario_settings import for_scenario

OURS = "Diffusion-SAC"
ALGORITHMS = {OURS: "diffusion_sac", "CQL": "cql", "IQL": "iql", "BCQ": "bcq", "BC": "bc"}
YARDSTICK, ROUND_ROBIN = "planner", "TDM"
REFERENCES = {
    ROUND_ROBIN: "tdm",
    "Saver": "saver",
    "random walk": "random_walk",
    "index at best hover": "hover",
    YARDSTICK: "planner",
}
ONLINE = "online SAC"


@dataclass(frozen=True)
class Scale:
    """How much is computed."""

    updates: int  # gradient steps of the headline comparison, with our settings
    sweep_updates: int  # of everything else
    published_updates: int  # with the paper's settings: it has 70,000, 150 passes over 30,000 rows in batches of 64
    headline_seeds: int
    sweep_seeds: int
    online_flights: int
    episodes: int
    fading_seeds: int
    points: int  # of a learning curve
    sizes: tuple[int, ...]
    denoising_steps: tuple[int, ...]
    age_weights: tuple[float, ...]
    max_steps: int | None = None  # of a flight; None: the scenario's own


SCALES = {
    "smoke": Scale(10, 10, 4, 2, 1, 2, 4, 1, 2, (500, 1_000), (2, 5), (0.1, 0.9), 20),
    "standard": Scale(
        4_000, 2_000, 4_000, 5, 2, 700, 100, 3, 8, (10_000, 30_000, 50_000), (5, 10, 20, 50), (0.1, 0.5, 0.9)
    ),
    "full": Scale(
        12_000,
        12_000,
        70_000,
        5,
        5,
        700,
        100,
        10,
        6,
        (10_000, 20_000, 30_000, 40_000, 50_000),
        (5, 10, 15, 20, 30, 40, 50),
        (0.1, 0.3, 0.5, 0.7, 0.9),
    ),
}


class Protocol(NamedTuple):
    """Where algorithms meet: scenario, layouts, data, and whose settings they bring."""

    name: str  # as claims call it
    title: str
    scenario: Scenario
    layouts: Literal["fixed", "random"]
    data: str
    preset: Literal["default", "paper"]

    def deterministic(self, algorithm: str) -> bool:
        """Which action is judged: the one that the algorithm's class says is its best; in the paper a sample."""
        return self.preset == "default" and acts_best_deterministically(preset(ALGORITHMS[algorithm], self.preset))


PROTOCOLS = {
    "layouts": Protocol(
        "unseen layouts",
        "unseen layouts, set network, our settings, scenario released",
        load_scenario("released"),
        "random",
        "layouts",
        "default",
    ),
    "published": Protocol(
        "as published",
        "one layout, the paper's perceptron and settings, scenario released",
        load_scenario("released"),
        "fixed",
        "fixed",
        "paper",
    ),
    "paper-objective": Protocol(
        "scenario paper",
        "unseen layouts, set network, our settings, scenario paper",
        load_scenario("paper"),
        "random",
        "layouts",
        "default",
    ),
    "realistic": Protocol(
        "scenario realistic",
        "unseen layouts, set network, our settings, scenario realistic",
        load_scenario("realistic"),
        "random",
        "realistic",
        "default",
    ),
}
PRIORITIES = (0.25, 0.25, 0.25) + (0.25 / 7,) * 7  # three devices of ten weigh three quarters
# Fewest of BCQ's authors' 10 to 100 actions at a decision: its flights would take longer than its training
CHEAPER = {"BCQ": {"candidates": 10}}
STARVED = (1, 2)  # devices whose services the biased log lacks


class Plan:
    """The runs of one scale."""

    def __init__(self, scale: Scale) -> None:
        self.scale = scale

    def learned(
        self,
        algorithm: str,
        protocol: Protocol,
        *,
        headline: bool = False,
        curve: bool = True,
        variant: str | None = None,
        changes: Mapping[str, Any] | None = None,
        data: Mapping[str, Any] | None = None,
    ) -> list[Run]:
        """One algorithm under a protocol with training seeds from 0 on.

        Args:
            algorithm: name of `ALGORITHMS`.
            protocol: where.
            headline: with the seeds and updates of the headline comparison, not of a sweep.
            curve: fly while learning too, which takes a third of a sweep's time; False where nobody draws it.
            variant: what a figure calls it; by default the algorithm.
            changes: of its settings.
            data: fields of `Data` that differ from 30,000 mixed rows of the protocol's log.
        """
        every = CHEAPER.get(algorithm, {}) | dict(changes or {})
        agent = changed(preset(ALGORITHMS[algorithm], protocol.preset), every)
        if protocol.preset == "default":
            agent = for_scenario(agent, protocol.scenario)
        agent = changed(agent, {"shortest_move": 0.0})  # compared with every move flown; held: results/layouts
        settings = agent.model_dump(mode="json")
        rows = Data(**{"name": protocol.data, "size": self.size, **(data or {})})
        options = self._setting(protocol, rows, protocol.deterministic(algorithm), curve)
        updates = self.scale.updates if headline else self.scale.sweep_updates
        if protocol.preset == "paper":
            updates = self.scale.published_updates
        return [
            Run(
                problem="offline",
                variant=variant or algorithm,
                settings=settings,
                updates=updates,
                seed=seed,
                options=options,
            )
            for seed in range(self.scale.headline_seeds if headline else self.scale.sweep_seeds)
        ]

    @property
    def size(self) -> int:
        """Rows of the usual log, the paper's 30,000 where the scale has as many."""
        return min(30_000, max(self.scale.sizes))

    def _setting(
        self, protocol: Protocol, data: Data | None = None, deterministic: bool = True, curve: bool = True
    ) -> dict[str, Any]:
        scenario = protocol.scenario
        if self.scale.max_steps is not None:
            scenario = scenario.replace(max_steps=self.scale.max_steps)
        return Setting(
            scenario=scenario,
            layouts=protocol.layouts,
            data=data,
            deterministic=deterministic,
            episodes=self.scale.episodes,
            fading_seeds=self.scale.fading_seeds,
            points=self.scale.points if curve else 0,
        ).model_dump(mode="json")

    def references(self, protocol: Protocol) -> list[Run]:
        """What needs no learning, in the same environments."""
        options = self._setting(protocol)
        return [
            Run(problem="policy", variant=name, settings={"policy": policy}, updates=0, seed=0, options=options)
            for name, policy in REFERENCES.items()
        ]

    def online(self) -> list[Run]:
        """The paper's first figure."""
        protocol = PROTOCOLS["published"]
        options = self._setting(protocol)
        settings = SacConfig().model_dump(mode="json")
        flights = self.scale.online_flights
        return self.references(protocol) + [
            Run(problem="online", variant=ONLINE, settings=settings, updates=flights, seed=seed, options=options)
            for seed in range(self.scale.sweep_seeds)
        ]

    def comparison(self, protocol: Protocol) -> list[Run]:
        """Every algorithm on equal data; the headline is of `released`, beside it stand the other two scenarios."""
        headline = protocol.scenario.name == "released"
        short = protocol.scenario.limits.max_steps is not None  # elsewhere a flight takes four times as many steps
        learned = [run for name in ALGORITHMS for run in self.learned(name, protocol, headline=headline, curve=short)]
        return self.references(protocol) + learned

    def variants(self, protocol: Protocol) -> list[Run]:
        """The six (alpha, eta)."""
        every = []
        for alpha in (0.0, 1.0):
            for eta in (0.0, 0.5, 1.0):
                changes = {"cql_weight": alpha, "bc_weight": eta}
                name = f"alpha = {alpha:g}, eta = {eta:g}"
                every += self.learned(OURS, protocol, variant=name, changes=changes)
        own = self.learned(OURS, protocol, variant="our settings")
        return self.references(protocol) + every + (own if protocol.preset == "default" else [])

    def sizes(self, protocol: Protocol) -> list[Run]:
        """Rows to learn from; with as many as usual these are the runs of the other figures, curves and all."""
        return self._over_data(protocol, {f"{size:,}": {"size": size} for size in self.scale.sizes})

    def qualities(self, protocol: Protocol) -> list[Run]:
        """As many rows of the last third of the log and of the first."""
        rows = self.size // 2
        return self._over_data(protocol, {name: {"size": rows, "quality": name} for name in ("good", "bad")})

    def _over_data(self, protocol: Protocol, choices: Mapping[str, Mapping[str, Any]]) -> list[Run]:
        return self.references(protocol) + [
            run
            for label, data in choices.items()
            for name in ALGORITHMS
            for run in self.learned(
                name, protocol, variant=f"{name} @ {label}", data=data, curve=data == {"size": self.size}
            )
        ]

    def denoising(self, protocol: Protocol) -> list[Run]:
        """Steps M of the chain, under two noise schedules; the baselines beside them."""
        found = self.references(protocol)
        for name in list(ALGORITHMS)[1:]:
            found += self.learned(name, protocol)
        for schedule in ("linear", "vp"):
            for steps in self.scale.denoising_steps:
                changes = {"diffusion": {"schedule": schedule, "steps": steps}}
                variant = f"{schedule} @ {steps}"
                found += self.learned(OURS, protocol, variant=variant, changes=changes, curve=False)
        return found

    def age_weights(self) -> list[Run]:
        """Lambda, from age alone to energy alone: rewards relabelled from the logged terms."""
        found = []
        for weight in self.scale.age_weights:
            base = PROTOCOLS["paper-objective"]
            protocol = base._replace(scenario=base.scenario.replace(age_weight=weight))
            for name in ALGORITHMS:
                compared = weight == base.scenario.objective.age_weight  # those are the comparison's runs
                found += self.learned(name, protocol, variant=f"{name} @ {weight:g}", curve=compared)
        return found

    def priorities(self) -> list[Run]:
        """Devices that matter more than others."""
        base = PROTOCOLS["layouts"]
        protocol = base._replace(scenario=base.scenario.replace(priority=PRIORITIES))
        learned = [run for name in ALGORITHMS for run in self.learned(name, protocol, curve=False)]
        return self.references(protocol) + learned

    def biased(self) -> list[Run]:
        """A log in which two devices are never served."""
        protocol = PROTOCOLS["published"]._replace(preset="default")
        choices = {"whole log": {}, "two devices never served": {"never_served": STARVED}}
        return self._over_data(protocol, choices)


class Figure(NamedTuple):
    """A figure of the paper, or beside it."""

    title: str
    runs: Callable[[Plan], list[Run]]
    kind: Literal["curves", "lines", "bars", "front", "fairness", "rates"]
    axis: str = ""  # what stands behind the @ of a variant


def _at(method: Callable[[Plan, Protocol], list[Run]], protocol: str) -> Callable[[Plan], list[Run]]:
    return lambda plan: method(plan, PROTOCOLS[protocol])


# file's name -> figure; in the order in which they are computed
FIGURES: dict[str, Figure] = {
    "comparison": Figure("Offline algorithms, unseen layouts", _at(Plan.comparison, "layouts"), "curves"),
    "comparison-published": Figure("Offline algorithms, as published", _at(Plan.comparison, "published"), "curves"),
    "rates": Figure("Transmission time and data", _at(Plan.comparison, "layouts"), "rates"),
    "fairness": Figure("Fairness", _at(Plan.comparison, "layouts"), "fairness"),
    "online": Figure("Online SAC and the heuristics", Plan.online, "curves"),
    "variants": Figure("Weights of the penalty and of cloning", _at(Plan.variants, "layouts"), "curves"),
    "sizes": Figure("Rows to learn from", _at(Plan.sizes, "layouts"), "lines", "rows"),
    "quality": Figure("Good and bad logs", _at(Plan.qualities, "layouts"), "bars", "log"),
    "denoising": Figure("Denoising steps", _at(Plan.denoising, "layouts"), "lines", "denoising steps M"),
    "biased": Figure("A severely biased log", Plan.biased, "bars", "log"),
    "comparison-paper": Figure("Offline algorithms, scenario paper", _at(Plan.comparison, "paper-objective"), "curves"),
    "comparison-realistic": Figure("Offline algorithms, scenario realistic", _at(Plan.comparison, "realistic"), "bars"),
    "lambda": Figure("Age against energy", Plan.age_weights, "front", "lambda"),
    "priorities": Figure("Unequal priorities", Plan.priorities, "fairness"),
    "variants-published": Figure(
        "Weights of the penalty and of cloning, as published", _at(Plan.variants, "published"), "curves"
    ),
    "sizes-published": Figure("Rows to learn from, as published", _at(Plan.sizes, "published"), "lines", "rows"),
    "quality-published": Figure("Good and bad logs, as published", _at(Plan.qualities, "published"), "bars", "log"),
}


def wanted(scale: Scale, figures: Iterable[str] = tuple(FIGURES)) -> dict[str, list[Run]]:
    """Each figure's runs; one seed of all first, since a figure is drawn from the seeds that all of them have."""
    plan = Plan(scale)
    return {name: sorted(FIGURES[name].runs(plan), key=lambda run: run.seed) for name in figures}
