"""Topics and protobuf messages of an MCAP file, at simulation time; the file itself is written in `_log`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mcap_protobuf.schema import build_file_descriptor_set

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.writer import Writer

    from crashhunt.recording.records._type import Message

__all__ = ["LogWriter", "to_ns"]


class LogWriter:
    """Writes protobuf messages to an MCAP file, at simulation time.

    Args:
        writer: of the file.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(
        self,
        topic: str,
        kind: type[Message],
        data: bytes,
        time_ns: int,
        sequence: int = 0,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Write a serialised message.

        Args:
            topic: its channel, made at its first message.
            kind: its protobuf class.
            data: the message.
            time_ns: simulation time.
            sequence: its number within the evidence.
            metadata: of the channel.
        """
        channel = self._channels.get(topic)
        if channel is None:
            name = kind.DESCRIPTOR.full_name
            if name not in self._schemas:
                described = build_file_descriptor_set(kind).SerializeToString()
                self._schemas[name] = self._writer.register_schema(name, "protobuf", described)
            channel = self._writer.register_channel(topic, "protobuf", self._schemas[name], dict(metadata or {}))
            self._channels[topic] = channel
        self._writer.add_message(channel, time_ns, data, time_ns, sequence)


def to_ns(time_s: float) -> int:
    """Return simulation time in ns."""
    return round(time_s * 1e9) if math.isfinite(time_s) and time_s > 0 else 0
