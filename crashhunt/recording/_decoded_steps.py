"""The steps of a recording; those of a long recording are decoded at each use, as decoded steps take much memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, overload

from crashhunt.recording._reading import Reading, StepRecord
from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._scene_record import STEP
from crashhunt.world import Roster

if TYPE_CHECKING:
    from crashhunt.recording._blackbox import Records
    from crashhunt.recording._reading import Prologue
    from crashhunt.world import Actor, Scene

_CHUNK_STEPS = 256
_MAX_DECODED_BYTES = 64 << 20
_BYTES_PER_RECORD, _BYTES_PER_RECORDED_BYTE = 700, 6  # of the decoded steps, measured
_MAX_CHUNKS = 4  # of a recording that takes more: a reader may follow a few places at a time


class _Mark(NamedTuple):
    """The place at which the records of a step begin.

    Args:
        step: number of the step.
        record: index of its first record.
        roster: the actors of the scene before this record.
        actors: number of actors that earlier records define.
    """

    step: int
    record: int
    roster: Roster
    actors: int


class DecodedSteps(Sequence[StepRecord]):
    """The steps of a recording; only a few steps of a long recording are in memory at a time.

    Two uses of a step may return two equal objects. Therefore a caller must not change them.

    Args:
        records: all records, beginning with the prologue.
        prologue: the agents of the recording.

    Raises:
        ValueError, IndexError, KeyError, TypeError, struct.error: the records contradict each other.
    """

    def __init__(self, records: Records, prologue: Prologue) -> None:
        self.actors: list[Actor] = []
        self._records = records
        self._prologue = prologue
        self._chunks: OrderedDict[int, list[StepRecord]] = OrderedDict()
        decoded_bytes = _BYTES_PER_RECORD * len(records) + _BYTES_PER_RECORDED_BYTE * records.size
        self._max_chunks = _MAX_CHUNKS if decoded_bytes > _MAX_DECODED_BYTES else len(records)
        # One step before each chunk but the first, because a scene knows the scene before it.
        self._marks = [_Mark(0, 1, Roster(()), 0)]
        chunk = 0
        while len(self._chunk(chunk)) == _CHUNK_STEPS:
            chunk += 1
        last = self._chunk(chunk)
        self._length = chunk * _CHUNK_STEPS + len(last)
        # Only the last step may have no scene: the process ended in it.
        self.scenes = self._length - (bool(last) and not last[-1].whole)

    def __len__(self) -> int:
        """Return the number of steps."""
        return self._length

    def __iter__(self) -> Iterator[StepRecord]:
        """Yield all steps in order."""
        for chunk in range(len(self._marks)):
            yield from self._chunk(chunk)

    @overload
    def __getitem__(self, place: int) -> StepRecord: ...
    @overload
    def __getitem__(self, place: slice) -> list[StepRecord]: ...
    def __getitem__(self, place: int | slice) -> StepRecord | list[StepRecord]:
        """Return a step, or a list of steps."""
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(self._length))]
        chunk, row = divmod(range(self._length)[place], _CHUNK_STEPS)
        return self._chunk(chunk)[row]

    def _chunk(self, number: int) -> list[StepRecord]:
        steps = self._chunks.get(number)
        if steps is None:
            steps = self._chunks[number] = self._decode(number)
            if len(self._chunks) > self._max_chunks:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(number)
        return steps

    def _decode(self, number: int) -> list[StepRecord]:
        mark, last = self._marks[number], (number + 1) * _CHUNK_STEPS - 1
        # The chunk before has read past the mark, and the records define an actor by its place among all actors.
        actors = self.actors[: mark.actors]
        reading = Reading(
            prologue=self._prologue, actors=actors, steps=[], current=StepRecord(mark.step), roster=mark.roster
        )
        readers = {tag: kind.read for tag, kind in RECORD_TYPES.items()}
        for index, (tag, aux, payload) in enumerate(self._records.since(mark.record), mark.record + 1):
            read = readers.get(tag)
            if read is None:
                continue  # it is of a later version: it is kept, and means nothing here
            read(reading, aux, payload)
            if tag == STEP.tag:
                if reading.current.step == last and number + 1 == len(self._marks):
                    self._marks.append(_Mark(last, index, reading.roster, len(actors)))
                if reading.current.step > last:
                    break
        else:
            reading.finish()
        if len(actors) > len(self.actors):
            self.actors = actors
        return reading.steps[1:] if number else reading.steps


class DecodedScenes(Sequence["Scene"]):
    """Scenes of a recording, which are decoded together with their steps.

    Args:
        steps: the steps of the recording.
        numbers: numbers of the steps.
    """

    def __init__(self, steps: DecodedSteps, numbers: range) -> None:
        self._steps = steps
        self._numbers = numbers

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self._numbers)

    def __iter__(self) -> Iterator[Scene]:
        """Yield all scenes in order."""
        return (self[place] for place in range(len(self._numbers)))

    @overload
    def __getitem__(self, place: int) -> Scene: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Scene]: ...
    def __getitem__(self, place: int | slice) -> Scene | Sequence[Scene]:
        """Return a scene, or some of the scenes."""
        if isinstance(place, slice):
            return DecodedScenes(self._steps, self._numbers[place])
        scene = self._steps[self._numbers[place]].scene
        assert scene is not None  # only the step in which the process ended has none
        return scene
