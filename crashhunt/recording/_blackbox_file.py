"""The file of a black box, as a process sees it that does not run the trial: header, records and report."""

from __future__ import annotations

import operator
import os
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, overload

from crashhunt.base.errors import DISK, BundleError
from crashhunt.recording._blackbox import (
    CHUNK,
    FIRST,
    HEADER,
    MAGIC,
    MAPPED,
    NO_ROOM,
    RECORD_HEAD,
    REPORT,
    REPORT_OFFSET,
    UNREPORTABLE,
    Phase,
    cannot_record,
)

if TYPE_CHECKING:
    from pathlib import Path


class Record(NamedTuple):
    """One record of the black box: tag, aux and payload."""

    tag: int
    aux: int
    payload: bytes

    def encode(self) -> bytes:
        """Return the bytes of the record in the black box; the trace digest is computed over these bytes."""
        return RECORD_HEAD.pack(self.tag, self.aux, len(self.payload)) + self.payload + bytes(-len(self.payload) % 8)


class Records(Sequence[Record]):
    """Records in the form in which a black box has them, which takes a third of the memory of as many objects.

    Args:
        data: bytes of the records; an incomplete last record is skipped.
        offsets: where the records begin; by default, all of them.
    """

    def __init__(self, data: bytes | bytearray, offsets: array[int] | None = None) -> None:
        self._data = bytes(data)
        self._offsets = array("Q", _offsets(data)) if offsets is None else offsets

    @classmethod
    def of(cls, records: Iterable[Record]) -> Records:
        """Return the given records."""
        data, offsets = bytearray(), array("Q")
        for record in records:
            offsets.append(len(data))
            data += record.encode()
        return cls(data, offsets)

    @property
    def size(self) -> int:
        """The size of all records together, in bytes."""
        return len(self._data)

    def since(self, number: int) -> Iterator[Record]:
        """Yield the records from a number on."""
        data, unpack, head = self._data, RECORD_HEAD.unpack_from, RECORD_HEAD.size
        for offset in memoryview(self._offsets)[number:]:
            tag, aux, length = unpack(data, offset)
            start = offset + head
            yield Record(tag, aux, data[start : start + length])

    def __iter__(self) -> Iterator[Record]:
        """Yield all records in order."""
        return self.since(0)

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self._offsets)

    @overload
    def __getitem__(self, place: int) -> Record: ...
    @overload
    def __getitem__(self, place: slice) -> Records: ...
    def __getitem__(self, place: int | slice) -> Record | Records:
        """Return a record, or some of the records."""
        if isinstance(place, slice):
            return Records(self._data, self._offsets[place])
        return next(self.since(range(len(self))[place]))

    def __eq__(self, other: object) -> bool:
        """Return whether two sequences have the same records."""
        return isinstance(other, Records) and len(self) == len(other) and all(map(operator.eq, self, other))

    __hash__ = None  # type: ignore[assignment]  # as of a list


def _offsets(data: bytes | bytearray) -> Iterator[int]:
    offset = 0
    while offset + RECORD_HEAD.size <= len(data):
        tag, _, length = RECORD_HEAD.unpack_from(data, offset)
        end = offset + RECORD_HEAD.size + length
        if tag == 0 or end > len(data):
            return
        yield offset
        offset = end + (-length % 8)


@dataclass(frozen=True, slots=True)
class BlackBoxHeader:
    """The position of a process when it last wrote, and the number of steps before the first step of the trial."""

    pid: int
    trial: int
    started: float
    committed: int
    step: int
    phase: Phase
    agent: int
    setup_steps: int = 0


def read_header(path: Path) -> BlackBoxHeader | None:
    """Return the header of a black box, or None if the file has no header yet."""
    try:
        with path.open("rb") as file:
            data = file.read(HEADER.size)
    except OSError:
        return None
    return decode_header(data)


def decode_header(data: bytes) -> BlackBoxHeader | None:
    """Return the header at the beginning of a black box; None if the header is damaged."""
    if len(data) < HEADER.size or not data.startswith(MAGIC):
        return None
    _, pid, setup_steps, trial, started, committed, step, phase, agent = HEADER.unpack(data)
    if not Phase.SETUP <= phase <= Phase.DONE:
        return None
    return BlackBoxHeader(
        pid=pid,
        trial=trial,
        started=started,
        committed=committed,
        step=step,
        phase=Phase(phase),
        agent=agent,
        setup_steps=setup_steps,
    )


def read_black_box(path: Path) -> Records:
    """Return all committed records of a black box.

    Raises:
        BundleError: the file is missing or not a black box.
    """
    header = read_header(path)
    if header is None:
        raise BundleError("the trial left no recording (black box)", fix="run the trial again", where=str(path))
    with path.open("rb") as file:
        file.seek(FIRST)
        data = file.read(max(0, min(header.committed, readable_bytes(os.fstat(file.fileno()))) - FIRST))
    return Records(data)


def readable_bytes(found: os.stat_result) -> int:
    """Return the number of bytes to read of a black box; the process of a trial may claim any size.

    A file that was extended without being written takes no space on the disk, and reading it would fill the memory. A
    file system with compression may store records in a tenth of their size.
    """
    return min(found.st_size, 16 * (512 * found.st_blocks + (1 << 20)))


class BlackBoxFile:
    """The file of a black box, for a process that neither runs nor trusts the trial that writes it.

    The file is never mapped into memory, because reading a mapped page would kill this process if the trial truncates
    the file.

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
        """The number of bytes of the file for which the disk has space."""
        return self._reserved

    @property
    def identity(self) -> os.stat_result:
        """The identity of the file in the file system."""
        return os.fstat(self._file)

    def require_room(self) -> None:
        """Reserve further space on the disk.

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
        """Discard the previous trial and prepare for the next; its process writes its own number at its start."""
        header = HEADER.pack(MAGIC, os.getpid(), 0, trial, started, FIRST, 0, Phase.SETUP, 0)
        os.pwrite(self._file, header + REPORT.pack(0), 0)

    def header(self) -> BlackBoxHeader | None:
        """Return the header of the black box; None if it is damaged."""
        return decode_header(os.pread(self._file, HEADER.size, 0))

    def has(self, header: BlackBoxHeader) -> bool:
        """Return whether the file is large enough for the records that its header claims."""
        return FIRST <= header.committed <= readable_bytes(os.fstat(self._file))

    def read_records(self, header: BlackBoxHeader) -> bytes:
        """Return the bytes of all committed records, or fewer bytes if the file ends early."""
        return self._read(FIRST, max(0, header.committed - FIRST))

    def read_report(self, header: BlackBoxHeader) -> bytes | None:
        """Return the report; empty if there is none, None if the process announced that it cannot write a report."""
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
        """Write the contents to another file, up to the end of the records and the report."""
        header = self.header()
        content = self._read(0, self._reserved if header is None else max(FIRST, header.committed))
        path.write_bytes(content)

    def is_reusable(self) -> bool:
        """Return whether the next trial can be recorded in this file, because the file still has its full size."""
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
