"""What is said of a difference between two recordings: step, agent, field, both values."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.base.codec import JsonObject

__all__ = ["Divergence", "first_difference"]


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first difference between a recording and its replay.

    Args:
        step: at which step; the observation and the action of step n lead to the scene of step n.
        agent: the agent or actor that it is about; empty where it is about the whole episode.
        field: such as ``observation[1, x]``, ``action[target_speed]``, ``scene.x`` or ``length``.
        recorded: the value in the recording; None where there is none.
        replayed: likewise in the replay.
        place: of the value within the step: the name of the type of record, and the index in what it holds.
    """

    step: int
    agent: str
    field: str
    recorded: object
    replayed: object
    place: tuple[str, tuple[int, ...]] | None = None

    def to_json(self) -> JsonObject:
        """Return the shape that ``replay --json`` prints."""
        facts = asdict(self)
        del facts["place"]
        data: JsonObject = json.loads(json.dumps(facts, default=float))
        return data

    def __str__(self) -> str:
        who = f"{self.agent} " if self.agent else ""
        return f"step {self.step}, {who}{self.field}: recorded {self.recorded!r}, replayed {self.replayed!r}"


def first_difference(left: NDArray[np.generic], right: NDArray[np.generic]) -> tuple[int, ...]:
    """Return the index at which two arrays of one shape first differ in a bit, where they do."""
    size = left.itemsize
    was, now = left.tobytes(), right.tobytes()
    flat = next(n for n in range(left.size) if was[n * size : (n + 1) * size] != now[n * size : (n + 1) * size])
    return tuple(int(index) for index in np.unravel_index(flat, left.shape))
