"""The keeper of a process: ends the process and all its descendants when it is done, or when its owner has ended.

``python -P …/reaper.py LIFELINE MODULE ARGUMENT…`` calls ``main()`` of a module in a child. The lifeline is one end of
a pipe, and the owner holds the other end. The kernel closes the owner's end whenever the owner dies, even before the
keeper has started. The keeper is run by its path and imports almost nothing, because the crashhunt that the child
imports comes from a snapshot, which may be older than this file.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from types import ModuleType

_FORWARDED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_LOOK_EVERY_S = 0.02  # where the kernel does not notify when a child ends
_RESUME_EVERY_S = 1.0  # one check takes 20 µs
_END_S = 5.0  # for the keeper to end all processes


class Kept:
    """A Python module that runs in a separate process; a second process, the keeper, ends it with its descendants.

    The keeper ends these processes when ``main()`` of the module has returned, or when the current process has ended.

    Args:
        module: module whose function ``main()`` is called.
        arguments: command-line arguments of the module.
        environment: environment variables of the process.
        inherited: file descriptors that the process receives.
        apart: whether the process has its own session, and thus gets no signals of this terminal and process group.
        stdin: standard input, as for `subprocess.Popen`.
        stdout: standard output, as for `subprocess.Popen`.
        stderr: standard error, as for `subprocess.Popen`.

    Raises:
        OSError: the system cannot start further processes or open further files.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str] = (),
        *,
        environment: Mapping[str, str],
        inherited: Sequence[int] = (),
        apart: bool = True,
        stdin: int | IO[bytes] | None = None,
        stdout: int | IO[bytes] | None = None,
        stderr: int | IO[bytes] | None = None,
    ) -> None:
        theirs, self._lifeline = os.pipe()
        # While Python starts, SIGINT would end the reaper with 1, as if its child had failed. The mask is inherited.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _FORWARDED_SIGNALS)
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-P", __file__, str(theirs), module, *arguments],
                stdin=stdin,
                stdout=stdout,
                stderr=stderr,
                env=environment,
                pass_fds=(theirs, *inherited),
                start_new_session=apart,
            )
        except BaseException:
            os.close(self._lifeline)
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            os.close(theirs)

    def end(self) -> None:
        """Kill the process and all processes below it; return when no process is left."""
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _main() -> None:
    lifeline, module, *arguments = sys.argv[1:]
    processes = _import_sibling("processes")
    processes.adopt_orphans()
    keeper = os.getpid()
    child = os.fork()
    if child == 0:
        os.close(int(lifeline))
        processes.die_with(keeper)
        sys.argv = [module, *arguments]
        # A signal of the terminal ends the imports, and prints no traceback of them.
        interrupted = signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _FORWARDED_SIGNALS)
        found = importlib.import_module(module)
        signal.signal(signal.SIGINT, interrupted)
        found.main()
        return
    for number in _FORWARDED_SIGNALS:  # the child, or the owner, handles signals that are sent to the whole group
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _FORWARDED_SIGNALS)
    status = _wait(child, int(lifeline), processes.resume)
    processes.end_descendants()
    processes.exit_as(1 if status is None else os.waitstatus_to_exitcode(status))


def _import_sibling(name: str) -> ModuleType:
    """Import a module of this folder by its file, even if another package with this name is importable."""
    spec = importlib.util.spec_from_file_location(f"_crashhunt_{name}", Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _wait(child: int, lifeline: int, resume: Callable[[int], None]) -> int | None:
    """Wait until the child has ended or the owner has closed the lifeline; return the child's status, or None.

    A child that is stopped alone, for example by an agent, is resumed. A batch system stops the keeper as well, so that
    the whole job stays suspended.
    """
    ended = None
    with suppress(OSError):  # an old kernel
        ended = os.pidfd_open(child)
    while True:
        ready, _, _ = select.select([lifeline, *([ended] if ended is not None else [])], [], [],
                                    _RESUME_EVERY_S if ended is not None else _LOOK_EVERY_S)  # fmt: skip
        if lifeline in ready:
            return None
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status
        if not ready:
            resume(child)


if __name__ == "__main__":
    _main()
