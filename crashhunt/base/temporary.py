"""Temporary files and folders of a process, which are removed however the process ends.

Each process has one folder for temporary files, ``crashhunt-temporary-UID/TOKEN`` in the system's folder for temporary
files (``TMPDIR``, else ``/tmp``). `OwnerProcess` defines the token. The folder contains

* folders that only this process needs (`temporary_folder`), and
* a symbolic link for each temporary file or folder in another place (`temporary_beside`). Such files become permanent
by a rename, or the user has chosen their disk. The link is made before the file, and removed after it.

`remove_leftovers` removes files that killed processes left. Each command calls this function at its start, and each
process calls it before the first temporary file. A leftover is removed only if three conditions hold
(`has_ended` checks a part of the first):

* its process has certainly ended (`has_ended`), and no process holds the lock of its folder,
* the leftover belongs to this user, and its name contains the token of that process,
* the leftover is a folder or a regular file. A symbolic link that looks like a leftover is not removed, nor is its
  target.

After a crash of the machine, no process can distinguish its temporary files from those of other hosts. The next hunt in
a directory removes the scratch folder of this directory, and the system clears its folder for temporary files.

The page `reference/files.md` of the guide lists every temporary file.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import stat
import sys
import threading
import time
import weakref
import zlib
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.processes import descendants_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator


_WRITTEN_MEANWHILE = "another process has written there in the meantime"


# Owners of temporary things: a name for a process that no other process on any machine shares, and whether it ended.
#
# The token of an owner is ``PID-START-BOOT-NAMESPACE``, such as ``4711-8812345-3f9a1c2b5d6e-8c736521``:
#
# * the process id and the time at which the process started, in clock ticks since the machine booted. Process ids are
#   reused, but no two processes of one boot share both.
# * the first 12 digits of the kernel's boot id. Another host has another one, and so has this host after a reboot.
# * a checksum of the PID and time namespaces. A process in another container has ids and times of its own.
#
# Only a process that sees the owner's namespaces can tell that the owner ended. Every other process has to take the
# owner for alive: a folder may be shared by NFS, by containers or by virtual machines.

_BOOT_ID = "/proc/sys/kernel/random/boot_id"
_NAMESPACE_FOLDER = "/proc/self/ns"  # of PIDs since Linux 3.8, of times since 5.6
_BOOT_DIGITS = 12
_MAX_READ_BYTES = 4096  # of a file of the kernel, which has some hundred
_UNKNOWN_BOOT = "0" * _BOOT_DIGITS  # where there is no /proc: such an owner counts as alive
_TOKEN = re.compile(r"(?<![0-9])([0-9]{1,10})-([0-9]{1,20})-([0-9a-f]{12})-([0-9a-f]{8})(?![0-9a-f])")


@dataclass(frozen=True, slots=True)
class OwnerProcess:
    """The process to which temporary files belong; their names contain its token.

    Args:
        pid: process id in its own PID namespace.
        started: start time of the process, in clock ticks since the machine booted.
        boot: first 12 hexadecimal digits of the kernel's boot id.
        namespace: checksum of the process's PID and time namespaces, 8 hexadecimal digits.
    """

    pid: int
    started: int
    boot: str
    namespace: str

    @property
    def token(self) -> str:
        """The part of a file name that identifies the process."""
        return f"{self.pid}-{self.started}-{self.boot}-{self.namespace}"


def this_process() -> OwnerProcess:
    """Return the owner that represents this process."""
    return _owner(os.getpid())


@cache
def _owner(pid: int) -> OwnerProcess:
    unknown = OwnerProcess(pid=pid, started=0, boot=_UNKNOWN_BOOT, namespace="0" * 8)
    boot = _boot()
    try:
        names = [_namespace(kind) for kind in ("pid", "time")]
    except OSError:
        return unknown
    started = start_time(pid)
    if started <= 0 or boot == _UNKNOWN_BOOT:
        return unknown
    return OwnerProcess(pid=pid, started=started, boot=boot, namespace=f"{zlib.crc32(' '.join(names).encode()):08x}")


@cache
def _boot() -> str:
    """Return the first digits of the kernel's boot id, which forks of this process do not read again."""
    try:
        boot = _read(_BOOT_ID).decode("ascii").replace("-", "")[:_BOOT_DIGITS]
    except (OSError, UnicodeError):
        return _UNKNOWN_BOOT
    return boot if len(boot) == _BOOT_DIGITS else _UNKNOWN_BOOT


def _namespace(kind: str) -> str:
    """Return the identifier of a namespace of this process; empty if the kernel has no namespaces of this kind."""
    try:
        return os.readlink(f"{_NAMESPACE_FOLDER}/{kind}")  # noqa: PTH115 - once for each trial, as `_read`
    except FileNotFoundError:
        return ""


