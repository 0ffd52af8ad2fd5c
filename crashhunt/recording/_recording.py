"""A recording: everything that was recorded of one episode, whichever file it came from."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import BundleError
from crashhunt.base.text import one_of
from crashhunt.recording._blackbox import digest_of, is_evidence
from crashhunt.recording._compact import Compact, Near, Present, compact_records
from crashhunt.recording._reading import Prologue, Reading
from crashhunt.recording._values import is_opaque
from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._agents import PROLOGUE

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from numpy.typing import NDArray

    from crashhunt.recording._blackbox import Record
    from crashhunt.recording._reading import AgentChannel, StepRecord
    from crashhunt.trial import Disturbance
    from crashhunt.world import Actor, Scene

__all__ = ["Recording"]


class Recording:
    """Everything that was recorded of one episode.

    Args:
        records: as they were written, from a black box or a log.
        compact: what is missing; None for a whole recording.

    Raises:
        BundleError: the records make no sense.
    """

    def __init__(self, records: Iterable[Record], compact: Compact | None = None) -> None:
        self.records = tuple(records)
        self.compact = compact
        if not self.records or self.records[0].tag != PROLOGUE.tag:
            raise BundleError("the recording has no beginning", fix="it was cut short or is not a recording")
        try:
            reading = _read(self.records)
        except (ValueError, IndexError, KeyError, TypeError, struct.error) as error:
            raise BundleError(f"the recording is damaged: {error}", fix="get an undamaged copy of it") from error
        self.prologue: Prologue = reading.prologue
        self.actors: list[Actor] = reading.actors
        self.all_steps: list[StepRecord] = reading.steps

    @property
    def agents(self) -> tuple[str, ...]:
        """The ids of the controlled vehicles."""
        return tuple(agent.id for agent in self.prologue.agents)

    @property
    def digest(self) -> str:
        """The trace digest, in hexadecimal; of a compact recording that of the whole one."""
        if self.compact is not None and self.compact.digest:
            return self.compact.digest
        return digest_of(b"".join(record.encode() for record in self.records if is_evidence(record.tag)))

    @property
    def steps(self) -> int:
        """How many steps were completed."""
        return max((step.step for step in self.all_steps if step.whole), default=0)

    def compacted(self, always: Collection[str], radius_m: float, *, observations: bool = True) -> Recording:
        """Return the recording with the agents, some other actors, and in each step those near an agent.

        Args:
            always: identifiers of the actors that are kept in each step.
            radius_m: greatest distance between an agent and another actor, in m.
            observations: whether it has what the agents observed.
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
        """Return the recording with the actors and observations that another one has; itself if that one is whole."""
        if other.compact is None or self.compact is not None:
            return self
        there = Present([step.scene.roster.index.keys() if step.scene is not None else () for step in other.all_steps])
        records = compact_records(self.records, there, observations=other.compact.observations)
        return Recording(records, replace(other.compact, digest=self.digest))

    def beginning(self, records: int) -> Recording:
        """Return the recording of its first records."""
        compact = self.compact and replace(self.compact, digest="")
        return Recording(self.records[:records], compact)

    def observations(self, agent: str) -> NDArray[np.generic]:
        """What an agent was shown, shape (steps it saw, *observation shape).

        Values of any length (`is_opaque`) are an array of arrays, shape (steps it saw,); `decode_value` reads each.
        """
        channel = self._channel(agent)
        found = [step.observations[agent] for step in self.all_steps if agent in step.observations]
        return _stacked(found, channel.observation_dtype, channel.observation_shape)

    def actions(self, agent: str) -> NDArray[np.generic]:
        """What an agent answered, shape (steps it acted, *action shape); of any length as for `observations`."""
        channel = self._channel(agent)
        found = [step.actions[agent] for step in self.all_steps if agent in step.actions]
        return _stacked(found, channel.action_dtype, channel.action_shape)

    def scene(self, step: int) -> Scene:
        """The scene after a step (0: before the first).

        Raises:
            IndexError: the recording has no such step.
        """
        found = self.all_steps[step].scene if 0 <= step < len(self.all_steps) else None
        if found is None:
            raise IndexError(f"no scene of step {step}; the recording has the steps 0 to {self.steps}")
        return found

    def scenes(self) -> list[Scene]:
        """All scenes, in order."""
        return [step.scene for step in self.all_steps if step.scene is not None]

    @property
    def disturbances(self) -> tuple[Disturbance, ...]:
        """Those that began, as they took place; without a target, the vehicle is empty."""
        return tuple(one for step in self.all_steps for one in step.more.get("disturbance", ()))

    def _channel(self, agent: str) -> AgentChannel:
        for channel in self.prologue.agents:
            if channel.id == agent:
                return channel
        raise BundleError(
            f"there is no agent {agent!r} in the recording", fix=one_of(agent, self.agents, give="it has")
        )


def _read(records: tuple[Record, ...]) -> Reading:
    reading = Reading(Prologue.decode(records[0].payload))
    readers = {tag: kind.read for tag, kind in RECORD_TYPES.items()}
    for tag, aux, payload in records[1:]:
        read = readers.get(tag)
        if read is not None:  # else it is of a later version: it is kept, and means nothing here
            read(reading, aux, payload)
    current = reading.current
    if current.observations or current.actions or current.more:
        reading.steps.append(current)  # the process ended in it
    return reading


def _stacked(found: list[NDArray[np.generic]], dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    if not is_opaque(shape):
        return np.array(found, dtype=dtype).reshape((len(found), *shape))
    stacked = np.empty(len(found), object)
    for place, array in enumerate(found):
        stacked[place] = array
    return stacked
