"""The black box: compact binary records in a memory-mapped scratch file.

Nothing is encoded while the episode runs, and the pages belong to the kernel, so that the records outlive a process
that is killed in the middle of a step. The layout consists of a header of 64 bytes and records, each with 8 bytes of
head (tag, aux, length) and its payload, padded to 8 bytes. Everything is little-endian. Only what lies before the
header's ``committed`` offset counts. The header also has the position of the process: step, phase and agent.

Behind the records, the process of a finished trial leaves one report, which the header announces by its length. The
report is not a record, and belongs neither to the digest nor to the log.
"""

from __future__ import annotations

import hashlib
import mmap
import operator
import os
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain, groupby
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple, overload

import numpy as np

from crashhunt.base.errors import DISK, BundleError, RecorderError
from crashhunt.base.forks import MEMORY
from crashhunt.recording.records._agent_records import ACTION, OBSERVATION, PROLOGUE
from crashhunt.recording.records._scene_record import LANES, NOTES, STEP
from crashhunt.world import joined_frame

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.native import Core, UsualSteps
    from crashhunt.world import Frame, Roster, Scene


# The digest of a trial: what belongs to it, and how it is computed.

FIRST_NON_EVIDENCE_TAG = 128
"""Tags from here on are of records that are no evidence, so a reader need not know a type to compute the digest."""
_NOTES_TAG = 11  # the only type of the first eleven that is no evidence, from before there was that rule


def is_evidence(tag: int) -> bool:
    """Return whether records with this tag belong to the digest of the trial."""
    return tag < FIRST_NON_EVIDENCE_TAG and tag != _NOTES_TAG


