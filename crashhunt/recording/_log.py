"""``log.mcap``: the compressed records of an episode, in a file format that other tools can also open.

Evidence channels contain the records of the black box, one message for each record, in the same order. Reading these
channels returns identical records, and therefore the same digest. View channels (see ``_foxglove``) are for display.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.writer import Writer

from crashhunt.base.codec import known_values
from crashhunt.base.errors import BundleError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import open_at_once
from crashhunt.recording._blackbox_file import Record
from crashhunt.recording._foxglove import MESSAGES, NAMESPACE, LogWriter, messages_of, to_ns, write_views
from crashhunt.recording._reading import Prologue
from crashhunt.recording._recording import Compact, Recording
from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._agent_records import ACTION, OBSERVATION
from crashhunt.recording.records._scene_record import DISTURBANCES, STEP, time_of
from crashhunt.recording.records._type import BytesForm, Form, TextForm

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.trial import TrialResult
    from crashhunt.world import Lane

SCHEMA = "1"
_COMPACT_KEY = "crashhunt_compact"  # key of the metadata that says what a compact recording lacks
_KNOWN_BY_TOPIC = 11
"""The last tag of the types that have been there from the beginning: a channel of any other says its tag."""
_DECISIONS = frozenset({OBSERVATION.tag, ACTION.tag, DISTURBANCES.tag})


def write_log(
    path: Path,
    recording: Recording,
    *,
    lanes: Sequence[Lane] = (),
    metadata: Mapping[str, str] | None = None,
    crash: TrialResult | None = None,
    views: bool = True,
) -> None:
    """Write a log completely or not at all.

    The lanes are for viewers. Without ``views``, the channels for other tools are omitted, and the file is half as
    large.

    Raises:
        HuntDirectoryError: the disk is full, or the folder is not writable.
    """
    with whole_file(path, lasting=False, noted=False) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="crashhunt")
        compact = {} if recording.compact is None else {_COMPACT_KEY: json.dumps(asdict(recording.compact))}
        writer.add_metadata("crashhunt", {**(metadata or {}), **compact, "crashhunt_log_schema": SCHEMA})
        log = LogWriter(writer)
        _write_evidence(log, recording)
        if views:
            write_views(log, recording, lanes, crash)
        writer.finish()


def read_log(path: Path) -> Recording:
    """Read the evidence channels of a log.

    Raises:
        BundleError: the file is missing, damaged, not a log of crashhunt, or of another version.
    """

    def refuse(message: str, fix: str = "get an undamaged copy of the log") -> BundleError:
        return BundleError(message, fix=fix, where=str(path))

    try:
        with open(path, "rb", opener=open_at_once) as file:
            reader = SeekingReader(file, validate_crcs=True)
            entries = [entry.metadata for entry in reader.iter_metadata()]
            version = next((found for one in entries if (found := one.get("crashhunt_log_schema")) is not None), None)
            said = next((one[_COMPACT_KEY] for one in entries if _COMPACT_KEY in one), "")
            compact = Compact(**known_values(Compact, json.loads(said))) if said else None
            if version is None:
                raise refuse("this MCAP file was not written by crashhunt", "give a log.mcap of a crash bundle")
            if version != SCHEMA:
                raise refuse(
                    f"the schema version of the log is {version}; this crashhunt reads {SCHEMA}",
                    "use the version of crashhunt that wrote it",
                )
            evidence = (
                _Message(
                    sequence=sequence, topic=channel.topic, data=data, schema=schema.name, metadata=channel.metadata
                )
                for schema, channel, sequence, data in messages_of(file, reader, validate_crcs=True)
                if schema is not None and sequence and schema.name.startswith(NAMESPACE)
            )
            return Recording(_read_evidence(evidence), compact)
    except OSError as error:
        raise refuse(f"cannot be read: {error.strerror}", "give the path of a log.mcap") from None
    except BundleError as error:
        raise refuse(error.message, error.fix) from None
    except (McapError, ValueError, KeyError, IndexError, EOFError, struct.error, OverflowError, MemoryError) as error:
        raise refuse(f"an incomplete MCAP file: {type(error).__name__}: {error}") from None
    except Exception as error:
        raise refuse(f"damaged: {type(error).__name__}: {error}") from None


class _Message(NamedTuple):
    """A message of the evidence, with the name of its schema and the metadata of its channel."""

    sequence: int
    topic: str
    data: bytes
    schema: str
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class _Channel:
    """A channel of the log with the records of one type, and of one agent if records are per agent."""

    tag: int
    aux: int
    topic: str
    form: Form


def _channel(tag: int, aux: int, prologue: Prologue) -> _Channel:
    kind = RECORD_TYPES.get(tag)
    if kind is None:  # of a black box that a later version wrote
        return _Channel(tag=tag, aux=aux, topic=f"/records/{tag}/{aux}", form=BytesForm())
    agent = quote(prologue.agents[aux].id, safe="") if kind.per_agent else ""
    return _Channel(tag=tag, aux=aux, topic=kind.topic.format(agent=agent), form=kind.form)


def _write_evidence(log: LogWriter, recording: Recording) -> None:
    prologue = recording.prologue
    channels: dict[tuple[int, int], _Channel] = {}
    times_ns = _times_ns(recording.records)
    for sequence, ((tag, aux, payload), time_ns) in enumerate(zip(recording.records, times_ns, strict=True), 1):
        channel = channels.get((tag, aux))
        if channel is None:
            channel = channels[tag, aux] = _channel(tag, aux, prologue)
        name, fields = channel.form.to_message(payload, prologue, aux)
        kind = MESSAGES[name]
        metadata = None if tag <= _KNOWN_BY_TOPIC else {"tag": str(tag), "aux": str(aux)}
        log.write(channel.topic, kind, kind(**fields).SerializeToString(), time_ns, sequence, metadata)


def _times_ns(records: Sequence[Record]) -> list[int]:
    """Return the simulation time of each record, in ns.

    The records of a scene precede its step and have its time. A viewer that shows the latest message of each topic
    then shows the actors and events of the scene. Decisions have the time of the scene that the agent observed.
    """
    steps_ns = [to_ns(time_of(payload)) for tag, _, payload in records if tag == STEP.tag]
    times_ns, step = [], 0
    for tag, _, _ in records:
        at = step - 1 if tag in _DECISIONS else step
        times_ns.append(steps_ns[min(max(at, 0), len(steps_ns) - 1)] if steps_ns else 0)
        step += tag == STEP.tag
    return times_ns


def _read_evidence(messages: Iterable[_Message]) -> Iterator[Record]:
    """Yield the records of messages."""
    channels = {
        kind.topic: _Channel(tag=tag, aux=0, topic=kind.topic, form=kind.form) for tag, kind in RECORD_TYPES.items()
    }
    prologue: Prologue | None = None
    for message in _in_order(messages):
        channel = channels.get(message.topic)
        if channel is None:
            channel = channels[message.topic] = _unknown(message)
        kind = MESSAGES[message.schema[len(NAMESPACE) :]]
        payload = channel.form.to_payload(kind.FromString(message.data), prologue, channel.aux)
        if prologue is None:
            prologue = Prologue.decode(payload)
            for aux in range(len(prologue.agents)):
                of_agent = [_channel(tag, aux, prologue) for tag, kind in RECORD_TYPES.items() if kind.per_agent]
                channels |= {channel.topic: channel for channel in of_agent}
        yield Record(channel.tag, channel.aux, payload)


def _in_order(messages: Iterable[_Message]) -> Iterator[_Message]:
    """Yield messages in the order of their numbers; only the program that wrote them last may have moved them."""
    expected, early = 1, dict[int, _Message]()
    for message in messages:
        if message.sequence < expected or message.sequence in early:
            raise BundleError(
                f"message {message.sequence} of the log is there twice", fix="get an undamaged copy of the log"
            )
        early[message.sequence] = message
        while expected in early:
            yield early.pop(expected)
            expected += 1
    if early:
        raise BundleError(f"message {expected} of the log is missing", fix="get an undamaged copy of the log")


def _unknown(message: _Message) -> _Channel:
    """Return the channel of records that a later version has written; their bytes are kept without a meaning."""
    tag = int(message.metadata["tag"])  # without one, no version has written it
    name = message.schema[len(NAMESPACE) :]
    form = next((form for form in (TextForm(), BytesForm()) if name in form.messages), None)
    if form is None:
        raise BundleError(
            f"the log contains records of a type that this version of crashhunt does not know ({message.topic})",
            fix="use the version of crashhunt that wrote the trial",
        )
    return _Channel(tag=tag, aux=int(message.metadata.get("aux", 0)), topic=message.topic, form=form)
