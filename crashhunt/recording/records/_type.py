"""The definition of a record type."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from crashhunt.recording._reading import AgentChannel, Divergence, Prologue, Reading, StepRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    Difference = Callable[[StepRecord, StepRecord, AgentChannel | None], Divergence | None]

SCENE = "scene"

Message: TypeAlias = Any
"""A protobuf message, of a class that is made when crashhunt is imported: its fields are those of `Form.messages`."""

Fields: TypeAlias = "Mapping[str, object]"
"""The values of a message's fields, by name."""


class Form:
    """The conversion of a payload to a log message and back, without losing a bit."""

    messages: Mapping[str, Mapping[str, str]]  # the possible protobuf messages, by name; each maps field names to types

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        """Return the name of the message, and the values of its fields."""
        raise NotImplementedError

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        """Return the payload from which `to_message` made the message; for the prologue record, `prologue` is None."""
        raise NotImplementedError


class TextForm(Form):
    """The conversion of a payload that is text."""

    messages: Mapping[str, Mapping[str, str]] = {"Text": {"text": "string"}}

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        """Return the payload as text in a message."""
        return "Text", {"text": payload}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        """Return the payload of the text."""
        text: str = message.text
        return text.encode()


class BytesForm(Form):
    """The conversion of a payload without a known meaning."""

    messages: Mapping[str, Mapping[str, str]] = {"Bytes": {"data": "bytes"}}

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        """Return the payload unchanged in a message."""
        return "Bytes", {"data": payload}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        """Return the payload unchanged."""
        data: bytes = message.data
        return data


@dataclass(frozen=True, slots=True)
class RecordType:
    """The properties of a record type."""

    tag: int  # unique number of the type in the black box; types from `FIRST_ASIDE` on do not belong to the digest
    name: str  # name for users, and for the place of a value
    # topic of its messages in a log; ``{agent}`` is replaced by the agent whose number is the record's ``aux``
    topic: str
    # the conversion to a message. Types after the first eleven are text or bytes, so that a version of crashhunt that
    # does not know the type can read the record and include it in the digest.
    form: Form
    # function that adds a record, given as ``aux`` and payload, to the `Reading`
    read: Callable[[Reading, int, bytes], None]
    # function that returns the first difference between the records of two equal steps; for one agent if the topic
    # contains ``{agent}``. The function is None if the record is never compared, or is compared with another type.
    difference: Difference | None = None
    # function that returns the value of the agent or actor of a divergence, or the value at an index, in the steps
    # around the divergence
    value: Callable[[StepRecord, str, tuple[int, ...]], object] | None = None

    @property
    def per_agent(self) -> bool:
        """Whether every agent has its own records of this type."""
        return "{agent}" in self.topic


def scene_texts(*fields: str) -> Difference:
    """Return a function that compares some fields of the scenes."""

    def difference(left: StepRecord, right: StepRecord, _: AgentChannel | None) -> Divergence | None:
        if left.scene is None or right.scene is None:  # which the step reports
            return None
        for field in fields:
            # As text, in which an unknown speed, NaN, equals itself.
            was, now = str(getattr(left.scene, field)), str(getattr(right.scene, field))
            if was != now:
                return Divergence(step=left.step, agent="", field=f"scene.{field}", recorded=was, replayed=now)
        return None

    return difference
