"""Neural networks: the paper's perceptron and one over the set of devices, behind the same interfaces."""

from uavrl.networks.build import (
    NetworkConfig,
    Spaces,
    fit_normalisers,
    make_actor,
    make_choice_actor,
    make_classifier,
    make_conditional,
    make_critic,
    make_denoiser,
)
from uavrl.networks.interfaces import Actor, ChoiceActor, Conditional, Critic, Denoiser, Observation, repeat

__all__ = [
    "Actor",
    "ChoiceActor",
    "Conditional",
    "Critic",
    "Denoiser",
    "NetworkConfig",
    "Observation",
    "Spaces",
    "fit_normalisers",
    "make_actor",
    "make_choice_actor",
    "make_classifier",
    "make_conditional",
    "make_critic",
    "make_denoiser",
    "repeat",
]
