"""Errors that a user can mend: each message is one line naming the field, the value and what is allowed."""


class UavrlError(Exception):
    """Base of every error caused by bad input; the command line prints it as one line and exits with code 2."""


class ScenarioError(UavrlError):
    """A scenario, layout or start position that cannot be flown."""


class DatasetError(UavrlError):
    """Logged flights that cannot be read or trained on."""


class CheckpointError(UavrlError):
    """A checkpoint that is missing, cut short, or made for something else."""


class ConfigError(UavrlError):
    """Settings of an agent, policy or run that contradict each other or do not exist."""


class DivergenceError(UavrlError):
    """Training left the range in which its numbers mean anything."""
