from __future__ import annotations

import shutil
from typing import Any

import pytest
import torch

from tests.agents.problems import Kind, agent
from tests.training.test_offline import config, flown
from uavrl.datasets import Transitions
from uavrl.errors import ConfigError
from uavrl.training.compilation import Compilation, compile_passes
from uavrl.training.offline import OfflineLearner

__all__ = ["flown"]  # a fixture

CPU = torch.device("cpu")
COMPILER = any(map(shutil.which, ("g++", "clang++")))


def weights(learner: OfflineLearner) -> list[torch.Tensor]:
    return [value.detach().cpu() for value in learner.agent.networks.state_dict().values()]


def compare(flown: Transitions, kind: Kind, how: Compilation, device: str) -> None:
    """Five updates, compiled and not, from equal weights and noise."""
    plain = OfflineLearner(config(kind=kind), flown, device)
    compiled = OfflineLearner(config(kind=kind, compilation=how), flown, device)
    for _ in range(5):
        expected, found = plain.step(), compiled.step()
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5)
    for one, other in zip(weights(compiled), weights(plain), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # the compiler touches what torch itself warns of
@pytest.mark.skipif(not COMPILER, reason="no C++ compiler")
@pytest.mark.parametrize("kind", ["mlp", "devices"])
def test_compiled_passes_learn_the_same(flown: Transitions, kind: Kind) -> None:
    compare(flown, kind, "step", "cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("how", ["step", "graphs"])
@pytest.mark.parametrize("kind", ["mlp", "devices"])
def test_compiled_passes_learn_the_same_on_a_gpu(flown: Transitions, kind: Kind, how: Compilation) -> None:
    compare(flown, kind, how, "cuda")


@pytest.mark.parametrize("kind", ["mlp", "devices"])
def test_every_pass_of_an_update_is_compiled(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []

    def pretend(function: Any, mode: str) -> Any:
        compiled.append(f"{type(function.__self__).__name__}.{function.__name__}, {mode}")
        return function

    monkeypatch.setattr(torch, "compile", pretend)
    monkeypatch.setattr(shutil, "which", lambda name: name)
    made = agent("diffusion_sac", kind)
    compile_passes(made, "none", CPU)
    assert not compiled
    names = list(made.networks.state_dict())
    compile_passes(made, "step", CPU)
    assert list(made.networks.state_dict()) == names
    prefix = {"mlp": "Mlp", "devices": "Set"}[kind]
    critic = [f"{prefix}Critic.{method}, default" for method in ("all_choices", "value")]
    assert sorted(compiled) == sorted(2 * [f"{prefix}Denoiser.predict, default"] + 2 * critic)


def test_what_cannot_be_compiled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match=r"^--compile graphs needs --device cuda, allowed on a CPU: none, step$"):
        compile_passes(agent("diffusion_sac", "mlp"), "graphs", CPU)
    with pytest.raises(ConfigError, match=r"^--compile step needs a C\+\+ compiler"):
        compile_passes(agent("diffusion_sac", "mlp"), "step", CPU)
    monkeypatch.setattr(shutil, "which", lambda name: name)
    with pytest.raises(ConfigError, match=r"^--compile step: this agent has no denoiser and no critic, allowed: none$"):
        compile_passes(agent("gaussian_bc", "mlp"), "step", CPU)
