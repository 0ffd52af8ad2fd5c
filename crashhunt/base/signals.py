"""Requests to stop: Ctrl-C, SIGTERM, a hang-up."""

from __future__ import annotations

import os
import signal
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["ended_by_signals", "stop_requests"]

_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SAME_REQUEST_S = 1.0
"""GNU timeout sends its signal to the process and then to its group, and batch systems do the like: what comes twice
within this is one request, not an impatient person."""


class _EndedError(BaseException):
    """A signal asked this process to end."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Have SIGTERM and a hang-up end this process as they do by default, but after everything temporary is removed."""
    asked: list[int] = []

    def end(number: int, _frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
        asked.append(number)
        raise _EndedError

    numbers = (signal.SIGTERM, signal.SIGHUP)
    try:
        heeded = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
        for number in heeded:
            signal.signal(number, end)
    except ValueError:  # not in the main thread
        heeded = []
    try:
        yield
    except _EndedError:
        pass
    finally:
        for number in heeded:
            signal.signal(number, signal.SIG_DFL)
        if asked:
            os.kill(os.getpid(), asked[0])


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
