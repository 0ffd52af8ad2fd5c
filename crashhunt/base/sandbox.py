"""Landlock: the kernel prevents this process from writing outside of its own folder."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

from crashhunt.base.layout import PACKAGE

# The numbers are the same on every processor (include/uapi/linux/landlock.h).
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_ONLY, _PATH_BENEATH, _PR_SET_NO_NEW_PRIVS = 1, 1, 38  # of <linux/landlock.h> and <sys/prctl.h>

_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR, _TRUNCATE = 1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 14
_READ_RIGHTS = _EXECUTE | _READ_FILE | _READ_DIR
_FILE_RIGHTS = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE
# What each version of the kernel's interface has added: rights to files, to ports, and to other processes.
_FILE_RIGHTS_BY_VERSION = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 5: (1 << 16) - 1}
_PORT_RIGHTS_BY_VERSION = {4: 0b11}  # to listen and to connect
_SCOPES_BY_VERSION = {6: 0b11}  # abstract sockets and signals

# What a Python process reads besides what is installed: libraries and their list, the clock, random numbers, itself.
_SYSTEM_PATHS = """
/usr /lib /lib64 /bin /opt /etc/ld.so.cache /etc/localtime /etc/fonts /dev/urandom /dev/null /proc
/proc/meminfo /proc/stat /sys/devices/system /sys/fs/cgroup
"""


def landlock_version() -> int:
    """Return the version of the kernel's Landlock interface; 0 if there is none."""
    return max(0, int(ctypes.CDLL(None, use_errno=True).syscall(_CREATE_RULESET, None, 0, _VERSION_ONLY)))


def confine(folder: Path, readable: Iterable[Path | str] = ()) -> bool:
    """Restrict this process and its children permanently to writing below one folder.

    The process can still read installed packages, this folder and the named files. If the kernel's version of Landlock
    supports it, the process can open no port and send no signal to other processes.

    Returns:
        Whether the kernel restricts the process; False if the kernel does not support it.
    """
    version = landlock_version()
    if not version:
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    rights, ports, others = (
        _newest(table, version) for table in (_FILE_RIGHTS_BY_VERSION, _PORT_RIGHTS_BY_VERSION, _SCOPES_BY_VERSION)
    )
    content = struct.pack("=QQQ", rights, ports, others)
    # An older kernel knows the first ones only; it takes more if they are zero.
    ruleset = int(libc.syscall(_CREATE_RULESET, content, len(content), 0))
    if ruleset < 0:
        return False
    try:
        _allow(libc, ruleset, folder, rights)
        _allow(libc, ruleset, Path("/dev/null"), (_READ_RIGHTS | _WRITE_FILE | _TRUNCATE) & rights)
        for path in {*map(Path, readable), *_installed()}:
            _allow(libc, ruleset, path, _READ_RIGHTS)
        if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
            return False
        return int(libc.syscall(_RESTRICT_SELF, ruleset, 0)) == 0
    finally:
        os.close(ruleset)


def _newest(table: dict[int, int], version: int) -> int:
    return next((table[since] for since in sorted(table, reverse=True) if since <= version), 0)


def _installed() -> set[Path]:
    """Return the folders of Python's modules, and the system folders that they need."""
    paths = {Path(path) for path in _SYSTEM_PATHS.split()} | {PACKAGE, PACKAGE.parent / "scenarios"}
    paths |= {
        Path(path).resolve()
        for path in (sys.prefix, sys.base_prefix, sys.exec_prefix, os.path.realpath(sys.executable))
    }
    # Not the working directory, which is the user's.
    return paths | {Path(entry) for entry in sys.path if entry and Path(entry).resolve() != Path.cwd()}


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path, rights: int) -> None:
    with suppress(OSError):  # what is not there needs no right
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            if not path.is_dir():
                rights &= _FILE_RIGHTS
            libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, opened), 0)
        finally:
            os.close(opened)