def _read(path: str) -> bytes:
    """Return the first bytes of a file of the kernel.

    Each trial calls this function in a new fork, in which `Path.read_text` would copy 200 more pages of memory.
    """
    file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return os.read(file, _MAX_READ_BYTES)
    finally:
        os.close(file)


def owner_in(name: str) -> OwnerProcess | None:
    """Return the owner that a file name identifies; None if it identifies no owner, or several."""
    found = set(_TOKEN.findall(name))
    if len(found) != 1:  # a user's file name may have such a token as well
        return None
    ((pid, started, boot, namespace),) = found
    return OwnerProcess(pid=int(pid), started=int(started), boot=boot, namespace=namespace)


def has_ended(owner: OwnerProcess) -> bool:
    """Return whether an owner has certainly ended.

    An owner from another boot, host or container counts as running, because this process cannot check it.
    """
    here = this_process()
    if here.boot == _UNKNOWN_BOOT or (owner.boot, owner.namespace) != (here.boot, here.namespace):
        return False
    return start_time(owner.pid) not in (-1, owner.started)


def start_time(pid: int) -> int:
    """Return when a process started, in clock ticks since the machine booted.

    Returns:
        The start time; 0 if the process does not exist or only a zombie is left, -1 if the system does not report it.
    """
    try:
        stat = _read(f"/proc/{pid}/stat").rpartition(b")")[2].split()
        # The first thread of a process may have ended before the others: it is a zombie then, and the process is not.
        if stat[0] in b"ZX" and len(os.listdir(f"/proc/{pid}/task")) <= 1:  # noqa: PTH208 - how many is enough
            return 0
        return int(stat[19])
    except OSError:
        pass
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return 0
    except (PermissionError, OverflowError):
        pass
    return -1  # /proc is not mounted, or hides the process


# Shared memory that trials create and leave behind.
#
# A segment is a file in ``/dev/shm``, and the kernel does not say who created it. Two facts prove that a trial did:
#
# * Python reported in a process of the trial that it creates the file by opening it, or maps a new file, as
#   `multiprocessing.shared_memory` does. Python's own resource tracker is no replacement: it is killed with the trial.
#   Before Python 3.13 it also removes segments of other programs to which an agent only attached.
# * The file is new since the trial began, a process of the trial has it open or mapped for writing, and no process
#   outside the trial has. This finds segments of C code and of programs that an agent starts.
#
# Every other file stays, such as a segment of C code whose process died of a signal, and named semaphores.

_SHARED_MEMORY_RECORD = "shared-memory-{}.txt"  # with the token of the process that created what the file names
_SHARED_MEMORY_FOLDER = Path("/dev/shm")
_OPENED, _USED = "opened", "used"  # first words of lines in records
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
    _boot()  # here, or each fork reads it again
    _before[:] = [_shared_memory()]

    def record(kind: str, value: int, name: str) -> None:
        owner = _owner(_recording_process[0]) if _recording_process else this_process()
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
        _owner(pid)


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


_LINK_NAME = "elsewhere"
_GIT_WORK_TREES_FOLDER = "worktrees"  # in the folder of a Git repository
_MAX_NAME_BYTES = 255  # bytes, on every usual file system
_MAX_MKDIR_ATTEMPTS = 5  # to make a folder that another process removes at the same moment, because it is empty


class TemporaryFolder:
    """A new folder that only this process and its children use.

    Args:
        purpose: first part of the folder's name, such as ``replay``.

    Raises:
        OSError: the disk is full, or no folder for temporary files can be written.
    """

    def __init__(self, purpose: str) -> None:
        self.path = _things.make(lambda folder: _new_folder(folder, purpose))
        # Python calls it at its end too, and when the caller loses the object.
        self._remove = weakref.finalize(self, _remove_of_owner, self.path, os.getpid())

    def remove(self) -> None:
        """Remove the folder and all its contents. A second call does nothing."""
        self._remove()


@contextmanager
def temporary_folder(purpose: str) -> Iterator[Path]:
    """Yield a new folder that only this process and its children use, and remove it at the end.

    The name of the folder begins with ``purpose``, such as ``replay``.

    Raises:
        OSError: the disk is full, or no folder for temporary files can be written.
    """
    folder = TemporaryFolder(purpose)
    try:
        yield folder.path
    finally:
        folder.remove()


@contextmanager
def temporary_beside(path: Path, *, name: str = "") -> Iterator[Path]:
    """Yield a temporary path in the same folder, and remove it at the end.

    The caller creates a file or a folder under this path, and renames it to its final path.

    Args:
        path: the final path; the temporary path has a similar name in the same folder.
        name: another name for the temporary file; it must contain the token of this process.
    """
    there = path.with_name(name or temporary_name(path, ".part"))
    target = there.absolute()  # wherever this process goes meanwhile
    link = None
    with suppress(OSError):  # then the thing is not found by other commands; the disk may be full
        link = _things.make(lambda folder: _new_link(folder, target))
    pid = os.getpid()
    try:
        yield there
    finally:
        if os.getpid() == pid:  # not in a fork of this process
            remove_scratch(target)
            if link is not None:
                _things.end(link, removed=not _exists(target))


