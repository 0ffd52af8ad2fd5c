"""Of each long vehicle that is bent: uint32 row, uint32 points, and float64 x, y and z of each point, in m."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording.records._type import Form, RecordType, scene_texts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from crashhunt.recording._reading import Reading
    from crashhunt.recording.records._type import Fields, Message
    from crashhunt.recording.records.prologue import Prologue
    from crashhunt.world import Scene, Spine

__all__ = ["TYPE", "encode_spines"]

_HEAD = struct.Struct("<II")


def encode_spines(scene: Scene) -> bytes:
    """Return the payload that says how the long vehicles are bent."""
    return _encode(scene.spines)


def _encode(spines: Mapping[int, Spine | NDArray[np.float64]]) -> bytes:
    return b"".join(_HEAD.pack(row, len(spine)) + np.array(spine, "<f8").tobytes() for row, spine in spines.items())


def _decode(payload: bytes) -> dict[int, Spine]:
    found, offset = {}, 0
    while offset < len(payload):
        row, count = _HEAD.unpack_from(payload, offset)
        offset += _HEAD.size
        points = np.frombuffer(payload, "<f8", 3 * count, offset).reshape(-1, 3).tolist()
        found[row] = tuple((x, y, z) for x, y, z in points)
        offset += 24 * count
    return found


class _SpinesForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {
        "Spines": {"rows": "uint32*", "points": "uint32*", "coordinates": "double*"}
    }

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        spines = _decode(payload)
        coordinates = [value for spine in spines.values() for point in spine for value in point]
        points = [len(spine) for spine in spines.values()]
        return "Spines", {"rows": list(spines), "points": points, "coordinates": coordinates}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        values = np.array(list(message.coordinates), "<f8").reshape(-1, 3)
        ends = np.cumsum(list(message.points))[:-1]
        return _encode(dict(zip(message.rows, np.split(values, ends), strict=True)))


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    reading.scene["spines"] = _decode(payload)


TYPE = RecordType(10, "spines", "/scene/spines", _SpinesForm(), _read, scene_texts("spines"))
