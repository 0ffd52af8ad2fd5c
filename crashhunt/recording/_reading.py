"""The data of a recorded episode: agents, their arrays, and steps."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from crashhunt.base.codec import OMIT_DEFAULT, JsonObject, Serializable
from crashhunt.world import Roster

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.world import Actor, Contact, Event, Scene, Spine


@dataclass(frozen=True, slots=True)
class ObservedPart(Serializable):
    """A part of an observation that consists of several arrays, which are recorded as one array."""

    name: str  # name of the part
    shape: tuple[int, ...]  # shape of the part
    columns: tuple[str, ...] = ()  # names of the entries of its last axis; empty if they have no names

    @property
    def size(self) -> int:
        """The number of values."""
        return math.prod(self.shape)


@dataclass(frozen=True, slots=True)
class AgentChannel(Serializable):
    """Types and shapes of the observations and actions of one agent."""

    id: str  # identifier of the agent, which is also the identifier of its vehicle
    observation_dtype: str  # type of the observations in NumPy's notation, such as ``<f4``
    observation_shape: tuple[int, ...]
    action_dtype: str  # type of the actions in NumPy's notation, such as ``<i8``
    action_shape: tuple[int, ...]
    action_names: tuple[str, ...] = ()  # names of the elements of an action
    observation_names: tuple[str, ...] = ()  # names of the columns of an observation
    # the parts of an observation, in their order in the recorded array; empty if the observation has no parts
    observation_parts: tuple[ObservedPart, ...] = field(default=(), metadata=OMIT_DEFAULT)

    def value_name(self, array: str, where: tuple[int, ...]) -> str:
        """Return the name of a value of an array: ``action[target_speed]``, or ``observation[actors, 0, x]``.

        ``array`` is ``observation`` or ``action``, and ``where`` the index of the value in it.
        """
        columns = self.action_names if array == "action" else self.observation_names
        words: list[object] = [*where[:-1], columns[where[-1]] if columns else where[-1]] if where else []
        if array == "observation" and self.observation_parts:
            (place,) = where
            for part in self.observation_parts:
                if place < part.size:
                    *rows, last = np.unravel_index(place, part.shape)
                    words = [part.name, *rows, part.columns[last] if part.columns else last]
                    break
                place -= part.size
        return f"{array}[{', '.join(map(str, words))}]" if words else array

    def part(self, name: str, observation: NDArray[Any]) -> NDArray[Any] | None:
        """Return a part of a recorded observation; None if the observation has no such part."""
        begin = 0
        for part in self.observation_parts:
            if part.name == name:
                return observation[begin : begin + part.size].reshape(part.shape)
            begin += part.size
        return None

    def values_by_name(self, observation: NDArray[Any]) -> dict[str, float]:
        """Return the first values of an observation with their names: the agent's own row, as text for users.

        If the observation has parts, these are the values of the part ``ego``, or of the first row of the first part.
        """
        if self.observation_parts:
            parts = self.observation_parts
            chosen = next((number for number, part in enumerate(parts) if part.name == "ego"), 0)
            names = parts[chosen].columns or tuple(map(str, range(parts[chosen].size)))
            begin = sum(part.size for part in parts[:chosen])
            rows = observation[begin : begin + parts[chosen].size].reshape(-1, len(names))
            values = rows[-1 if parts[chosen].name == "ego" else 0].tolist()  # the last row of a history is the present
            return dict(zip(names, values, strict=False))
        names = self.observation_names or tuple(map(str, range(observation.shape[-1] if observation.ndim else 1)))
        values = observation.reshape(-1, observation.shape[-1])[:1] if observation.ndim else observation
        return dict(zip(names, values.reshape(-1).tolist(), strict=False))


@dataclass(frozen=True, slots=True)
class Prologue(Serializable):
    """The agents and the step length of an episode."""

    agents: tuple[AgentChannel, ...]  # agents in the order of their numbers
    step_length_s: float  # step length in s of simulation time
    # whether the digest covers only the changes of observations
    digest_of_changes: bool = field(default=False, metadata=OMIT_DEFAULT)

    def encode(self) -> bytes:
        """Return the payload of the record."""
        return json.dumps(self.to_json(), sort_keys=True).encode()

    @classmethod
    def decode(cls, payload: bytes) -> Prologue:
        """Decode a payload of `encode`; keys that a later version has added are skipped."""
        return cls.from_json(json.loads(payload))


@dataclass(slots=True)
class StepRecord:
    """The recorded data of one step."""

    step: int  # number of the step; 0 is the start of the episode, before the first action
    scene: Scene | None = None  # scene after the step; None if the process ended inside the step
    rewards: dict[str, float] = field(default_factory=dict)  # reward of each agent, by agent id
    # the observation of each agent before this step; empty at step 0
    observations: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    actions: dict[str, NDArray[np.generic]] = field(default_factory=dict)  # the action of each agent
    more: dict[str, Any] = field(default_factory=dict)  # data of further record types, by the name of the type

    @property
    def whole(self) -> bool:
        """Whether the step was completed."""
        return self.scene is not None


class SceneParts(TypedDict, total=False):
    """The parts of a scene that are recorded separately from the step; see `Scene`."""

    contacts: tuple[Contact, ...]
    off_road: tuple[str, ...]
    lanes: tuple[str, ...]
    heights: list[float]
    grades: list[float]
    spines: dict[int, Spine]


@dataclass(slots=True)
class Reading:
    """The part of an episode that has been read."""

    prologue: Prologue  # the agents and the step length of the episode
    actors: list[Actor] = field(default_factory=list)  # all actors that were introduced, in the order of their numbers
    steps: list[StepRecord] = field(default_factory=list)  # the complete steps since the beginning of the reading
    current: StepRecord = field(default_factory=lambda: StepRecord(0))  # the step of which records are being read
    roster: Roster = field(default_factory=lambda: Roster(()))  # the actors of the next scene
    # further arguments of the next scene, by their names; the next step uses them
    scene: SceneParts = field(default_factory=SceneParts)
    events: tuple[Event, ...] = ()  # the traffic events of the next scene

    def finish(self) -> None:
        """Add the step in which the process ended, if there is one."""
        if self.current.observations or self.current.actions or self.current.more:
            self.steps.append(self.current)


# What is said of a difference between two recordings: step, agent, field, both values.

_MAX_SHOWN = 100  # characters of a value in a sentence: an action may be a whole trajectory


@dataclass(frozen=True, slots=True)
class Divergence(Serializable):
    """The first difference between a recording and its replay.

    Args:
        step: step of the difference; the observation and the action of step n lead to the scene of step n.
        agent: agent or actor whose value differs; empty for a value of the whole episode.
        field: name of the value, such as ``observation[1, x]``, ``action[target_speed]``, ``scene.x`` or ``length``.
        recorded: the value in the recording; None if it is missing.
        replayed: the value in the replay; None if it is missing.
        place: place of the value within the step: the name of the record type, and the index in the record.
    """

    step: int
    agent: str
    field: str
    recorded: object
    replayed: object
    place: tuple[str, tuple[int, ...]] | None = None

    @property
    def is_end(self) -> bool:
        """Whether no value differs, and the runs only end at different steps or with different outcomes."""
        return self.field in ("length", "outcome")

    def to_json(self) -> JsonObject:
        """Return the divergence in the form that ``replay --json`` prints."""
        facts = asdict(self)
        del facts["place"]
        data: JsonObject = json.loads(json.dumps(facts, default=float))
        return data

    def __str__(self) -> str:
        who = f"{self.agent} " if self.agent else ""
        values = map(repr, (self.recorded, self.replayed))
        was, now = (text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}…" for text in values)
        return f"step {self.step}, {who}{self.field}: recorded {was}, replayed {now}"


def first_difference(left: NDArray[np.generic], right: NDArray[np.generic]) -> tuple[int, ...]:
    """Return the index of the first bit difference between two different arrays of the same shape."""
    size = left.itemsize
    was, now = left.tobytes(), right.tobytes()
    flat = next(n for n in range(left.size) if was[n * size : (n + 1) * size] != now[n * size : (n + 1) * size])
    return tuple(int(index) for index in np.unravel_index(flat, left.shape))
