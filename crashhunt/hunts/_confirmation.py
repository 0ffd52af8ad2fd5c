"""Confirmation while a hunt goes on: each crash that it saves is run again, on one of the hunt's own slots."""

from __future__ import annotations

import queue
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.executors import PoolExecutor

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle
    from crashhunt.executors import Executor
    from crashhunt.hunts._again import RunsAgain
    from crashhunt.hunts._progress import Progress

__all__ = ["Confirmation"]


class Confirmation:
    """Confirms crashes one at a time, beside the thread of the hunt. Meanwhile, the hunt has one slot less.

    Crashes that it has not come to when the hunt is over are confirmed then.

    Args:
        again: runs them.
        executor: of the hunt.
    """

    def __init__(self, again: RunsAgain, executor: Executor) -> None:
        self._again = again
        self._executor = executor
        self._asked: queue.SimpleQueue[Bundle | None] = queue.SimpleQueue()
        self._confirmed: queue.SimpleQueue[Bundle] = queue.SimpleQueue()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._known: set[str] = set()

    def look(self, progress: Progress) -> None:
        """Ask for crashes that are new, and take in those that have been confirmed."""
        if progress.kinds is None:
            return  # the first crash ends the hunt, and is confirmed then
        for bundle in progress.crashes:
            if bundle.confirmed is None and bundle.id not in self._known:
                self._known.add(bundle.id)
                self._asked.put(bundle)
                if self._thread is None:
                    self._thread = threading.Thread(target=self._confirm, name="crashhunt-confirmation", daemon=True)
                    self._thread.start()
        with suppress(queue.Empty):
            while True:
                found = self._confirmed.get_nowait()
                progress.replace([found if found.id == crash.id else crash for crash in progress.crashes])

    def close(self, progress: Progress) -> None:
        """Give up what runs, so that no stop waits for it."""
        self._over.set()
        if self._thread is not None:
            self._asked.put(None)
            self._thread.join()
        self.look(progress)

    def _confirm(self) -> None:
        while (bundle := self._asked.get()) is not None and not self._over.is_set():
            self._hold_back(1)
            try:
                found = self._again.confirm_one(bundle, self._over.is_set)
                if found is not bundle:
                    self._confirmed.put(found)
            except Exception:  # the confirmation at the end of the hunt reports it
                return
            finally:
                self._hold_back(0)

    def _hold_back(self, slots: int) -> None:
        if isinstance(self._executor, PoolExecutor):
            self._executor.held_back = slots
