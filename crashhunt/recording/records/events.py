"""What touched, and who left the road, as JSON; only where anything did."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, TypedDict

from crashhunt.recording.records._type import RecordType, TextForm, scene_texts
from crashhunt.world import Contact

if TYPE_CHECKING:
    from crashhunt.recording._reading import Reading
    from crashhunt.world import Scene

__all__ = ["TYPE", "encode_events"]

_FIELDS = len(Contact.__slots__)


class _Events(TypedDict, total=False):
    contacts: list[list[Any]]
    off_road: list[str]


def encode_events(scene: Scene) -> bytes:
    """Return the payload that says what touched and who left the road."""
    contacts = [[getattr(contact, name) for name in Contact.__slots__] for contact in scene.contacts]
    return json.dumps({"contacts": contacts, "off_road": list(scene.off_road)}).encode()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    events: _Events = json.loads(payload)
    # What a later version has added to a contact stands at its end.
    reading.scene["contacts"] = tuple(Contact(*entry[:_FIELDS]) for entry in events.get("contacts", ()))
    reading.scene["off_road"] = tuple(events.get("off_road", ()))


TYPE = RecordType(8, "events", "/events", TextForm(), _read, scene_texts("contacts", "off_road"))
