"""Traffic events, as JSON. What we conclude from an episode is no part of it, nor of its digest; nor is it compared."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from crashhunt.recording.records._type import RecordType, TextForm
from crashhunt.world import Event

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.recording._reading import Reading

__all__ = ["TYPE", "encode_notes"]


def encode_notes(events: Iterable[Event]) -> bytes:
    """Return the payload that says what else happened in the traffic."""
    return json.dumps([event.to_json() for event in events]).encode()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    reading.events = tuple(Event.from_json(note) for note in json.loads(payload))


TYPE = RecordType(11, "notes", "/traffic_events", TextForm(), _read)
