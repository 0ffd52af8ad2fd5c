"""The messages of our own evidence channels, as protobuf types made here, without a compiler."""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

__all__ = [
    "DoubleArray",
    "FloatArray",
    "Heights",
    "IntArray",
    "Metrics",
    "Roster",
    "Spines",
    "Step",
    "Text",
    "array_type",
]

_TYPES = {
    "double": descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
    "float": descriptor_pb2.FieldDescriptorProto.TYPE_FLOAT,
    "int64": descriptor_pb2.FieldDescriptorProto.TYPE_INT64,
    "uint32": descriptor_pb2.FieldDescriptorProto.TYPE_UINT32,
    "string": descriptor_pb2.FieldDescriptorProto.TYPE_STRING,
}
_MESSAGES = {
    "Text": {"text": "string"},
    "Roster": {"actors": "uint32*"},
    "FloatArray": {"values": "float*"},
    "DoubleArray": {"values": "double*"},
    "IntArray": {"values": "int64*"},
    "Step": {
        "step": "int64",
        "time_s": "double",
        "rewards": "double*",
        "positions": "double*",
        "headings": "double*",
        "speeds": "double*",
    },
    "Heights": {"heights": "double*", "grades": "double*"},
    "Spines": {"rows": "uint32*", "points": "uint32*", "coordinates": "double*"},
    "Metrics": {
        "speed": "double",
        "time_to_collision_s": "double",
        "gap_m": "double",
        "required_deceleration": "double",
    },
}


def _make() -> dict[str, Any]:
    file = descriptor_pb2.FileDescriptorProto(name="crashhunt/log.proto", package="crashhunt", syntax="proto3")
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), 1):
            repeated = kind.endswith("*")
            label = descriptor_pb2.FieldDescriptorProto
            message.field.add(
                name=field,
                number=number,
                type=_TYPES[kind.rstrip("*")],
                label=label.LABEL_REPEATED if repeated else label.LABEL_OPTIONAL,
            )
    # A pool of its own: another version of crashhunt in the same process must not clash with it.
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file) if hasattr(pool, "Add") else pool.AddSerializedFile(file.SerializeToString())
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"crashhunt.{name}")) for name in _MESSAGES
    }


_classes = _make()
Text, Roster, Step, Metrics = (_classes[name] for name in ("Text", "Roster", "Step", "Metrics"))
Heights, Spines = _classes["Heights"], _classes["Spines"]
FloatArray, DoubleArray, IntArray = (_classes[name] for name in ("FloatArray", "DoubleArray", "IntArray"))


def array_type(dtype: str) -> Any:
    """Return the message that holds arrays of a NumPy type without losing a bit.

    Args:
        dtype: as NumPy writes it, such as ``<f4``.
    """
    kind, size = dtype[1], int(dtype[2:])
    if kind == "f" and size in (4, 8):
        return FloatArray if size == 4 else DoubleArray
    if kind in "iub":
        return IntArray
    raise TypeError(f"arrays of {dtype} cannot be recorded")
