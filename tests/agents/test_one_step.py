"""The student against its loss written out, and against its teacher."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.agents.problems import DEVICES, KINDS, Kind, agent, batch, copies, diffusion_sac, disturb, equal, noise
from uavrl.agents.one_step import OneStep, OneStepConfig
from uavrl.networks import NetworkConfig

ROWS, SIZE = 6, DEVICES + 3
BOTH = pytest.mark.parametrize("kind", KINDS)


def student(kind: Kind, **changes: Any) -> OneStep:
    made = agent("one_step", kind, **{"choice": "critic"} | changes)
    assert isinstance(made, OneStep)
    disturb(made.teacher.actor.average, 1)
    disturb(made.student, 2)
    return made


def found(loss: Tensor, module: torch.nn.Module) -> list[Tensor | None]:
    return list(torch.autograd.grad(loss, list(module.parameters()), retain_graph=True, allow_unused=True))


@BOTH
def test_the_loss_is_the_weighted_distance_to_the_teachers_map(kind: Kind) -> None:
    made, data, start = student(kind, displacement_weight=4.0), batch(kind, ROWS), noise(5, ROWS, SIZE)
    loss, metrics = made.student_loss(data, start)
    actor = made.teacher.actor
    wanted = actor.map(actor.average, actor.average.encode(data.observation), start)
    last = torch.tensor([made.config.teacher.diffusion.steps])
    answer = made.student(made.student.encode(data.observation), start, last)
    weight = np.array([4.0, 4.0, *[1.0] * (SIZE - 2)])
    error = (answer - wanted).detach().double().numpy() ** 2
    loss = loss.detach()
    assert float(loss) == pytest.approx(float((error.mean(axis=0) * weight).sum() / weight.sum()), rel=1e-5)
    assert float(metrics["distance"]) == float(loss)
    assert "guided_q" not in metrics


def teachers_decisions(made: OneStep, data: Any, start: Tensor) -> Any:
    """What the teacher answers to x_M = start, its critic's device and its null action included."""
    actor = made.teacher.actor
    context = actor.average.encode(data.observation)
    vector = actor.average.possible(context, actor.map(actor.average, context, start))
    return made.teacher.best(data.observation, vector, 1)


@BOTH
def test_a_student_that_chooses_learns_whole_decisions(kind: Kind) -> None:
    teacher = diffusion_sac(kind, null_candidate=True).config
    made = student(kind, choice="student", displacement_weight=4.0, teacher=teacher)
    disturb(made.teacher.critic, 3)
    data, start = batch(kind, ROWS), noise(5, ROWS, SIZE)
    w, d = teachers_decisions(made, data, start)
    answer = made.map(made.student, made.student.encode(data.observation), start).detach().double()
    squared = ((answer[:, :2] - w) ** 2).mean()
    likelihood = answer[:, 2:].log_softmax(dim=1)[range(ROWS), d].mean()
    loss = made.student_loss(data, start)[0].detach()
    assert float(loss) == pytest.approx(float(4.0 * squared - likelihood), rel=1e-5)


@BOTH
def test_a_student_that_chooses_asks_no_critic_and_holds_its_place_when_idle(kind: Kind) -> None:
    teacher = diffusion_sac(kind, null_candidate=True).config
    made = student(kind, choice="student", teacher=teacher)
    disturb(made.average, 8)
    for parameter in made.teacher.critic.parameters():
        parameter.data.fill_(float("nan"))
    seen, generator = batch(kind, 200).observation, torch.Generator().manual_seed(0)
    action = made.act(seen, generator=generator)
    idle = action.choice == 0
    assert 0 < idle.sum() < 200
    assert (action.continuous[idle] == 0).all()
    assert (action.continuous[~idle] != 0).any(dim=1).all()
    made.config = made.config.model_copy(update={"teacher": teacher.model_copy(update={"null_candidate": False})})
    action = made.act(seen, generator=generator.manual_seed(0))
    assert (action.continuous[idle] != 0).any()  # there idling may move


