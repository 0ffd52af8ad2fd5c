"""Requests to stop: Ctrl-C, SIGTERM, a hang-up; and code that no signal handler may interrupt."""

from __future__ import annotations

import os
import signal
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["block_signals", "blocked_signals", "stop_requests"]

# Bound here, before an agent is imported that could replace them.
_set_mask, _ALL = signal.pthread_sigmask, tuple(signal.valid_signals())

_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SAME_REQUEST_S = 1.0
"""GNU timeout sends its signal to the process and then to its group, and batch systems do the like: what comes twice
within this is one request, not an impatient person."""


def block_signals() -> None:
    """Have no signal handler of Python run in this thread from now on.

    A handler whose signal has come before may run once more meanwhile, and what it raises is dropped.
    """
    for _ in range(2):
        try:
            _set_mask(signal.SIG_BLOCK, _ALL)
        except BaseException:
            continue


@contextmanager
def blocked_signals() -> Iterator[None]:
    """Have no signal handler of Python run in this thread meanwhile; signals that come are handled afterwards."""
    before = _set_mask(signal.SIG_BLOCK, ())
    try:
        block_signals()
        yield
    finally:
        _set_mask(signal.SIG_SETMASK, before)


@contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collect requests to stop, as numbers of signals, instead of ending; a later second one ends the process at once.

    Whoever ignores hang-ups, as nohup does, goes on ignoring them. In a thread that is not the main one nothing is
    collected: whoever runs us there handles signals.
    """
    asked: list[int] = []
    first_at: list[float] = []

    def stop(number: int, _frame: object) -> None:
        now = time.monotonic()
        if not first_at:
            first_at.append(now)
            asked.append(number)
        elif now - first_at[0] > _SAME_REQUEST_S:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    try:
        heeded = [number for number in _STOPS if signal.getsignal(number) is not signal.SIG_IGN]
        before = {number: signal.signal(number, stop) for number in heeded}
    except ValueError:  # not in the main thread
        before = {}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
