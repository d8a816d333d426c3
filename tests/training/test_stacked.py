from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.training.test_offline import config, flown, mapped, quiet, rows  # noqa: F401  # two of them are fixtures
from uavrl.datasets import MappedTransitions, Transitions
from uavrl.errors import ConfigError, DivergenceError
from uavrl.training.checkpoint import load_checkpoint
from uavrl.training.offline import OfflineLearner
from uavrl.training.policy import AgentPolicy
from uavrl.training.stacked import StackedLearner

SEEDS = (3, 4)


def learners(transitions: Transitions, **changes: Any) -> list[OfflineLearner]:
    return [OfflineLearner(config(seed=seed, **changes), transitions) for seed in SEEDS]


def near(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    """All but a few entries: where a gradient is rounding error alone Adam makes a whole step of it."""
    assert first.keys() == second.keys()
    for name, value in first.items():
        far = (value.double() - second[name].double()).abs() > 1e-4
        assert far.double().mean() < 0.03, name


@pytest.mark.parametrize("kind", ["mlp", "devices"])
def test_seeds_in_a_stack_end_as_each_would_alone(tmp_path: Path, flown: Transitions, kind: str) -> None:  # noqa: F811
    for learner in learners(flown, kind=kind):
        learner.run(tmp_path / f"alone{learner.config.seed}", quiet)
    places = [tmp_path / f"stacked{seed}" for seed in SEEDS]
    policies = StackedLearner(learners(flown, kind=kind)).run(places, quiet)
    for seed, place, policy in zip(SEEDS, places, policies, strict=True):
        alone = load_checkpoint(tmp_path / f"alone{seed}" / "checkpoint")
        stacked = load_checkpoint(place / "checkpoint")
        documents = [one.document | {"files": None} for one in (alone, stacked)]
        assert documents[0] == documents[1]
        for file in ("networks", "optimisers"):
            near(stacked.tensors[file], alone.tensors[file])
        assert torch.equal(stacked.tensors["loop"]["generator"], alone.tensors["loop"]["generator"])
        weights = policy.agent.networks.state_dict()
        assert all(torch.equal(value, stacked.tensors["networks"][name]) for name, value in weights.items())
        logged, expected = rows(place), rows(tmp_path / f"alone{seed}")
        assert [row["step"] for row in logged] == [2, 4, 6, 8, 10, 12]
        for mine, theirs in zip(logged, expected, strict=True):
            assert mine == pytest.approx(theirs, rel=0.02, abs=2e-3)


def test_a_stopped_stack_goes_on_as_a_stack_or_one_by_one(
    tmp_path: Path,
    flown: Transitions,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = [tmp_path / f"whole{seed}" for seed in SEEDS]
    StackedLearner(learners(flown)).run(whole, quiet)
    for way in ("stack", "single"):
        places = [tmp_path / f"{way}{seed}" for seed in SEEDS]
        stopping = StackedLearner(learners(flown))

        def stop(done: int, text: str) -> None:
            if done == 7:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            stopping.run(places, stop)
        again = [OfflineLearner.resume(place, flown) for place in places]
        found = [one for one in again if one is not None]
        assert [one.updates for one in found] == [5, 5]  # the last checkpoint before
        if way == "stack":
            StackedLearner(found).run(places, quiet)
        else:
            for one, place in zip(found, places, strict=True):
                one.run(place, quiet)
        for place, expected in zip(places, whole, strict=True):
            near(
                load_checkpoint(place / "checkpoint").tensors["networks"],
                load_checkpoint(expected / "checkpoint").tensors["networks"],
            )
            assert [row["step"] for row in rows(place)] == [2, 4, 6, 8, 10, 12]


def test_mapped_data_train_stacked_as_in_memory(
    tmp_path: Path,
    flown: Transitions,  # noqa: F811
    mapped: MappedTransitions,  # noqa: F811
) -> None:
    stacks = [StackedLearner(learners(data)) for data in (flown, mapped)]
    for _ in range(3):
        first, second = (stack.step() for stack in stacks)
        assert first == second
    for one, other in zip(stacks[0].learners, stacks[1].learners, strict=True):
        assert one.digest == other.digest
        assert torch.equal(one.generator.get_state(), other.generator.get_state())


def test_each_seed_is_flown_and_judged_by_itself(tmp_path: Path, flown: Transitions) -> None:  # noqa: F811
    seen: list[int] = []
    stack = StackedLearner(learners(flown, evaluate_every=6))
    agents = [learner.agent for learner in stack.learners]

    def evaluate(policy: AgentPolicy) -> dict[str, float]:
        seen.append(agents.index(policy.agent))
        return {"return": float(len(seen))}

    places = [tmp_path / f"{seed}" for seed in SEEDS]
    stack.run(places, quiet, evaluate)
    assert seen == [0, 1, 0, 1]
    assert [[row["return"] for row in rows(place) if "return" in row] for place in places] == [[1.0, 3.0], [2.0, 4.0]]


@pytest.mark.parametrize(("spoiled_at", "found_at"), [(7, 8), (9, 10)])  # where it is logged, where it is saved
def test_one_seed_that_diverges_stops_all_and_harms_nothing(
    tmp_path: Path,
    flown: Transitions,  # noqa: F811
    spoiled_at: int,
    found_at: int,
) -> None:
    stack = StackedLearner(learners(flown))
    places = [tmp_path / f"{seed}" for seed in SEEDS]

    def spoil(done: int, text: str) -> None:
        if done == spoiled_at:
            stack.stack.tensors["critic.first.trunk.token.weight"].data[1].fill_(float("nan"))

    with pytest.raises(DivergenceError, match=rf"after {found_at} updates; '.*4/checkpoint' keeps update 5, the last"):
        stack.run(places, spoil)
    assert [load_checkpoint(place / "checkpoint").document["step"] for place in places] == [5, 5]
    assert [rows(place)[-1]["step"] for place in places] == [found_at - 2] * 2


def test_runs_that_make_no_stack_are_refused(flown: Transitions) -> None:  # noqa: F811
    first, second = learners(flown)
    with pytest.raises(ConfigError, match="differ in more than their seed"):
        StackedLearner([first, OfflineLearner(config(seed=4, updates=11), flown)])
    with pytest.raises(ConfigError, match="different data"):
        StackedLearner([first, OfflineLearner(config(seed=4), flown.take(slice(0, 30)))])
    with pytest.raises(ConfigError, match="agent = 'bc', allowed for a stack of seeds: 'diffusion_sac'"):
        StackedLearner(learners(flown, name="bc"))
    second.step()
    with pytest.raises(ConfigError, match="seed 3 stands at update 0, seed 4 at 1"):
        StackedLearner([first, second])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_stack_learns_on_a_gpu_what_each_learns_alone_there(flown: Transitions) -> None:  # noqa: F811
    alone, stacked = ([OfflineLearner(config(seed=seed), flown, "cuda") for seed in SEEDS] for _ in range(2))
    stack = StackedLearner(stacked)
    for _ in range(3):
        expected, found = [learner.step() for learner in alone], stack.step()
    for mine, theirs in zip(found, expected, strict=True):
        assert {k: float(v) for k, v in mine.items()} == pytest.approx(
            {k: float(v) for k, v in theirs.items()}, rel=0.02, abs=2e-3
        )