def digest_of(records: Iterable[bytes | memoryview]) -> str:
    """Return the trace digest of encoded records: BLAKE2b of 16 bytes, in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    for part in records:
        digest.update(part)
    return digest.hexdigest()


MAGIC = b"CRASHBB1"
HEADER = struct.Struct("<8sIIQdQqiI")  # magic, pid, set-up, trial, started, committed, step, phase, agent
_PROGRESS = struct.Struct("<QqiI")  # the last four of them
_PROGRESS_OFFSET = HEADER.size - _PROGRESS.size
_SETUP, _SETUP_OFFSET = struct.Struct("<I"), 12
REPORT, REPORT_OFFSET = struct.Struct("<Q"), HEADER.size  # length of the report in bytes; 0 for none
UNREPORTABLE = 2**64 - 1  # in place of that length: the process is damaged and cannot report
NO_ROOM = 2**64 - 2  # the same: the disk had no room for the recording
FIRST = 64  # where records begin; the header has room to grow
_DAMAGE_ANNOUNCED = REPORT.pack(UNREPORTABLE)
_RECORD_HEAD = struct.Struct("<BxHI")
CHUNK = 1 << 20  # bytes that the file grows by: each time asks the disk whether there is room
MAPPED = 64 << 20  # bytes of addresses, not of memory: mapping again moves every view


class Phase(IntEnum):
    """The current task of the process. ``ACT`` before the scene of step 0 means that the agent is being created."""

    SETUP = 0
    ACT = 1
    SIMULATE = 2
    DONE = 3


# Attributes of modules, and members of an enum, are looked up at every use; these are used in every step.
_STEP, _OBSERVATION, _ACTION = STEP.tag, OBSERVATION.tag, ACTION.tag
_CORE_TAGS = _OBSERVATION, _ACTION, _STEP, LANES.tag  # records of another writer
_ACT, _SIMULATE = int(Phase.ACT), int(Phase.SIMULATE)


class Record(NamedTuple):
    """One record of the black box: tag, aux and payload."""

    tag: int
    aux: int
    payload: bytes

    def encode(self) -> bytes:
        """Return the bytes of the record in the black box; the trace digest is computed over these bytes."""
        return _RECORD_HEAD.pack(self.tag, self.aux, len(self.payload)) + self.payload + bytes(-len(self.payload) % 8)


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
        data, unpack, head = self._data, _RECORD_HEAD.unpack_from, _RECORD_HEAD.size
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
    while offset + _RECORD_HEAD.size <= len(data):
        tag, _, length = _RECORD_HEAD.unpack_from(data, offset)
        end = offset + _RECORD_HEAD.size + length
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


class BlackBox:
    """Writes the records of one trial after another to the same scratch file, whose pages stay in memory.

    Args:
        path: path of the file to create.
        begun: size that another process has reserved in the file, in bytes; 0 to create the file.

    Raises:
        RecorderError: the disk is full.
    """

    def __init__(self, path: Path | str, *, begun: int = 0) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | (0 if begun else os.O_CREAT | os.O_TRUNC), 0o644)
        self._reserved = begun
        self._mapped = 0
        self._map: mmap.mmap
        self._offset = FIRST
        self._step = 0
        self._agents = 0
        self._roster: Roster | None = None
        self._core: Core | None = None
        self._steps: dict[int, struct.Struct] = {}
        self._trail: list[tuple[Roster | None, int, Scene | None]] = []
        self._aside: list[tuple[int, int]] = []
        self._lent: UsualSteps | None = None
        try:
            self._reserve(FIRST)
        except RecorderError:
            os.close(self._file)
            raise

    @property
    def reserved(self) -> int:
        """The reserved size of the file, in bytes."""
        return self._reserved

    def begin(self, *, pid: int, trial: int, started: float) -> None:
        """Discard the previous trial, and begin the recording of the next trial."""
        self._stop_core()
        HEADER.pack_into(self._map, 0, MAGIC, pid, 0, trial, started, FIRST, 0, Phase.SETUP, 0)
        REPORT.pack_into(self._map, REPORT_OFFSET, 0)
        self._offset = FIRST
        self._step = 0
        self._roster = None
        self._trail.clear()
        self._aside.clear()

    def set_up(self, steps: int) -> None:
        """Record the number of simulated steps before the first step."""
        _SETUP.pack_into(self._map, _SETUP_OFFSET, min(steps, 2**32 - 1))

    def prologue(self, payload: bytes, agents: int) -> None:
        """Record the prologue of the trial; ``agents`` is the number of rewards in each step."""
        self._agents = agents
        self._steps = {}
        self.append(PROLOGUE.tag, 0, payload)

    def append(self, tag: int, aux: int, payload: bytes) -> None:
        """Record data of any record type; use this method only for data that occur rarely."""
        self._stop_core()
        offset, length = self._offset, len(payload)
        if offset + length + 16 > self._reserved:
            self._reserve(offset + length + 16)
        _RECORD_HEAD.pack_into(self._map, offset, tag, aux, length)
        start = offset + 8
        self._map[start : start + length] = payload
        self._finish(start + length)
        if not is_evidence(tag):
            self._aside.append((offset, self._offset))
        self.mark(Phase.SETUP if self._roster is None else Phase.SIMULATE)

    def report(self, report: bytes) -> None:
        """Write a report after the records. Nothing can be recorded after this."""
        self._stop_core()
        end = self._offset + len(report)
        if end > self._reserved:
            self._reserve(end)
        self._map[self._offset : end] = report
        REPORT.pack_into(self._map, REPORT_OFFSET, len(report))

    def announce_no_room(self) -> None:
        """Announce that the disk has no room for the recording; the supervisor verifies this."""
        REPORT.pack_into(self._map, REPORT_OFFSET, NO_ROOM)

    def announce_damage(self) -> None:
        """Announce that this process cannot write its report, without code that an agent may have damaged."""
        self._map[REPORT_OFFSET:FIRST] = _DAMAGE_ANNOUNCED

    def note(self, payload: bytes) -> None:
        """Record data that do not belong to the digest."""
        self.append(NOTES.tag, 0, payload)

    def observation(self, agent: int, array: NDArray[np.generic]) -> None:
        """Record the observation that an agent receives next."""
        self._raw(_OBSERVATION, agent, array, _ACT)

    def action(self, agent: int, array: NDArray[np.generic]) -> None:
        """Record the action that an agent returned."""
        self._raw(_ACTION, agent, array, _SIMULATE)

    def lend(self, steps: UsualSteps, roster: Roster) -> None:
        """Let the core record the steps of one agent until another method of this black box is called.

        Args:
            steps: steps of the core to record.
            roster: the actors of these steps, which must have been recorded.
        """
        self._stop_core()
        self._roster = roster
        steps.borrow(self._map, self._offset, self._reserved, _CORE_TAGS)
        self._lent = steps

    def _stop_core(self) -> None:
        if self._lent is not None:
            self._offset, step, places = self._lent.give_back()
            self._lent = None
            if places:
                self._step = step
                self._trail += [(self._roster, place, None) for place in places]

    def _raw(self, tag: int, agent: int, array: NDArray[np.generic], phase: int) -> None:
        if self._lent is not None:
            self._stop_core()
        offset, length = self._offset, array.nbytes
        if offset + length + 16 > self._reserved:
            self._reserve(offset + length + 16)
        mapped = self._map
        if self._core is not None:
            written = self._core.write_array(mapped, offset, tag, agent, array, self._step, phase)
            if written is not None:
                self._offset = written
                return
        _RECORD_HEAD.pack_into(mapped, offset, tag, agent, length)
        start = offset + 8
        end = start + length
        mapped[start:end] = array.tobytes()
        if length & 7:
            mapped[end : end + (-length & 7)] = bytes(-length & 7)
            end += -length & 7
        self._offset = end
        _PROGRESS.pack_into(mapped, _PROGRESS_OFFSET, end, self._step, phase, agent)

    def step(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Record a completed step; the scene's roster must already have been recorded."""
        if self._lent is not None:
            self._stop_core()
        offset, count = self._offset, len(scene.roster)
        packer = self._steps.get(count)
        if packer is None:
            packer = self._steps[count] = struct.Struct(f"<BxHIqd{self._agents + 4 * count}d")
        if offset + packer.size > self._reserved:
            self._reserve(offset + packer.size)
        core, columns, end = scene.core, scene.columns, None
        if core is not None and columns is not None:
            where = (self._map, offset, _STEP, step)
            end = core.write_step(*where, scene.time_s, rewards, columns, _SIMULATE)
        if end is None:
            packer.pack_into(
                self._map,
                offset,
                _STEP,
                0,
                packer.size - 8,
                step,
                scene.time_s,
                *rewards,
                *chain.from_iterable(scene.points),
                *scene.headings,
                *scene.speeds,
            )
            end = offset + packer.size
            _PROGRESS.pack_into(self._map, _PROGRESS_OFFSET, end, step, _SIMULATE, 0)
        self._roster, self._core = scene.roster, core
        rest = scene if scene.heights or scene.spines else None
        self._trail.append((scene.roster, end - 32 * count, rest))
        self._offset, self._step = end, step

    def mark(self, phase: int, agent: int = 0) -> None:
        """Write the current phase and agent of the process into the header, and commit all records until now."""
        self._stop_core()
        _PROGRESS.pack_into(self._map, _PROGRESS_OFFSET, self._offset, self._step, phase, agent)

    def take_frames(self) -> list[Frame]:
        """Return the scenes recorded since the last call, as plain columns."""
        self._stop_core()
        frames: list[Frame] = []
        for roster, group in groupby(self._trail, key=itemgetter(0)):
            run = list(group)
            size = 32 * len(roster)
            data = b"".join([self._map[offset : offset + size] for _, offset, _ in run])
            columns = np.frombuffer(data, "<f8").reshape(len(run), 4 * len(roster))
            frames.append(joined_frame(roster, columns, [scene for *_, scene in run], self._core))
        self._trail.clear()
        return frames

    def committed(self) -> memoryview:
        """The bytes of all records written until now."""
        self._stop_core()
        return memoryview(self._map)[FIRST : self._offset]

    def evidence(self) -> list[memoryview]:
        """The bytes of those records that belong to the digest."""
        self._stop_core()
        whole = memoryview(self._map)
        edges = [FIRST, *chain.from_iterable(self._aside), self._offset]
        return [whole[begins:ends] for begins, ends in zip(edges[::2], edges[1::2], strict=True)]

    def detach(self) -> None:
        """Discard all further records, because this process is a fork of the recording process."""
        self._stop_core()
        self._map = mmap.mmap(-1, self._mapped)
        self._file = os.open(os.devnull, os.O_RDWR)

    def delay(self, wall_s: float) -> None:
        """Exclude some seconds from the wall time of the trial."""
        magic, pid, setup_steps, trial, started, *where = HEADER.unpack_from(self._map, 0)
        HEADER.pack_into(self._map, 0, magic, pid, setup_steps, trial, started + wall_s, *where)

    def copy(self) -> None:
        """Continue to record in private memory, because this process is a fork of the recording process."""
        self._stop_core()
        data = bytes(memoryview(self._map)[: self._offset])
        self._file = os.memfd_create(MEMORY)
        self._reserved = self._mapped = 0
        self._reserve(len(data))
        self._map[: len(data)] = data

    def close(self) -> None:
        """Unmap and close the file."""
        self._stop_core()
        self._map.close()
        os.close(self._file)

    def _finish(self, end: int) -> None:
        padded = end + (-end % 8)
        if padded != end:
            self._map[end:padded] = bytes(padded - end)
        self._offset = padded

    def _reserve(self, end: int) -> None:
        # Written, not only made longer: a full disk must be an error here, not a SIGBUS at the first access.
        try:
            while self._reserved < end:
                self._reserved += os.pwrite(self._file, bytes(CHUNK), self._reserved)
            if self._reserved > self._mapped:
                # The old mapping, where there is one, is unmapped when its last view is gone.
                self._mapped = max(MAPPED, 2 * self._reserved)
                os.ftruncate(self._file, self._mapped)
                self._map = mmap.mmap(self._file, self._mapped)
        except OSError as error:
            if error.errno not in DISK:  # such as a file that the agent has closed
                raise
            raise cannot_record(error, self._path) from error


def cannot_record(error: OSError, path: Path | str) -> RecorderError:
    """Return the error that ends a trial when the disk has no room for its recording."""
    return RecorderError(
        f"the trial cannot be recorded: {error.strerror}",
        fix="free some space and run the same command again",
        where=str(path),
    )


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


# A black box as a file: what the process sees of it that supervises a trial, and does not run it.


class BlackBoxFile:
    """The file of a black box, for a process that neither runs nor trusts the trial that writes it.

    The file is never mapped into memory, because reading a mapped page would kill this process if the trial truncates
    the file.

    Args:
        path: path of the file to create.

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
