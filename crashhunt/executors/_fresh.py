"""A new Python process for every trial: slower than one pool, but independent of everything that ran before."""

from __future__ import annotations

import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING

from crashhunt.executors._pool import PoolExecutor
from crashhunt.executors._protocol import Notes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.episode import WorkerSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult, TrialSpec


_LOOK_EVERY_S = 0.01  # starting one takes thirty times as long


class FreshProcessExecutor:
    """Runs every trial in a pool of its own, with the code that the settings name."""

    def __init__(self, settings: WorkerSettings, *, parallel: int = 1) -> None:
        self._settings = settings
        self.capacity = parallel
        self._notes = Notes(settings.scratch)
        self._waiting: deque[TrialSpec] = deque()
        self._pools: dict[int, PoolExecutor] = {}  # by the number of the trial

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        self._waiting.append(spec)
        self._start()

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended; wait at most ``timeout_s`` for the first one.

        Raises:
            CrashhuntError: a trial cannot be run, for a reason outside of the trial.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            found = [result for pool in list(self._pools.values()) for result in pool.completed(0.0)]
            for result in found:
                self._end(result.spec.number)
            self._start()
            yield from found
            if found or time.monotonic() >= deadline:
                return
            time.sleep(_LOOK_EVERY_S)

    def cancel(self, *, above: int = -1) -> None:
        """Cancel all trials whose number is greater than ``above``, at once."""
        self._waiting = deque(spec for spec in self._waiting if spec.number <= above)
        for number in [number for number in self._pools if number > above]:
            self._end(number)

    def where(self) -> dict[int, BlackBoxHeader]:
        """Return the progress of each running trial, for the status screen."""
        return {number: header for pool in self._pools.values() for number, header in pool.where().items()}

    def notes(self) -> list[str]:
        """Return new notices for the user."""
        self._gather(*self._pools.values())
        return self._notes.fresh()

    def close(self) -> None:
        """Kill every process, including all processes that it has started."""
        self.cancel()

    def _start(self) -> None:
        while self._waiting and len(self._pools) < self.capacity:
            if any(pool.repeats for pool in self._pools.values()):
                return
            spec = self._waiting.popleft()
            may_repeat = partial(self._may_repeat, spec.number)
            pool = PoolExecutor(self._settings, snapshot=True, may_repeat=may_repeat)
            self._pools[spec.number] = pool
            pool.submit(spec)

    def _may_repeat(self, number: int) -> bool:
        """Return whether no other trial runs; of several trials that wait to be repeated, the first one comes first."""
        others = [(other, pool) for other, pool in list(self._pools.items()) if other != number]
        return all(pool.repeats and not pool.runs and other > number for other, pool in others)

    def _end(self, number: int) -> None:
        pool = self._pools.pop(number)
        self._gather(pool)
        pool.close()

    def _gather(self, *pools: PoolExecutor) -> None:
        for note in (note for pool in pools for note in pool.notes()):
            self._notes.add(note)
