"""Work that imports foreign code, in a fork of this process that ends with the work.

A foreign module may end its process when it is imported, hang, replace functions of Python, or start programs. The
process of the command decides what a hunt reports, so it imports no module of an agent.

The work is done in a fork of a fork. The first fork, the keeper, runs no foreign code, so it can end every program that
the work has started. The keeper ends these programs at the end of the work, and when the command is interrupted or
killed.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import select
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

from crashhunt.base import errors
from crashhunt.base.errors import CrashhuntError, PluginError
from crashhunt.base.forks import CannotForkError, Copy, ends, held, threads, write_all
from crashhunt.base.opened_files import OpenedFiles
from crashhunt.base.processes import die_with, end_descendants

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from crashhunt.base.json_types import ErrorData, Plain

    Report: TypeAlias = Callable[[str], None]

C = TypeVar("C", bound=Copy)

OWN_THREAD = "crashhunt"
"""Prefix of the names of threads of crashhunt, which work that imports something does not need."""

_opened: OpenedFiles | None = None
_KEEPER_S = 3.0  # for the keeper to end the programs that the work has started
_LOOK_EVERY_S = 0.002  # between two checks of whether the keeper has ended
_TASK = 1 << 10  # bytes of the words for what the work does
_RECEIVED = 1 << 16  # bytes at a time
_MODULE = "see what the module does when it is imported, or give it more time with --timeout"


def work_apart(work: Callable[[Report], Plain], *, task: str, timeout_s: float) -> Plain:
    """Return the result of a function that imports foreign code. The function runs in a fork of this process.

    If this process cannot be forked, or has other Python threads, the function runs in this process. A process with
    other threads is a user's program that calls crashhunt, and that imports the user's modules anyway.

    Args:
        work: the function to call; its result must be expressible as JSON. The argument of the function is another
            function, to be called with each new task.
        task: the error to report if there is no result, such as "'planner:Planner' cannot be imported".
        timeout_s: time limit, in s of wall time.

    Raises:
        CrashhuntError: the function raised this error.
        PluginError: the fork ended without a result, or exceeded the time limit.
    """
    if _is_embedded():
        return work(lambda _: None)
    begun = _Task(task)

    def answer() -> Plain:
        global _opened
        _opened = OpenedFiles()
        try:
            return {"result": work(begun.write)}
        except CrashhuntError as error:
            return _described(error)

    try:
        keeper = _keeper_of(answer, timeout_s)
    except CannotForkError:
        return work(lambda _: None)
    return _result(keeper.answer(timeout_s + _KEEPER_S), keeper, begun.read(), _MODULE)


def files_read_apart() -> list[str]:
    """Return the files that the work of `work_apart` has read in its fork; nothing in another process."""
    return [] if _opened is None else _opened.inputs()


class ServerApart:
    """A function that a fork of this process calls once for each request, until `close` or the end of this process.

    Unlike `work_apart`, the fork keeps the modules that it has imported.

    Args:
        work: function that returns the answer to a request; both must be expressible as JSON.
        task: the error to report if there is no answer, such as "the disturbance 'trucks:CutIn' cannot be drawn".
        fix: the fix for this error.
        timeout_s: maximum wall time for an answer, in s.
    """

    def __init__(self, work: Callable[[Plain], Plain], *, task: str, fix: str, timeout_s: float) -> None:
        self._work, self._task, self._fix, self._timeout_s = work, task, fix, timeout_s
        self._keeper: _Keeper | None = None
        self._requests = self._answers = -1
        if _is_embedded():
            return
        requests, self._requests = os.pipe()
        self._answers, answers = os.pipe()
        ends.update((self._requests, self._answers))
        try:
            serve = partial(_serve, work, requests, answers)
            self._keeper = _keeper_of(serve, math.inf, keeps=(requests, answers))
        except CannotForkError:
            self._close()
        finally:
            os.close(requests)
            os.close(answers)

    def ask(self, request: Plain) -> Plain:
        """Return the answer to a request.

        Raises:
            CrashhuntError: the function raised this error.
            PluginError: the fork ended without an answer, or exceeded the time limit.
        """
        if self._keeper is None:
            return self._work(request)
        if self._requests < 0:
            raise PluginError(f"{self._task}: its process has ended", fix=self._fix)
        received, deadline = bytearray(), time.monotonic() + self._timeout_s
        with suppress(BrokenPipeError):  # which the missing answer shows
            write_all(self._requests, json.dumps(request).encode() + b"\n")
        while not received.endswith(b"\n"):
            watched = (
                self._answers,
                self._keeper.end_of_answer,
            )  # a program that the work has started may keep one open
            ready, _, _ = select.select(watched, [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                self.close()
                raise PluginError(f"{self._task}: it took longer than {self._timeout_s:g} s", fix=self._fix)
            data = os.read(self._answers, _RECEIVED) if self._answers in ready else b""
            if not data:
                self._close()
                return _result(self._keeper.answer(_KEEPER_S), self._keeper, self._task, self._fix)
            received += data
        answered: Any = None
        with suppress(ValueError):
            answered = json.loads(received)
        return _result(answered, self._keeper, self._task, self._fix)

    def close(self) -> None:
        """End the fork; a second call does nothing."""
        if self._keeper is not None and self._requests >= 0:
            self._close()
            self._keeper.end()

    def _close(self) -> None:
        ends.difference_update((self._requests, self._answers))
        os.close(self._requests)
        os.close(self._answers)
        self._requests = self._answers = -1


def _serve(work: Callable[[Plain], Plain], requests: int, answers: int) -> Plain:
    """Answer requests until the pipe for requests is closed."""
    with os.fdopen(requests, "rb", closefd=False) as lines:
        for line in lines:
            try:
                answer: Plain = {"result": work(json.loads(line))}
            except CrashhuntError as error:
                answer = _described(error)
            write_all(answers, json.dumps(answer).encode() + b"\n")
    return {}


class _Task:
    """The present task of a function, as text that remains readable after its process has ended."""

    def __init__(self, text: str) -> None:
        self._words = mmap.mmap(-1, _TASK)
        self.write(text)

    def write(self, text: str) -> None:
        self._words[:] = text.encode()[:_TASK].ljust(_TASK, b"\0")

    def read(self) -> str:
        return self._words[:].rstrip(b"\0").decode(errors="replace")


class _Keeper(Copy):
    """A process that ends every program below it before it ends itself."""

    @property
    def end_of_answer(self) -> int:
        """The file descriptor of a pipe from the keeper, which becomes readable when the work has ended."""
        return self._end

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


def _keeper_of(answer: Callable[[], Plain], timeout_s: float, keeps: Collection[int] = ()) -> _Keeper:
    """Fork a keeper, which forks the process that does the work.

    Raises:
        CannotForkError: this process cannot be forked.
    """
    owner = os.getpid()

    def keep() -> Plain:
        _end_when_asked(owner)
        copy = _fork(answer, Copy, keeps)
        for descriptor in keeps:  # whose other ends see that the work has ended
            os.close(descriptor)
        found = copy.answer(timeout_s)
        return {"silence": copy.no_answer.why if copy.no_answer is not None else ""} if found is None else found

    return _fork(keep, _Keeper, keeps)


def _fork(work: Callable[[], Plain], kind: type[C], keeps: Collection[int] = ()) -> C:
    # Threads of NumPy's libraries, for instance: a fork that only imports modules does not need them.
    return kind(work, replace(held(), threads=threads()), keeps=keeps)


def _is_embedded() -> bool:
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    return not all(thread.name.startswith(OWN_THREAD) for thread in others)


def _result(answered: Any, keeper: Copy, task: str, fix: str) -> Plain:
    """Return the result from an answer.

    Raises:
        CrashhuntError: the work raised this error.
        PluginError: the answer contains no result.
    """
    if isinstance(answered, dict) and "result" in answered:
        result: Plain = answered["result"]
        return result
    if isinstance(answered, dict) and "error" in answered:
        raise _rebuilt(str(answered.get("kind")), cast("ErrorData", answered))
    why = answered.get("silence", "") if isinstance(answered, dict) else ""
    why = why or (keeper.no_answer.why if keeper.no_answer is not None else "ended")
    raise PluginError(f"{task}: its process {why} meanwhile", fix=fix)


def _end_when_asked(owner: int) -> None:
    """Make this process, the keeper, end with all programs below it on SIGTERM, even after its owner has ended."""

    def end(_number: int, _frame: object) -> None:
        end_descendants()
        os._exit(1)

    for number in (signal.SIGINT, signal.SIGHUP):  # of the terminal, for the whole group: the owner decides
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, end)
    die_with(owner, signal.SIGTERM)


def _described(error: CrashhuntError) -> Plain:
    return {**error.to_json(), "kind": type(error).__name__}


def _rebuilt(kind: str, data: ErrorData) -> CrashhuntError:
    found: object = getattr(errors, kind, None)
    known = found if isinstance(found, type) and issubclass(found, CrashhuntError) else CrashhuntError
    return known.from_json(data)
