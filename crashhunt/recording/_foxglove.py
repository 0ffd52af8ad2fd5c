"""The view channels of a log in Foxglove's own schemas, so that Foxglove and Lichtblick can display the log at once."""

from __future__ import annotations

import math
import struct
from operator import attrgetter
from typing import IO, TYPE_CHECKING

import numpy as np
import zstandard
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream
from mcap_protobuf.schema import build_file_descriptor_set

from crashhunt.base.errors import BundleError
from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._type import BytesForm, Message
from crashhunt.world import approaches, is_person, join_frames, levels, outlines

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from google.protobuf.timestamp_pb2 import Timestamp
    from mcap.records import Channel, Schema
    from mcap.writer import Writer
    from numpy.typing import NDArray

    from crashhunt.recording._recording import Recording
    from crashhunt.trial import TrialResult
    from crashhunt.world import Actor, Lane, Scene


_MAX_CHUNK_BYTES = 256 << 20  # unpacked; crashhunt begins a new chunk after 1 MB, and the log may be a stranger's
_MAP_REACH_M = 300.0  # around where anybody drove; a town's whole map is too much for a viewer
_OBSTACLES = "obstacles"  # entity of the map whose lines are outlines, and not borders of lanes
_HEIGHT_M = 1.5  # of a car of unknown height
_PERSON_HEIGHT_M = 1.7  # likewise
_COLORS = {
    "ego": (1.0, 0.8, 0.1, 1.0),
    "agent": (0.2, 0.8, 0.4, 1.0),
    "party": (0.95, 0.2, 0.2, 1.0),
    "other": (0.55, 0.6, 0.68, 1.0),
    "border": (0.45, 0.45, 0.5, 1.0),
}


def write_views(log: LogWriter, recording: Recording, lanes: Sequence[Lane], crash: TrialResult | None) -> None:
    """Write all view channels.

    Lanes far from every controlled vehicle are skipped.
    """
    scenes = recording.scenes()
    if not scenes or not recording.agents:
        return
    _write_map(log, recording, scenes, lanes)
    _write_scenes(log, recording, scenes, crash)
    _write_metrics(log, recording.agents[0], scenes)
    _write_events(log, scenes)
    if crash is not None:
        _write_crash(log, recording, scenes[-1], crash)


def foxglove_layout(recording: Recording) -> dict[str, object]:
    """Return a layout for Foxglove or Lichtblick with the scene from above, the metrics and the log."""
    ego = recording.agents[0] if recording.agents else "map"
    paths = [
        {"value": f"/metrics.{field}", "enabled": True, "timestampMethod": "receiveTime"}
        for field in ("speed", "time_to_collision_s", "gap_m")
    ]
    return {
        "configById": {
            "3D!scene": {
                "cameraState": {
                    "perspective": False,
                    "distance": 120,
                    "phi": 0,
                    "thetaOffset": 0,
                    "targetOffset": [0, 0, 0],
                    "target": [0, 0, 0],
                    "targetOrientation": [0, 0, 0, 1],
                    "fovy": 45,
                    "near": 0.5,
                    "far": 5000,
                },
                "followMode": "follow-position",
                "followTf": ego,
                "topics": {topic: {"visible": True} for topic in ("/map", "/scene/actors", "/scene/crash")},
            },
            "Plot!metrics": {"paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"},
            "RosOut!log": {"topicToRender": "/log", "searchTerms": [], "minLogLevel": 1},
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "first": "3D!scene",
            "second": {"first": "Plot!metrics", "second": "RosOut!log", "direction": "column", "splitPercentage": 70},
            "direction": "row",
            "splitPercentage": 65,
        },
    }


