"""Arrays of one agent: raw bytes in the black box, numbers in the log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording._divergence import Divergence, first_difference
from crashhunt.recording.records._type import Form

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from crashhunt.recording.records._type import Fields, Message
    from crashhunt.recording.records.prologue import Prologue

__all__ = ["ArrayForm", "difference", "message_of"]


class ArrayForm(Form):
    """Arrays of the type that the prologue says.

    Args:
        what: the field of the agent's channel that has the type.
    """

    messages: Mapping[str, Mapping[str, str]] = {
        "FloatArray": {"values": "float*"},
        "DoubleArray": {"values": "double*"},
        "IntArray": {"values": "int64*"},
    }

    def __init__(self, what: str) -> None:
        self._what = what

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        """Return the numbers, in the message that holds those of this type without losing a bit."""
        dtype = getattr(prologue.agents[aux], self._what)
        return message_of(dtype), {"values": np.frombuffer(payload, dtype).tolist()}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        """Return their bytes."""
        if prologue is None:
            raise ValueError("an array comes before the beginning")
        return np.array(list(message.values), getattr(prologue.agents[aux], self._what)).tobytes()


def message_of(dtype: str) -> str:
    """Return the name of the message that holds arrays of a NumPy type, such as ``<f4``, without losing a bit."""
    kind, size = dtype[1], int(dtype[2:])
    if kind == "f" and size in (4, 8):
        return "FloatArray" if size == 4 else "DoubleArray"
    if kind in "iub":
        return "IntArray"
    raise TypeError(f"arrays of {dtype} cannot be recorded")


def difference(
    step: int,
    agent: str,
    kind: str,
    columns: tuple[str, ...],
    was: NDArray[np.generic] | None,
    now: NDArray[np.generic] | None,
) -> Divergence | None:
    """Return the first difference between two arrays of an agent, either of which may be missing."""
    if was is None and now is None:
        return None
    if was is None or now is None:
        return Divergence(step, agent, kind, _plain(was), _plain(now))
    if was.tobytes() == now.tobytes():
        return None
    where = first_difference(was, now)
    name = ", ".join((*map(str, where[:-1]), columns[where[-1]] if columns else str(where[-1]))) if where else ""
    field = f"{kind}[{name}]" if name else kind
    return Divergence(step, agent, field, was[where].item(), now[where].item(), (kind, where))


def _plain(array: NDArray[np.generic] | None) -> object:
    return None if array is None else array.tolist()
