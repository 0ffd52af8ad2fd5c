"""How high everybody is, then how steep it is there, as float64[]; only where the map is not flat."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording.records._type import Form, RecordType, scene_texts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.recording._reading import Reading
    from crashhunt.recording.records._type import Fields, Message
    from crashhunt.recording.records.prologue import Prologue
    from crashhunt.world import Scene

__all__ = ["TYPE", "encode_heights"]


def encode_heights(scene: Scene) -> bytes:
    """Return the payload that says how high everybody is, and how steep it is there."""
    return np.array([*scene.heights, *scene.grades], "<f8").tobytes()


class _HeightsForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {"Heights": {"heights": "double*", "grades": "double*"}}

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        heights, grades = np.frombuffer(payload, "<f8").reshape(2, -1).tolist()
        return "Heights", {"heights": heights, "grades": grades}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        return np.array([*message.heights, *message.grades], "<f8").tobytes()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    heights, grades = np.frombuffer(payload, "<f8").reshape(2, -1).tolist()
    reading.scene["heights"], reading.scene["grades"] = heights, grades


TYPE = RecordType(9, "heights", "/scene/heights", _HeightsForm(), _read, scene_texts("heights", "grades"))
