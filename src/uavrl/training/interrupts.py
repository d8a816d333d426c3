"""Ctrl-C between two steps of a loop, never within one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def held_interrupts() -> Iterator[Callable[[], bool]]:
    """While open, Ctrl-C only raises a flag, which the yielded function reads; a second one interrupts at once.

    So what a loop saves on Ctrl-C is a state that an uninterrupted run passes through as well. Where Python's own
    handler is not in place, as in another thread than the main one, nothing changes and the flag stays down.
    """
    python = signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not python:
        yield lambda: False
        return
    raised = False

    def hold(number: int, frame: Any) -> None:
        nonlocal raised
        raised = True
        signal.signal(signal.SIGINT, python)

    signal.signal(signal.SIGINT, hold)
    try:
        yield lambda: raised
    finally:
        signal.signal(signal.SIGINT, python)
