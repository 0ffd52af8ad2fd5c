"""Phases of a hunt, their progress and the time left.

The time left is robust against trials that end in batches. The mean rate so far falls while a batch runs. The time left
by that rate rises for as long as a trial takes. Therefore a new estimate is made only when a trial ends, over the
time of whole batches, and the mean of the estimates of the last batch counts. Between two trials, the time left falls
with the clock.
"""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Literal, TypeVar

from crashhunt.base.codec import Serializable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["PhaseClock", "PhaseName", "PhaseStatus", "RemainingTime"]

T = TypeVar("T")
R = TypeVar("R")

PhaseName = Literal["causes", "confirming", "auditing", "near misses", "probes", "branches", "rare crashes"]
"""What a hunt does after its last trial."""

_TICK_S = 0.1  # how late the screen may be
_MIN_SPAN = 8  # trials whose mean rate is an estimate
_MAX_SPAN = 10_000  # trials whose times are kept
_STALL_BATCHES = 2  # durations of a batch without an end of a trial, after which the time left stands still


class RemainingTime:
    """Estimates when the last of several trials ends, from the times at which trials end.

    Cost: constant for each trial and each question, but for O(`_MAX_SPAN`) memory.

    Args:
        began: when the first trial began, in s of a monotonic clock.
    """

    def __init__(self, began: float) -> None:
        self._began = began
        self._times: deque[float] = deque(maxlen=_MAX_SPAN)
        self._count = 0
        self._ends: deque[float] = deque()
        self._rate = 0.0

    def ended(self, now: float, left: int, parallel: int) -> None:
        """Count a trial that has ended.

        Args:
            now: when, in s of the same clock.
            left: number of trials that have not ended.
            parallel: number of trials that run at a time.
        """
        self._count += 1
        self._times.append(now)
        span = min(max(_MIN_SPAN, 4 * parallel, self._count // 2), self._count, _MAX_SPAN - 1)
        span = max(span // parallel * parallel, min(span, parallel))  # whole batches
        first = self._began if span == self._count else self._times[-span - 1]
        self._rate = span / max(now - first, 1e-6)
        if self._count <= parallel:  # the first batch is not complete before
            self._ends.clear()
        self._ends.append(now + left / self._rate)
        while len(self._ends) > parallel:
            self._ends.popleft()

    def seconds_left(self, now: float, left: int, parallel: int) -> float:
        """Return the time until the last trial ends, in s; infinite before the first trial has ended.

        Args:
            now: in s of the same clock.
            left: number of trials that have not ended.
            parallel: number of trials that run at a time.
        """
        if not left:
            return 0.0
        if not self._ends:
            return math.inf
        stalls = self._times[-1] + _STALL_BATCHES * max(1, parallel) / self._rate
        return max(1.0, statistics.fmean(self._ends) - min(now, stalls))


@dataclass(frozen=True, slots=True)
class PhaseStatus(Serializable):
    """Progress of a phase.

    Args:
        name: of the phase.
        done: number of runs that have ended.
        total: number of runs.
        seconds_left: until the phase ends; None where that is unknown.
    """

    name: PhaseName
    done: int
    total: int
    seconds_left: float | None


class PhaseClock:
    """Reports the progress of what a hunt does after its last trial.

    Args:
        show: receives the progress about ten times a second, in the thread of the hunt.
        parallel: number of runs at a time.
    """

    def __init__(self, show: Callable[[PhaseStatus], None], parallel: int) -> None:
        self._show, self._parallel = show, max(1, parallel)
        self._name: PhaseName | None = None
        self._done = self._total = 0
        self._left = RemainingTime(0.0)
        self._shown = -math.inf

    def begin(self, name: PhaseName, total: int, done: int = 0) -> None:
        """Begin a phase.

        Args:
            name: of the phase.
            total: number of runs.
            done: number of these that earlier runs of the hunt have finished.
        """
        self._name, self._total, self._done = name, total, done
        self._left = RemainingTime(time.monotonic())
        self.tick(force=True)

    def advance(self) -> None:
        """Count a run that has ended."""
        self._done += 1
        self._left.ended(time.monotonic(), self._total - self._done, self._parallel)
        self.tick(force=True)

    def tick(self, *, force: bool = False) -> None:
        """Show the progress, if that was not done in the last 0.1 s; nothing before the first phase."""
        now = time.monotonic()
        if self._name is None or (now - self._shown < _TICK_S and not force):
            return
        self._shown = now
        left = self._left.seconds_left(now, self._total - self._done, self._parallel)
        self._show(
            PhaseStatus(
                name=self._name,
                done=self._done,
                total=self._total,
                seconds_left=left if math.isfinite(left) else None,
            )
        )

    def run(
        self, function: Callable[[T], R], items: Sequence[T], *, counts: Callable[[R], bool] = lambda _: True
    ) -> list[R]:
        """Run a function of each item in threads that wait for processes; return the results in their order.

        Args:
            function: is called in a thread.
            items: its arguments.
            counts: whether a result counts as a run that has ended.
        """
        with ThreadPoolExecutor(self._parallel) as threads:
            futures = [threads.submit(function, item) for item in items]
            pending = dict.fromkeys(futures)
            while pending:
                first = list(islice(pending, 8 * self._parallel))  # a wait for 10,000 futures takes longer than a tick
                for future in wait(first, timeout=_TICK_S, return_when=FIRST_COMPLETED).done:
                    del pending[future]
                    if counts(future.result()):
                        self.advance()
                self.tick()
            return [future.result() for future in futures]