def _write_map(log: LogWriter, recording: Recording, scenes: Sequence[Scene], lanes: Sequence[Lane]) -> None:
    """Write both borders of every lane near a controlled vehicle, and the obstacles there, once, at the beginning."""
    rows = ((scene, scene.roster.index.get(agent)) for scene in scenes[::10] for agent in recording.agents)
    driven = np.array([scene.points[row] for scene, row in rows if row is not None]).reshape(-1, 2)
    if not len(driven):
        return
    low, high = driven.min(axis=0) - _MAP_REACH_M, driven.max(axis=0) + _MAP_REACH_M
    entities = [SceneEntity(id=name, frame_id="map") for name in ("lanes", _OBSTACLES)]
    for entity in entities:
        _stamp(entity.timestamp, scenes[0].time_s)
    for lane in lanes:
        shape = np.array(lane.shape, dtype=float).reshape(-1, 2)
        if len(shape) < 2 or not ((shape.max(axis=0) >= low) & (shape.min(axis=0) <= high)).all():
            continue
        for side in (-0.5, 0.5) if lane.width else (0.0,):
            line = entities[0 if lane.width else 1].lines.add(
                type=LinePrimitive.LINE_STRIP, thickness=0.12, scale_invariant=False, color=_color("border")
            )
            line.pose.orientation.w = 1.0
            for x, y in _shifted(shape, side * lane.width).tolist():
                line.points.add(x=x, y=y)
    shown = [entity for entity in entities if entity.id != _OBSTACLES or entity.lines]
    log.write("/map", SceneUpdate, SceneUpdate(entities=shown).SerializeToString(), to_ns(scenes[0].time_s))


