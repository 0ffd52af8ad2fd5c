"""Detects open files and memory that a process shares with its forks, and gives a fork private copies.

A fork shares three resources with its parent:

- the position and flags of every open file,
- the content of unnamed files,
- memory that is mapped as shared (`mmap.mmap(-1, …)`, `multiprocessing.Value`).

A change of any of these resources by one fork is visible to all others. The same is true for data that a fork reads
from a pipe or a socket. Pipes and sockets cannot be copied, so they are reported.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Collection

_MAX_COPIED_BYTES: Final = 16 << 20  # of a file without a name, or of a mapping; a copy of it is made in every fork
_MAP_FIXED: Final = 0x10
_RESTORED_OPEN_FLAGS: Final = (
    os.O_ACCMODE | os.O_APPEND | os.O_NONBLOCK | os.O_SYNC
)  # others say how a file was created
_COPY_NAME: Final = "crashhunt-own"
_CONNECTIONS: Final = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}


@dataclass(frozen=True, slots=True)
class _File:
    descriptor: int
    flags: int
    position: int
    inode: tuple[int, int]
    is_nameless: bool  # so that nothing but this process and its forks knows its content
    size: int


@dataclass(frozen=True, slots=True)
class _Mapping:
    start: int
    length: int
    offset: int
    inode: tuple[int, int]


class SharedState:
    """The files and memory that this process shares with its forks. Each fork first calls `separate`."""

    def __init__(self, known: Collection[int] = ()) -> None:
        self._files: list[_File] = []
        self._mappings: list[_Mapping] = []
        # description of a file that is too large to copy, or of a pipe or socket; empty if there is none
        self.remaining = ""
        for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are enough
            with suppress(OSError):  # the descriptor by which they are listed
                self._add_file(int(name), known)
        for line in Path("/proc/self/maps").read_bytes().splitlines():
            if b" rw-s " in line:
                self._add_mapping(line)

    def separate(self) -> None:
        """Give this process, which is a fork, private files and memory."""
        copies: dict[tuple[int, int], int] = {}
        for file in self._files:
            try:
                self._reopen(file, copies)
            except OSError:  # its user may not open it any more
                continue
        for mapping in self._mappings:
            _map_own(mapping, copies.get(mapping.inode))
        for copy in copies.values():
            os.close(copy)

    def _add_file(self, descriptor: int, known: Collection[int]) -> None:
        found = os.fstat(descriptor)
        flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
        if descriptor in known or flags & os.O_PATH:  # which has no position
            return
        if not stat.S_ISREG(found.st_mode):
            self.remaining = _CONNECTIONS.get(stat.S_IFMT(found.st_mode), self.remaining)
            return
        inode = found.st_dev, found.st_ino
        is_nameless = found.st_nlink == 0
        if is_nameless and found.st_size > _MAX_COPIED_BYTES:
            self.remaining = f"a file without a name of {found.st_size >> 20} MB"
            return
        position = os.lseek(descriptor, 0, os.SEEK_CUR)
        self._files.append(
            _File(
                descriptor=descriptor,
                flags=flags & _RESTORED_OPEN_FLAGS,
                position=position,
                inode=inode,
                is_nameless=is_nameless,
                size=found.st_size,
            )
        )

    def _add_mapping(self, line: bytes) -> None:
        place, _, offset, device, inode, *name = line.split(maxsplit=5)
        start, end = (int(part, 16) for part in place.split(b"-"))
        shown = name[0] if name else b""
        if shown.startswith(b"/") and not shown.endswith(b"(deleted)"):
            return  # a file that others know, whose content is meant to stay
        if end - start > _MAX_COPIED_BYTES:
            self.remaining = f"shared memory of {(end - start) >> 20} MB"
            return
        major, minor = (int(part, 16) for part in device.split(b":"))
        at = os.makedev(major, minor), int(inode)
        self._mappings.append(_Mapping(start=start, length=end - start, offset=int(offset, 16), inode=at))

    def _reopen(self, file: _File, copies: dict[tuple[int, int], int]) -> None:
        path = f"/proc/self/fd/{file.descriptor}"
        if file.is_nameless and file.inode not in copies:
            copies[file.inode] = os.memfd_create(_COPY_NAME)
            content = os.open(path, os.O_RDONLY)
            done = 0
            while done < file.size and (sent := os.sendfile(copies[file.inode], content, done, file.size - done)):
                done += sent
            os.close(content)
        if file.is_nameless:
            path = f"/proc/self/fd/{copies[file.inode]}"
        own = os.open(path, file.flags)
        os.lseek(own, file.position, os.SEEK_SET)
        os.dup2(own, file.descriptor, inheritable=os.get_inheritable(file.descriptor))
        os.close(own)


def _map_own(mapping: _Mapping, copy: int | None) -> None:
    """Replace a memory mapping by private memory with the same contents."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    types = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long)
    libc.mmap.argtypes = types
    content = ctypes.string_at(mapping.start, mapping.length) if copy is None else b""
    kind = mmap.MAP_SHARED | _MAP_FIXED | (mmap.MAP_ANONYMOUS if copy is None else 0)
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    offset = 0 if copy is None else mapping.offset
    found = libc.mmap(mapping.start, mapping.length, protection, kind, -1 if copy is None else copy, offset)
    if found != mapping.start:
        raise OSError(ctypes.get_errno(), "memory cannot be mapped")
    if copy is None:
        ctypes.memmove(mapping.start, content, mapping.length)
