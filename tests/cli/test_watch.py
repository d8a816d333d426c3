from __future__ import annotations

from pathlib import Path

import pytest

from uavrl.cli import main
from uavrl.errors import ConfigError
from uavrl.evaluation.rollouts import EvaluationSet, evaluation_set, fly
from uavrl.policies import make_policy
from uavrl.policies.base import Policy


def test_the_flight_is_the_one_that_evaluate_flies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "flight.html"
    assert main(["watch", "tdm", "--episode", "2", "--seed", "1000005", "--frames", "20", "--out", str(page)]) == 0
    flights = fly(make_policy("tdm"), evaluation_set("released", "random", 4, seed=1_000_005))
    total = f"return {flights.episode(2).total_reward:.4g}"
    assert total in capsys.readouterr().out
    assert f"tdm: {total}" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "name"), [(["tdm"], "released"), (["pretrained:realistic"], "realistic"),
                        (["pretrained:realistic", "--scenario", "released"], "released")]
)  # fmt: skip
def test_a_policy_is_watched_where_it_learned(
    words: list[str], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[str] = []

    def fly(policy: Policy, environments: EvaluationSet, **_: object) -> None:
        seen.append(environments.scenario.name)
        raise ConfigError("far enough")

    monkeypatch.setattr("uavrl.evaluation.rollouts.fly", fly)
    assert main(["watch", *words]) == 2
    assert seen == [name]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["watch", "nobody"], "policy 'nobody' does not exist"),
        (["watch", "tdm", "--episode", "-1"], "--episode -1, allowed: 0 or more"),
        (["watch", "tdm", "--frames", "1"], "--frames 1, allowed: 2 or more"),
        (["watch", "tdm", "--scenario", "mars"], "scenario 'mars'"),
        (["watch", "tdm", "--out", "none/flight.html"], "'none' does not exist"),
    ],
)
def test_wrong_words_are_one_line_and_code_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
