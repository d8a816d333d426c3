from __future__ import annotations

import json
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.agents.problems import equal
from tests.datasets.flights import fly, small_scenario
from uavrl.cli import main
from uavrl.cli.train import trial_flights
from uavrl.datasets import save_flat
from uavrl.evaluation.rollouts import EVALUATION_SEED, TRIAL_SEED, fixed_layout
from uavrl.scenario import load_scenario
from uavrl.training.checkpoint import load_checkpoint
from uavrl.training.policy import load_policy

SMALL = [word for setting in ("network.width=8", "batch_size=8", "diffusion.steps=2") for word in ("--set", setting)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current directory with a log of 60 rows in log.parquet."""
    monkeypatch.chdir(tmp_path)
    scenario = small_scenario()
    save_flat(tmp_path / "log.parquet", fly(scenario, steps=20), scenario)
    return tmp_path


def train(*words: str) -> int:
    return main(["train", *words])


@pytest.mark.parametrize("agent", ["diffusion_sac", "bc"])
def test_a_flat_file_becomes_a_policy(folder: Path, agent: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = [agent, "--out", "runs/mine", "--data", "log.parquet", "--updates", "4", "--seed", "5", *SMALL]
    assert train(*words) == 0
    captured = capsys.readouterr()
    assert "4 updates on 60 transitions; policy in runs/mine" in captured.out
    judge = "next: uavrl evaluate --policy tdm --policy runs/mine --scenario runs/mine/scenario.toml"
    assert captured.out.splitlines()[-1] == judge + (" --deterministic" if agent == "diffusion_sac" else "")
    assert len(captured.err.splitlines()) <= 1
    document = load_checkpoint(folder / "runs/mine/checkpoint").document
    assert (document["agent"], document["step"], document["data"]["rows"]) == (agent, 4, 60)
    assert document["train"]["seed"] == 5
    assert document["config"]["network"]["width"] == 8
    policy = load_policy(folder / "runs/mine", small_scenario())
    assert (policy.name, policy.needs) == (agent, "devices")
    rows = [json.loads(line) for line in (folder / "runs/mine/metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4]
    assert all(row["support_distance"] > 0 for row in rows)
    assert "health unknown: 4 rows in the log" in captured.out


@pytest.mark.parametrize(
    ("words", "per", "discount"),
    [
        ([], "second", 0.99),
        (["--set", "discount=0.98"], "second", 0.98),
        (["--set", "discount_per=step"], "step", 0.9995),
        (["--preset", "paper"], "step", 0.99),
    ],
)
def test_a_reward_per_second_is_discounted_by_the_second(
    folder: Path, words: list[str], per: str, discount: float
) -> None:
    data = ["--data", "realistic", "--size", "200", "--updates", "1", *SMALL[:-2], *words]
    assert train("diffusion_sac", "--out", "runs/mine", *data) == 0
    config = load_checkpoint(folder / "runs/mine/checkpoint").document["config"]
    assert (config["discount_per"], config["discount"]) == (per, discount)


def test_mapped_flights_train_to_the_same_policy_and_resume(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from uavrl.training.offline import OfflineLearner

    assert main(["data", "convert", "log.parquet", "log.mapped"]) == 0
    words = ["bc", "--updates", "4", "--evaluate-every", "4", *SMALL]
    assert train(*words, "--out", "flat", "--data", "log.parquet") == 0
    words += ["--out", "run", "--data", "log.mapped"]
    real = OfflineLearner.step

    def step(self: OfflineLearner) -> object:
        if self.updates == 1:
            signal.raise_signal(signal.SIGINT)
        return real(self)

    with monkeypatch.context() as patch:
        patch.setattr(OfflineLearner, "step", step)
        assert train(*words) == 130
    assert train(*words, "--resume") == 0
    assert "4 updates on 60 transitions" in capsys.readouterr().out
    assert (folder / "run/metrics.jsonl").read_text() == (folder / "flat/metrics.jsonl").read_text()
    networks = [load_checkpoint(folder / run / "checkpoint").tensors["networks"] for run in ("flat", "run")]
    assert equal(networks[0], networks[1])
    rows = folder / "log.mapped/rows.npy"
    rows.write_bytes(rows.read_bytes()[:-9])
    assert train(*words, "--resume") == 2
    complaint = capsys.readouterr().err
    assert "log.mapped/rows.npy: missing, cut short or damaged" in complaint
    assert complaint.count("\n") == 1


@pytest.mark.parametrize("named", [True, False])
def test_the_scenario_that_the_last_line_names_is_the_one_learned_from(
    folder: Path, capsys: pytest.CaptureFixture[str], named: bool
) -> None:
    """Data carry a scenario that no preset and no file of the user's may hold."""
    (folder / "mine.toml").write_text(small_scenario().to_toml())
    words = ["--scenario", "mine.toml"] if named else []
    assert train("gaussian_bc", "--data", "log.parquet", "--out", "run", "--updates", "2", *SMALL[:4], *words) == 0
    proposed = capsys.readouterr().out.splitlines()[-1].split(" --scenario ")[1]
    assert proposed == ("mine.toml" if named else "run/scenario.toml")
    assert load_scenario(proposed) == small_scenario()


def test_a_run_ends_with_a_line_on_its_health(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["gaussian_bc", "--data", "log.parquet", "--updates", "120", "--set", "network.width=16"]
    assert train(*words, "--out", "good", "--set", "learning_rate=0.03") == 0
    line = capsys.readouterr().out.splitlines()[0]
    assert line.startswith("healthy: bc_loss "), line
    rows = (folder / "good/metrics.jsonl").read_text().splitlines()
    assert len(rows) == 60  # every second: short runs are logged closely enough to be judged
    assert train(*words, "--out", "bad", "--set", "learning_rate=1e-9") == 0
    line = capsys.readouterr().out.splitlines()[0]
    assert line.startswith("unhealthy: bc_loss "), line


def test_a_long_run_is_logged_every_200_updates(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from uavrl.training.offline import OfflineLearner

    seen = []
    monkeypatch.setattr(OfflineLearner, "run", lambda self, out, *_, **__: seen.append(self.config.log_every))
    words = ["bc", "--out", "run", "--data", "log.parquet", *SMALL]
    assert train(*words) == 2  # there is no metrics.jsonl: nothing ran
    assert seen == [200]


def test_a_full_disk_is_told_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from uavrl.training.offline import OfflineLearner

    def full(self: OfflineLearner, out: Path, *_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", str(out / "checkpoint"))

    monkeypatch.setattr(OfflineLearner, "run", full)
    assert train("bc", "--out", "run", "--data", "log.parquet", *SMALL) == 2
    assert capsys.readouterr().err == "uavrl: error: 'run/checkpoint': No space left on device\n"


def test_tensorboard_that_is_not_installed_is_one_line_before_anything_runs(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "2", *SMALL, "--tensorboard"]
    assert train(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert "extra 'tracking'" in line
    assert "uavrl[tracking]" in line
    assert not (folder / "run").exists()


def test_the_log_is_written_for_tensorboard_too(folder: Path) -> None:
    pytest.importorskip("tensorboard")
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "2", *SMALL, "--tensorboard"]
    assert train(*words) == 0
    assert list((folder / "run/tensorboard").glob("events.out.tfevents.*"))


def test_a_run_whose_writer_was_killed_between_its_renames_is_one(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "2", *SMALL]
    assert train(*words) == 0
    (folder / "run/checkpoint").rename(folder / "run/.checkpoint.old")
    assert load_policy(folder / "run", small_scenario()).name == "bc"
    assert train(*words) == 2
    assert "holds a run already; give --resume" in capsys.readouterr().err
    assert load_checkpoint(folder / "run/checkpoint").document["step"] == 2


def test_an_interrupt_says_what_was_saved_and_how_to_go_on(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from uavrl.training.offline import OfflineLearner

    real = OfflineLearner.step

    def step(self: OfflineLearner) -> object:
        if self.updates == 3:
            signal.raise_signal(signal.SIGINT)
        return real(self)

    monkeypatch.setattr(OfflineLearner, "step", step)
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "9", *SMALL]
    assert train(*words) == 130
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-2:] == [
        "saved update 4; the same command with --resume goes on",
        "uavrl: interrupted",
    ]
    assert captured.out == ""
    assert load_checkpoint(folder / "run/checkpoint").document["step"] == 4


def test_a_run_is_not_overwritten_and_goes_on_only_with_its_own_settings(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "2", *SMALL]
    assert train(*words) == 0
    assert train(*words) == 2
    assert "holds a run already; give --resume" in capsys.readouterr().err
    assert train(*words, "--resume") == 0
    assert "going on from update 2" in capsys.readouterr().err
    capsys.readouterr()
    assert train(*words, "--resume", "--set", "learning_rate=0.1", "--set", "diffusion.steps=3") == 2
    began = capsys.readouterr().err.strip()
    assert began.endswith("was started with other settings, give the same ones: learning_rate=0.001, diffusion.steps=2")
    assert train(*words, "--resume", "--size", "50") == 2
    assert "other data" in capsys.readouterr().err


@pytest.mark.parametrize("at_once", [False, True])
def test_several_seeds_are_as_many_runs(
    folder: Path, at_once: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("uavrl.cli.train.at_once", lambda config, device: at_once)
    words = ["diffusion_sac", "--data", "log.parquet", "--updates", "2", *SMALL]
    assert train(*words, "--out", "runs", "--seed", "5", "--seeds", "2") == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in out] == [
        "seed5",
        "seed6",
        "2 updates on 60 transitions; policy in runs/seed5, runs/seed6",
        "next",
    ]
    assert "--policy tdm --policy runs/seed5 --policy runs/seed6 --scenario" in out[-1]
    assert train(*words, "--out", "alone", "--seed", "6") == 0
    alone, run = (load_checkpoint(folder / name / "checkpoint") for name in ("alone", "runs/seed6"))
    assert run.document["train"] == alone.document["train"]
    for name, value in run.tensors["networks"].items():
        assert value.numpy() == pytest.approx(alone.tensors["networks"][name].numpy(), abs=1e-4), name
    capsys.readouterr()
    assert train(*words, "--out", "runs", "--seed", "4", "--seeds", "2") == 2
    assert "--out 'runs/seed5' holds a run already; give --resume" in capsys.readouterr().err
    assert not (folder / "runs/seed4").exists()
    again = [*words, "--out", "runs", "--seed", "4", "--seeds", "3", "--resume"]
    assert train(*again, "--set", "learning_rate=0.1") == 2  # before anything is begun
    assert "'runs/seed5' was started with other settings" in capsys.readouterr().err
    assert not (folder / "runs/seed4").exists()
    assert train(*again) == 0  # what is there goes on, what is not is begun
    said = capsys.readouterr().err.splitlines()
    assert {f"seed{seed}: going on from update 2" for seed in (5, 6)} <= set(said)
    assert load_checkpoint(folder / "runs/seed4/checkpoint").document["step"] == 2


def test_seeds_and_single_runs_do_not_mix(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bc", "--data", "log.parquet", "--updates", "1", *SMALL]
    assert train(*words, "--out", "one") == 0
    assert train(*words, "--out", "one", "--seeds", "2") == 2
    assert "--out 'one' holds a single run" in capsys.readouterr().err
    assert train(*words, "--out", "two", "--seeds", "2") == 0
    assert train(*words, "--out", "two", "--resume") == 2
    assert "several seeds' (two/seed0): give --seeds" in capsys.readouterr().err
    (folder / "three").mkdir()
    (folder / "three/seed1").write_text("")
    assert train(*words, "--out", "three", "--seeds", "2") == 2
    assert "'three/seed1' cannot be made" in capsys.readouterr().err
    assert not (folder / "three/seed0/checkpoint").exists()


def test_one_seed_that_diverges_does_not_keep_the_next_from_learning(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from uavrl.errors import DivergenceError
    from uavrl.training.offline import OfflineLearner

    real = OfflineLearner.step

    def step(self: OfflineLearner) -> object:
        if self.config.seed == 1:
            raise DivergenceError("training diverged: it was told to")
        return real(self)

    monkeypatch.setattr(OfflineLearner, "step", step)
    assert train("bc", "--data", "log.parquet", "--updates", "1", "--out", "runs", "--seeds", "3", *SMALL) == 2
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == "uavrl: error: seed1: training diverged: it was told to"
    assert [line.partition(":")[0] for line in captured.out.splitlines()] == ["seed0", "seed2"]
    assert (folder / "runs/seed2/checkpoint").exists()


@pytest.mark.parametrize(("word", "kept"), [("on", True), ("off", False), ("auto", None)])
def test_symmetry_is_a_setting_of_the_run(folder: Path, word: str, kept: bool | None) -> None:
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "1", "--symmetry", word, *SMALL]
    assert train(*words) == 0
    assert load_checkpoint(folder / "run/checkpoint").document["train"]["symmetry"] is kept


@pytest.mark.parametrize(
    ("words", "share"),
    [
        (["diffusion_sac"], 0.5),
        (["diffusion_sac", "--relocate", "0"], 0.0),
        (["diffusion_sac", "--preset", "paper", "--set", "network.kind=devices"], 0.0),
        (["bc"], 0.0),
        (["bc", "--relocate", "0.25"], 0.25),
    ],
)
def test_devices_are_moved_by_default_where_a_log_has_one_layout(folder: Path, words: list[str], share: float) -> None:
    scenario = small_scenario()
    save_flat(folder / "one.parquet", fly(scenario, steps=20, layout=np.full((3, 2), 300.0)), scenario)
    assert train(*words, "--out", "run", "--data", "one.parquet", "--updates", "1", *SMALL) == 0
    assert load_checkpoint(folder / "run/checkpoint").document["train"]["relocation"] == share
    assert train("diffusion_sac", "--out", "many", "--data", "log.parquet", "--updates", "1", *SMALL) == 0
    assert load_checkpoint(folder / "many/checkpoint").document["train"]["relocation"] == 0


def test_a_part_of_a_file_and_the_papers_settings(folder: Path) -> None:
    words = ["diffusion_sac", "--out", "run", "--data", "log.parquet", "--size", "30", "--preset", "paper"]
    assert train(*words, "--updates", "1", *SMALL) == 0
    document = load_checkpoint(folder / "run/checkpoint").document
    assert document["data"]["rows"] == 30
    assert document["spaces"]["observation"] == 6
    assert document["config"]["network"]["kind"] == "mlp"


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["sca", "--out", "o"], ["sca", "diffusion_sac"]),
        (["bc"], ["--out"]),
        (["bc", "--out", "o", "--data", "gone.parquet"], ["gone.parquet", "no such file"]),
        (["bc", "--out", "o", "--data", "cut.parquet"], ["cut.parquet"]),
        (["bc", "--out", "o", "--scenario", "mars"], ["'mars'", "released"]),
        (["bc", "--out", "o", "--scenario", "released"], ["10"]),
        (["bc", "--out", "o", "--updates", "0"], ["updates", "0", "greater than or equal to 1"]),
        (["bc", "--out", "o", "--updates", "many"], ["--updates", "many"]),
        (["bc", "--out", "o", "--seed", "1000000"], ["seed", "1000000", "less than 1000000"]),
        (["bc", "--out", "o", "--seed", "-1"], ["seed", "-1"]),
        (["bc", "--out", "o", "--seeds", "0"], ["--seeds 0", "at least 1"]),
        (["bc", "--out", "o", "--seed", "999999", "--seeds", "2"], ["seed", "1000000", "less than 1000000"]),
        (["bc", "--out", "o", "--size", "61"], ["size = 61", "1 to 60"]),
        (["bc", "--out", "o", "--size", "9", "--data-seed", "-1"], ["seed = -1"]),
        (["bc", "--out", "o", "--quality", "good"], ["--quality good needs --size"]),
        (["bc", "--out", "o", "--set", "bc_weight=0.3"], ["'bc_weight' does not exist", "learning_rate"]),
        (["diffusion_sac", "--out", "o", "--set", "bc_weight=3"], ["bc_weight", "3", "less than or equal to 1"]),
        (["diffusion_sac", "--out", "o", "--set", "bc_weight"], ["'bc_weight'", "name=value"]),
        (["diffusion_sac", "--out", "o", "--set", "diffusion.step=3"], ["'diffusion.step' does not exist", "steps"]),
        (["diffusion_sac", "--out", "o", "--set", "diffusion=3"], ["diffusion"]),
        (["diffusion_sac", "--out", "o", "--set", "name=bc"], ["'name' does not exist"]),
        (["diffusion_sac", "--out", "o", "--set", "guidance=softmax"], ["guidance = 'softmax'", "choice_heads"]),
        (["diffusion_sac", "--out", "o", "--set", "gradient=half"], ["gradient", "'half'", "full_chain"]),
        (
            ["bc", "--out", "o", "--symmetry", "on", "--set", "network.kind=mlp"],
            ["symmetry = true", "'devices'", "'mlp'"],
        ),
        (["bc", "--out", "o", "--relocate", "2"], ["relocation", "2", "less than or equal to 1"]),
        (["bc", "--out", "o", "--resume"], ["--resume", "holds no checkpoint"]),
        (["bc", "--out", "log.parquet"], ["--out", "log.parquet", "directory"]),
        (["bc", "--out", "log.parquet/run"], ["--out", "log.parquet/run", "directory"]),
    ],
)
def test_wrong_input_is_one_line_and_code_2(
    folder: Path, words: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "cut.parquet").write_bytes((folder / "log.parquet").read_bytes()[:-40])
    given = words if "--data" in words else [*words, "--data", "log.parquet"]
    assert train(*given) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("uavrl: error: ")
    assert all(part in line for part in parts), line
    assert captured.out == ""
    assert not (folder / "o" / "checkpoint").exists()


def test_a_damaged_checkpoint_is_one_line_and_code_2(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "1", *SMALL]
    assert train(*words) == 0
    capsys.readouterr()
    file = folder / "run/checkpoint/networks.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    assert train(*words, "--resume") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "networks.safetensors' is damaged" in line


def test_trial_flights_are_of_their_own_seed_and_of_the_datas_layout_where_it_is_one(folder: Path) -> None:
    assert TRIAL_SEED < EVALUATION_SEED
    words = ["bc", "--out", "run", "--data", "log.parquet", "--updates", "2", "--evaluate-every", "1", *SMALL]
    assert train(*words) == 0
    rows = [json.loads(line) for line in (folder / "run/metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "return" in row] == [1, 2]
    assert all(row["return"] < 0 for row in rows if "return" in row)

    scenario = small_scenario()
    seen: list[np.ndarray] = []

    class Spy:
        name, needs = "spy", "devices"
        agent = SimpleNamespace(acts_best_deterministically=True)

        def reset(self, count: int) -> None: ...

        def act(self, observation: dict[str, np.ndarray], **_: object) -> object:
            from uavrl.simulation.state import FlightAction

            seen.append(observation["uav"][:, None, :2] + observation["devices"][:, :, :2])
            count = len(observation["uav"])
            return FlightAction(np.zeros((count, 2)), np.zeros(count, dtype=np.int64))

    one = fly(scenario, steps=5, layout=fixed_layout(scenario))
    result = trial_flights(one, scenario, episodes=3)(Spy())  # type: ignore[arg-type]  # flies as an AgentPolicy does
    assert set(result) == {"return", "return_median"}
    np.testing.assert_allclose(seen[-1], np.broadcast_to(fixed_layout(scenario), (3, 3, 2)), atol=1e-2)
    seen.clear()
    trial_flights(fly(scenario, steps=30), scenario, episodes=3)(Spy())  # type: ignore[arg-type]  # as above
    assert len(np.unique(seen[-1].round(1), axis=0)) == 3
