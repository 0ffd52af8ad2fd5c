"""A copy of this process that sleeps, and does something whenever it is asked, each time as if for the first time."""

from __future__ import annotations

import json
import os
import select
import time
from functools import partial
from typing import TYPE_CHECKING

from crashhunt.base import forks
from crashhunt.base.answers import NoAnswer, explain_silence, took_longer
from crashhunt.base.processes import kill

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.plain import Plain

__all__ = ["Asleep"]

_RECEIVED = 1 << 16
_MORE_S = 1.0  # than a copy of it has, for it to say that there is no answer

# Kept apart from what an agent may put in their place.
_dumps, _loads, _write = json.dumps, json.loads, os.write


class Asleep:
    """A sleeping copy; whatever it is asked, a copy of its own does, so that it stays as it is.

    Args:
        work: what is done with what is asked; both that and what it returns are expressible as JSON.
        known: what was open before somebody's code ran.

    Raises:
        CannotForkError: this process cannot be copied.

    Attributes:
        pid: its process.
        raised: the exception that has ended what was asked last, in words; empty where there was none.
        no_answer: why `ask` has returned None.
        is_usable: whether it can be asked again.
    """

    def __init__(self, work: Callable[[Plain], Plain], known: forks.Held | None = None) -> None:
        self.raised = ""
        self.no_answer: NoAnswer | None = None
        self.is_usable = True
        wakes, self._asks = os.pipe()
        self._says, says = os.pipe()
        forks.ends.update((self._asks, self._says))
        try:
            self.pid = forks.fork(lambda: _sleep(wakes, says, work, known), known, keeps=(wakes, says))
        except BaseException:
            self._close()
            raise
        finally:
            os.close(wakes)
            os.close(says)

    def ask(self, job: Plain, timeout_s: float) -> Plain | None:
        """Return what comes of it; None where it raised something, died, or took longer: `no_answer` has the reason.

        Args:
            job: what is asked.
            timeout_s: wall time that it has, in s.
        """
        if not self.is_usable:
            return None
        children = forks.children_now()
        try:
            return self._ask(job, timeout_s)
        finally:
            if not self.is_usable:
                forks.end_orphans(children)

    def _ask(self, job: Plain, timeout_s: float) -> Plain | None:
        text, received = _dumps([job, timeout_s]).encode() + b"\n", bytearray()
        deadline = time.monotonic() + timeout_s + _MORE_S
        try:
            while text:
                text = text[_write(self._asks, text) :]
        except BrokenPipeError:
            self._lose(explain_silence(self.pid))
            return None
        while not received.endswith(b"\n"):
            ready, _, _ = select.select([self._says], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                self._lose(took_longer(timeout_s))
                return None
            data = os.read(self._says, _RECEIVED)
            if not data:
                self._lose(explain_silence(self.pid))
                return None
            received += data
        answer: Plain | None
        try:
            answer, self.raised, why = _loads(received)
        except (ValueError, TypeError):
            self._lose(NoAnswer("sent data that are no answer"))
            return None
        if answer is None:
            self.no_answer = NoAnswer(*why)
        return answer

    def _lose(self, why: NoAnswer) -> None:
        self.no_answer, self.is_usable = why, False

    def end(self) -> None:
        """End it, and whatever it has asked a copy for; may be called twice."""
        if self._asks >= 0:
            kill(self.pid)
            forks.ended(self.pid)
            self._close()

    def _close(self) -> None:
        forks.ends.difference_update((self._asks, self._says))
        os.close(self._asks)
        os.close(self._says)
        self._asks = self._says = -1


def _sleep(wakes: int, says: int, work: Callable[[Plain], Plain], known: forks.Held | None) -> None:
    with os.fdopen(wakes, "rb", closefd=False) as jobs:
        for line in jobs:
            job, timeout_s = _loads(line)
            answer: Plain | None = None
            raised, why = "", NoAnswer("")
            try:
                copy = forks.Copy(partial(work, job), known)
                answer, raised, why = copy.answer(timeout_s), copy.raised, copy.no_answer or why
            except forks.CannotForkError as error:
                raised = error.message
                why = NoAnswer(f"could not be made: {raised}", isinstance(error, forks.NoProcessError))
            text = _dumps([answer, raised, [why.why, why.is_from_outside]]).encode() + b"\n"
            while text:
                text = text[_write(says, text) :]
