"""Work that imports foreign code, in a fork of this process that ends with the work.

A module of an agent may end its process when it is imported, hang, or replace functions of Python. The process of the
command decides what a hunt reports, so no such module is imported there.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from crashhunt.base import errors
from crashhunt.base.errors import CrashhuntError, PluginError
from crashhunt.base.forks import CannotForkError, Copy, held, threads

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.json_types import ErrorData, Plain


__all__ = ["OWN_THREAD", "work_apart"]

OWN_THREAD = "crashhunt"
"""Prefix of the names of threads of crashhunt, which work that imports something does not need."""


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

    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if not all(thread.name.startswith(OWN_THREAD) for thread in others):
        return work()
    try:
        # Threads of NumPy's libraries, for instance: a fork that only imports modules does not need them.
        copy = Copy(answer, replace(held(), threads=threads()))
    except CannotForkError:
        return work()
    answered: Any = copy.answer(timeout_s)
    if answered is None:
        assert copy.no_answer is not None
        fix = "see what the module does when it is imported, or give it more time with --timeout"
        raise PluginError(f"{task}: its process {copy.no_answer.why} meanwhile", fix=fix)
    if "error" in answered:
        raise _rebuilt(str(answered.get("kind")), answered)
    result: Plain = answered["result"]
    return result


def _rebuilt(kind: str, data: ErrorData) -> CrashhuntError:
    found: object = getattr(errors, kind, None)
    known = found if isinstance(found, type) and issubclass(found, CrashhuntError) else CrashhuntError
    return known.from_json(data)
