"""Resource limits of this process (``ulimit``): which limit caused an error, and how to raise it."""

from __future__ import annotations

import errno
import os
import resource
import threading
from contextlib import suppress
from pathlib import Path
from typing import Final

_MEBIBYTE = 1 << 20
_NO_MEMORY_MESSAGES = (
    "can't start new thread",
    "failed to map segment",
    "cannot allocate memory",
    "unable to allocate",
)
_NO_THREAD_MESSAGES = ("can't start new thread", "unable to start watchdog thread")


def limit_behind(error: BaseException) -> str:
    """Return as text the limit that caused an error, and how to raise the limit; empty if no limit is set.

    A limit on memory (``RLIMIT_AS``) can cause many errors: in Python, in a thread, or in a library that does not load.
    A limit on the size of files (``RLIMIT_FSIZE``) causes an `OSError`, because Python ignores its signal. A limit on
    processes (``RLIMIT_NPROC``) also counts threads. If a thread does not start, the text also names a limit
    on memory, because Python does not report which of the two was reached.
    """
    limits = []
    if is_no_thread(error) and (limit := _soft_limit(resource.RLIMIT_NPROC)) is not None:
        limits.append(
            f"the limit on processes and threads is {limit}: raise it with ulimit -u, or that of the container"
        )
    if _is_no_memory(error) and (limit := _soft_limit(resource.RLIMIT_AS)) is not None:
        limits.append(f"the limit on memory is {limit / _MEBIBYTE:.4g} MiB: raise it with ulimit -v")
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EFBIG and (limit := _soft_limit(resource.RLIMIT_FSIZE)) is not None:
        limits.append(f"the limit on the size of a file is {limit / _MEBIBYTE:.4g} MiB: raise it with ulimit -f")
    if number == errno.EMFILE and (limit := _soft_limit(resource.RLIMIT_NOFILE)) is not None:
        limits.append(f"the limit on open files is {limit}: raise it with ulimit -n")
    return "; ".join(limits)


def is_no_thread(error: BaseException) -> bool:
    """Return whether an error reports that no thread could be started."""
    return isinstance(error, RuntimeError) and str(error) in _NO_THREAD_MESSAGES


def error_of_next_thread() -> RuntimeError | None:
    """Return the error that starting a thread raises now; None if a thread starts.

    OpenBLAS raises SIGINT if it cannot start its threads while NumPy is imported, which looks like a Ctrl-C.
    """
    try:
        threading.Thread(target=int, daemon=True).start()
    except RuntimeError as error:
        return error
    return None


def error_of_next_files(count: int) -> OSError | None:
    """Return the error that opening a number of files raises now; None if they can be opened.

    SQLite reports every reason for which a file cannot be opened in the same words.
    """
    opened: list[int] = []
    try:
        for _ in range(count):
            opened.append(os.open(os.devnull, os.O_RDONLY))  # noqa: PERF401 - closes those before an error as well
    except OSError as error:
        return error
    finally:
        for descriptor in opened:
            os.close(descriptor)
    return None


def _is_no_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    try:
        said = str(error).lower()
    except BaseException:  # of a class that cannot even say its message
        return False
    return isinstance(error, ImportError | RuntimeError | OSError) and any(
        words in said for words in _NO_MEMORY_MESSAGES
    )


def _soft_limit(which: int) -> int | None:
    soft, _ = resource.getrlimit(which)
    return None if soft == resource.RLIM_INFINITY else soft


# How much of the memory is free.

FREE: Final = 0.25
"""The share of the memory that must be free before another suspended fork is kept."""
_MAX_STATUS_LINES = 30  # what is looked for stands further up


def free_memory(root: Path = Path("/")) -> float:
    """Return the share of the memory that is free or can be reclaimed at once; 1 if the system does not report it.

    Args:
        root: folder that contains the kernel's folders ``proc`` and ``sys``.
    """
    with suppress(OSError, ValueError, KeyError, ZeroDivisionError):
        found = _status_values(root / "proc" / "meminfo")
        free = found["MemAvailable"] / found["MemTotal"]
        with suppress(OSError, ValueError):  # of a container
            group = root / "sys" / "fs" / "cgroup"
            most = int((group / "memory.max").read_text(encoding="ascii"))
            used = int((group / "memory.current").read_text(encoding="ascii"))
            with suppress(OSError, ValueError, KeyError):  # files that were read or written once are in there, too
                used -= min(used, _status_values(group / "memory.stat")["inactive_file"])
            free = min(free, 1 - used / most)
        return free
    return 1.0


def _status_values(path: Path) -> dict[str, int]:
    """Return the numbers that follow the names in the first lines of a file."""
    lines = path.read_text(encoding="ascii").splitlines()[:_MAX_STATUS_LINES]
    return {name.rstrip(":"): int(number) for name, number, *_ in map(str.split, lines)}