@BOTH
def test_guidance_is_added_with_its_weight(kind: Kind) -> None:
    made, data, start = student(kind, q_weight=0.3), batch(kind, ROWS), noise(5, ROWS, SIZE)
    loss, metrics = made.student_loss(data, start)
    answer = made.map(made.student, made.student.encode(data.observation), start)
    guidance = made.teacher.guidance_loss(data.observation, answer)[0].detach()
    assert float(loss.detach()) == pytest.approx(float(metrics["distance"] + 0.3 * guidance), rel=1e-5)


@BOTH
@pytest.mark.parametrize("q_weight", [0.0, 0.3])
def test_both_terms_train_the_student_alone(kind: Kind, q_weight: float) -> None:
    made = student(kind, q_weight=q_weight)
    loss, _ = made.student_loss(batch(kind, ROWS), noise(5, ROWS, SIZE))
    trained = found(loss, made.student)
    assert all(value is not None and value.isfinite().all() and value.abs().max() > 0 for value in trained)
    before = {name: copies(made.networks[name]) for name in ("teacher", "critic")}
    made.update(batch(kind, ROWS), torch.Generator().manual_seed(0))
    assert all(equal(before[name], copies(made.networks[name])) for name in before)


@pytest.mark.parametrize(("still", "share"), [(0.0, 0.0), (1.0, 1.0), (0.75, 0.75)])
def test_a_share_of_the_batch_starts_from_zero(still: float, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    made, starts = student("devices", still=still), []
    real = made.student_loss

    def watched(data: Any, start: Tensor) -> Any:
        starts.append(start)
        return real(data, start)

    monkeypatch.setattr(made, "student_loss", watched)
    made.update(batch("devices", 400), torch.Generator().manual_seed(0))
    zero = (starts[0] == 0).all(dim=1)
    assert float(zero.float().mean()) == pytest.approx(share, abs=0.08)
    if share < 1:
        assert starts[0][~zero].std() == pytest.approx(1.0, abs=0.1)


@BOTH
@pytest.mark.parametrize(("choice", "width"), [("critic", None), ("student", None), ("student", 16)])
def test_it_learns_to_decide_as_its_teacher(kind: Kind, choice: str, width: int | None) -> None:
    teacher = diffusion_sac(kind)
    disturb(teacher.actor.average, 3, scale=0.15)
    disturb(teacher.critic, 4)
    made = agent("one_step", kind, teacher=teacher.config, learning_rate=3e-3, choice=choice, width=width)
    assert isinstance(made, OneStep)
    made.learn_from(teacher)
    data, generator = batch(kind, 256), torch.Generator().manual_seed(0)
    distances = [float(made.update(data, generator)["distance"]) for _ in range(400)]
    assert np.mean(distances[-20:]) < 0.25 * distances[0]
    own, theirs = (one.act(data.observation, generator=generator, deterministic=True) for one in (made, teacher))
    assert (own.continuous - theirs.continuous).abs().mean() < 0.3  # of a box whose width is 2; untaught: above 0.5
    assert (own.choice == theirs.choice).float().mean() > 0.8


def test_the_best_of_several_answers_is_taken() -> None:
    one, many = student("devices"), student("devices", candidates=8)
    seen = batch("devices", 64).observation
    encoded = one.teacher.critic.encode(seen)

    def value(made: OneStep) -> float:
        action = made.act(seen, generator=torch.Generator().manual_seed(0))
        every = one.teacher.critic.all_choices(encoded, action.continuous).amin(dim=0)
        return float(every.gather(1, action.choice[:, None]).mean().detach())

    assert value(many) > value(one)


def test_a_network_that_is_not_the_teachers_is_refused() -> None:
    with pytest.raises(ValueError, match="network must be that of the teacher, but for its width"):
        OneStepConfig(network=NetworkConfig(scale_m=3.0))


def test_candidates_need_the_critic_that_compares_them() -> None:
    with pytest.raises(ValueError, match="candidates = 4 needs choice = 'critic'"):
        OneStepConfig(choice="student", candidates=4)
