"""Shared memory that trials create and leave behind.

A segment is a file in ``/dev/shm``, and the kernel does not say who created it. Two facts prove that a trial did:

* Python reported in a process of the trial that it creates the file by opening it, or maps a new file, as
  `multiprocessing.shared_memory` does. Python's own resource tracker is no replacement: it is killed with the trial.
  Before Python 3.13 it also removes segments of other programs to which an agent only attached.
* The file is new since the trial began, a process of the trial has it open or mapped for writing, and no process
  outside the trial has. This finds segments of C code and of programs that an agent starts.

Every other file stays, such as a segment of C code whose process died of a signal, and named semaphores.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.process_owners import boot_id, has_ended, owner_in, owner_of, this_process
from crashhunt.base.processes import descendants_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


_SHARED_MEMORY_RECORD = "shared-memory-{}.txt"  # with the token of the process that created what the file names
_SHARED_MEMORY_FOLDER = Path("/dev/shm")
_OPENED = "opened"  # first word of a line in records
_USED = "used"
_CLOCK_NS = 20_000_000  # the time of a file is that of the last tick of the kernel's clock
_recording_process: list[int] = []  # for this process and its forks; else each process records for itself
_records: list[Callable[[str, int, str], None]] = []  # writes a line of a record
_listed: list[tuple[int, frozenset[tuple[str, int]]]] = []  # time of the last change of the folder, and its files
_before: list[frozenset[tuple[str, int]]] = []  # name and inode of the files before the records, or the trial


def record_shared_memory(scratch: Path) -> None:
    """Record every file in ``/dev/shm`` that Python creates in this process from now on.

    Args:
        scratch: folder for the records, which is later passed to `release_shared_memory`, directly or inside of another
            folder.
    """
    folder = scratch.absolute()
    boot_id()  # here, or each fork reads it again
    _before[:] = [_shared_memory()]

    def record(kind: str, value: int, name: str) -> None:
        owner = owner_of(_recording_process[0]) if _recording_process else this_process()
        with suppress(OSError, ValueError):
            path = folder / _SHARED_MEMORY_RECORD.format(owner.token)
            # Not by open(), whose audit event would call `look` again.
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
            try:
                os.write(file, f"{kind} {value} {name}\n".encode())
            finally:
                os.close(file)

    def look(event: str, arguments: tuple[object, ...]) -> None:
        if event == "mmap.__new__":
            with suppress(OSError, TypeError, ValueError):
                descriptor, prefix = int(arguments[0]), f"{_SHARED_MEMORY_FOLDER}/"  # type: ignore[call-overload]
                writes = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY
                if writes and (target := os.readlink(f"/proc/self/fd/{descriptor}")).startswith(prefix):  # noqa: PTH115
                    name, number = target.removeprefix(prefix), os.fstat(descriptor).st_ino
                    if "/" not in name and (name, number) not in _before[0]:
                        record(_USED, number, name)
        if event not in ("open", "os.mkdir"):
            return
        path = arguments[0]
        if isinstance(path, bytes):
            path = os.fsdecode(path)
        if not isinstance(path, str) or os.path.dirname(path) != str(_SHARED_MEMORY_FOLDER):  # noqa: PTH120
            return
        flags = arguments[2] if event == "open" else os.O_CREAT
        if isinstance(flags, int) and flags & os.O_CREAT and not os.path.lexists(path):
            record(_OPENED, time.time_ns(), os.path.basename(path))  # noqa: PTH119

    sys.addaudithook(look)
    os.register_at_fork(before=_know_owner)
    _records[:] = [record]


def _know_owner() -> None:
    """Look up the owner of the records before this process forks, because a fork may outlive it."""
    for pid in _recording_process:
        owner_of(pid)


def begin_records() -> None:
    """Record shared memory of this process and its forks until this process ends, and not each fork for itself."""
    _recording_process[:] = [os.getpid()]
    _before[:] = [_shared_memory()]


def end_records() -> None:
    """Record the new files in ``/dev/shm`` that this process has open or mapped for writing."""
    for record, before in zip(_records, _before, strict=False):
        if new := _shared_memory() - before:
            for name, number in _shared_memory_of([os.getpid()], written=True) & new:
                record(_USED, number, name)


class SharedMemoryWatch:
    """Finds and removes the files in ``/dev/shm`` that the descendants of this process create.

    The owner calls `look` from time to time, and before it ends its descendants.
    """

    def __init__(self) -> None:
        self._before = _shared_memory()
        self._used = set[tuple[str, int]]()

    def look(self) -> None:
        """Find new files that the descendants of this process have open or mapped for writing."""
        if new := _shared_memory() - self._before - self._used:
            self._used |= _shared_memory_of(descendants_of(os.getpid()), written=True) & new

    def remove(self) -> None:
        """Remove the files that were found, unless a running process has them open or mapped."""
        _remove_unused(self._used)
        self._used.clear()


def _shared_memory() -> frozenset[tuple[str, int]]:
    """Return name and inode of all files in ``/dev/shm``; without a change, this takes a few microseconds."""
    with suppress(OSError):
        changed_ns = _SHARED_MEMORY_FOLDER.stat().st_mtime_ns
        if _listed and _listed[0][0] == changed_ns:
            return _listed[0][1]
        with os.scandir(_SHARED_MEMORY_FOLDER) as entries:
            found = frozenset((entry.name, entry.inode()) for entry in entries)
        # A later change within the same tick of the kernel's clock would not be seen.
        _listed[:] = [(changed_ns, found)] if time.time_ns() - changed_ns > _CLOCK_NS else []
        return found
    return frozenset()


def _shared_memory_of(processes: Iterable[int], *, written: bool) -> frozenset[tuple[str, int]]:
    """Return name and inode of the files in ``/dev/shm`` that processes have open or mapped.

    With ``written``, only files that the processes may write are returned.
    """
    prefix, found = f"{_SHARED_MEMORY_FOLDER}/", set[tuple[str, int]]()
    for pid in processes:
        with suppress(OSError, ValueError):
            for line in Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="surrogateescape").splitlines():
                if prefix in line:
                    _, rights, _, _, number, name = line.split(maxsplit=5)
                    if "w" in rights or not written:
                        found.add((name.removeprefix(prefix), int(number)))
        with suppress(OSError), os.scandir(f"/proc/{pid}/fd") as entries:
            for entry in entries:
                with suppress(OSError):
                    target = os.readlink(entry)  # noqa: PTH115 - there may be hundreds
                    may_write = entry.stat(follow_symlinks=False).st_mode & stat.S_IWUSR
                    if target.startswith(prefix) and (may_write or not written):
                        found.add((target.removeprefix(prefix), entry.stat().st_ino))
    return frozenset(found)


def _remove_unused(files: Iterable[tuple[str, int]]) -> None:
    """Remove files in ``/dev/shm`` that no running process has open or mapped."""
    if wanted := frozenset(files):
        running = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal()]
        for name, number in wanted - _shared_memory_of(running, written=False):
            _remove(name, lambda found, number=number: found.st_ino == number)  # type: ignore[misc]


def release_shared_memory(scratch: Path, *, of_ended: bool = False) -> None:
    """Remove the files in ``/dev/shm`` that are recorded in a folder.

    With ``of_ended``, only files of processes that have ended are removed.
    """
    name = _SHARED_MEMORY_RECORD.format("*")
    # At the end at any depth: processes that confirm crashes have folders of their own inside.
    for records in [*(scratch.glob(name) if of_ended else scratch.rglob(name))]:
        owner = owner_in(records.name)
        if of_ended and (owner is None or not has_ended(owner)):
            continue
        with suppress(OSError):
            for line in records.read_bytes().splitlines():
                with suppress(ValueError):
                    kind, value, segment = line.decode().split(" ", 2)
                    _release(kind, int(value), segment)
            records.unlink()


def _release(kind: str, value: int, name: str) -> None:
    """Remove what a line of a record names, unless it is a later file of the same name."""
    if kind == _USED:
        _remove_unused([(name, value)])
    else:
        _remove(name, lambda found: found.st_ctime_ns >= value - _CLOCK_NS)


def _remove(name: str, is_meant: Callable[[os.stat_result], bool]) -> None:
    """Remove a file or folder of this user in ``/dev/shm`` if it is the one that is meant."""
    path = _SHARED_MEMORY_FOLDER / name
    if path.parent != _SHARED_MEMORY_FOLDER or not name.strip("."):
        return
    with suppress(OSError):
        found = path.lstat()
        if found.st_uid == os.getuid() and is_meant(found):
            if stat.S_ISREG(found.st_mode):
                path.unlink()
            elif stat.S_ISDIR(found.st_mode):
                shutil.rmtree(path, ignore_errors=True)
