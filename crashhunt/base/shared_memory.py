"""POSIX shared memory that trials create and leave behind.

A segment is a file in ``/dev/shm``, and the kernel does not say who created it. So a process that runs trials records
each segment that Python's `multiprocessing.shared_memory` creates in it and in its forks. Python's own resource tracker
is no replacement: it is killed with the trial. Before Python 3.13 it also removes segments of other programs to which
an agent only attached.

Every other segment stays, because nothing proves its origin: segments of C code, segments of a Python interpreter that
an agent starts itself, and named semaphores.
"""

from __future__ import annotations

import importlib
import os
import stat
from contextlib import suppress
from functools import wraps
from pathlib import Path

from crashhunt.base.owners import has_ended, owner_in, this_process

__all__ = ["record_shared_memory", "release_shared_memory"]

_RECORDS = "shared-memory-{}.txt"  # with the token of the process that created what the file names
_SEGMENTS = Path("/dev/shm")
_NEW = os.O_CREAT | os.O_EXCL  # with both, shm_open has made the segment


def record_shared_memory(scratch: Path) -> None:
    """Record every segment that this process creates from now on.

    Args:
        scratch: a folder that is given to `release_shared_memory` later, directly or inside of another one.
    """
    try:
        module = importlib.import_module("_posixshmem")
    except ImportError:  # Python was built without it
        return
    original = vars(module)["shm_open"]
    folder = scratch.absolute()

    @wraps(original)
    def shm_open(path: str, flags: int, mode: int = 0o777) -> int:
        descriptor: int = original(path, flags, mode=mode)
        if flags & _NEW == _NEW:
            with suppress(OSError, ValueError):
                found = os.fstat(descriptor)
                with (folder / _RECORDS.format(this_process().token)).open("a", encoding="utf-8") as records:
                    records.write(f"{found.st_dev} {found.st_ino} {path.lstrip('/')}\n")
        return descriptor

    vars(module)["shm_open"] = shm_open


def release_shared_memory(scratch: Path, *, of_ended: bool = False) -> None:
    """Remove the segments that are recorded in a folder.

    Args:
        scratch: the folder.
        of_ended: only those of processes that have ended.
    """
    name = _RECORDS.format("*")
    for records in [*scratch.glob(name), *([] if of_ended else scratch.glob(f"*/{name}"))]:
        owner = owner_in(records.name)
        if of_ended and (owner is None or not has_ended(owner)):
            continue
        with suppress(OSError):
            for line in records.read_bytes().splitlines():
                with suppress(ValueError):
                    device, number, segment = line.decode().split(" ", 2)
                    _remove(segment, int(device), int(number))
            records.unlink()


def _remove(name: str, device: int, number: int) -> None:
    """Remove a segment, if it is still the one that was recorded."""
    path = _SEGMENTS / name
    if path.parent != _SEGMENTS or not name.strip("."):
        return
    with suppress(OSError):
        found = path.lstat()
        same = (found.st_dev, found.st_ino, found.st_uid) == (device, number, os.getuid())
        if same and stat.S_ISREG(found.st_mode):
            path.unlink()
