"""Neural networks: the paper's perceptron and one over the set of devices, behind the same interfaces."""

from uavrl.networks.build import NetworkConfig, Spaces, fit_normalisers, make_actor, make_critic, make_denoiser
from uavrl.networks.interfaces import Actor, Critic, Denoiser, Observation, repeat

__all__ = [
    "Actor",
    "Critic",
    "Denoiser",
    "NetworkConfig",
    "Observation",
    "Spaces",
    "fit_normalisers",
    "make_actor",
    "make_critic",
    "make_denoiser",
    "repeat",
]
