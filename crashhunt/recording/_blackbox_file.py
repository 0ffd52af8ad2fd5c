"""A black box as a file: what the process sees of it that supervises a trial, and does not run it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from crashhunt.base.errors import DISK
from crashhunt.recording._blackbox import (
    CHUNK,
    FIRST,
    HEADER,
    MAGIC,
    MAPPED,
    NO_ROOM,
    REPORT,
    REPORT_OFFSET,
    UNREPORTABLE,
    Phase,
    cannot_record,
    decode_header,
    readable_bytes,
)

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.recording._blackbox import BlackBoxHeader

__all__ = ["BlackBoxFile"]


class BlackBoxFile:
    """The file of a black box, for a process that neither runs nor trusts the trial that writes it.

    It never maps the file: where the trial truncates it, reading a mapped page would kill this process as well.

    Args:
        path: the file to create.

    Raises:
        RecorderError: the disk is full.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._reserved = 0
        try:
            self.require_room()
            os.ftruncate(self._file, MAPPED)
        except BaseException:
            os.close(self._file)
            raise

    @property
    def reserved(self) -> int:
        """How many bytes of the file have space on the disk."""
        return self._reserved

    @property
    def identity(self) -> os.stat_result:
        """What the file system says of the file."""
        return os.fstat(self._file)

    def require_room(self) -> None:
        """Reserve some more of the disk.

        Raises:
            RecorderError: the disk is full.
        """
        try:
            _write_all(self._file, bytes(CHUNK), self._reserved)
        except OSError as error:
            if error.errno in DISK:
                raise cannot_record(error, self._path) from error
            raise
        self._reserved += CHUNK

    def begin(self, *, trial: int, started: float) -> None:
        """Forget the previous trial and open the next; its process writes its own number at its start."""
        header = HEADER.pack(MAGIC, os.getpid(), 0, trial, started, FIRST, 0, Phase.SETUP, 0)
        os.pwrite(self._file, header + REPORT.pack(0), 0)

    def header(self) -> BlackBoxHeader | None:
        """Return the header; None where it is damaged."""
        return decode_header(os.pread(self._file, HEADER.size, 0))

    def has(self, header: BlackBoxHeader) -> bool:
        """Whether the file can have as many records as its header claims."""
        return FIRST <= header.committed <= readable_bytes(os.fstat(self._file))

    def read_records(self, header: BlackBoxHeader) -> bytes:
        """Return the bytes of all committed records, or fewer where the file ends before."""
        return self._read(FIRST, max(0, header.committed - FIRST))

    def read_report(self, header: BlackBoxHeader) -> bytes | None:
        """Return the report; empty where there is none, None where the process announced that it cannot report."""
        size = self._announced()
        if size == UNREPORTABLE:
            return None
        return b"" if size == NO_ROOM else self._read(header.committed, size)

    @property
    def had_no_room(self) -> bool:
        """Whether the process announced that the disk had no room for the recording."""
        return self._announced() == NO_ROOM

    def _announced(self) -> int:
        found = os.pread(self._file, REPORT.size, REPORT_OFFSET).ljust(REPORT.size, b"\0")
        size: int = REPORT.unpack(found)[0]
        return size

    def copy_to(self, path: Path) -> None:
        """Write the content to another file, up to the end of the records and the report."""
        header = self.header()
        content = self._read(0, self._reserved if header is None else max(FIRST, header.committed))
        path.write_bytes(content)

    def is_reusable(self) -> bool:
        """Whether the next trial can be recorded here: the file still has its size. Notes how much of it there is."""
        found = os.fstat(self._file)
        self._reserved = max(self._reserved, min(found.st_blocks * 512 // CHUNK * CHUNK, found.st_size))
        return found.st_size >= MAPPED

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _read(self, offset: int, size: int) -> bytes:
        found, end = bytearray(), min(offset + size, readable_bytes(os.fstat(self._file)))
        while offset < end and (data := os.pread(self._file, end - offset, offset)):
            found += data
            offset += len(data)
        return bytes(found)


def _write_all(file: int, data: bytes, offset: int) -> None:
    while data:
        written = os.pwrite(file, data, offset)
        data, offset = data[written:], offset + written
