"""The keeper of a process: ends it, and all that it has started, when it is done or nobody waits for it any more.

``python -P …/keeper.py LIFELINE MODULE ARGUMENT…`` calls ``main()`` of a module in a child. The lifeline is the end of
a pipe whose other end is held by whoever waits: the kernel closes that one however its holder dies, also before the
keeper has come to look. It is run by its path, and imports next to nothing: the crashhunt that the child imports is
that of a snapshot, which may be older than this file.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import runpy
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import ModuleType

__all__ = ["Kept"]

_PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_LOOK_EVERY_S = 0.02  # where the kernel does not tell when a child ends
_END_S = 5.0  # for the keeper to have ended everything


class Kept:
    """A Python module that runs in a process of its own, with a keeper.

    Args:
        module: whose ``main()`` is called.
        arguments: of its command line.
        environment: of it.
        inherited: file descriptors that it is given.
        apart: whether signals of this one's terminal and group stay away from it. Otherwise it has the terminal.
        stdin: as of `subprocess.Popen`.
        stdout: the same.
        stderr: the same.

    Raises:
        OSError: no more processes or files can be had.
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
            os.close(theirs)

    def end(self) -> None:
        """Kill it and everything below it; returns when nothing is left."""
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
    processes = _beside("processes")
    processes.adopt_orphans()
    keeper = os.getpid()
    child = os.fork()
    if child == 0:
        os.close(int(lifeline))
        processes.die_with(keeper)
        sys.argv = [module, *arguments]
        found = importlib.import_module(module)
        if "main" in vars(found):
            found.main()
        else:  # the debugger of older versions
            del sys.modules[module]
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        return
    for number in _PASSED_ON:  # what is asked of everybody at once is for the child, or for whoever waits
        signal.signal(number, signal.SIG_IGN)
    status = _wait(child, int(lifeline))
    processes.end_descendants()
    _leave(status)


def _beside(name: str) -> ModuleType:
    """Import a module that lies beside this one, whatever package of that name there is to import."""
    spec = importlib.util.spec_from_file_location(f"_crashhunt_{name}", Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _wait(child: int, lifeline: int) -> int | None:
    """Wait until the child has ended or nobody waits for it any more; return how it ended."""
    ended = None
    with suppress(AttributeError, OSError):  # an old kernel, or not Linux
        ended = os.pidfd_open(child)
    while True:
        ready, _, _ = select.select([lifeline, *([ended] if ended is not None else [])], [], [],
                                    None if ended is not None else _LOOK_EVERY_S)  # fmt: skip
        if lifeline in ready:
            return None
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status


def _leave(status: int | None) -> None:
    """Leave as the child has left, so that whoever waits sees what it would have seen without a keeper."""
    if status is None:
        os._exit(1)
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        import resource

        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # the child's, where there is one, is enough
        if -code not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code & 0xFF)


if __name__ == "__main__":
    _main()
