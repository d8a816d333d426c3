from __future__ import annotations

import pytest

from benchmarks import profile


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("aten::addmm", "products"),
        ("AddmmBackward0", "other operations"),
        ("aten::silu_backward", "activations"),
        ("_Layers", "activations"),
        ("Optimizer.step#AdamW.step", "optimiser"),
        ("aten::copy_", "other operations"),
    ],
)
def test_kinds_of_operations(name: str, kind: str) -> None:
    assert profile.kind(name) == kind


def test_an_update_spends_its_time_somewhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(profile, "UPDATES", 1)
    profile.main(("default",))
    lines = capsys.readouterr().out.splitlines()
    spent = {name: float(value) for name, value in (line.strip("| ").split(" | ") for line in lines[2:])}
    assert {"products", "activations", "optimiser", "other operations"} < set(spent)
    assert 0.1 < spent["products"] < spent["all"]
    assert spent["all"] == pytest.approx(sum(spent.values()) / 2, abs=0.5)
