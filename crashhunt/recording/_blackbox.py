"""The black box: compact binary records in a memory-mapped scratch file.

Nothing is encoded while the episode runs, and the pages belong to the kernel, so that the records outlive a process
that is killed in the middle of a step. The layout consists of a header of 64 bytes and records, each with 8 bytes of
head (tag, aux, length) and its payload, padded to 8 bytes. Everything is little-endian. Only what lies before the
header's ``committed`` offset counts. The header also has the position of the process: step, phase and agent.

Behind the records, the process of a finished trial leaves one report, which the header announces by its length. The
report is not a record, and belongs neither to the digest nor to the log.
"""

from __future__ import annotations

import mmap
import os
import struct
from enum import IntEnum
from itertools import chain, groupby
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import DISK, RecorderError
from crashhunt.base.forks import MEMORY
from crashhunt.recording.records._agent_records import ACTION, OBSERVATION, PROLOGUE
from crashhunt.recording.records._scene_record import ACTORS, LANES, NOTES, ROSTER, STEP
from crashhunt.world import joined_frame

if TYPE_CHECKING:
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
RECORD_HEAD = struct.Struct("<BxHI")
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
_CORE_TAGS = _OBSERVATION, _ACTION, _STEP, LANES.tag, ROSTER.tag, ACTORS.tag  # records of another writer
_ACT, _SIMULATE = int(Phase.ACT), int(Phase.SIMULATE)


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
        self._roster: Roster | None = None
        self._core: Core | None = None
        self._step_head = struct.Struct("<BxHIqd")  # of a record of a step, with the rewards
        self._numbers: dict[int, struct.Struct] = {}  # of a scene, by the number of actors
        self._trail: list[tuple[Roster | None, list[int], list[Scene | None]]] = []
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
        self._step_head = struct.Struct(f"<BxHIqd{agents}d")
        self.append(PROLOGUE.tag, 0, payload)

    def append(self, tag: int, aux: int, payload: bytes) -> None:
        """Record data of any record type; use this method only for data that occur rarely."""
        self._stop_core()
        offset, length = self._offset, len(payload)
        if offset + length + 16 > self._reserved:
            self._reserve(offset + length + 16)
        RECORD_HEAD.pack_into(self._map, offset, tag, aux, length)
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

    @property
    def roster(self) -> Roster | None:
        """The actors of the last step; None before the first step."""
        self._stop_core()
        return self._roster

    def lend(self, steps: UsualSteps, roster: Roster, numbers: bytes) -> None:
        """Let the core record the steps of one agent until another method of this black box is called.

        The roster of the first of these steps must have been recorded; ``numbers`` is the payload of its record.
        """
        self._stop_core()
        self._roster = roster
        steps.borrow(self._map, self._offset, self._reserved, _CORE_TAGS, roster, numbers)
        self._lent = steps

    def _stop_core(self) -> None:
        if self._lent is not None:
            self._offset, step, self._roster, runs = self._lent.give_back()
            self._lent = None
            if runs:
                self._step = step
                lists = [(roster, memoryview(places).cast("Q").tolist()) for roster, places in runs]
                self._trail += [(roster, places, [None] * len(places)) for roster, places in lists]

    def _raw(self, tag: int, agent: int, array: NDArray[np.generic], phase: int) -> None:
        if self._lent is not None:
            self._stop_core()
        offset, length = self._offset, array.nbytes
        if offset + length + 16 > self._reserved:
            self._reserve(offset + length + 16)
        mapped = self._map
        RECORD_HEAD.pack_into(mapped, offset, tag, agent, length)
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
        offset, count, head = self._offset, len(scene.roster), self._step_head
        start = offset + head.size
        end = start + 32 * count
        if end > self._reserved:
            self._reserve(end)
        mapped, columns = self._map, scene.columns
        head.pack_into(mapped, offset, _STEP, 0, end - offset - 8, step, scene.time_s, *rewards)
        if columns is not None:
            mapped[start:end] = columns.recorded
        else:
            packer = self._numbers.get(count)
            if packer is None:
                packer = self._numbers[count] = struct.Struct(f"<{4 * count}d")
            packer.pack_into(mapped, start, *chain.from_iterable(scene.points), *scene.headings, *scene.speeds)
        _PROGRESS.pack_into(mapped, _PROGRESS_OFFSET, end, step, _SIMULATE, 0)
        self._roster, self._core = scene.roster, scene.core
        rest = scene if scene.heights or scene.spines else None
        self._trail.append((scene.roster, [end - 32 * count], [rest]))
        self._offset, self._step = end, step

    def mark(self, phase: int, agent: int = 0) -> None:
        """Write the current phase and agent of the process into the header, and commit all records until now."""
        self._stop_core()
        _PROGRESS.pack_into(self._map, _PROGRESS_OFFSET, self._offset, self._step, phase, agent)

    def take_frames(self) -> list[Frame]:
        """Return the scenes recorded since the last call, as plain columns."""
        self._stop_core()
        frames: list[Frame] = []
        for roster, runs in groupby(self._trail, key=itemgetter(0)):
            _, places, rest = zip(*runs, strict=True)
            scenes, size = [*chain.from_iterable(rest)], 32 * len(roster)
            data = b"".join([self._map[offset : offset + size] for offset in chain.from_iterable(places)])
            columns = np.frombuffer(data, "<f8").reshape(len(scenes), 4 * len(roster))
            frames.append(joined_frame(roster, columns, scenes, self._core))
        self._trail.clear()
        return frames

    def committed(self) -> memoryview:
        """The bytes of all records written until now."""
        self._stop_core()
        return memoryview(self._map)[FIRST : self._offset]

    @property
    def core(self) -> Core | None:
        """The compiled core of the recorded simulator; None without one."""
        return self._core

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


# A black box as a file: what the process sees of it that supervises a trial, and does not run it.
