"""Records of agents: the prologue, which lists them with the shapes of their arrays, their observations and actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording._reading import AgentChannel, Divergence, Prologue, Reading, StepRecord, first_difference
from crashhunt.recording._values import describe_value, is_opaque
from crashhunt.recording.records._type import Fields, Form, Message, RecordType, TextForm

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray


# The first record: what the episode consists of, as JSON.


def _read_prologue(_reading: Reading, _aux: int, _payload: bytes) -> None:
    raise ValueError("it begins twice")


PROLOGUE = RecordType(tag=1, name="prologue", topic="/prologue", form=TextForm(), read=_read_prologue)


# Arrays of one agent: raw bytes in the black box, numbers in the log.


class ArrayForm(Form):
    """The conversion of an array whose type is given in the prologue."""

    messages: Mapping[str, Mapping[str, str]] = {
        "FloatArray": {"values": "float*"},
        "DoubleArray": {"values": "double*"},
        "IntArray": {"values": "int64*"},
    }

    def __init__(self, what: str) -> None:
        self._what = what

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        """Return the numbers in a message that can represent the array's type without loss."""
        dtype = getattr(prologue.agents[aux], self._what)
        array = np.frombuffer(payload, dtype)
        if array.dtype.kind == "b":
            array = array.view(np.uint8)  # protobuf 7 refuses bools as integers
        return message_of(dtype), {"values": array.tolist()}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        """Return the array of the message as bytes."""
        if prologue is None:
            raise ValueError("an array of an agent comes before the first record")
        return np.array(list(message.values), getattr(prologue.agents[aux], self._what)).tobytes()


def message_of(dtype: str) -> str:
    """Return the name of the message that stores arrays of a NumPy type, such as ``<f4``, without losing a bit."""
    kind, size = dtype[1], int(dtype[2:])
    if kind == "f" and size in (4, 8):
        return "FloatArray" if size == 4 else "DoubleArray"
    if kind in "iub":
        return "IntArray"
    raise TypeError(f"arrays of {dtype} cannot be recorded")


def array_difference(
    step: int, agent: AgentChannel, kind: str, was: NDArray[np.generic] | None, now: NDArray[np.generic] | None
) -> Divergence | None:
    """Return the first difference between two arrays of an agent; either array may be missing.

    ``kind`` is ``observation`` or ``action``.
    """
    opaque = is_opaque(getattr(agent, f"{kind}_shape"))
    if was is None and now is None:
        return None
    if was is None or now is None:
        recorded, replayed = (
            None if array is None else describe_value(array) if opaque else array.tolist() for array in (was, now)
        )
        return Divergence(step=step, agent=agent.id, field=kind, recorded=recorded, replayed=replayed)
    if was.tobytes() == now.tobytes():
        return None
    if was.shape != now.shape or opaque:  # texts of values
        recorded, replayed = (describe_value(array) for array in (was, now))
        return Divergence(step=step, agent=agent.id, field=kind, recorded=recorded, replayed=replayed)
    where = first_difference(was, now)
    return Divergence(
        step=step, agent=agent.id, field=agent.value_name(kind, where), recorded=was[where].item(),
        replayed=now[where].item(), place=(kind, where),
    )  # fmt: skip


def _array_record(tag: int, what: str) -> RecordType:
    """Return the record type for one array per agent and step, as raw bytes; ``aux`` is the agent's number.

    ``what`` is ``observation`` or ``action``, as in the fields of `AgentChannel` and `StepRecord`.
    """

    def read(reading: Reading, aux: int, payload: bytes) -> None:
        channel = reading.prologue.agents[aux]
        array = np.frombuffer(payload, getattr(channel, f"{what}_dtype"))
        getattr(reading.current, f"{what}s")[channel.id] = array.reshape(getattr(channel, f"{what}_shape"))

    def difference(left: StepRecord, right: StepRecord, agent: AgentChannel | None) -> Divergence | None:
        if agent is None:
            return None
        was, now = (getattr(step, f"{what}s").get(agent.id) for step in (left, right))
        return array_difference(left.step, agent, what, was, now)

    def value(step: StepRecord, agent: str, index: tuple[int, ...]) -> object:
        array = getattr(step, f"{what}s").get(agent)
        return None if array is None else array[index].item()

    return RecordType(
        tag=tag,
        name=what,
        topic=f"/agents/{{agent}}/{what}",
        form=ArrayForm(f"{what}_dtype"),
        read=read,
        difference=difference,
        value=value,
    )


OBSERVATION = _array_record(4, "observation")
ACTION = _array_record(5, "action")
