"""Topics and protobuf messages of an MCAP file, at simulation time; the file itself is written in `_log`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap_protobuf.schema import build_file_descriptor_set

from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._type import BytesForm

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.writer import Writer

    from crashhunt.recording.records._type import Message


__all__ = ["MESSAGES", "NAMESPACE", "LogWriter", "to_ns"]


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


# The messages of our own evidence channels, as protobuf types made here, without a compiler.

NAMESPACE = "crashhunt."
_TYPES = {
    "double": descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
    "float": descriptor_pb2.FieldDescriptorProto.TYPE_FLOAT,
    "int64": descriptor_pb2.FieldDescriptorProto.TYPE_INT64,
    "uint32": descriptor_pb2.FieldDescriptorProto.TYPE_UINT32,
    "string": descriptor_pb2.FieldDescriptorProto.TYPE_STRING,
    "bytes": descriptor_pb2.FieldDescriptorProto.TYPE_BYTES,
}
_METRICS = {
    "Metrics": {
        "speed": "double",
        "time_to_collision_s": "double",
        "gap_m": "double",
        "required_deceleration": "double",
    },
}
_OF_RECORDS = {name: fields for kind in RECORD_TYPES.values() for name, fields in kind.form.messages.items()}
# A schema in a log has its whole file, so what few logs have is in one of its own.
_FILES: dict[str, Mapping[str, Mapping[str, str]]] = {
    "crashhunt/log.proto": {**_OF_RECORDS, **_METRICS},
    "crashhunt/bytes.proto": BytesForm.messages,
}


def _make() -> dict[str, type[Message]]:
    # A pool of its own: another version of crashhunt in the same process must not clash with it.
    pool = descriptor_pool.DescriptorPool()
    for place, messages in _FILES.items():
        file = _file(place, messages)
        pool.Add(file) if hasattr(pool, "Add") else pool.AddSerializedFile(file.SerializeToString())
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(NAMESPACE + name))
        for messages in _FILES.values()
        for name in messages
    }


def _file(place: str, messages: Mapping[str, Mapping[str, str]]) -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name=place, package=NAMESPACE.rstrip("."), syntax="proto3")
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), 1):
            label = descriptor_pb2.FieldDescriptorProto
            message.field.add(
                name=field,
                number=number,
                type=_TYPES[kind.rstrip("*")],
                label=label.LABEL_REPEATED if kind.endswith("*") else label.LABEL_OPTIONAL,
            )
    return file


MESSAGES = _make()
"""The class of each message, by its name."""
