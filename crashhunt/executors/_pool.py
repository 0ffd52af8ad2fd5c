"""A pool of warm worker processes."""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
import time
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.context import ForkServerContext, ForkServerProcess
from types import ModuleType
from typing import TYPE_CHECKING, Any

from pebble import ProcessExpired, ProcessPool

from crashhunt.executors._remains import died, hung, where_it_is
from crashhunt.executors._worker import run_trial, start_worker, worker_environment
from crashhunt.plugins import registered

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.synchronize import RLock

    from pebble import ProcessFuture

    from crashhunt.executors._protocol import WorkerSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["PoolExecutor"]

_main_lock = threading.Lock()
_LOOK_EVERY_S = 0.1
_GRACE_S = 1.0  # for the pool to notice by itself that a worker is gone, with its exit code
_LAST_WORDS_S = 0.2  # after its time limit, for a hung worker to write down where it is stuck
_START_UP_S = 60.0  # for a new worker to import what it needs, before a trial counts as begun


@dataclass(slots=True)
class _Running:
    spec: TrialSpec
    future: ProcessFuture[TrialResult]
    gone_at: float | None = None  # when its process was first found dead
    killed: bool = False  # at its time limit, by us


class PoolExecutor:
    """Runs trials on warm workers, each a process of its own.

    pebble sees to it that a worker that dies costs its own trial only. What pebble does not see is seen here: a worker
    that leaves with exit code 0, and one that hangs.

    Args:
        settings: of the hunt.
        parallel: how many workers.
        recycle_after: trials after which a worker is replaced by a fresh one; 0 for never.
    """

    def __init__(self, settings: WorkerSettings, *, parallel: int = 1, recycle_after: int = 1000) -> None:
        self._settings = settings
        self._parallel = parallel
        self._recycle_after = recycle_after
        self._running: dict[int, _Running] = {}
        self._done: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._looked = 0.0
        self._pool: ProcessPool | None = None

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        pool = self._open()
        future = pool.schedule(run_trial, args=(spec,), timeout=self._settings.timeout_s + _START_UP_S)
        self._running[spec.number] = _Running(spec, future)
        future.add_done_callback(partial(self._finished, spec.number))

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended, waiting so long for a first one.

        Raises:
            CrashhuntError: a trial could not even begin, for a reason that has nothing to do with it.
        """
        deadline = time.monotonic() + timeout_s
        found = False
        while not found:
            wait = min(deadline - time.monotonic(), _LOOK_EVERY_S)
            with suppress(queue.Empty):
                number = self._done.get(timeout=wait) if wait > 0 else self._done.get_nowait()
                while True:
                    result = self._collect(number)
                    if result is not None:
                        found = True
                        yield result
                    number = self._done.get_nowait()
            if time.monotonic() - self._looked > _LOOK_EVERY_S:
                self._looked = time.monotonic()
                for result in self._look_after():
                    found = True
                    yield result
            if time.monotonic() >= deadline:
                return

    def cancel(self, *, above: int = -1) -> None:
        """Give up all trials whose number is greater than ``above``, at once."""
        given_up = [number for number in self._running if number > above]
        for number in given_up:
            running = self._running.pop(number)
            running.future.cancel()
            header = where_it_is(self._settings.scratch, number)
            if header is not None and not running.future.done():
                _kill(header.pid)

    def where(self) -> dict[int, BlackBoxHeader]:
        """Return where each running trial is, for people who watch."""
        found = {number: where_it_is(self._settings.scratch, number) for number in self._running}
        return {number: header for number, header in found.items() if header is not None}

    def close(self) -> None:
        """Kill every worker."""
        self.cancel()
        if self._pool is not None:
            # A worker is told to end by SIGTERM, which it does not catch: it ends even where it does not return.
            self._pool.stop()
            self._pool.join()
            self._pool = None

    def _finished(self, number: int, _future: object) -> None:
        self._done.put(number)

    def _open(self) -> ProcessPool:
        if self._pool is None or not self._pool.active:
            # The fork server has the simulator loaded, so that a new worker is there in milliseconds, not in seconds.
            context = _Context()
            preload = [start_worker.__module__]
            simulator = registered("simulators").get(self._settings.scenario.simulator)
            if simulator is not None:
                preload.append(simulator.module)
            context.set_forkserver_preload(preload)
            with _environment(worker_environment()):
                self._pool = ProcessPool(
                    max_workers=self._parallel,
                    max_tasks=self._recycle_after,
                    initializer=start_worker,
                    initargs=(self._settings,),
                    context=context,
                )
                assert self._pool.active  # starts it
        return self._pool

    def _collect(self, number: int) -> TrialResult | None:
        running = self._running.pop(number, None)
        if running is None:
            return None  # cancelled, or already accounted for
        spec, scratch = running.spec, self._settings.scratch
        try:
            return running.future.result()
        except TimeoutError:
            return hung(spec, scratch, self._settings.timeout_s)
        except ProcessExpired as expired:
            if running.killed:
                return hung(spec, scratch, self._settings.timeout_s)
            return died(spec, scratch, int(expired.exitcode))
        except CancelledError:
            return None
        except RuntimeError:  # pebble gave up on the whole pool, because a worker died between two trials
            self._resubmit(running)
            return None

    def _resubmit(self, first: _Running) -> None:
        """Start a new pool for everything that the broken one had not finished."""
        waiting = [first, *self._running.values()]
        self._running.clear()
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()
            self._pool = None
        for running in sorted(waiting, key=lambda item: item.spec.number):
            self.submit(running.spec)

    def _look_after(self) -> Iterator[TrialResult]:
        """Deal with workers that hang, and with those that left without a word."""
        now = time.monotonic()
        for number, running in list(self._running.items()):
            if running.future.done():
                continue
            header = where_it_is(self._settings.scratch, number)
            if header is None:
                continue
            if not _is_alive(header.pid):
                running.gone_at = running.gone_at or now
                if now - running.gone_at > _GRACE_S:
                    del self._running[number]
                    running.future.cancel()
                    if running.killed:
                        yield hung(running.spec, self._settings.scratch, self._settings.timeout_s)
                    else:
                        yield died(running.spec, self._settings.scratch, 0)
            elif now - header.started > self._settings.timeout_s + _LAST_WORDS_S and not running.killed:
                running.killed = True
                _kill(header.pid)


class _Process(ForkServerProcess):
    """Does not run the script that started the hunt again in every worker: nothing in there is needed."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802 - the name is multiprocessing's
        with _main_lock:
            script = sys.modules["__main__"]
            sys.modules["__main__"] = ModuleType("__main__")
            try:
                return ForkServerProcess._Popen(process_obj)
            finally:
                sys.modules["__main__"] = script


class _Context(ForkServerContext):
    """Keeps locks until the pool is gone: pebble drops its own before it has stopped the workers that are starting."""

    Process = _Process

    def __init__(self) -> None:
        super().__init__()
        self._locks: list[RLock] = []

    def RLock(self) -> RLock:  # noqa: N802 - the name is multiprocessing's
        """Make a lock."""
        lock = super().RLock()
        self._locks.append(lock)
        return lock


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Have the processes that start meanwhile see other environment variables."""
    before: dict[str, Any] = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
