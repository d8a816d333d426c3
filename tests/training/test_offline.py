from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.agents.problems import CONFIGS, copies, equal, network
from tests.datasets.flights import fly, small_scenario
from uavrl.actions import HybridAction
from uavrl.agents.base import Batch, Metrics
from uavrl.agents.bc import BcConfig
from uavrl.agents.diffusion_actor import DiffusionConfig
from uavrl.agents.diffusion_sac import DiffusionSacConfig
from uavrl.agents.registry import preset
from uavrl.datasets import MappedTransitions, Transitions, load_builtin, save_mapped
from uavrl.errors import CheckpointError, ConfigError, DivergenceError
from uavrl.scenario import load_scenario
from uavrl.training.checkpoint import agent_tensors, load_checkpoint
from uavrl.training.offline import OfflineLearner, TrainConfig
from uavrl.training.policy import AgentPolicy, load_policy
from uavrl.training.scenario_settings import for_scenario

SCENARIO = small_scenario()
CHAIN = DiffusionConfig(steps=2)


def config(name: str = "diffusion_sac", kind: str = "devices", **changes: Any) -> TrainConfig:
    shape = network("mlp" if kind == "mlp" else "devices", width=8)
    common: dict[str, Any] = {"network": shape, "diffusion": CHAIN, "batch_size": 8} | changes.pop("agent", {})
    agent = BcConfig(**common) if name == "bc" else DiffusionSacConfig(**common)
    settings = {"updates": 12, "log_every": 2, "save_every": 5, "seed": 3, **changes}
    return TrainConfig(scenario=SCENARIO, agent=agent, **settings)


@pytest.fixture(scope="module")
def flown() -> Transitions:
    return fly(SCENARIO, steps=20)


@pytest.fixture(scope="module")
def mapped(flown: Transitions, tmp_path_factory: pytest.TempPathFactory) -> MappedTransitions:
    """The same rows on disk."""
    return save_mapped(tmp_path_factory.mktemp("data") / "flown.mapped", [flown], SCENARIO)


def quiet(done: int, text: str) -> None:
    """A reporter that says nothing."""


def rows(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]


def interrupt_at(step: int) -> Any:
    def report(done: int, text: str) -> None:
        if done == step:
            signal.raise_signal(signal.SIGINT)

    return report


@pytest.mark.parametrize(("name", "kind"), [("diffusion_sac", "devices"), ("diffusion_sac", "mlp"), ("bc", "devices")])
def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path: Path, flown: Transitions, name: str, kind: str) -> None:
    straight = OfflineLearner(config(name, kind), flown)
    straight.run(tmp_path / "straight", quiet)
    broken = OfflineLearner(config(name, kind), flown)
    with pytest.raises(KeyboardInterrupt):
        broken.run(tmp_path / "broken", interrupt_at(6))
    assert load_checkpoint(tmp_path / "broken" / "checkpoint").document["step"] == 7  # the step after was finished
    resumed = OfflineLearner.resume(tmp_path / "broken", flown)
    assert resumed is not None
    assert resumed.config == config(name, kind)
    resumed.run(tmp_path / "broken", quiet)
    assert equal(copies(resumed.agent.networks), copies(straight.agent.networks))
    assert equal(agent_tensors(resumed.agent)["optimisers"], agent_tensors(straight.agent)["optimisers"])
    assert rows(tmp_path / "broken") == rows(tmp_path / "straight")
    ended = [load_checkpoint(tmp_path / run / "checkpoint") for run in ("straight", "broken")]
    assert ended[0].document == ended[1].document
    assert all(equal(ended[0].tensors[name], ended[1].tensors[name]) for name in ended[0].tensors)


