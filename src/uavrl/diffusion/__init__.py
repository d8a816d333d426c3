"""Denoising diffusion: noise schedules, samplers and the denoising loss, for any denoiser."""

from uavrl.diffusion.samplers import (
    ChainDenoiser,
    Denoiser,
    Variance,
    add_noise,
    ddim,
    ddpm,
    denoising_loss,
    dpm_solver_pp_2m,
    predict_x0,
    straight_through_clamp,
)
from uavrl.diffusion.schedules import Schedule, ScheduleName, make_schedule, schedule_from_beta, thinned

__all__ = [
    "ChainDenoiser",
    "Denoiser",
    "Schedule",
    "ScheduleName",
    "Variance",
    "add_noise",
    "ddim",
    "ddpm",
    "denoising_loss",
    "dpm_solver_pp_2m",
    "make_schedule",
    "predict_x0",
    "schedule_from_beta",
    "straight_through_clamp",
    "thinned",
]
