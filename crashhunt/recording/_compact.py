"""Compact recordings: in each step the agents, the vehicles of the crash, and the actors near an agent.

A compact recording has the digest of the whole recording. A replay of all actors is therefore still compared bit by
bit: the actors that are left give the first difference, and the digest decides about the others.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from crashhunt.recording._reading import Prologue
from crashhunt.recording.records._agents import OBSERVATION
from crashhunt.recording.records._scene import (
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

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from crashhunt.recording._blackbox import Record

__all__ = ["Compact", "Near", "Present", "compact_records"]


@dataclass(frozen=True, slots=True)
class Compact:
    """What is missing in a compact recording.

    Args:
        digest: of the whole recording; empty where only its beginning is here.
        actors: number of actors of the whole recording.
        radius_m: greatest distance to an agent, in m, up to which an actor is recorded.
        observations: whether the observations are left.
    """

    digest: str
    actors: int
    radius_m: float
    observations: bool


class Choice(Protocol):
    """Chooses the actors of a step."""

    def __call__(self, step: int, actors: Sequence[str], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether to keep each actor, shape (actors,).

        Args:
            step: number of the step.
            actors: identifiers of the actors that are present.
            points: their positions, in m, shape (actors, 2).
        """
        ...


@dataclass(frozen=True, slots=True)
class Near:
    """Keeps some actors, and those near an agent.

    Args:
        agents: identifiers of the controlled vehicles.
        always: identifiers of the actors that are kept in each step.
        radius_m: greatest distance between the centres, in m.
    """

    agents: Collection[str]
    always: Collection[str]
    radius_m: float

    def __call__(self, step: int, actors: Sequence[str], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether to keep each actor."""
        mask = np.array([name in self.always or name in self.agents for name in actors], bool)
        for row, name in enumerate(actors):
            if name in self.agents:
                mask |= np.hypot(*(points - points[row]).T) <= self.radius_m
        return mask


@dataclass(frozen=True, slots=True)
class Present:
    """Keeps the actors that another recording has in the same step.

    Args:
        actors: identifiers of the actors of each step.
    """

    actors: Sequence[Collection[str]]

    def __call__(self, step: int, actors: Sequence[str], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether to keep each actor."""
        there = self.actors[step] if step < len(self.actors) else ()
        return np.array([name in there for name in actors], bool)


def compact_records(records: Iterable[Record], choose: Choice, *, observations: bool) -> Iterator[Record]:
    """Yield the records of a recording without some actors.

    Args:
        records: of the whole recording.
        choose: chooses the actors of each step.
        observations: whether to keep what the agents observed.
    """
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