def test_a_killed_run_goes_on_from_its_last_checkpoint_and_ends_the_same(tmp_path: Path, flown: Transitions) -> None:
    straight = OfflineLearner(config(), flown)
    straight.run(tmp_path / "straight", quiet)

    def kill(done: int, text: str) -> None:
        if done == 8:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        OfflineLearner(config(), flown).run(tmp_path / "killed", kill)
    assert rows(tmp_path / "killed")[-1]["step"] == 8
    resumed = OfflineLearner.resume(tmp_path / "killed", flown)
    assert resumed is not None
    assert resumed.updates == 5
    resumed.run(tmp_path / "killed", quiet)
    assert equal(copies(resumed.agent.networks), copies(straight.agent.networks))
    assert rows(tmp_path / "killed") == rows(tmp_path / "straight")


def test_one_seed_one_result_and_no_global_generator(tmp_path: Path, flown: Transitions) -> None:
    before = torch.random.get_rng_state()
    found: list[Any] = []
    for seed in (3, 3, 4):
        learner = OfflineLearner(config(seed=seed, updates=2), flown)
        learner.run(tmp_path / str(len(found)), quiet)
        found.append(copies(learner.agent.networks))
    assert equal(found[0], found[1])
    assert not equal(found[0], found[2])
    assert torch.equal(torch.random.get_rng_state(), before)


def test_the_learning_rate_falls_on_a_cosine_and_the_log_has_every_row(tmp_path: Path, flown: Transitions) -> None:
    learner = OfflineLearner(config(), flown)
    rates = []

    def report(done: int, text: str) -> None:
        rates.append(learner.agent.optimisers["critic"].param_groups[0]["lr"])

    learner.run(tmp_path, report)
    expected = learner.config.agent.learning_rate * 0.5 * (1 + np.cos(np.pi * np.arange(12) / 12))
    np.testing.assert_allclose(rates, expected, rtol=1e-6)
    assert [row["step"] for row in rows(tmp_path)] == [2, 4, 6, 8, 10, 12]
    assert {"q", "bc_loss", "guided_q", "critic_gradient", "actor_gradient"} <= set(rows(tmp_path)[0])


def test_an_agent_knows_how_much_of_its_training_is_done_also_after_a_stop(tmp_path: Path, flown: Transitions) -> None:
    def knows(learner: OfflineLearner) -> list[float]:
        told: list[float] = []
        update = learner.agent.update

        def spy(batch: Batch, generator: torch.Generator) -> Metrics:
            told.append(learner.agent.progress)
            return update(batch, generator)

        learner.agent.update = spy  # type: ignore[method-assign]  # a spy
        return told

    learner = OfflineLearner(config(), flown)
    told = knows(learner)
    with pytest.raises(KeyboardInterrupt):
        learner.run(tmp_path, interrupt_at(7))
    resumed = OfflineLearner.resume(tmp_path, flown)
    assert resumed is not None
    then = knows(resumed)
    resumed.run(tmp_path, quiet)
    assert len(told) < 12
    np.testing.assert_allclose(told + then, np.arange(12) / 12)


def test_what_an_update_sees_is_a_row_of_the_data_as_a_whole(flown: Transitions) -> None:
    learner = OfflineLearner(config(agent={"reward": {"transform": "centred", "clip": 1.5, "scale": 2.0}}), flown)
    data, index = learner.sample, torch.tensor([5, 0, 5])
    reward = np.clip(2.0 * (flown.reward - np.median(flown.reward)), -1.5, 1.5)
    np.testing.assert_allclose(data.reward.numpy(), reward, rtol=1e-4, atol=1e-5)
    found = learner.data.take(index)
    assert isinstance(found.observation, dict)
    assert isinstance(data.observation, dict)
    assert isinstance(found.next_observation, dict)
    assert isinstance(data.next_observation, dict)
    for position, row in enumerate(index.tolist()):
        assert torch.equal(found.observation["devices"][position], data.observation["devices"][row])
        assert torch.equal(found.next_observation["uav"][position], data.next_observation["uav"][row])
        assert torch.equal(found.action.continuous[position], data.action.continuous[row])
        for name in ("reward", "duration_s", "terminated"):
            assert getattr(found, name)[position] == getattr(data, name)[row]
        assert found.action.choice[position] == data.action.choice[row]