@contextmanager
def new_folder(path: Path, *, mode: int = 0o777) -> Iterator[Path]:
    """Yield a temporary folder, which becomes the given folder at the end.

    An existing folder receives the contents and stays the same folder, because it may be the current folder of the
    user, a mount point, or the target of a link. A folder that exists must be empty. ``mode`` has the permissions of a
    new folder.

    Raises:
        OSError: the folder cannot be written, or another process has written into it in the meantime.
    """
    target = path.absolute()
    is_there = target.is_dir()
    with temporary_beside(target / "new" if is_there else target) as building:
        building.mkdir(mode=mode)
        yield building
        if is_there:
            if any(entry.suffix != building.suffix for entry in target.iterdir()):
                raise FileExistsError(errno.EEXIST, _WRITTEN_MEANWHILE, str(path))
            for entry in sorted(building.iterdir()):
                entry.rename(target / entry.name)
            return
        try:
            building.rename(target)
        except OSError as error:
            if target.exists():
                raise FileExistsError(errno.EEXIST, _WRITTEN_MEANWHILE, str(path)) from error
            raise


def temporary_name(path: Path, suffix: str = "") -> str:
    """Return a hidden name with the token of this process, for a temporary file in the folder of a path.

    Each thread has another name, because a program may, for example, minimize the same crash in two threads.

    Args:
        path: final path of the file or folder.
        suffix: end of the name; by default the ending of the path, because some libraries choose the format by it.
    """
    stem, suffix = (path.name, suffix) if suffix else (path.stem, path.suffix)
    thread = "" if threading.current_thread() is threading.main_thread() else f"-{threading.get_native_id()}"
    rest = f".{this_process().token}{thread}{suffix}"
    room = _MAX_NAME_BYTES - 1 - len(os.fsencode(rest))
    while len(os.fsencode(stem)) > room:
        stem = stem[:-1]
    return f".{stem}{rest}"


def remove_leftovers() -> None:
    """Remove the temporary files of processes that have ended, from the folder that contains all of them."""
    _things.swept = True
    place, prefix = _base_folder()
    try:
        names = [entry.name for entry in os.scandir(place) if entry.name.startswith(prefix)]
    except OSError:
        return  # no process has made anything
    for name in names:
        owner = owner_in(name)
        if owner is not None and name == f"{prefix}{owner.token}" and has_ended(owner):
            with suppress(OSError):
                _remove_left(place / name, owner.token)
    if not prefix:
        with suppress(OSError):  # other processes use it
            place.rmdir()


def remove_ended(folder: Path) -> None:
    """Remove the files in one folder whose hidden names contain the token of a process that has ended."""
    with suppress(OSError):
        for path in list(folder.iterdir()):
            owner = owner_in(path.name) if path.name.startswith(".") else None
            if owner is not None and has_ended(owner):
                _remove_if_ours(path, owner.token)


def remove_at_once(path: Path) -> None:
    """Remove a folder so that no other process ever sees a part of its contents; errors are ignored."""
    with temporary_beside(path) as hidden, suppress(OSError):
        path.rename(hidden)


def remove_scratch(path: Path) -> None:
    """Remove a folder in which trials ran, and the shared memory of these trials."""
    release_shared_memory(path)
    remove_tree(path)


def remove_tree(path: Path) -> None:
    """Remove a file or a folder with all its contents, even if their permissions forbid it.

    Errors are ignored. For a symbolic link, the link is removed and not its target.
    """
    with suppress(OSError):
        if not stat.S_ISDIR(path.lstat().st_mode):
            path.unlink()
            return
        shutil.rmtree(path, ignore_errors=True)
        if _exists(path):  # an agent may have taken permissions away
            path.chmod(0o700)
            for parent, names, _ in os.walk(path):
                for folder in (Path(parent, name) for name in names):
                    if not folder.is_symlink():
                        folder.chmod(0o700)
            shutil.rmtree(path, ignore_errors=True)


