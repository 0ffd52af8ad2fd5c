"""Signals: requests to stop, deaths by external signals, and code that signal handlers cannot interrupt."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_SENT_FROM_OUTSIDE: Final = frozenset(
    {signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGKILL, signal.SIGXCPU}
)
"""What an administrator, a batch system, or the kernel where memory runs out, ends a process by."""
# Bound here, before an agent is imported that could replace them.
_set_mask, _ALL = signal.pthread_sigmask, tuple(signal.valid_signals())

_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SAME_REQUEST_S = 1.0
"""GNU timeout and batch systems send a signal to the process and then to its group. Two signals within this time are
therefore one request, not a second request of an impatient user."""


_interrupts: Final[list[int]] = []
"""Interrupts that `remember_interrupts` has seen."""


def remember_interrupts() -> None:
    """Pass a Ctrl-C on to the next `stop_requests` if Python has dropped its `KeyboardInterrupt`.

    Python drops exceptions that are raised in a callback of a weak reference, and importing a module runs such a
    callback each time.
    """

    def interrupt(number: int, _frame: object) -> None:
        _interrupts.append(number)
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not under nohup, which ignores it
        signal.signal(signal.SIGINT, interrupt)


def is_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is a Ctrl-C, or is caused by one.

    Up to version 3.11, Python turns a Ctrl-C that comes while a class is created into a `RuntimeError`.
    """
    seen: set[int] = set()  # because an error may be its own cause: raise error from error
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            return True
        seen.add(id(error))
        error = error.__cause__
    return False


@contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Return a context whose code is interrupted by an `InterruptedCodeError` if it does not end in time.

    The code is interrupted again each second, because it may catch the interruption.

    In a thread that is not the main thread, signal handlers cannot be set, so the code is not interrupted.

    Raises:
        InterruptedCodeError: the code did not end in time.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: object) -> None:
        raise _TimeIsUpError

    handler, timer = signal.signal(signal.SIGALRM, interrupt), signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    except _TimeIsUpError:
        raise InterruptedCodeError from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)
        signal.signal(signal.SIGALRM, handler if handler is not None else signal.SIG_DFL)


class InterruptedCodeError(TimeoutError):
    """The code in a context of `interrupted_after` did not end in time."""


class _TimeIsUpError(BaseException):
    """The code in a context of `interrupted_after` has run too long; code that catches `Exception` does not see it."""


class _EndedError(BaseException):
    """A signal requested the end of this process."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Return a context that removes all temporary files before SIGTERM or a hang-up ends this process."""
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


def block_signals() -> None:
    """Prevent signal handlers of Python from running in this thread from now on.

    If there are other threads, the kernel may deliver a signal to one of these, and then a handler runs. The handler of
    an earlier signal may still run once, and its exceptions are dropped.
    """
    for _ in range(2):
        try:
            _set_mask(signal.SIG_BLOCK, _ALL)
        except BaseException:
            continue


@contextmanager
def blocked_signals() -> Iterator[None]:
    """Return a context in which signal handlers of Python do not run in this thread; signals are handled afterwards."""
    before = _set_mask(signal.SIG_BLOCK, ())
    try:
        block_signals()
        yield
    finally:
        _set_mask(signal.SIG_SETMASK, before)


@contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collect requests to stop as signal numbers instead of ending the process; a second request ends it at once.

    An interrupt that `remember_interrupts` has seen is collected at once, because Python has dropped it. Hang-ups that
    are already ignored, as under nohup, stay ignored. Outside of the main thread nothing is collected, because the
    embedding program handles signals there.
    """
    asked = [*_interrupts[:1]]
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
        heeded = [number for number in _STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        before = {number: signal.signal(number, stop) for number in heeded}
    except ValueError:  # not in the main thread
        before = {}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible() -> Iterator[None]:
    """Return a context in which a Ctrl-C raises `KeyboardInterrupt`, even inside `stop_requests`.

    For a question to the user: what has only been collected would wait for an answer.
    """
    try:
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def is_sent_from_outside(exit_code: int) -> bool:
    """Return whether a process died of a signal that another process or the kernel may have sent.

    The exit code is that of `subprocess`, negative for a signal.
    """
    return -exit_code in _SENT_FROM_OUTSIDE


def describe_death(exit_code: int) -> str:
    """Return how a process ended: "was killed by SIGKILL", "exited with 3".

    The exit code is that of `subprocess`, negative for a signal.
    """
    return f"exited with {exit_code}" if exit_code >= 0 else f"was killed by {signal_name(exit_code)}"


def signal_name(exit_code: int) -> str:
    """Return the name of the signal that ended a process, such as ``SIGKILL``.

    The exit code is that of `subprocess`, negative for a signal.
    """
    try:
        return signal.Signals(-exit_code).name
    except ValueError:  # a real-time signal
        return f"signal {-exit_code}"