def test_the_data_of_a_perceptron_set_its_normalisers(flown: Transitions) -> None:
    learner = OfflineLearner(config(kind="mlp"), flown)
    state = learner.agent.networks.state_dict()
    means = [value for name, value in state.items() if name.endswith("normaliser.mean")]
    assert len(means) == 4  # denoiser, its average, critic, target
    for mean in means:
        np.testing.assert_allclose(mean[:2].numpy(), flown.position_m.mean(axis=0), rtol=1e-3)


@pytest.mark.parametrize("sick", ["nan", "far"])
def test_divergence_stops_the_run_and_the_last_good_checkpoint_stays(
    tmp_path: Path, flown: Transitions, sick: str
) -> None:
    """Sick from update 6 on; the checkpoint of update 5 stays, though update 10 saves and no row is due before 30."""
    learner = OfflineLearner(config(log_every=100, updates=30), flown)
    real = learner.agent.update

    def update(*arguments: Any) -> dict[str, torch.Tensor]:
        metrics = real(*arguments)
        if learner.updates < 5:
            return metrics
        if sick == "nan":
            return metrics | {"critic_loss": torch.tensor(float("nan"))}
        return metrics | {"q": torch.tensor(-2.0 * learner.q_limit)}

    learner.agent.update = update  # type: ignore[method-assign,assignment]  # what a run that diverges does
    with pytest.raises(
        DivergenceError, match="diverged: " + ("critic_loss = nan" if sick == "nan" else "q = -")
    ) as error:
        learner.run(tmp_path, quiet)
    assert "\n" not in str(error.value)
    assert f"after 10 updates; '{tmp_path / 'checkpoint'}' keeps update 5, the last good one" in str(error.value)
    assert "smaller learning_rate or a larger bc_weight" in str(error.value)
    assert load_checkpoint(tmp_path / "checkpoint").document["step"] == 5
    assert load_policy(tmp_path, SCENARIO).name == "diffusion_sac"


@pytest.mark.parametrize("due", ["log_every", "save_every", "evaluate_every"])
def test_weights_that_are_not_finite_are_neither_saved_nor_flown(tmp_path: Path, flown: Transitions, due: str) -> None:
    """Though every metric of that update, taken before its step, is fine."""
    changes: dict[str, Any] = {"log_every": 100, "save_every": 100, "updates": 30, due: 3}
    learner = OfflineLearner(config("bc", **changes), flown)
    real, tried = learner.agent.update, list[AgentPolicy]()

    def evaluate(policy: AgentPolicy) -> dict[str, float]:
        tried.append(policy)
        return {"return": -1.0}

    def update(*arguments: Any) -> dict[str, torch.Tensor]:
        metrics = real(*arguments)
        with torch.no_grad():
            next(learner.agent.networks.parameters()).view(-1)[0] *= float("inf") if learner.updates == 2 else 1.0
        return metrics

    learner.agent.update = update  # type: ignore[method-assign,assignment]  # what a run that diverges does
    with pytest.raises(
        DivergenceError, match=r"weights actor\..* are not finite after 3 updates; no checkpoint had been"
    ):
        learner.run(tmp_path, quiet, evaluate)
    assert not (tmp_path / "checkpoint").exists()
    assert tried == []


def test_a_learning_rate_without_measure_is_found(tmp_path: Path, flown: Transitions) -> None:
    learner = OfflineLearner(
        config(updates=400, log_every=1, agent={"learning_rate": 1e6, "gradient_clip": None, "huber": None}), flown
    )
    with pytest.raises(DivergenceError, match="training diverged"):
        learner.run(tmp_path, quiet)


def test_data_of_another_number_of_devices_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"data have 2 devices, the scenario traffic.devices = 3"):
        OfflineLearner(config(), fly(small_scenario(devices=2), steps=5))


