"""Actions of the page with ``--allow-control``: it may interrupt a hunt, and start commands for a crash.

Commands run one after the other, each in its own process, as if the user had started it. A command without a terminal
cannot ask whether to trust code, so it refuses untrusted code.
"""

from __future__ import annotations

import codecs
import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from crashhunt.base.errors import UsageError
from crashhunt.base.text import one_of, visible

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.dashboard._hunt_page import HuntView

COMMANDS: Final = {"replay": "replay", "judge": "judge", "shrink": "shrink"}
"""What a job may be, and the command that it is."""

_MAX_WAITING = 20
_MAX_KEPT = 50  # jobs that have ended
_MAX_OUTPUT_CHARACTERS = 4_000  # characters of the end of a job's output
_TERMINAL_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def stop_hunt(view: HuntView) -> None:
    """Interrupt a running hunt as Ctrl-C does: finished trials are kept, and the hunt can be resumed.

    Raises:
        UsageError: the hunt is not running, or runs on another machine.
    """
    state = view.refresh()
    owner = view.facts.get("owner")
    if state.state != "running" or owner is None:
        raise UsageError(
            f"the hunt is not running: its state is {state.state}", fix="only a running hunt can be stopped"
        )
    if owner["host"] != socket.gethostname():
        raise UsageError(
            f"the hunt runs on the machine {owner['host']}", fix=f"stop it there: kill -INT {owner['pid']}"
        )
    # The state is "running" only if the process is the one that the ledger names, and not a later one of its number.
    with suppress(ProcessLookupError):
        os.kill(owner["pid"], signal.SIGINT)


@dataclass(slots=True)
class _Job:
    number: int
    hunt: str
    crash: str
    name: str
    words: list[str]
    state: str = "waiting"
    code: int | None = None
    output: str = ""

    def to_json(self) -> JsonObject:
        return {
            "job": self.number, "hunt": self.hunt, "crash": self.crash, "name": self.name, "state": self.state,
            "exit_code": self.code, "output": self.output,
        }  # fmt: skip


class Jobs:
    """Runs commands, one at a time, in the order in which they were requested."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._jobs: deque[_Job] = deque(maxlen=_MAX_KEPT + _MAX_WAITING + 1)
        self._changed = threading.Condition()
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._thread: threading.Thread | None = None

    def add(self, hunt: str, path: Path, crash: str, name: str) -> JsonObject:
        """Add a job to the queue.

        The crash must exist, and ``name`` is one of `COMMANDS`.

        Raises:
            UsageError: the command does not exist, or too many jobs are waiting.
        """
        if name not in COMMANDS:
            raise UsageError(f"there is no job {name!r}", fix=one_of(name, COMMANDS))
        words = [sys.executable, "-P", "-m", "crashhunt", COMMANDS[name], "--crash", crash, "--", str(path)]
        with self._changed:
            if sum(job.state == "waiting" for job in self._jobs) >= _MAX_WAITING:
                raise UsageError(f"too many jobs are waiting: {_MAX_WAITING}", fix="wait until some of them have ended")
            job = _Job(number=next(self._numbers), hunt=hunt, crash=crash, name=name, words=words)
            self._jobs.append(job)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            self._changed.notify_all()
            return job.to_json()

    def list(self, hunt: str, crash: str) -> list[JsonObject]:
        """Return the jobs for a crash, the latest job first."""
        with self._changed:
            return [job.to_json() for job in reversed(self._jobs) if (job.hunt, job.crash) == (hunt, crash)]

    def close(self) -> None:
        """Interrupt the running job, and start no further jobs."""
        with self._changed:
            self._closed = True
            process = self._process
            self._changed.notify_all()
        if process is not None:
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGINT)
        if self._thread is not None:
            self._thread.join(30)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._closed and not any(job.state == "waiting" for job in self._jobs):
                    self._changed.wait()
                if self._closed:
                    return
                job = next(job for job in self._jobs if job.state == "waiting")
                try:
                    process = subprocess.Popen(
                        job.words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
                    )
                except OSError as error:
                    job.state, job.output = "failed", str(error)
                    continue
                job.state, self._process = "running", process
            self._follow(job, process)

    def _follow(self, job: _Job, process: subprocess.Popen[bytes]) -> None:
        """Collect the output of a process until the process ends."""
        assert process.stdout is not None
        # A part may end within a character or within an escape sequence.
        text, decode = "", codecs.getincrementaldecoder("utf-8")("replace").decode
        with process.stdout:
            while part := os.read(process.stdout.fileno(), 65_536):
                text = _TERMINAL_ESCAPES.sub("", text + decode(part))[-_MAX_OUTPUT_CHARACTERS:]
                with self._changed:
                    job.output = visible(text)
        code = process.wait()
        with self._changed:
            job.code, job.state, self._process = code, "ended", None
