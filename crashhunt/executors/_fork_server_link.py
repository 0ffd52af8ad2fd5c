"""The pool's end of its fork server: how the fork server is started, asked for supervisors, and listened to."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.base.errors import WorkerError
from crashhunt.base.reaper import Kept
from crashhunt.base.signals import describe_death
from crashhunt.executors._time_limits import import_died
from crashhunt.executors._worker_environment import snapshot_environment, worker_environment

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._protocol import ForkServerJob, FromForkServer


_MAX_MESSAGE_BYTES = 1 << 16  # bytes, as in _fork_server


_MAX_CONSECUTIVE_DEATHS = 3  # in a row, without a trial between them, before the pool stops


_END_S = 5.0  # for the template to say why it ended


_OUTSIDE_SIGNALS = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGKILL)


_numbers = itertools.count()


class ForkServerLink:
    """The connection to a running fork server.

    Args:
        settings: settings of the hunt.
        late: whether each trial imports its agents itself, because a process with imported agents cannot be forked.
        deaths: number of times that the process was killed.
        snapshot: whether the processes use the crashhunt of the settings' snapshot.
    """

    def __init__(
        self, settings: WorkerSettings, *, late: bool = False, deaths: int = 0, snapshot: bool = False
    ) -> None:
        self._settings = settings
        self._late = late
        self._snapshot = snapshot
        self.deaths = deaths
        self.ready = False
        self._importing = ""  # what its template could not import when it was killed, in words
        self.unfit = False
        number = next(_numbers)
        self._job = settings.scratch / f"fork-server-{number}.json"
        path = [] if snapshot else sys.path
        content: ForkServerJob = {"settings": settings.to_json(), "sys_path": path, "late": late}
        environment = snapshot_environment(settings) if snapshot else {**os.environ, **worker_environment()}
        self._job.write_text(json.dumps(content), encoding="utf-8")
        self._log = settings.scratch / f"fork-server-{number}.log"
        # Messages stay apart from each other, and file descriptors with theirs.
        self.control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, self._log.open("wb") as log:
            try:
                self._kept = Kept(
                    "crashhunt.executors._fork_server",
                    [str(theirs.fileno()), str(self._job)],
                    environment=environment,
                    inherited=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                )
            except BaseException:
                self.control.close()
                raise
        self.control.setblocking(False)

    def fork(self, slot: int, end: socket.socket) -> None:
        """Request a supervisor, which receives one end of a socket."""
        with suppress(OSError):  # it is gone, which shows when it is listened to
            socket.send_fds(self.control, [json.dumps({"slot": slot}).encode()], [end.fileno()])

    def kill(self, slot: int) -> None:
        """Kill a supervisor and the process of its trial, if they are still running."""
        with suppress(OSError):
            self.control.send(json.dumps({"kill": slot}).encode())

    def receive(self) -> list[FromForkServer] | None:
        """Return messages on supervisors that have ended, and how they ended; None if the fork server itself has ended.

        Raises:
            WorkerError: a module that trials need cannot be imported.
        """
        ended: list[FromForkServer] = []
        while True:
            try:
                data = self.control.recv(_MAX_MESSAGE_BYTES)
            except BlockingIOError:
                return ended
            except OSError:
                data = b""
            if not data:
                return None
            message: FromForkServer = json.loads(data)
            if "error" in message:
                raise WorkerError.from_json({"error": message["error"]})
            if "slot" in message:
                ended.append(message)
            self.ready = self.ready or "ready" in message
            self.unfit = self.unfit or "unfit" in message
            self._importing = message.get("importing", self._importing)

    def restart(self) -> ForkServerLink:
        """Start a new fork server after the previous one has ended.

        Raises:
            WorkerError: the fork server ended without a kill, or was killed too often.
        """
        try:
            code = self._kept.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            code = -signal.SIGKILL
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        self.end()
        if self.unfit:
            return ForkServerLink(self._settings, late=True, deaths=self.deaths, snapshot=self._snapshot)
        if -code not in _OUTSIDE_SIGNALS or self.deaths + 1 >= _MAX_CONSECUTIVE_DEATHS:
            if self._importing:
                raise import_died(self._importing, code, times=self.deaths + 1)
            how = describe_death(code)
            said = f": {lines[-1]}" if lines else ""
            again = f", {_MAX_CONSECUTIVE_DEATHS} times" if -code in _OUTSIDE_SIGNALS else ""
            raise WorkerError(
                f"the process that starts the workers {how}{again}{said}",
                fix="raise the limits on memory (ulimit -v) and processes (ulimit -u), and run the same command again",
            )
        return ForkServerLink(self._settings, late=self._late, deaths=self.deaths + 1, snapshot=self._snapshot)

    def end(self) -> None:
        """Kill the fork server and all processes that it has started."""
        self._kept.end()
        self.control.close()
        for file in (self._job, self._log):
            file.unlink(missing_ok=True)  # a hunt with a new process for each trial has a million
