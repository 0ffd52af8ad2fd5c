"""Work that imports foreign code, in a fork of this process that ends with the work.

A module of an agent may end its process when it is imported, hang, replace functions of Python, or start programs. The
process of the command decides what a hunt reports, so no such module is imported there.

The work is done in a fork of a fork. The first fork, the keeper, runs no foreign code, so it can end every program that
the work has started: at the end of the work, and when the command is interrupted or killed.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from crashhunt.base import errors
from crashhunt.base.errors import CrashhuntError, PluginError
from crashhunt.base.forks import CannotForkError, Copy, held, threads
from crashhunt.base.processes import die_with, end_descendants

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.json_types import ErrorData, Plain


__all__ = ["OWN_THREAD", "work_apart"]

OWN_THREAD = "crashhunt"
"""Prefix of the names of threads of crashhunt, which work that imports something does not need."""

_KEEPER_S = 3.0  # for the keeper to end the programs that the work has started
_LOOK_EVERY_S = 0.002  # between two checks of whether the keeper has ended


def work_apart(work: Callable[[], Plain], *, task: str, timeout_s: float) -> Plain:
    """Return what some work returns. The work is done in a fork of this process.

    It is done in this process if that cannot be forked, or if other threads of Python run. With other threads, this is
    a program of the user that calls crashhunt, and that imports the user's modules anyway.

    Args:
        work: its result must be expressible as JSON.
        task: what has failed if there is no result, as in "'planner:Planner' cannot be imported".
        timeout_s: time limit, in s of wall time.

    Raises:
        CrashhuntError: an error that the work has raised.
        PluginError: the fork ended without a result, or exceeded the time limit.
    """

    def answer() -> Plain:
        try:
            return {"result": work()}
        except CrashhuntError as error:
            return {**error.to_json(), "kind": type(error).__name__}

    owner = os.getpid()

    def keep() -> Plain:
        _end_when_asked(owner)
        copy = _fork(answer)
        found = copy.answer(timeout_s)
        return {"silence": copy.no_answer.why if copy.no_answer is not None else ""} if found is None else found

    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if not all(thread.name.startswith(OWN_THREAD) for thread in others):
        return work()
    try:
        keeper = _fork(keep, kind=_Keeper)
    except CannotForkError:
        return work()
    answered: Any = keeper.answer(timeout_s + _KEEPER_S)
    if answered is None or "silence" in answered:
        why = answered["silence"] if answered is not None else keeper.no_answer.why if keeper.no_answer else ""
        fix = "see what the module does when it is imported, or give it more time with --timeout"
        raise PluginError(f"{task}: its process {why} meanwhile", fix=fix)
    if "error" in answered:
        raise _rebuilt(str(answered.get("kind")), answered)
    result: Plain = answered["result"]
    return result


class _Keeper(Copy):
    """A fork that ends every program below it before it ends."""

    def end(self) -> None:
        if self._end < 0:
            return
        deadline = time.monotonic() + _KEEPER_S
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.pid, signal.SIGTERM)
            while not os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG):
                if time.monotonic() > deadline:
                    break
                time.sleep(_LOOK_EVERY_S)
        super().end()


def _fork(work: Callable[[], Plain], kind: type[Copy] = Copy) -> Copy:
    # Threads of NumPy's libraries, for instance: a fork that only imports modules does not need them.
    return kind(work, replace(held(), threads=threads()))


def _end_when_asked(owner: int) -> None:
    """Have this process, the keeper, end with all programs below it on SIGTERM, also when its owner has ended."""

    def end(_number: int, _frame: object) -> None:
        end_descendants()
        os._exit(1)

    for number in (signal.SIGINT, signal.SIGHUP):  # of the terminal, for the whole group: the owner decides
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, end)
    die_with(owner, signal.SIGTERM)


def _rebuilt(kind: str, data: ErrorData) -> CrashhuntError:
    found: object = getattr(errors, kind, None)
    known = found if isinstance(found, type) and issubclass(found, CrashhuntError) else CrashhuntError
    return known.from_json(data)
