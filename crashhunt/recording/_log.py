"""``log.mcap``: what is kept of an episode, in a file that other tools open too.

Evidence channels hold our records, one message each, in their order; the message's sequence number is the record's.
Reading them gives back the very same records, hence the same digest. View channels (see ``_views``) are for people.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.writer import Writer

from crashhunt.base.errors import BundleError
from crashhunt.base.files import whole_file
from crashhunt.recording import _schemas as schemas
from crashhunt.recording._blackbox import Record, Tag
from crashhunt.recording._recording import Prologue, Recording, decode_spines, pack_spines
from crashhunt.recording._views import write_views
from crashhunt.recording._writer import LogWriter, to_ns

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.trial import TrialResult
    from crashhunt.world import Lane

__all__ = ["read_log", "write_log"]

SCHEMA = "1"
_STEP = struct.Struct("<qd")
_TEXTS = {
    Tag.PROLOGUE: "/prologue",
    Tag.ACTORS: "/scene/actor_definitions",
    Tag.LANES: "/scene/lanes",
    Tag.EVENTS: "/events",
    Tag.NOTES: "/traffic_events",
}


def write_log(
    path: Path,
    recording: Recording,
    *,
    lanes: Sequence[Lane] = (),
    metadata: Mapping[str, str] | None = None,
    crash: TrialResult | None = None,
) -> None:
    """Write a log; all of it or nothing.

    Args:
        path: of the file.
        recording: what happened.
        lanes: of the map, for whoever looks at it.
        metadata: further facts.
        crash: how it ended, for the crash marker and the log line.

    Raises:
        HuntDirectoryError: the disk is full, or the folder is not writable.
    """
    with whole_file(path, lasting=False) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="crashhunt")
        writer.add_metadata("crashhunt", {**(metadata or {}), "crashhunt_log_schema": SCHEMA})
        log = LogWriter(writer)
        _write_evidence(log, recording)
        write_views(log, recording, lanes, crash)
        writer.finish()


def read_log(path: Path) -> Recording:
    """Read the evidence of a log.

    Raises:
        BundleError: it is missing, damaged, not a log of ours, or of another version.
    """

    def refuse(message: str, fix: str = "get an undamaged copy of it") -> BundleError:
        return BundleError(message, fix=fix, where=str(path))

    try:
        with path.open("rb") as file:
            reader = SeekingReader(file, validate_crcs=True)
            versions = [entry.metadata.get("crashhunt_log_schema") for entry in reader.iter_metadata()]
            version = next((found for found in versions if found is not None), None)
            if version is None:
                raise refuse("this MCAP file was not written by crashhunt", "give a log.mcap of a crash bundle")
            if version != SCHEMA:
                raise refuse(f"its schema is {version}, not {SCHEMA}", "use the version of crashhunt that wrote it")
            messages = reader.iter_messages(log_time_order=False)
            evidence = sorted(
                (message.sequence, channel.topic, message.data)
                for schema, channel, message in messages
                if schema is not None and schema.name.startswith("crashhunt.") and message.sequence
            )
            return Recording(_read_evidence(evidence))
    except OSError as error:
        raise refuse(f"cannot be read: {error.strerror}", "give the path of a log.mcap") from None
    except BundleError as error:
        raise refuse(error.message, error.fix) from None
    except (McapError, ValueError, KeyError, IndexError, EOFError, struct.error, OverflowError, MemoryError) as error:
        raise refuse(f"not a whole MCAP file: {type(error).__name__}: {error}") from None
    except Exception as error:
        raise refuse(f"damaged: {type(error).__name__}: {error}") from None


def _agent_topic(agent: str, what: str) -> str:
    return f"/agents/{quote(agent, safe='')}/{what}"


@dataclass(frozen=True, slots=True)
class _ArrayCodec:
    """Arrays of one agent, to messages and back."""

    topic: str
    kind: Any
    dtype: str

    def encode(self, payload: bytes) -> bytes:
        data: bytes = self.kind(values=np.frombuffer(payload, self.dtype).tolist()).SerializeToString()
        return data

    def decode(self, data: bytes) -> bytes:
        return np.array(list(self.kind.FromString(data).values), self.dtype).tobytes()


def _codecs(prologue: Prologue) -> dict[tuple[int, int], _ArrayCodec]:
    found = {}
    for number, agent in enumerate(prologue.agents):
        for tag, what, dtype in (
            (Tag.OBSERVATION, "observation", agent.observation_dtype),
            (Tag.ACTION, "action", agent.action_dtype),
        ):
            found[int(tag), number] = _ArrayCodec(_agent_topic(agent.id, what), schemas.array_type(dtype), dtype)
    return found


def _write_evidence(log: LogWriter, recording: Recording) -> None:
    codecs = _codecs(recording.prologue)
    agents = len(recording.agents)
    time_ns = 0
    for sequence, (tag, aux, payload) in enumerate(recording.records, 1):
        if tag in _TEXTS:
            log.write(_TEXTS[Tag(tag)], schemas.Text, schemas.Text(text=payload).SerializeToString(), time_ns, sequence)
        elif tag == Tag.ROSTER:
            message = schemas.Roster(actors=np.frombuffer(payload, "<u4").tolist())
            log.write("/scene/roster", schemas.Roster, message.SerializeToString(), time_ns, sequence)
        elif tag == Tag.HEIGHTS:
            heights, grades = np.frombuffer(payload, "<f8").reshape(2, -1).tolist()
            message = schemas.Heights(heights=heights, grades=grades)
            log.write("/scene/heights", schemas.Heights, message.SerializeToString(), time_ns, sequence)
        elif tag == Tag.SPINES:
            message = _spines_message(payload)
            log.write("/scene/spines", schemas.Spines, message.SerializeToString(), time_ns, sequence)
        elif tag == Tag.STEP:
            step, time_s = _STEP.unpack_from(payload)
            time_ns = to_ns(time_s)
            values = np.frombuffer(payload, "<f8", offset=_STEP.size).tolist()
            rewards, scene = values[:agents], values[agents:]
            count = len(scene) // 4
            message = schemas.Step(
                step=step,
                time_s=time_s,
                rewards=rewards,
                positions=scene[: 2 * count],
                headings=scene[2 * count : 3 * count],
                speeds=scene[3 * count :],
            )
            log.write("/scene", schemas.Step, message.SerializeToString(), time_ns, sequence)
        else:
            codec = codecs[tag, aux]
            log.write(codec.topic, codec.kind, codec.encode(payload), time_ns, sequence)


def _read_evidence(evidence: Sequence[tuple[int, str, bytes]]) -> Iterator[Record]:
    texts = {topic: tag for tag, topic in _TEXTS.items()}
    arrays: dict[str, tuple[int, int, _ArrayCodec]] = {}
    for expected, (sequence, topic, data) in enumerate(evidence, 1):
        if sequence != expected:
            raise BundleError(f"message {expected} of the evidence is missing", fix="get an undamaged copy of it")
        if topic == "/scene":
            yield _read_step(data)
        elif topic == "/scene/roster":
            yield Record(Tag.ROSTER, 0, np.array(schemas.Roster.FromString(data).actors, "<u4").tobytes())
        elif topic == "/scene/heights":
            heights = schemas.Heights.FromString(data)
            yield Record(Tag.HEIGHTS, 0, np.array([*heights.heights, *heights.grades], "<f8").tobytes())
        elif topic == "/scene/spines":
            yield _read_spines(data)
        elif topic in texts:
            payload = schemas.Text.FromString(data).text.encode()
            if texts[topic] == Tag.PROLOGUE:
                codecs = _codecs(Prologue.decode(payload))
                arrays = {codec.topic: (tag, agent, codec) for (tag, agent), codec in codecs.items()}
            yield Record(texts[topic], 0, payload)
        else:
            tag, agent, codec = arrays[topic]
            yield Record(tag, agent, codec.decode(data))


def _read_step(data: bytes) -> Record:
    step = schemas.Step.FromString(data)
    values = np.array([*step.rewards, *step.positions, *step.headings, *step.speeds], "<f8")
    return Record(Tag.STEP, 0, _STEP.pack(step.step, step.time_s) + values.tobytes())


def _spines_message(payload: bytes) -> Any:
    spines = decode_spines(payload)
    coordinates = [value for spine in spines.values() for point in spine for value in point]
    return schemas.Spines(rows=list(spines), points=[len(spine) for spine in spines.values()], coordinates=coordinates)


def _read_spines(data: bytes) -> Record:
    message = schemas.Spines.FromString(data)
    values = np.array(list(message.coordinates), "<f8").reshape(-1, 3)
    ends = np.cumsum(list(message.points))[:-1]
    spines = dict(zip(message.rows, np.split(values, ends), strict=True))
    return Record(Tag.SPINES, 0, pack_spines(spines))
