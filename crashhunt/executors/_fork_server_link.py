"""The pool's end of its fork server: how it is started, asked for supervisors, and listened to."""

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

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.keeper import Kept
from crashhunt.executors._environment import snapshot_environment, worker_environment
from crashhunt.executors._remains import signal_name

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._messages import ForkServerJob, FromForkServer

__all__ = ["ForkServerLink"]

_MESSAGE = 1 << 16  # bytes, as in _fork_server
_DEATHS = 3  # in a row, without a trial between them, before the pool gives up
_END_S = 5.0  # for the template to say why it ended
_FROM_OUTSIDE = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGKILL)
_numbers = itertools.count()


class ForkServerLink:
    """A running fork server.

    Args:
        settings: of the hunt.
        late: whether each trial imports its agents itself, because what has imported them cannot be forked.
        deaths: how often it was killed before.
        snapshot: whether crashhunt itself comes from the code of the settings.
    """

    def __init__(
        self, settings: WorkerSettings, *, late: bool = False, deaths: int = 0, snapshot: bool = False
    ) -> None:
        self._settings = settings
        self._late = late
        self._snapshot = snapshot
        self.deaths = deaths
        self.ready = False
        self.unfit = False
        number = next(_numbers)
        job = settings.scratch / f"fork-server-{number}.json"
        path = [] if snapshot else sys.path
        content: ForkServerJob = {"settings": settings.to_json(), "sys_path": path, "late": late}
        environment = snapshot_environment(settings) if snapshot else {**os.environ, **worker_environment()}
        job.write_text(json.dumps(content), encoding="utf-8")
        self._log = settings.scratch / f"fork-server-{number}.log"
        # Messages stay apart from each other, and file descriptors with theirs.
        self.control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, self._log.open("wb") as log:
            self._kept = Kept(
                "crashhunt.executors._fork_server",
                [str(theirs.fileno()), str(job)],
                environment=environment,
                inherited=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self.control.setblocking(False)

    def fork(self, slot: int, end: socket.socket) -> None:
        """Ask for a supervisor, which is given one end of a socket."""
        with suppress(OSError):  # it is gone, which shows when it is listened to
            socket.send_fds(self.control, [json.dumps({"slot": slot}).encode()], [end.fileno()])

    def kill(self, slot: int) -> None:
        """Kill a supervisor, and with it what runs its trial, if it is still there."""
        with suppress(OSError):
            self.control.send(json.dumps({"kill": slot}).encode())

    def receive(self) -> list[FromForkServer] | None:
        """Return which supervisors have ended, and how; None where the fork server itself is gone.

        Raises:
            CrashhuntError: what trials need cannot be imported.
        """
        ended: list[FromForkServer] = []
        while True:
            try:
                data = self.control.recv(_MESSAGE)
            except BlockingIOError:
                return ended
            except OSError:
                data = b""
            if not data:
                return None
            message: FromForkServer = json.loads(data)
            if "error" in message:
                raise CrashhuntError(**message["error"])
            if "slot" in message:
                ended.append(message)
            self.ready = self.ready or "ready" in message
            self.unfit = self.unfit or "unfit" in message

    def anew(self) -> ForkServerLink:
        """Start another one in its place, after its end.

        Raises:
            CrashhuntError: it has ended by itself, or too often.
        """
        try:
            code = self._kept.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            code = -signal.SIGKILL
        self.end()
        if self.unfit:
            return ForkServerLink(self._settings, late=True, deaths=self.deaths, snapshot=self._snapshot)
        if -code not in _FROM_OUTSIDE or self.deaths + 1 >= _DEATHS:
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            how = f"was killed by {signal_name(code)}" if code < 0 else f"exited with {code}"
            said = f": {lines[-1]}" if lines else ""
            again = f", {_DEATHS} times" if -code in _FROM_OUTSIDE else ""
            raise CrashhuntError(
                f"the process that starts the workers {how}{again}{said}",
                fix="raise the limits on memory (ulimit -v) and processes (ulimit -u), and run the same command again",
            )
        return ForkServerLink(self._settings, late=self._late, deaths=self.deaths + 1, snapshot=self._snapshot)

    def end(self) -> None:
        """Kill it, and everything that it has started."""
        self._kept.end()
        self.control.close()