def test_a_device_that_is_not_there_is_refused(flown: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match="device = 'cuda'"):
        OfflineLearner(config(), flown, "cuda")


def test_resume_refuses_what_it_cannot_go_on_with(tmp_path: Path, flown: Transitions) -> None:
    assert OfflineLearner.resume(tmp_path, flown) is None
    OfflineLearner(config(updates=1), flown).run(tmp_path, quiet)
    with pytest.raises(CheckpointError, match="other data"):
        OfflineLearner.resume(tmp_path, flown.take(np.arange(len(flown) - 1)))
    manifest = tmp_path / "checkpoint" / "checkpoint.json"
    document = json.loads(manifest.read_text())
    for change, message in (
        ({"kind": "online"}, "kind 'online'"),
        ({"device": "cuda"}, "device = 'cuda'"),
        ({"train": {**document["train"], "surprise": 1}}, "no run of this version"),
        ({"train": None}, "no run of this version"),
    ):
        manifest.write_text(json.dumps(document | change))
        with pytest.raises(CheckpointError, match=message) as error:
            OfflineLearner.resume(tmp_path, flown)
        assert "\n" not in str(error.value)


def test_trial_flights_are_logged_and_do_not_disturb_training(tmp_path: Path, flown: Transitions) -> None:
    asked: list[str] = []

    def evaluate(policy: AgentPolicy) -> dict[str, float]:
        asked.append(policy.name)
        observation = {"uav": np.zeros((2, 4), np.float32), "devices": np.ones((2, 3, 6), np.float32)}
        policy.act(observation, generator=np.random.default_rng(0))
        return {"return": -1.5}

    straight = OfflineLearner(config(), flown)
    straight.run(tmp_path / "straight", quiet)
    tried = OfflineLearner(config(evaluate_every=6), flown)
    tried.run(tmp_path / "tried", quiet, evaluate)
    assert asked == ["diffusion_sac"] * 2
    assert [row["step"] for row in rows(tmp_path / "tried") if "return" in row] == [6, 12]
    assert equal(copies(tried.agent.networks), copies(straight.agent.networks))


def test_logging_changes_no_bit_of_what_is_learned(tmp_path: Path, flown: Transitions) -> None:
    """Nor does what is logged, the distance to the data included, depend on how often it is."""
    found = {}
    for every in (1, 4):
        learner = OfflineLearner(config(log_every=every), flown)
        learner.run(tmp_path / str(every), quiet)
        found[every] = copies(learner.agent.networks), learner.generator.get_state()
    assert equal(found[1][0], found[4][0])
    assert torch.equal(found[1][1], found[4][1])
    often = {row["step"]: row for row in rows(tmp_path / "1")}
    assert all(row == often[row["step"]] for row in rows(tmp_path / "4"))
    assert len({row["support_distance"] for row in often.values()}) > 6


def test_the_distance_to_the_data_is_the_policys(flown: Transitions) -> None:
    learner = OfflineLearner(config(), flown)
    first = learner.support_distance()
    assert learner.support_distance() == first > 0
    support = learner.support
    assert support is not None
    learner.agent.act = lambda *_, **__: HybridAction(support.logged[:, 2], None)  # type: ignore[method-assign]  # on the data
    assert learner.support_distance() == 0.0


@pytest.mark.parametrize(
    ("name", "agent", "q", "loss"),
    [
        ("diffusion_sac", {"discount": 0.9, "reward": {"transform": "none", "clip": 1.0}}, (-10.0, 0.0), 1.0),
        ("diffusion_sac", {"bc_weight": 0.0}, None, None),
        ("bc", {}, None, 1.0),
        ("gaussian_bc", {}, None, 2 * np.log(2) + np.log(4)),
        ("iql", {}, None, None),
    ],
)
def test_what_a_run_is_judged_by_follows_from_settings_and_data(
    flown: Transitions, name: str, agent: dict[str, Any], q: tuple[float, float] | None, loss: float | None
) -> None:
    settings = CONFIGS[name](network=network("devices", width=8), batch_size=8, **agent)
    learner = OfflineLearner(config().model_copy(update={"agent": settings}), flown)
    expected = learner.expected
    if q is not None:
        assert flown.reward.min() < -1.0
        assert expected.q == pytest.approx(q)
        assert learner.q_limit == pytest.approx(100.0)
    assert expected.q[0] < expected.q[1]
    assert (expected.bc_loss is None) == (loss is None)
    assert loss is None or expected.bc_loss == pytest.approx(loss)
    assert expected.reward_deviation == pytest.approx(float(learner.sample.reward.numpy().std()))


