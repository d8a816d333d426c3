r"""One-step policy: a student that answers at once what a trained Diffusion-SAC's chain arrives at.

After flow Q-learning (Park, Li, Levine 2025, arXiv:2502.02538). The teacher's DDIM without noise is a map from x_M to
its vector [w, z], and with its critic's device and null action to a decision (w_\theta, d_\theta). The student
[w, z] = \mu_\omega(s, x_M) learns these decisions in one pass, with the teacher's Q where that has a weight:
    L = displacement_weight E|w - w_\theta|^2 + E[-\log softmax(z)_{d_\theta}] + q_weight L_g(\mu_\omega(s, x_M))
With choice = "critic" it learns the map alone, before the argmax, and asks the critic at each decision:
    L = E|\mu_\omega(s, x_M) - DDIM_\theta(s, x_M)|^2 + q_weight L_g(\mu_\omega(s, x_M))
An ancestral chain is no map of x_M: a squared error to it would average its modes.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from uavrl.actions import HybridAction, decode
from uavrl.agents.base import Agent, AgentConfig, Batch, Metrics, adam, minimise, move_towards
from uavrl.agents.diffusion_actor import block_mean
from uavrl.agents.diffusion_sac import DiffusionSac, DiffusionSacConfig, held
from uavrl.networks import Denoiser, Observation, Spaces, make_denoiser, repeat
from uavrl.networks.interfaces import Context


class OneStepConfig(AgentConfig):
    """Settings of the student; `network` (but for its width) and `reward` are its teacher's."""

    name: Literal["one_step"] = "one_step"
    teacher: DiffusionSacConfig = DiffusionSacConfig()
    learning_rate: float = Field(1e-3, gt=0, description="of Adam")
    q_weight: float = Field(0.0, ge=0, description="of L_g beside the error; 0 skips it")
    still: float = Field(
        0.75, ge=0, le=1, description="share of a batch that starts from x_M = 0, as a deterministic decision does"
    )
    displacement_weight: float = Field(3.0, gt=0, description="weight of a continuous entry in the squared error")
    choice: Literal["critic", "student"] = Field(
        "student",
        description="whom to serve: the student itself says it, which learns the teacher's decisions, null action "
        "included, and at a decision asks no critic; or the teacher's critic for the student's w",
    )
    student_average: float = Field(0.98, ge=0, lt=1, description="decay of the student that acts; 0: no average")
    candidates: int = Field(1, ge=1, description="actions drawn at a decision; the one of largest min Q is taken")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.network.model_copy(update={"width": self.teacher.network.width}) != self.teacher.network:
            raise ValueError("network must be that of the teacher, but for its width")
        if self.choice == "student" and self.candidates > 1:
            raise ValueError(f"candidates = {self.candidates} needs choice = 'critic', which compares them; allowed: 1")
        return self


