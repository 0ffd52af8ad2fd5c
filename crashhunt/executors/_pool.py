"""A pool of slots: the supervisor of each slot runs one trial after another, each in a new process."""

from __future__ import annotations

import json
import queue
import selectors
import signal
import socket
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import WorkerError
from crashhunt.base.signals import describe_death
from crashhunt.executors._fork_server_link import ForkServerLink
from crashhunt.executors._postmortem import result_of_death
from crashhunt.executors._protocol import Answer, Notes
from crashhunt.executors._trial_attempts import TrialAttempt, where_it_is
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from crashhunt.episode import WorkerSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialSpec


_LOOK_EVERY_S = 0.5  # whether the pool is closing, should nothing wake it up
_CHUNK_BYTES = 1 << 16  # bytes at a time; a result is a few hundred


@dataclass(slots=True, eq=False)
class _Worker:
    """A supervisor, and the trial that it runs."""

    slot: int
    socket: socket.socket
    attempt: TrialAttempt | None = None
    received: bytearray = field(default_factory=bytearray)
    retired: bool = False  # it is not given any more trials


class PoolExecutor:
    """Runs every trial in its own process: a fork of a process that has imported the agents and has run no trial.

    A thread starts a trial as soon as a slot is free, independently of the thread of the hunt.

    Args:
        settings: settings of the hunt.
        parallel: number of slots.
        snapshot: whether the trials use the crashhunt of the settings' snapshot, in new Python processes.
        may_repeat: function that returns whether a trial may run again, alone on the machine; called repeatedly.

    Attributes:
        held_back: number of slots that receive no further trial for now.
    """

    def __init__(
        self,
        settings: WorkerSettings,
        *,
        parallel: int = 1,
        snapshot: bool = False,
        may_repeat: Callable[[], bool] = lambda: True,
    ) -> None:
        self.held_back = 0
        self._may_repeat = may_repeat
        self._snapshot = snapshot
        self._settings = settings
        self._parallel = parallel
        self._lock = threading.RLock()
        self._waiting: deque[TrialAttempt] = deque()
        self._workers: dict[int, _Worker] = {}
        self._slots = 0
        self._done: queue.SimpleQueue[TrialResult | Exception] = queue.SimpleQueue()
        self._notes = Notes(settings.scratch)
        self._selector = selectors.DefaultSelector()
        self._link: ForkServerLink | None = None
        self._wake_up, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread: threading.Thread | None = None
        self._closing = False

    @property
    def capacity(self) -> int:
        """The number of trials that run at a time."""
        return self._parallel

    @property
    def runs(self) -> bool:
        """Whether a trial runs."""
        return any(worker.attempt is not None for worker in list(self._workers.values()))

    @property
    def repeats(self) -> bool:
        """Whether a trial runs again, or waits for it."""
        attempts = [*self._waiting, *(worker.attempt for worker in list(self._workers.values()))]
        return any(attempt is not None and attempt.alone for attempt in attempts)

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        with self._lock:
            self._waiting.append(TrialAttempt(spec))
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, name="crashhunt-pool", daemon=True)
                self._thread.start()
        self._wake_up.send(b".")

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended; wait at most ``timeout_s`` for the first one.

        Raises:
            CrashhuntError: no trial can be run, for a reason outside of the trials.
        """
        with suppress(queue.Empty):
            found = self._done.get(timeout=timeout_s) if timeout_s > 0 else self._done.get_nowait()
            while True:
                if isinstance(found, Exception):
                    raise found
                yield found
                found = self._done.get_nowait()

    def cancel(self, *, above: int = -1) -> None:
        """Cancel all trials whose number is greater than ``above``, at once."""
        with self._lock:
            self._waiting = deque(attempt for attempt in self._waiting if attempt.spec.number <= above)
            for worker in self._workers.values():
                if worker.attempt is not None and worker.attempt.spec.number > above:
                    worker.attempt = None
                    self._stop_worker(worker)
                    if self._link is not None:
                        self._link.kill(worker.slot)
            kept = []
            with suppress(queue.Empty):
                while True:
                    found = self._done.get_nowait()
                    if isinstance(found, Exception) or found.spec.number <= above:
                        kept.append(found)
            for found in kept:
                self._done.put(found)

    def where(self) -> dict[int, BlackBoxHeader]:
        """Return the progress of each running trial, for the status screen."""
        with self._lock:
            running = [worker.attempt.spec.number for worker in self._workers.values() if worker.attempt is not None]
        found = {number: where_it_is(self._settings.scratch, number) for number in running}
        return {number: header for number, header in found.items() if header is not None}

    def notes(self) -> list[str]:
        """Return new notices for the user."""
        return self._notes.fresh()

    def close(self) -> None:
        """Kill every worker, including all processes that it has started."""
        with self._lock:
            self._closing = True
            self.cancel()
        if self._link is not None:
            self._link.end()
        if self._thread is not None:
            with suppress(OSError):
                self._wake_up.send(b".")
            self._thread.join()
            self._thread = None
        for worker in self._workers.values():
            worker.socket.close()
        self._workers.clear()
        self._selector.close()
        self._wake_up.close()
        self._woken.close()

    def _serve(self) -> None:
        try:
            while not self._closing:
                ready = self._selector.select(_LOOK_EVERY_S)
                with self._lock:
                    if self._closing:
                        return
                    for key, _ in ready:
                        if key.fileobj is self._woken:
                            self._woken.recv(_CHUNK_BYTES)
                        elif isinstance(key.data, _Worker):
                            if key.data.slot in self._workers:  # which its end, heard of just now, has changed
                                self._read_messages(key.data)
                        else:
                            self._read_fork_server()
                    self._assign_trials()
        except Exception as error:
            self._done.put(error)

    def _assign_trials(self) -> None:
        """Assign trials to free slots, in the order of the queue."""
        while self._waiting:
            running = [worker.attempt for worker in self._workers.values() if worker.attempt is not None]
            if any(attempt.alone for attempt in running):
                return
            if self._waiting[0].alone and (running or not self._may_repeat()):
                return
            if len(running) >= self._parallel - self.held_back:
                return
            if self._link is None:
                self._link = ForkServerLink(self._settings, snapshot=self._snapshot)
                self._selector.register(self._link.control, selectors.EVENT_READ)
            free = next((worker for worker in self._workers.values() if not (worker.attempt or worker.retired)), None)
            if free is None:
                if (
                    not self._link.ready
                    or sum(not worker.retired for worker in self._workers.values()) >= self._parallel
                ):
                    return
                free = self._start_worker(self._link)
            self._send_trial(free, self._waiting.popleft())

    def _start_worker(self, link: ForkServerLink) -> _Worker:
        ours, theirs = socket.socketpair()
        with theirs:
            self._slots += 1
            link.fork(self._slots, theirs)
        worker = self._workers[self._slots] = _Worker(self._slots, ours)
        ours.setblocking(False)
        self._selector.register(ours, selectors.EVENT_READ, worker)
        return worker

    def _send_trial(self, worker: _Worker, attempt: TrialAttempt) -> None:
        worker.attempt = attempt
        text = json.dumps(attempt.spec.to_json()).encode() + b"\n"
        worker.socket.setblocking(True)
        with suppress(OSError):  # it has ended, which the fork server will report
            worker.socket.sendall(text)
        worker.socket.setblocking(False)

    def _read_messages(self, worker: _Worker) -> None:
        """Read the complete messages that a worker has sent."""
        over = False
        try:
            data = worker.socket.recv(_CHUNK_BYTES)
            over = not data
            worker.received += data
        except BlockingIOError:
            return
        except OSError:
            over = True
        if over:
            with suppress(KeyError, ValueError):
                self._selector.unregister(worker.socket)
        while b"\n" in worker.received:
            line, _, rest = bytes(worker.received).partition(b"\n")
            worker.received = bytearray(rest)
            self._handle_message(worker, line)

    def _handle_message(self, worker: _Worker, line: bytes) -> None:
        """Process the message of a supervisor about its trial."""
        attempt = worker.attempt
        if attempt is None:
            return  # it was cancelled meanwhile
        answer: Answer = json.loads(line)
        if "error" in answer:
            raise WorkerError.from_json(answer)  # or an InternalError
        if "lost" in answer:
            worker.attempt = None
            self._end_attempt(attempt, answer["lost"])
            self._stop_worker(worker)
            return
        result = TrialResult.from_json(answer["result"])
        if answer.get("searches"):
            attempt.result = result
            return
        worker.attempt = None
        for notice in answer.get("notices", ()):
            self._notes.add(notice)
        self._done.put(result)
        if self._link is not None:
            self._link.deaths = 0
        if answer.get("retires"):
            self._stop_worker(worker)

    def _stop_worker(self, worker: _Worker) -> None:
        """Send a supervisor no further trials; it ends when it has none left."""
        worker.retired = True
        with suppress(OSError):
            worker.socket.shutdown(socket.SHUT_WR)

    def _read_fork_server(self) -> None:
        """Process the messages of the fork server about ended supervisors, and its own end."""
        assert self._link is not None
        messages = self._link.receive()
        for message in messages or ():
            self._ended(message["slot"], message["exit_code"])
        if messages is None:
            self._restart()

    def _restart(self) -> None:
        """Start a new fork server, and run the trials again that were running when the old one ended."""
        assert self._link is not None
        for worker in list(self._workers.values()):
            self._discard(worker)
            if worker.attempt is not None:  # one of them may have done it, as shows when each runs alone
                self._end_attempt(worker.attempt, -signal.SIGKILL)
        self._waiting = deque(sorted(self._waiting, key=lambda attempt: attempt.spec.number))
        self._selector.unregister(self._link.control)
        if not self._link.unfit:
            self._notes.add("the process that starts the workers was killed from outside, and was started again")
        self._link = self._link.restart()
        self._selector.register(self._link.control, selectors.EVENT_READ)

    def _ended(self, slot: int, exit_code: int) -> None:
        worker = self._workers.get(slot)
        if worker is None:
            return
        self._read_messages(worker)  # what it said before it ended
        self._discard(worker)
        if worker.attempt is not None:  # an agent or another process has killed it
            self._end_attempt(worker.attempt, exit_code if exit_code < 0 else -signal.SIGKILL)

    def _end_attempt(self, attempt: TrialAttempt, exit_code: int) -> None:
        """Determine the result of a trial whose process has ended, or run the trial again."""
        scratch = self._settings.scratch
        if attempt.result is not None:
            why = f"the process that searched {describe_death(exit_code)}"
            self._done.put(replace(attempt.result, why_no_escape=why))
        elif why := attempt.again(scratch, exit_code):
            self._notes.add(why)
            self._waiting.appendleft(attempt)
        else:
            self._done.put(result_of_death(attempt, scratch, exit_code))

    def _discard(self, worker: _Worker) -> None:
        with suppress(KeyError, ValueError):
            self._selector.unregister(worker.socket)
        worker.socket.close()
        self._workers.pop(worker.slot, None)
