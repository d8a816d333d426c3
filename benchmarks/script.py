"""A script's words, read by its `main`'s signature as the command line reads its own: --help, one line for an error."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from typing import Any

from uavrl.cli import guarded, made_from
from uavrl.errors import ConfigError


def run(main: Callable[..., None], program: str) -> None:
    """Call `main` with what stands behind `python -m PROGRAM`, and exit."""

    @functools.wraps(main)
    def read(*positional: Any, **named: Any) -> Callable[[], None]:
        return functools.partial(main, *positional, **named)  # called outside, where errors are the script's own

    def action() -> None:
        asked = made_from(sys.argv[1:], read, f"python -m {program}")
        if asked is not None:
            asked()

    sys.exit(guarded(action))


def needed(name: str, given: Sequence[str]) -> None:
    """Refuse an empty list.

    Raises:
        ConfigError: nothing is `given`.
    """
    if not given:
        raise ConfigError(f"{name} is missing, needed: 1 or more")
