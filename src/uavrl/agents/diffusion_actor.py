"""The denoising-diffusion actor: a policy over hybrid actions as a chain from noise to the vector [w, 2 onehot(d) - 1].

Paper, Section V-B. All noise is an argument; `ChainNoise.draw` is the one place that makes it.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Literal, NamedTuple

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from uavrl.actions import HybridAction, decode
from uavrl.diffusion import ChainDenoiser, Schedule, ScheduleName, ddim, ddpm, dpm_solver_pp_2m, make_schedule, thinned
from uavrl.networks import Denoiser, NetworkConfig, Spaces, make_denoiser
from uavrl.networks.interfaces import Context


class DiffusionConfig(BaseModel):
    """The chain."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schedule: ScheduleName = Field("vp", description="noise schedule; the paper has linear, unscaled")
    steps: int = Field(5, ge=1, description="M, denoising steps")
    sampler: Literal["ddpm", "ddim"] = Field("ddpm", description="ancestral, or DDIM with ddim_eta")
    variance: Literal["posterior", "beta"] = Field(
        "posterior", description="of ddpm's noise; the paper prints beta, the posterior variance is beta-tilde"
    )
    ddim_eta: float = Field(0.0, ge=0, le=1, description="0: deterministic, 1: as ddpm with the posterior variance")
    clip_x0: bool = Field(True, description="hold each predicted x_0 in [-1, 1]; the paper does not")


SolverName = Literal["ddim", "dpm"]


class Solver(NamedTuple):
    """A deterministic walk from x_M to x_0 over some of the M steps: DDIM without noise, or DPM-Solver++(2M)."""

    name: SolverName
    steps: int  # 1 to M


class ChainNoise(NamedTuple):
    """Randomness of one chain of N samples."""

    start: Tensor  # (N, C + D)
    steps: Tensor  # (M, N, C + D)

    @classmethod
    def draw(cls, count: int, size: int, steps: int, generator: torch.Generator) -> ChainNoise:
        """Standard normal noise for `count` samples of `size` entries."""
        both = torch.randn((steps + 1, count, size), generator=generator, device=generator.device)
        return cls(both[0], both[1:])

    @classmethod
    def of_rows(cls, noise: Tensor, steps: int) -> ChainNoise:
        """From noise (B, n (M + 1), C + D), that of B x n samples: start, then steps 1..M, of one after another."""
        both = noise.reshape(-1, steps + 1, noise.shape[-1]).transpose(0, 1)
        return cls(both[0], both[1:])


class DiffusionActor(nn.Module):
    """A denoiser and its exponential moving average, the target actor, which also acts."""

    def __init__(self, spaces: Spaces, network: NetworkConfig, config: DiffusionConfig) -> None:
        super().__init__()
        self.config, self.continuous = config, spaces.continuous
        self.denoiser = make_denoiser(spaces, network)
        self.average = deepcopy(self.denoiser).requires_grad_(False)
        self._schedule = make_schedule(config.schedule, config.steps)
        self.use(None)

    def use(self, solver: Solver | None) -> None:
        """Decide by `solver`, a sample by its walk from a random x_M; None: as trained, and from x_M = 0 by DDIM.

        Raises:
            ValueError: its steps are not of the chain's.
        """
        self.solver = solver
        self._walk = solver or Solver("ddim", self.config.steps)
        self._walked, kept = thinned(self.config.schedule, self.config.steps, self._walk.steps)
        self._steps_walked = torch.tensor(kept)

    @property
    def noise_steps(self) -> int:
        """Steps of a decision's sample that take noise."""
        return self.config.steps if self.solver is None else 0

    def schedule(self, device: torch.device) -> Schedule:
        """The noise schedule on `device`."""
        if self._schedule.beta.device != device:
            self._schedule = self._schedule.to(device)
        return self._schedule

    def sample(
        self, denoiser: Denoiser, context: Context, noise: ChainNoise, gradient_steps: int | None = None
    ) -> Tensor:
        """x_0 (N, C + D) of the chain from `noise`, eq. (reverse_QL); the graph holds the last `gradient_steps`."""
        schedule, config = self.schedule(noise.start.device), self.config
        predict = self._chain(denoiser, context, noise.start.device)
        if config.sampler == "ddim":
            return ddim(
                predict,
                schedule,
                noise.start,
                noise.steps,
                ddim_eta=config.ddim_eta,
                clip_x0=config.clip_x0,
                gradient_steps=gradient_steps,
            )
        return ddpm(
            predict,
            schedule,
            noise.start,
            noise.steps,
            variance=config.variance,
            clip_x0=config.clip_x0,
            gradient_steps=gradient_steps,
        )

    def map(self, denoiser: Denoiser, context: Context, start: Tensor | None) -> Tensor:
        """x_0 (N, C + D) that the solver, by default DDIM over all steps, makes of x_M = start (N, C + D); None: 0."""
        still = start is None
        if start is None:
            start = torch.zeros((), device=context[0].device)
        if self._steps_walked.device != start.device:
            self._walked, self._steps_walked = self._walked.to(start.device), self._steps_walked.to(start.device)
        predict = self._chain(denoiser, context, start.device, self._steps_walked, still)
        if self._walk.name == "dpm":
            return dpm_solver_pp_2m(predict, self._walked, start, clip_x0=self.config.clip_x0)
        return ddim(predict, self._walked, start, None, clip_x0=self.config.clip_x0)

    def _chain(
        self,
        denoiser: Denoiser,
        context: Context,
        device: torch.device,
        kept: Tensor | None = None,
        still: bool = False,
    ) -> ChainDenoiser:
        """The network as the samplers call it, with the parts of s and of all steps computed here, once.

        `still`: it sets out from 0.
        """
        numbers = torch.arange(1, self.config.steps + 1, device=device) if kept is None else kept
        steps = denoiser.steps(numbers).split(1)

        def predict(vector: Tensor, step: int) -> Tensor:
            return denoiser.predict(context, None if still and step == len(steps) else vector, steps[step - 1])

        return predict

    @torch.no_grad()
    def act(self, context: Context, generator: torch.Generator, deterministic: bool) -> HybridAction:
        """One action a row by the average network; deterministic: from x_M = 0."""
        return self.decide(context, None if deterministic else self.draw(context, generator))

    def draw(self, context: Context, generator: torch.Generator) -> ChainNoise:
        """Noise of one sample a row."""
        return ChainNoise.draw(len(context[0]), self.average.vector_size(context), self.noise_steps, generator)

    @torch.no_grad()
    def answer(self, context: Context, noise: ChainNoise | None) -> Tensor:
        """One vector (C + D) a row by the average network; without noise: from x_M = 0."""
        if noise is not None and self.solver is None:
            vector = self.sample(self.average, context, noise)
        else:
            vector = self.map(self.average, context, None if noise is None else noise.start)
        return self.average.possible(context, vector)

    def decide(self, context: Context, noise: ChainNoise | None) -> HybridAction:
        """The action of `answer`."""
        return decode(self.answer(context, noise), self.continuous)


def block_mean(error: Tensor, continuous: int, weight: float) -> Tensor:
    """Mean of squared errors (B, C + D) with `weight` on the C continuous entries, which D choice entries outnumber."""
    scale = torch.ones(error.shape[-1], device=error.device)
    scale[:continuous] = weight
    return (error.mean(dim=0) * scale).sum() / scale.sum()