def lane_borders(lanes: Sequence[Lane]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the right and the left border of each lane, shape (n, 2), in m, in the form of `read_lanes`."""
    shapes = [(lane, np.array(lane.shape, dtype=float).reshape(-1, 2)) for lane in lanes]
    return [
        (_shifted(shape, -0.5 * lane.width), _shifted(shape, 0.5 * lane.width))
        for lane, shape in shapes
        if len(shape) > 1
    ]


def read_lanes(path: Path) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the lanes in a log: the right and the left border of each lane, shape (n, 2), in m.

    Raises:
        BundleError: the log cannot be read.
    """
    lines = _read_lines(path, is_obstacle=False)
    return list(zip(lines[0::2], lines[1::2], strict=True))


def read_obstacles(path: Path) -> list[NDArray[np.float64]]:
    """Return the outlines of the obstacles in a log, such as buildings, each of shape (n, 2), in m.

    Raises:
        BundleError: the log cannot be read.
    """
    return _read_lines(path, is_obstacle=True)


def _read_lines(path: Path, *, is_obstacle: bool) -> list[NDArray[np.float64]]:
    try:
        with path.open("rb") as file:
            for _, _, _, data in messages_of(file, SeekingReader(file), topic="/map"):
                update = SceneUpdate.FromString(data)
                lines = [
                    np.array([(point.x, point.y) for point in line.points]).reshape(-1, 2)
                    for entity in update.entities
                    if (entity.id == _OBSTACLES) == is_obstacle
                    for line in entity.lines
                ]
                if len(lines) % 2 and not is_obstacle:
                    raise ValueError("a lane has one border")
                return lines
    except OSError as error:
        raise BundleError(
            f"cannot be read: {error.strerror}", fix="check that the file exists and may be read", where=str(path)
        ) from None
    except (McapError, DecodeError, ValueError, KeyError, EOFError, struct.error) as error:
        raise BundleError(
            f"the map of the recording is damaged: {error}", fix="get an undamaged copy", where=str(path)
        ) from None
    return []


def _shifted(shape: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Return a polyline that is moved sideways, to the left for a positive distance."""
    along = np.gradient(shape, axis=0)
    norm = np.hypot(along[:, 0], along[:, 1])
    norm[norm == 0] = 1.0
    left = np.stack((-along[:, 1], along[:, 0]), axis=1) / norm[:, None]
    return shape + distance * left


def _write_scenes(log: LogWriter, recording: Recording, scenes: Sequence[Scene], crash: TrialResult | None) -> None:
    # Making a message is dear, changing one is cheap: each actor has one that is changed and serialised in every
    # step. A SceneUpdate is then put together from these; on the wire it is nothing but its parts in a row.
    boxes: dict[Actor, _Box] = {}
    roster, present = None, list[_Box]()
    transforms = FrameTransforms()
    children = {
        agent: transforms.transforms.add(parent_frame_id="map", child_frame_id=agent) for agent in recording.agents
    }
    pose = PoseInFrame(frame_id="map")
    parties = (crash.collision.collider, crash.collision.victim) if crash and crash.collision else ()
    lifetime_ns = round(recording.prologue.step_length_s * 1.1e9)
    for scene in scenes:
        time_ns = to_ns(scene.time_s)
        seconds, nanos = divmod(time_ns, 1_000_000_000)
        centers = scene.centers.tolist()
        if scene.roster is not roster:
            roster = scene.roster
            for actor in roster.actors:
                if actor not in boxes:
                    boxes[actor] = _Box(_entity(actor, recording.agents, parties, lifetime_ns))
            present = [boxes[actor] for actor in roster.actors]
        parts: list[bytes] = []
        for row, (box, (x, y), heading) in enumerate(zip(present, centers, scene.headings, strict=True)):
            half = heading / 2
            z = scene.heights[row] if scene.heights else 0.0
            turn_z, turn_w = math.sin(half), math.cos(half)
            entity, position, orientation, timestamp = box.entity, box.position, box.orientation, box.timestamp
            if scene.spines or len(entity.cubes) > 1:
                _bend(entity, scene, row)
            else:
                position.x, position.y, position.z = x, y, z + box.half_height
                orientation.z, orientation.w = turn_z, turn_w
            timestamp.seconds, timestamp.nanos = seconds, nanos
            data = entity.SerializeToString()
            size = len(data)
            parts += (b"\x12", _VARINTS[size] if size < len(_VARINTS) else _varint(size), data)  # field 2, entities
            child = children.get(entity.id)
            if child is not None:
                child.timestamp.seconds, child.timestamp.nanos = seconds, nanos
                child.translation.x, child.translation.y, child.translation.z = x, y, z
                child.rotation.z, child.rotation.w = turn_z, turn_w
                if entity.id == recording.agents[0]:
                    pose.timestamp.seconds, pose.timestamp.nanos = seconds, nanos
                    pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
                    pose.pose.orientation.z, pose.pose.orientation.w = turn_z, turn_w
        log.write("/scene/actors", SceneUpdate, b"".join(parts), time_ns)
        log.write("/tf", FrameTransforms, transforms.SerializeToString(), time_ns)
        log.write("/ego/pose", PoseInFrame, pose.SerializeToString(), time_ns)


class _Box:
    """The entity of an actor, and the parts of it that change in every step; each access makes a new object."""

    __slots__ = ("entity", "half_height", "orientation", "position", "timestamp")

    def __init__(self, entity: SceneEntity) -> None:
        cube = entity.cubes[0]
        self.entity, self.timestamp, self.half_height = entity, entity.timestamp, cube.size.z / 2
        self.position, self.orientation = cube.pose.position, cube.pose.orientation


def _entity(actor: Actor, agents: Sequence[str], parties: Sequence[str], lifetime_ns: int) -> SceneEntity:
    role = (
        "ego"
        if actor.id == agents[0]
        else "agent"
        if actor.id in agents
        else "party"
        if actor.id in parties
        else "other"
    )
    entity = SceneEntity(id=actor.id, frame_id="map")
    # Just over one step: a viewer that jumps shows the latest message only, and an actor that left disappears.
    entity.lifetime.seconds, entity.lifetime.nanos = divmod(lifetime_ns, 1_000_000_000)
    entity.metadata.add(key="kind", value=actor.kind)
    cube = entity.cubes.add(color=_color(role))
    height = actor.height or (_PERSON_HEIGHT_M if is_person(actor.id) else _HEIGHT_M)
    cube.size.x, cube.size.y, cube.size.z = actor.length, actor.width, height
    cube.pose.position.z = height / 2
    return entity


def _bend(entity: SceneEntity, scene: Scene, row: int) -> None:
    """Draw an actor with one cube for each of its parts in this scene."""
    like, actor = entity.cubes[0], scene.roster.actors[row]
    parts = list(zip(outlines(scene, row), levels(scene, row), strict=True))
    while len(entity.cubes) < len(parts):
        entity.cubes.add().CopyFrom(like)
    del entity.cubes[len(parts) :]
    for cube, ((x, y, heading, length, _), (z, _)) in zip(entity.cubes, parts, strict=True):
        cube.size.x, cube.size.y = length, actor.width
        cube.pose.position.x, cube.pose.position.y = (
            x - length / 2 * math.cos(heading),
            y - length / 2 * math.sin(heading),
        )
        cube.pose.position.z = z + cube.size.z / 2
        cube.pose.orientation.z, cube.pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)


def _write_metrics(log: LogWriter, agent: str, scenes: Sequence[Scene]) -> None:
    kind = MESSAGES["Metrics"]
    times, gaps, brakes = approaches([*join_frames(scenes)], agent)
    for scene, time, gap, brake in zip(scenes, times.tolist(), gaps.tolist(), brakes.tolist(), strict=True):
        row = scene.roster.index.get(agent)
        speed = scene.speeds[row] if row is not None else math.nan
        metrics = kind(speed=speed, time_to_collision_s=time, gap_m=gap, required_deceleration=brake)
        log.write("/metrics", kind, metrics.SerializeToString(), to_ns(scene.time_s))


def _write_events(log: LogWriter, scenes: Sequence[Scene]) -> None:
    """Write the traffic events as lines of the log."""
    for scene in scenes:
        for event in scene.events:
            line = Log(level=Log.WARNING, message=f"{event.kind}: {event.what}", name="crashhunt")
            _stamp(line.timestamp, scene.time_s)
            log.write("/log", Log, line.SerializeToString(), to_ns(scene.time_s))


def _write_crash(log: LogWriter, recording: Recording, scene: Scene, crash: TrialResult) -> None:
    time_ns = to_ns(scene.time_s)
    line = Log(level=Log.ERROR, message=f"{crash.outcome}: {crash.summary}", name="crashhunt")
    _stamp(line.timestamp, scene.time_s)
    log.write("/log", Log, line.SerializeToString(), time_ns)
    row = scene.roster.index.get(crash.collision.agent if crash.collision else recording.agents[0])
    if row is None:
        return
    x, y = scene.points[row]
    entity = SceneEntity(id="crash", frame_id="map")
    _stamp(entity.timestamp, scene.time_s)
    text = entity.texts.add(text=str(crash.outcome), font_size=2.0, billboard=True, color=_color("party"))
    z = scene.heights[row] if scene.heights else 0.0
    text.pose.position.x, text.pose.position.y, text.pose.position.z = x, y, z + 4.0
    text.pose.orientation.w = 1.0
    ring = entity.lines.add(type=LinePrimitive.LINE_LOOP, thickness=0.3, color=_color("party"))
    ring.pose.orientation.w = 1.0
    for angle in np.linspace(0, 2 * np.pi, 32, endpoint=False).tolist():
        ring.points.add(x=x + 5 * math.cos(angle), y=y + 5 * math.sin(angle), z=z + 0.1)
    log.write("/scene/crash", SceneUpdate, SceneUpdate(entities=[entity]).SerializeToString(), time_ns)


def _color(name: str) -> Color:
    red, green, blue, alpha = _COLORS[name]
    return Color(r=red, g=green, b=blue, a=alpha)


def _stamp(timestamp: Timestamp, time_s: float) -> None:
    timestamp.seconds, timestamp.nanos = divmod(to_ns(time_s), 1_000_000_000)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


_VARINTS = tuple(map(_varint, range(1024)))


# Topics and protobuf messages of an MCAP file, at simulation time; the file itself is written in `_log`.


_RECORD_HEAD = struct.Struct("<BQ")  # type and size of a record
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence number and two times of a message
_MESSAGE_RECORD = 5  # type of a record that is a message


def messages_of(
    file: IO[bytes], reader: SeekingReader, *, topic: str = "", validate_crcs: bool = False
) -> Iterator[tuple[Schema | None, Channel, int, bytes]]:
    """Yield schema, channel, sequence number and contents of the messages of an MCAP file, in the order of the file.

    A crash has thousands of messages. mcap's own reader takes five times as long, because it creates several objects
    for each message. Without a topic, the messages of all topics are yielded.

    Raises:
        McapError: a record is longer than its chunk.
    """
    summary = reader.get_summary()
    if summary is None or not summary.chunk_indexes:
        for schema, channel, message in reader.iter_messages(topic or None, log_time_order=False):
            yield schema, channel, message.sequence, message.data
        return
    wanted = {number for number, channel in summary.channels.items() if topic in ("", channel.topic)}
    for index in sorted(summary.chunk_indexes, key=attrgetter("chunk_start_offset")):
        if index.message_index_offsets and wanted.isdisjoint(index.message_index_offsets):
            continue
        file.seek(index.chunk_start_offset + _RECORD_HEAD.size)
        packed = Chunk.read(ReadDataStream(file))
        if (unpacked := _unpacked_size(packed)) > _MAX_CHUNK_BYTES:
            raise McapError(f"a chunk has {unpacked:,} bytes when it is unpacked (allowed: {_MAX_CHUNK_BYTES:,})")
        stream, size = get_chunk_data_stream(packed, validate_crc=validate_crcs)
        chunk, at = stream.read(size), 0
        while at < size:
            kind, length = _RECORD_HEAD.unpack_from(chunk, at)
            start, at = at + _RECORD_HEAD.size, at + _RECORD_HEAD.size + length
            if at > size or (kind == _MESSAGE_RECORD and length < _MESSAGE_HEAD.size):
                raise McapError(f"a record of {length} bytes extends beyond the end of its chunk")
            if kind == _MESSAGE_RECORD:
                number, sequence, _, _ = _MESSAGE_HEAD.unpack_from(chunk, start)
                channel = summary.channels[number]
                if number in wanted:
                    schema = summary.schemas[channel.schema_id] if channel.schema_id else None
                    yield schema, channel, sequence, chunk[start + _MESSAGE_HEAD.size : at]


def _unpacked_size(chunk: Chunk) -> int:
    """Return the number of bytes to which a chunk would be unpacked, as its header or its frame states it."""
    if chunk.compression == "zstd":
        stated: int = zstandard.get_frame_parameters(chunk.data).content_size
        if stated != zstandard.CONTENTSIZE_UNKNOWN:  # then the header is the limit of what is unpacked
            return max(stated, chunk.uncompressed_size)
    return chunk.uncompressed_size if chunk.compression != "lz4" else _MAX_CHUNK_BYTES + 1  # which has no limit


class LogWriter:
    """Writes protobuf messages to an MCAP file, at simulation time."""

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

        A channel is created for its first message, with ``metadata``. ``sequence`` is the number of the message within
        the evidence channels.
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
    """Convert simulation time to ns."""
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
_RECORD_MESSAGES = {name: fields for kind in RECORD_TYPES.values() for name, fields in kind.form.messages.items()}
# A schema in a log has its whole file, so what few logs have is in one of its own.
_FILES: dict[str, Mapping[str, Mapping[str, str]]] = {
    "crashhunt/log.proto": {**_RECORD_MESSAGES, **_METRICS},
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