class OneStep(Agent):
    """A student of one pass beside its teacher, whose critic may choose the device for the student's w.

    Its teacher knows nothing until `learn_from`.
    """

    config: OneStepConfig
    acts_best_deterministically = True

    def __init__(self, spaces: Spaces, config: OneStepConfig) -> None:
        self.spaces, self.config = spaces, config
        self.teacher = DiffusionSac(spaces, config.teacher)
        self.student: Denoiser = make_denoiser(spaces, config.network)
        self.average = deepcopy(self.student).requires_grad_(False)
        self.networks = nn.ModuleDict(
            {
                "teacher": self.teacher.actor.average,
                "critic": self.teacher.critic,
                "student": self.student,
                "average": self.average,
            }
        )
        self.optimisers = {"student": adam(self.student.parameters(), config)}

    def learn_from(self, teacher: DiffusionSac) -> None:
        """Take over a trained teacher's target actor and critic.

        A student of the same width begins with that actor's weights.
        """
        learned = teacher.actor.average.state_dict()
        alike = self.config.network == self.config.teacher.network
        for network in (self.teacher.actor.average, *((self.student, self.average) if alike else ())):
            network.load_state_dict(learned)
        self.teacher.critic.load_state_dict(teacher.critic.state_dict())

    def learns_from(self, teacher: DiffusionSac) -> bool:
        """Whether the weights taken over are this teacher's."""
        mine, theirs = (
            {**one.actor.average.state_dict(prefix="actor."), **one.critic.state_dict(prefix="critic.")}
            for one in (self.teacher, teacher)
        )
        return mine.keys() == theirs.keys() and all(torch.equal(mine[name].cpu(), theirs[name]) for name in mine)

    def map(self, student: Denoiser, context: Context, start: Tensor | None) -> Tensor:
        """The student's vector (B, C + D) from x_M (B, C + D), None being 0, in one pass."""
        last = torch.full((1,), self.config.teacher.diffusion.steps, device=context[0].device)
        return student.predict(context, start, student.steps(last))

    def student_loss(self, batch: Batch, start: Tensor) -> tuple[Tensor, Metrics]:
        """The loss above; start (B, C + D) is x_M of student and teacher."""
        config, teacher, continuous = self.config, self.teacher.actor, self.spaces.continuous
        encoded = self.student.encode(batch.observation)
        answer = self.map(self.student, encoded, start)
        with torch.no_grad():
            context = teacher.average.encode(batch.observation)
            wanted = teacher.map(teacher.average, context, start)
        if config.choice == "critic":
            distance = block_mean((answer - wanted).square(), continuous, config.displacement_weight)
        else:
            decided = self.teacher.best(batch.observation, teacher.average.possible(context, wanted), 1)
            logits = self.student.possible(encoded, answer)[:, continuous:]
            distance = config.displacement_weight * (answer[:, :continuous] - decided.continuous).square().mean()
            distance = distance + functional.cross_entropy(logits, decided.choice)
        loss, metrics = distance, {"distance": distance.detach()}
        if config.q_weight > 0:
            guidance, more = self.teacher.guidance_loss(batch.observation, answer)
            loss = loss + config.q_weight * guidance
            metrics |= more
        return loss, metrics | {"actor_loss": loss.detach()}

    def update(self, batch: Batch, generator: torch.Generator) -> Metrics:
        """One step of the student, and of its average."""
        count, size = len(batch.reward), self.spaces.continuous + self.spaces.choices
        start = torch.randn((count, size), generator=generator, device=generator.device)
        moves = torch.rand((count, 1), generator=generator, device=generator.device) >= self.config.still
        loss, metrics = self.student_loss(batch, start * moves)
        clip = self.config.gradient_clip
        metrics["actor_gradient"] = minimise(loss, self.student, self.optimisers["student"], clip)
        move_towards(self.average, self.student, 1.0 - self.config.student_average)
        return metrics

    def noise_shape(self, choices: int) -> tuple[int, int]:
        """x_M of each candidate."""
        return self.config.candidates, self.spaces.continuous + choices

    @torch.no_grad()
    def decide(self, observation: Observation, noise: Tensor | None) -> HybridAction:
        """See `Agent`."""
        context, count = self.average.encode(observation), 1 if noise is None else self.config.candidates
        start = None
        if noise is not None:
            start = noise.reshape(count * context[0].shape[0], self.average.vector_size(context))
        context = repeat(context, count)
        vector = self.average.possible(context, self.map(self.average, context, start))
        if self.config.choice == "critic":
            return self.teacher.best(observation, vector, count)
        answer = decode(vector, self.spaces.continuous)
        return held(answer) if self.config.teacher.null_candidate else answer

    @torch.no_grad()
    def act(self, observation: Observation, *, generator: torch.Generator, deterministic: bool = False) -> HybridAction:
        """The student's answer to noise, the best of `candidates` by min Q; deterministic: to x_M = 0."""
        if deterministic:
            return self.decide(observation, None)
        context = self.average.encode(observation)
        shape = (len(context[0]), self.config.candidates, self.average.vector_size(context))
        return self.decide(observation, torch.randn(shape, generator=generator, device=generator.device))
