"""Owners of temporary things: a name for a process that no other process on any machine shares, and whether it ended.

The token of an owner is ``PID-START-BOOT-NAMESPACE``, such as ``4711-8812345-3f9a1c2b5d6e-8c736521``:

* the process id and the time at which the process started, in clock ticks since the machine booted. Process ids are
  reused, but no two processes of one boot share both.
* the first 12 digits of the kernel's boot id. Another host has another one, and so has this host after a reboot.
* a checksum of the PID and time namespaces. A process in another container has ids and times of its own.

Only a process that sees the owner's namespaces can tell that the owner ended. Every other process has to take the owner
for alive: a folder may be shared by NFS, by containers or by virtual machines.
"""

from __future__ import annotations

import os
import re
import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

__all__ = ["Owner", "has_ended", "owner_in", "start_time", "this_process"]

_BOOT_ID = "/proc/sys/kernel/random/boot_id"
_NAMESPACES = "/proc/self/ns"  # of PIDs since Linux 3.8, of times since 5.6
_BOOT_DIGITS = 12
_UNKNOWN_BOOT = "0" * _BOOT_DIGITS  # where there is no /proc: such an owner counts as alive
_TOKEN = re.compile(r"(?<![0-9])([0-9]{1,10})-([0-9]{1,20})-([0-9a-f]{12})-([0-9a-f]{8})(?![0-9a-f])")


@dataclass(frozen=True, slots=True)
class Owner:
    """A process, as the names of its temporary things give it.

    Args:
        pid: process id in its own PID namespace.
        started: start time in clock ticks since the boot of the machine.
        boot: first 12 hexadecimal digits of the kernel's boot id.
        namespace: checksum of its PID and time namespaces, 8 hexadecimal digits.
    """

    pid: int
    started: int
    boot: str
    namespace: str

    @property
    def token(self) -> str:
        """The part of a file name that names this process."""
        return f"{self.pid}-{self.started}-{self.boot}-{self.namespace}"


def this_process() -> Owner:
    """Return the owner that this process is."""
    return _owner(os.getpid())


@cache
def _owner(pid: int) -> Owner:
    try:
        boot = Path(_BOOT_ID).read_text(encoding="ascii").replace("-", "")[:_BOOT_DIGITS]
        names = [_namespace(kind) for kind in ("pid", "time")]
    except (OSError, UnicodeError):
        return Owner(pid, 0, _UNKNOWN_BOOT, "0" * 8)
    started = start_time(pid)
    if started <= 0 or len(boot) < _BOOT_DIGITS:
        return Owner(pid, 0, _UNKNOWN_BOOT, "0" * 8)
    return Owner(pid, started, boot, f"{zlib.crc32(' '.join(names).encode()):08x}")


def _namespace(kind: str) -> str:
    """Return what names a namespace of this process; nothing where the kernel is too old to have any of that kind."""
    try:
        return str(Path(_NAMESPACES, kind).readlink())
    except FileNotFoundError:
        return ""


def owner_in(name: str) -> Owner | None:
    """Return the owner that a file name gives; None where the name gives none, or several."""
    found = set(_TOKEN.findall(name))
    if len(found) != 1:  # a user's file name may have such a token as well
        return None
    ((pid, started, boot, namespace),) = found
    return Owner(int(pid), int(started), boot, namespace)


def has_ended(owner: Owner) -> bool:
    """Return whether it is certain that an owner has ended.

    An owner of another boot, of another host or of another container counts as alive, because this process cannot know.
    """
    here = this_process()
    if here.boot == _UNKNOWN_BOOT or (owner.boot, owner.namespace) != (here.boot, here.namespace):
        return False
    return start_time(owner.pid) not in (-1, owner.started)


def start_time(pid: int) -> int:
    """Return when a process started, in clock ticks since the machine booted.

    Returns:
        0 where there is no such process, or only a zombie is left of it; -1 where nothing tells.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        # The first thread of a process may have ended before the others: it is a zombie then, and the process is not.
        if stat[0] in "ZX" and len(os.listdir(f"/proc/{pid}/task")) <= 1:  # noqa: PTH208 - how many is enough
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
