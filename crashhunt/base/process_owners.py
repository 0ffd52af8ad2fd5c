"""The process that owns a temporary thing: a name that no other process on any machine has, and whether it ended.

The token of an owner is ``PID-START-BOOT-NAMESPACE``, such as ``4711-8812345-3f9a1c2b5d6e-8c736521``:

* the process id and the time at which the process started, in clock ticks since the machine booted. Process ids are
  reused, but no two processes of one boot share both.
* the first 12 digits of the kernel's boot id. Another host has another one, and so has this host after a reboot.
* a checksum of the PID and time namespaces. A process in another container has ids and times of its own.

Only a process that sees the owner's namespaces can tell that the owner ended. Every other process has to take the
owner for alive: a folder may be shared by NFS, by containers or by virtual machines.
"""

from __future__ import annotations

import os
import re
import zlib
from dataclasses import dataclass
from functools import cache

_BOOT_ID = "/proc/sys/kernel/random/boot_id"
_NAMESPACE_FOLDER = "/proc/self/ns"  # of PIDs since Linux 3.8, of times since 5.6
_BOOT_DIGITS = 12
_MAX_READ_BYTES = 4096  # of a file of the kernel, which has some hundred
_UNKNOWN_BOOT = "0" * _BOOT_DIGITS  # where there is no /proc: such an owner counts as alive
_TOKEN = re.compile(r"(?<![0-9])([0-9]{1,10})-([0-9]{1,20})-([0-9a-f]{12})-([0-9a-f]{8})(?![0-9a-f])")


@dataclass(frozen=True, slots=True)
class OwnerProcess:
    """The process to which temporary files belong; their names contain its token."""

    pid: int  # process id in its own PID namespace
    started: int  # start time of the process, in clock ticks since the machine booted
    boot: str  # first 12 hexadecimal digits of the kernel's boot id
    namespace: str  # checksum of the process's PID and time namespaces, 8 hexadecimal digits

    @property
    def token(self) -> str:
        """The part of a file name that identifies the process."""
        return f"{self.pid}-{self.started}-{self.boot}-{self.namespace}"


def this_process() -> OwnerProcess:
    """Return the owner that represents this process."""
    return owner_of(os.getpid())


@cache
def owner_of(pid: int) -> OwnerProcess:
    """Return the owner that represents a process of this PID namespace."""
    unknown = OwnerProcess(pid=pid, started=0, boot=_UNKNOWN_BOOT, namespace="0" * 8)
    boot = boot_id()
    try:
        names = [_namespace(kind) for kind in ("pid", "time")]
    except OSError:
        return unknown
    started = start_time(pid)
    if started <= 0 or boot == _UNKNOWN_BOOT:
        return unknown
    return OwnerProcess(pid=pid, started=started, boot=boot, namespace=f"{zlib.crc32(' '.join(names).encode()):08x}")


@cache
def boot_id() -> str:
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
