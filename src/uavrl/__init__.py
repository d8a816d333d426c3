"""Offline diffusion reinforcement learning for UAV-assisted wireless data collection."""

__version__ = "0.1.0"