def test_discounting_per_second_is_judged_by_the_shortest_step(flown: Transitions) -> None:
    changes = {"discount": 0.9, "discount_per": "second", "reward": {"transform": "none", "clip": 1.0}}
    learner = OfflineLearner(config(agent=changes), flown)
    horizon = 1.0 / (1.0 - 0.9 ** float(flown.duration_s.min()))
    least = max(float(flown.reward.min()), -float(flown.duration_s.max()))  # at most 1 a second
    assert learner.expected.q[0] == pytest.approx(least * horizon, rel=1e-5)


def test_evaluation_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match="seed"):
        config(seed=1_000_000)


def test_the_level_is_pinned_only_where_no_flight_can_end_by_itself(flown: Transitions) -> None:
    plan = config(agent={"pinned_level": True})
    assert OfflineLearner(plan, flown).agent.config == plan.agent
    ended = replace(
        flown, terminated=np.arange(len(flown)) == 3, truncated=flown.truncated & (np.arange(len(flown)) != 3)
    )
    weak, strong = SCENARIO.replace(energy_budget_j=1e3), SCENARIO.replace(energy_budget_j=1e9, max_transmission_s=2.0)
    for scenario, data, level in ((weak, flown, False), (strong, flown, True), (strong, ended, False)):
        learner = OfflineLearner(plan.model_copy(update={"scenario": scenario}), data)
        assert learner.agent.config.pinned_level == level  # type: ignore[attr-defined]  # Diffusion-SAC's
        assert (learner.seen.level != 0) == level


def test_a_reward_per_second_is_centred_by_the_second_where_no_battery_can_end_a_flight() -> None:
    rows = load_builtin("realistic", 500)
    scenario = load_scenario("realistic")
    agent = for_scenario(preset("diffusion_sac", "default"), scenario)
    learner = OfflineLearner(TrainConfig(scenario=scenario, agent=agent, updates=2), rows)
    level = float(np.median(rows.reward / rows.duration_s))
    assert learner.seen.level == pytest.approx(level)
    bound = 10.0 / 0.4 * rows.duration_s
    expected = np.clip((rows.reward - level * rows.duration_s) / 0.4, -bound, bound)
    np.testing.assert_allclose(learner.sample.reward.numpy(), expected, rtol=1e-4, atol=1e-4)
    learner.step()
    still = replace(rows, duration_s=np.zeros_like(rows.duration_s))
    with pytest.raises(ConfigError, match="steps of 0 s"):
        OfflineLearner(learner.config, still)


@pytest.mark.parametrize(("name", "kind"), [("diffusion_sac", "devices"), ("diffusion_sac", "mlp"), ("bc", "devices")])
def test_mapped_data_train_as_the_same_data_in_memory_also_after_a_stop(
    tmp_path: Path, flown: Transitions, mapped: MappedTransitions, name: str, kind: str
) -> None:
    straight = OfflineLearner(config(name, kind), flown)
    straight.run(tmp_path / "straight", quiet)
    broken = OfflineLearner(config(name, kind), mapped)
    assert broken.expected == straight.expected
    with pytest.raises(KeyboardInterrupt):
        broken.run(tmp_path / "broken", interrupt_at(6))
    resumed = OfflineLearner.resume(tmp_path / "broken", mapped)
    assert resumed is not None
    resumed.run(tmp_path / "broken", quiet)
    assert equal(copies(resumed.agent.networks), copies(straight.agent.networks))
    assert rows(tmp_path / "broken") == rows(tmp_path / "straight")  # the distance to the data included
    documents = [load_checkpoint(tmp_path / run / "checkpoint").document for run in ("straight", "broken")]
    assert documents[0] == documents[1]


