"""Actors that were not seen before, as JSON; each is numbered in order of appearance."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from crashhunt.recording.records._type import RecordType, TextForm
from crashhunt.world import Actor

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.recording._reading import Reading

__all__ = ["TYPE", "encode_actors"]

_FIELDS = len(Actor.__slots__)


def encode_actors(actors: Iterable[Actor]) -> bytes:
    """Return the payload that introduces actors."""
    known = [[actor.id, actor.kind, actor.length, actor.width, actor.height] for actor in actors]
    return json.dumps([entry if entry[-1] else entry[:-1] for entry in known]).encode()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    # What a later version has added stands at the end.
    reading.actors.extend(Actor(*entry[:_FIELDS]) for entry in json.loads(payload))


TYPE = RecordType(2, "actors", "/scene/actor_definitions", TextForm(), _read)
