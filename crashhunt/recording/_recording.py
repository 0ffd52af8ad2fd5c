"""Recordings of episodes from any file, complete or compact."""

from __future__ import annotations

import json
import struct
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, overload

import numpy as np

from crashhunt.base.errors import BundleError
from crashhunt.base.text import format_time, one_of
from crashhunt.recording._blackbox import is_evidence
from crashhunt.recording._blackbox_file import Record, Records
from crashhunt.recording._reading import AgentChannel, Prologue, Reading, StepRecord
from crashhunt.recording._trace_digest import digest_of
from crashhunt.recording._values import is_opaque
from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._agent_records import OBSERVATION, PROLOGUE
from crashhunt.recording.records._scene_record import (
    ACTORS,
    HEIGHTS,
    LANES,
    ROSTER,
    SPINES,
    STEP,
    encode_roster,
    points_of,
    select_actors,
    step_of,
)
from crashhunt.world import Roster

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.trial import Disturbance
    from crashhunt.world import Actor, Scene


# The steps of a recording; those of a long recording are decoded at each use, as decoded steps take much memory.


_CHUNK_STEPS = 256
_MAX_DECODED_BYTES = 64 << 20
_BYTES_PER_RECORD, _BYTES_PER_RECORDED_BYTE = 700, 6  # of the decoded steps, measured
_MAX_CHUNKS = 4  # of a recording that takes more: a reader may follow a few places at a time


class _Mark(NamedTuple):
    """The place at which the records of a step begin."""

    step: int  # number of the step
    record: int  # index of its first record
    roster: Roster  # the actors of the scene before this record
    actors: int  # number of actors that earlier records define


class DecodedSteps(Sequence[StepRecord]):
    """The steps of a recording; only a few steps of a long recording are in memory at a time.

    Two uses of a step may return two equal objects. Therefore a caller must not change them.

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
    """Scenes of a recording, which are decoded together with their steps."""

    def __init__(self, steps: DecodedSteps, numbers: range) -> None:
        self._steps = steps
        self._numbers = numbers

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self._numbers)

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


class Recording:
    """The complete recording of one episode.

    Args:
        records: records of a black box or a log, in the order in which they were written.
        compact: description of the missing parts; None for a complete recording.

    Raises:
        BundleError: the records contradict each other.
    """

    def __init__(self, records: Iterable[Record], compact: Compact | None = None) -> None:
        self.records = records if isinstance(records, Records) else Records.of(records)
        self.compact = compact
        if not self.records or self.records[0].tag != PROLOGUE.tag:
            raise BundleError("the recording has no beginning", fix="get an undamaged copy of the log")
        try:
            self.prologue = Prologue.decode(self.records[0].payload)
            steps = DecodedSteps(self.records, self.prologue)
        except (ValueError, IndexError, KeyError, TypeError, struct.error) as error:
            raise BundleError(f"the recording is damaged: {error}", fix="get an undamaged copy of the log") from error
        self.actors: list[Actor] = steps.actors
        self.all_steps: Sequence[StepRecord] = steps
        self._scenes = DecodedScenes(steps, range(steps.scenes))

    @property
    def agents(self) -> tuple[str, ...]:
        """The ids of the controlled vehicles."""
        return tuple(agent.id for agent in self.prologue.agents)

    @property
    def digest(self) -> str:
        """The digest of the trace, in hexadecimal; for a compact recording, the digest of the complete recording."""
        if self.compact is not None and self.compact.digest:
            return self.compact.digest
        evidence = (record.encode() for record in self.records if is_evidence(record.tag))
        return digest_of(evidence, of_changes=self.prologue.digest_of_changes)

    @property
    def steps(self) -> int:
        """The number of completed steps."""
        return max(0, len(self._scenes) - 1)

    def compacted(self, always: Collection[str], radius_m: float, *, observations: bool = True) -> Recording:
        """Return the recording with only the agents, some other actors, and in each step the actors near an agent.

        Args:
            always: identifiers of the actors that are kept in each step.
            radius_m: maximum distance between an agent and another actor, in m.
            observations: whether the result contains the observations of the agents.
        """
        compact = Compact(
            digest=self.digest,
            actors=len({actor.id for actor in self.actors}),
            radius_m=radius_m,
            observations=observations,
        )
        near = Near(self.agents, frozenset(always), radius_m)
        return Recording(compact_records(self.records, near, observations=observations), compact)

    def like(self, other: Recording) -> Recording:
        """Return this recording reduced to the actors and observations of another recording, which may be compact."""
        if other.compact is None or self.compact is not None:
            return self
        present = [step.scene.roster.index if step.scene is not None else {} for step in other.all_steps]

        def there(step: int, actors: Sequence[str], _points: NDArray[np.float64]) -> NDArray[np.bool_]:
            return np.array([name in present[step] if step < len(present) else False for name in actors], bool)

        records = compact_records(self.records, there, observations=other.compact.observations)
        return Recording(records, replace(other.compact, digest=self.digest))

    def beginning(self, records: int) -> Recording:
        """Return a recording that consists of the first records only."""
        compact = self.compact and replace(self.compact, digest="")
        return Recording(self.records[:records], compact)

    def observations(self, agent: str) -> NDArray[np.generic]:
        """The observations of an agent, shape (steps with an observation, *observation shape).

        If values have no fixed size (`is_opaque`), the result is an array of arrays, shape (steps with an
        observation,). `decode_value` reads each of them.
        """
        channel = self._channel(agent)
        found = [step.observations[agent] for step in self.all_steps if agent in step.observations]
        return _stacked(found, channel.observation_dtype, channel.observation_shape)

    def actions(self, agent: str) -> NDArray[np.generic]:
        """The actions of an agent, shape (steps with an action, *action shape), as in `observations`."""
        channel = self._channel(agent)
        found = [step.actions[agent] for step in self.all_steps if agent in step.actions]
        return _stacked(found, channel.action_dtype, channel.action_shape)

    def scene(self, step: int) -> Scene:
        """Return the scene after a step; 0 for the scene before the first step.

        Raises:
            IndexError: the recording has no such step.
        """
        if not 0 <= step < len(self._scenes):
            raise IndexError(f"no scene of step {step}; the recording has the steps 0 to {self.steps}")
        return self._scenes[step]

    def before_end_s(self, step: int) -> float:
        """Return the time from the end of a step to the end of the last step, in s.

        This is the clock of all texts on crashes: a crash is at the end of the step that found it, whenever within the
        step the actors touched.

        Raises:
            IndexError: the recording has no such step.
        """
        return self._scenes[-1].time_s - self.scene(step).time_s

    def ago(self, step: int) -> str:
        """Return as text how long before the end of the last step a step ended, such as ``0.4 s before``."""
        return f"{format_time(self.before_end_s(step), self.prologue.step_length_s)} before"

    def scenes(self) -> Sequence[Scene]:
        """All scenes of the episode, in order; those of a long episode are decoded at each use."""
        return self._scenes

    @property
    def disturbances(self) -> tuple[Disturbance, ...]:
        """The disturbances that took place; the id of the target is empty if there was no target vehicle."""
        return tuple(one for step in self.all_steps for one in step.more.get("disturbance", ()))

    def _channel(self, agent: str) -> AgentChannel:
        for channel in self.prologue.agents:
            if channel.id == agent:
                return channel
        raise BundleError(
            f"there is no agent {agent!r} in the recording", fix=one_of(agent, self.agents, give="it has")
        )


def _stacked(found: list[NDArray[np.generic]], dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    if not is_opaque(shape):
        return np.array(found, dtype=dtype).reshape((len(found), *shape))
    stacked = np.empty(len(found), object)
    for place, array in enumerate(found):
        stacked[place] = array
    return stacked


# Compact recordings: in each step the agents, the vehicles of the crash, and the actors near an agent.
#
# A compact recording has the digest of the whole recording. A replay of all actors is therefore still compared bit by
# bit: the actors that are left give the first difference, and the digest decides about the others.


@dataclass(frozen=True, slots=True)
class Compact:
    """A description of the parts that a compact recording lacks."""

    digest: str  # digest of the complete recording; empty if the recording is only a beginning
    actors: int  # number of actors in the complete recording
    radius_m: float  # maximum distance to an agent, in m, up to which an actor is recorded
    observations: bool  # whether the recording contains observations


ActorSelector: TypeAlias = "Callable[[int, Sequence[str], NDArray[np.float64]], NDArray[np.bool_]]"
"""Called with the number of a step, and with identifiers and positions in m, shape (actors, 2), of its actors. Returns
whether to keep each actor, shape (actors,)."""


@dataclass(frozen=True, slots=True)
class Near:
    """Selects some given actors, and the actors near an agent."""

    agents: Collection[str]  # identifiers of the controlled vehicles
    always: Collection[str]  # identifiers of the actors that are kept in each step
    radius_m: float  # maximum distance between the centres, in m

    def __call__(self, step: int, actors: Sequence[str], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether to keep each actor."""
        mask = np.array([name in self.always or name in self.agents for name in actors], bool)
        for row, name in enumerate(actors):
            if name in self.agents:
                mask |= np.hypot(*(points - points[row]).T) <= self.radius_m
        return mask