class _TemporaryFiles:
    """The temporary files of this process. The folder for temporary files exists only while it has contents."""

    def __init__(self) -> None:
        self.swept = False
        self._forget()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        """Ignore the temporary files of the parent process, because a fork does not own them."""
        # A finalizer may run anywhere, such as when `make` allocates memory, and then calls `end` in the same thread.
        self._lock = threading.RLock()
        self._folder: Path | None = None
        self._is_shared = False
        self._opened = -1
        self._count = self._serial = 0

    def make(self, made: Callable[[Path], Path]) -> Path:
        """Create a file or folder in the temporary folder of this process, and return it.

        Raises:
            OSError: the file or folder cannot be created.
        """
        if not self.swept:
            remove_leftovers()
        with self._lock:
            self._count += 1  # first, so that the folder stays if a finalizer ends the last other thing meanwhile
            for left in reversed(range(_MAX_MKDIR_ATTEMPTS)):
                try:
                    return made(self._create_folder())
                except FileNotFoundError:  # another process removed it or its parent, which were empty or old
                    self._close()
                    if not left:
                        self._count -= 1
                        raise
                except BaseException:
                    self._count -= 1
                    self._remove_folder()
                    raise
        raise AssertionError

    def end(self, path: Path, *, removed: bool = True) -> None:
        """Remove a temporary file; with the last file, also remove the folder.

        Args:
            path: path of the temporary file.
            removed: whether the file or folder is gone; otherwise it stays, and the next command tries again.
        """
        with self._lock:
            if removed:
                remove_tree(path)
            self._count -= 1
            self._remove_folder()

    def next_name(self, purpose: str) -> str:
        """Return a name that is not yet used in the folder."""
        self._serial += 1
        return f"{purpose}-{self._serial}"

    def _create_folder(self) -> Path:
        if self._folder is not None:
            return self._folder
        place, prefix = _base_folder()
        if not prefix:
            with suppress(FileExistsError):
                place.mkdir(mode=0o700)
        folder = place / f"{prefix}{this_process().token}"
        with suppress(FileExistsError):  # what this process could not remove is still there
            folder.mkdir(mode=0o700)
        self._opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        with suppress(OSError):  # some file systems have no locks; then the start time alone decides
            fcntl.flock(self._opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._folder, self._is_shared = folder, bool(prefix)
        return folder

    def _remove_folder(self) -> None:
        if self._folder is not None and not self._count:
            with suppress(OSError):
                self._folder.rmdir()
                if not self._is_shared:
                    self._folder.parent.rmdir()
            self._close()

    def _close(self) -> None:
        if self._opened >= 0:
            os.close(self._opened)
        self._folder, self._opened = None, -1


def _new_folder(folder: Path, purpose: str) -> Path:
    made = folder / _things.next_name(purpose)
    made.mkdir(mode=0o700)
    return made


def _new_link(folder: Path, target: Path) -> Path:
    made = folder / _things.next_name(_LINK_NAME)
    made.symlink_to(target)
    return made


def _remove_of_owner(path: Path, pid: int) -> None:
    if os.getpid() == pid:  # not in a fork of this process
        remove_scratch(path)
        _things.end(path, removed=not _exists(path))


def _base_folder() -> tuple[Path, str]:
    """Return the folder that contains the temporary folders of all processes of this user, and their name prefix."""
    usual = folder_for_temporary_files()
    place = usual / f"crashhunt-temporary-{os.getuid()}"
    try:
        found = place.lstat()
        ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    except FileNotFoundError:
        ours = True
    except OSError:
        ours = False
    return (place, "") if ours else (usual, "crashhunt-temporary-")  # another user made one with this name


def folder_for_temporary_files() -> Path:
    """Return the folder for temporary files that `tempfile` would choose, without the slow import of `tempfile`."""
    named = (os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    for path in (*named, "/tmp", "/var/tmp", "/usr/tmp"):
        if path and os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK):  # noqa: PTH112
            return Path(path).absolute()
    return Path.cwd()


def _remove_left(folder: Path, token: str) -> None:
    """Remove all temporary files of a process that has ended."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(opened).st_uid != os.getuid():
            return
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where it is in use, or being removed by another one
        for path in list(folder.iterdir()):
            if not path.is_symlink():
                remove_scratch(path)
            elif _remove_if_ours(left := path.readlink(), token):
                path.unlink()
                if left.parent.name == _GIT_WORK_TREES_FOLDER:
                    with suppress(OSError):  # Git removes it with the last work tree too
                        left.parent.rmdir()
        folder.rmdir()
    finally:
        os.close(opened)


def _remove_if_ours(path: Path, token: str) -> bool:
    """Remove a path if its name contains a token; return whether the path is gone."""
    owner = owner_in(path.name)
    try:
        found = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    kind = stat.S_ISDIR(found.st_mode) or stat.S_ISREG(found.st_mode)
    if owner is None or owner.token != token or not kind or found.st_uid != os.getuid():
        return True  # it is something else, and stays
    remove_scratch(path)
    return not _exists(path)


def _exists(path: Path) -> bool:
    """Return whether a path exists; a broken symbolic link counts as existing."""
    try:
        path.lstat()
    except OSError:
        return False
    return True


_things = _TemporaryFiles()
