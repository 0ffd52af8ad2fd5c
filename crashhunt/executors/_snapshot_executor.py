"""Trials run again with the code of a snapshot: in forks of one new Python process, where the snapshot can do that."""

from __future__ import annotations

import itertools
import json
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.episode import scratch_of
from crashhunt.executors._fresh import FreshProcessExecutor
from crashhunt.executors._pool import PoolExecutor

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._protocol import Executor
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["SharedExecutors", "run_alone", "snapshot_executor"]

_LOOK_EVERY_S = 0.1  # how late a request to stop may be


def snapshot_executor(settings: WorkerSettings, *, parallel: int = 1) -> Executor:
    """Return an executor that runs trials with the code of a snapshot, crashhunt itself included.

    Snapshots of crashhunt 0.1.0 and before have no fork server: with them, every trial starts Python anew.
    """
    package = [Path(folder) / layout.PACKAGE.name for folder in settings.code]
    if all((found / "executors" / "_fork_server.py").is_file() for found in package if found.is_dir()):
        return PoolExecutor(settings, parallel=parallel, snapshot=True)
    return FreshProcessExecutor(settings, parallel=parallel)


def run_alone(
    settings: WorkerSettings, spec: TrialSpec, stopped: Callable[[], bool] = lambda: False
) -> TrialResult | None:
    """Run one trial in a new Python process; return what came of it, None where it was stopped.

    Raises:
        CrashhuntError: it cannot be run.
    """
    with closing(FreshProcessExecutor(settings)) as executor:
        executor.submit(spec)
        while True:
            for result in executor.completed(_LOOK_EVERY_S):
                return result
            if stopped():
                return None


class SharedExecutors:
    """Executors for trials of several threads: those whose settings are equal share one.

    Args:
        scratch: a folder for them.
        parallel: trials at a time.
    """

    def __init__(self, scratch: Path, *, parallel: int) -> None:
        self._scratch = scratch
        self._parallel = parallel
        self._lock = threading.Lock()
        self._shared: dict[str, _Shared] = {}

    def run(
        self, settings: WorkerSettings, spec: TrialSpec, stopped: Callable[[], bool] = lambda: False
    ) -> tuple[TrialResult, Path] | None:
        """Run a trial.

        Returns:
            What came of it, and the folder in which it was recorded; None where it was stopped.

        Raises:
            CrashhuntError: it cannot be run.
        """
        key = json.dumps(replace(settings, scratch=self._scratch).to_json(), sort_keys=True)
        with self._lock:
            shared = self._shared.get(key)
            if shared is None:
                scratch = self._scratch / f"shared-{len(self._shared)}"
                scratch.mkdir(parents=True)
                executor = snapshot_executor(replace(settings, scratch=scratch), parallel=self._parallel)
                shared = self._shared[key] = _Shared(executor, scratch)
        return shared.run(spec, stopped)

    def close(self) -> None:
        """End every process."""
        for shared in self._shared.values():
            shared.executor.close()


class _Shared:
    """An executor of which each thread waits for its own trial.

    A trial that was stopped may still be running when the same one is asked for again, so that each run gets a number
    of its own, by which its folder is called.
    """

    def __init__(self, executor: Executor, scratch: Path) -> None:
        self.executor, self._scratch = executor, scratch
        self._lock = threading.Lock()
        self._ended: dict[int, TrialResult] = {}
        self._numbers = itertools.count()

    def run(self, spec: TrialSpec, stopped: Callable[[], bool]) -> tuple[TrialResult, Path] | None:
        with self._lock:
            number = next(self._numbers)
            self.executor.submit(replace(spec, number=number))
        while number not in self._ended:
            if stopped():
                return None
            with self._lock:
                if number not in self._ended:
                    for result in self.executor.completed(_LOOK_EVERY_S):
                        self._ended[result.spec.number] = result
        return replace(self._ended.pop(number), spec=spec), scratch_of(self._scratch, number)
