"""The lane of each actor of the roster, as text, one a line; only in steps that looked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.recording.records._type import RecordType, TextForm, scene_texts

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.recording._reading import Reading

__all__ = ["TYPE", "encode_lanes"]


def encode_lanes(lanes: Iterable[str]) -> bytes:
    """Return the payload that says where everybody drives."""
    return "\n".join(lanes).encode()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    reading.scene["lanes"] = tuple(payload.decode().split("\n"))


TYPE = RecordType(7, "lanes", "/scene/lanes", TextForm(), _read, scene_texts("lanes"))