def test_mapped_data_of_another_digest_are_refused(tmp_path: Path, flown: Transitions) -> None:
    OfflineLearner(config(updates=1), flown).run(tmp_path, quiet)
    other = save_mapped(tmp_path / "other.mapped", [flown.take(np.arange(len(flown) - 1))], SCENARIO)
    with pytest.raises(CheckpointError, match="other data"):
        OfflineLearner.resume(tmp_path, other)


def test_statistics_of_mapped_data_are_of_a_sample_and_extremes_and_minibatches_of_all(
    flown: Transitions, mapped: MappedTransitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("uavrl.training.offline.SAMPLE_ROWS", 20)
    plain = {"reward": {"transform": "zscore", "clip": None}}
    learner = OfflineLearner(config(kind="mlp", agent=plain), mapped)
    known = mapped.sample(20)
    assert len(learner.sample) == 20
    assert learner.seen.level == pytest.approx(float(known.reward.mean()))
    assert learner.expected.reward_deviation == pytest.approx(1.0, rel=1e-3)
    means = [value for name, value in learner.agent.networks.state_dict().items() if name.endswith("normaliser.mean")]
    np.testing.assert_allclose(means[0][:2].numpy(), known.position_m.mean(axis=0), rtol=1e-3)
    assert known.reward.min() > flown.reward.min()
    lowest = (float(flown.reward.min()) - learner.seen.level) / float(known.reward.std())
    assert learner.rewards[0] == pytest.approx(lowest, rel=1e-3)
    assert learner.shortest_s == float(flown.duration_s.min())
    assert len(learner.data) == 60
    learner.step()
    assert learner.support_distance() > 0


LIMITED = """
import resource, sys
from pathlib import Path
from tests.training.test_offline import config, quiet
from uavrl.datasets import load_source
from uavrl.training import offline

offline.SAMPLE_ROWS = 2_000
log, _ = load_source(sys.argv[1])
run = config(kind="mlp", updates=3)
offline.OfflineLearner(run, log.take(slice(0, 100))).run(Path(sys.argv[1] + ".warm"), quiet)  # what torch needs once
with open("/proc/self/status") as status:
    used = next(int(line.split()[1]) for line in status if line.startswith("VmData")) << 10
resource.setrlimit(resource.RLIMIT_DATA, (used + (30 << 20), resource.RLIM_INFINITY))
data = log if sys.argv[2] == "mapped" else log.take(slice(None))
offline.OfflineLearner(run, data).run(Path(sys.argv[1] + ".run"), quiet)
print("trained")
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits and /proc as Linux has them")
def test_mapped_data_train_in_less_memory_than_they_take(tmp_path: Path) -> None:
    """30 MB more than before the data, which are 46 MB on disk; as tensors they do not fit."""
    part = fly(SCENARIO, environments=500, steps=24)
    episodes = int(part.episode.max()) + 1
    parts = (Transitions(**part.columns() | {"episode": part.episode + i * episodes}) for i in range(25))
    save_mapped(tmp_path / "log.mapped", parts, SCENARIO)
    assert (tmp_path / "log.mapped" / "rows.npy").stat().st_size > 40e6
    root = Path(__file__).parents[2]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(root / "src"), str(root)])}
    for how in ("mapped", "in memory"):
        command = [sys.executable, "-c", LIMITED, str(tmp_path / "log.mapped"), how]
        run = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=False)
        if how == "mapped":
            assert run.stdout == "trained\n", run.stderr
        else:
            assert run.returncode != 0
            assert "llocat" in run.stderr  # of torch's "can't allocate" or NumPy's "Unable to allocate"