def compact_records(records: Iterable[Record], choose: ActorSelector, *, observations: bool) -> Iterator[Record]:
    """Yield the records of a recording, reduced to some of the actors."""
    actors: list[list[object]] = []  # as their definitions say
    numbers: dict[int, int] = {}  # of the actors that are kept: number there to number here
    roster: list[int] = []
    shown: list[int] | None = None
    waiting: list[Record] = []
    agents: int | None = None
    scene = (STEP.tag, HEIGHTS.tag, SPINES.tag, LANES.tag)
    for record in records:
        tag, _, payload = record
        if agents is None:  # the prologue comes first
            agents = len(Prologue.decode(payload).agents)
            yield record
            continue
        if tag == ACTORS.tag:
            actors += json.loads(payload)
            continue
        if tag == ROSTER.tag:
            roster = np.frombuffer(payload, "<u4").tolist()
            continue
        if tag != OBSERVATION.tag or observations:
            waiting.append(record)
        if tag != STEP.tag:
            continue
        # Only at the end of a step is it certain who is present, and where.
        mask = choose(step_of(payload), [str(actors[number][0]) for number in roster], points_of(payload, agents))
        there = [number for number, is_kept in zip(roster, mask.tolist(), strict=True) if is_kept]
        new = [number for number in there if number not in numbers]
        numbers |= {number: len(numbers) + place for place, number in enumerate(new)}
        changes: list[tuple[int, bytes]] = []
        if new:
            changes.append((ACTORS.tag, json.dumps([actors[number] for number in new]).encode()))
        if there != shown:
            changes.append((ROSTER.tag, encode_roster([numbers[number] for number in there])))
        shown = there
        yield from (record._replace(tag=kind, aux=0, payload=data) for kind, data in changes)
        for one in waiting:
            yield one._replace(payload=select_actors(one.tag, one.payload, mask, agents))
        waiting = []
    yield from (one for one in waiting if one.tag not in scene)
