"""A recording: everything that was recorded of one episode, whichever file it came from."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import BundleError
from crashhunt.base.names import one_of
from crashhunt.recording._blackbox import Record, Tag
from crashhunt.world import Actor, Contact, Event, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from crashhunt.world import Spine

__all__ = [
    "AgentChannel",
    "Prologue",
    "Recording",
    "StepRecord",
    "decode_spines",
    "digest_of",
    "encode_actors",
    "encode_events",
    "encode_heights",
    "encode_notes",
    "encode_spines",
    "pack_spines",
]

_STEP_HEAD = struct.Struct("<qd")
_SPINE_HEAD = struct.Struct("<II")


@dataclass(frozen=True, slots=True)
class AgentChannel:
    """What the arrays of one agent look like.

    Args:
        id: the agent, which is also the id of its vehicle among the actors.
        observation_dtype: as NumPy writes it, such as ``<f4``.
        observation_shape: of one observation.
        action_dtype: likewise.
        action_shape: of one action.
        action_names: what the elements of an action are.
        observation_names: what the columns of an observation are.
    """

    id: str
    observation_dtype: str
    observation_shape: tuple[int, ...]
    action_dtype: str
    action_shape: tuple[int, ...]
    action_names: tuple[str, ...] = ()
    observation_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Prologue:
    """What an episode consists of.

    Args:
        agents: in the order of their numbers.
        step_length_s: in s of simulation time.
    """

    agents: tuple[AgentChannel, ...]
    step_length_s: float

    def encode(self) -> bytes:
        """Return the payload of the record."""
        agents = [{name: getattr(agent, name) for name in AgentChannel.__slots__} for agent in self.agents]
        return json.dumps({"agents": agents, "step_length_s": self.step_length_s}, sort_keys=True).encode()

    @classmethod
    def decode(cls, payload: bytes) -> Prologue:
        """Rebuild what `encode` returned."""
        data = json.loads(payload)
        channels: list[dict[str, Any]] = [
            {name: tuple(value) if isinstance(value, list) else value for name, value in agent.items()}
            for agent in data["agents"]
        ]
        agents = tuple(AgentChannel(**channel) for channel in channels)
        return cls(agents, data["step_length_s"])


def encode_actors(actors: Iterable[Actor]) -> bytes:
    """Return the payload that introduces actors."""
    known = [[actor.id, actor.kind, actor.length, actor.width, actor.height] for actor in actors]
    return json.dumps([entry if entry[-1] else entry[:-1] for entry in known]).encode()


def decode_actors(payload: bytes) -> list[Actor]:
    """Rebuild what `encode_actors` was given."""
    return [Actor(*entry) for entry in json.loads(payload)]


def encode_events(scene: Scene) -> bytes:
    """Return the payload that says what touched and who left the road."""
    contacts = [[getattr(contact, name) for name in Contact.__slots__] for contact in scene.contacts]
    return json.dumps({"contacts": contacts, "off_road": list(scene.off_road)}).encode()


def encode_heights(scene: Scene) -> bytes:
    """Return the payload that says how high everybody is, and how steep it is there."""
    return np.array([*scene.heights, *scene.grades], "<f8").tobytes()


def encode_spines(scene: Scene) -> bytes:
    """Return the payload that says how the long vehicles are bent."""
    return pack_spines(scene.spines)


def pack_spines(spines: Mapping[int, Any]) -> bytes:
    """Return the payload of `encode_spines`: row to points, shape (n, 3), in m."""
    return b"".join(
        _SPINE_HEAD.pack(row, len(spine)) + np.array(spine, "<f8").tobytes() for row, spine in spines.items()
    )


def decode_spines(payload: bytes) -> dict[int, Spine]:
    """Rebuild what `encode_spines` was given."""
    found, offset = {}, 0
    while offset < len(payload):
        row, count = _SPINE_HEAD.unpack_from(payload, offset)
        offset += _SPINE_HEAD.size
        points = np.frombuffer(payload, "<f8", 3 * count, offset).reshape(-1, 3).tolist()
        found[row] = tuple((x, y, z) for x, y, z in points)
        offset += 24 * count
    return found


def encode_notes(events: Iterable[Event]) -> bytes:
    """Return the payload that says what else happened in the traffic."""
    return json.dumps([event.to_json() for event in events]).encode()


@dataclass(slots=True)
class StepRecord:
    """What was recorded of one step.

    Args:
        step: 0 is the start of the episode, before the first action.
        scene: after the step.
        rewards: agent id to reward.
        observations: what each agent was shown before this step; nothing at step 0.
        actions: what each agent answered.
        whole: False where the process ended inside the step, so that there is no scene after it.
    """

    step: int
    scene: Scene | None = None
    rewards: dict[str, float] = field(default_factory=dict)
    observations: dict[str, NDArray[Any]] = field(default_factory=dict)
    actions: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether the step was completed."""
        return self.scene is not None


class Recording:
    """Everything that was recorded of one episode.

    Args:
        records: as they were written, from a black box or a log.

    Raises:
        BundleError: the records make no sense.
    """

    def __init__(self, records: Iterable[Record]) -> None:
        self.records = tuple(records)
        if not self.records or self.records[0].tag != Tag.PROLOGUE:
            raise BundleError("the recording has no beginning", fix="it was cut short or is not a recording")
        self.prologue = Prologue.decode(self.records[0].payload)
        self.actors: list[Actor] = []
        self.all_steps: list[StepRecord] = []
        try:
            self._read()
        except (ValueError, IndexError, KeyError, TypeError, struct.error) as error:
            raise BundleError(f"the recording is damaged: {error}", fix="get an undamaged copy of it") from error

    @property
    def agents(self) -> tuple[str, ...]:
        """The ids of the controlled vehicles."""
        return tuple(agent.id for agent in self.prologue.agents)

    @property
    def digest(self) -> str:
        """The trace digest, in hexadecimal."""
        return digest_of(b"".join(record.encode() for record in self.records if record.tag != Tag.NOTES))

    @property
    def steps(self) -> int:
        """How many steps were completed."""
        return max((step.step for step in self.all_steps if step.whole), default=0)

    def observations(self, agent: str) -> NDArray[Any]:
        """What an agent was shown, shape (steps it saw, *observation shape)."""
        channel = self._channel(agent)
        found = [step.observations[agent] for step in self.all_steps if agent in step.observations]
        shape = (len(found), *channel.observation_shape)
        return np.array(found, dtype=channel.observation_dtype).reshape(shape)

    def actions(self, agent: str) -> NDArray[Any]:
        """What an agent answered, shape (steps it acted, *action shape)."""
        channel = self._channel(agent)
        found = [step.actions[agent] for step in self.all_steps if agent in step.actions]
        return np.array(found, dtype=channel.action_dtype).reshape((len(found), *channel.action_shape))

    def scene(self, step: int) -> Scene:
        """The scene after a step (0: before the first).

        Raises:
            IndexError: the recording has no such step.
        """
        found = self.all_steps[step].scene if 0 <= step < len(self.all_steps) else None
        if found is None:
            raise IndexError(f"no scene of step {step}; the recording has the steps 0 to {self.steps}")
        return found

    def scenes(self) -> list[Scene]:
        """All scenes, in order."""
        return [step.scene for step in self.all_steps if step.scene is not None]

    def _channel(self, agent: str) -> AgentChannel:
        for channel in self.prologue.agents:
            if channel.id == agent:
                return channel
        raise BundleError(
            f"there is no agent {agent!r} in the recording", fix=one_of(agent, self.agents, give="it has")
        )

    def _read(self) -> None:
        agents = self.prologue.agents
        roster = Roster(())
        current = StepRecord(0)
        lanes: tuple[str, ...] = ()
        events: dict[str, Any] = {}
        heights: list[float] = []
        spines: dict[int, Spine] = {}
        notes: tuple[Event, ...] = ()
        for record in self.records[1:]:
            tag, aux, payload = record
            if tag == Tag.OBSERVATION:
                channel = agents[aux]
                array = np.frombuffer(payload, channel.observation_dtype).reshape(channel.observation_shape)
                current.observations[channel.id] = array
            elif tag == Tag.ACTION:
                channel = agents[aux]
                current.actions[channel.id] = np.frombuffer(payload, channel.action_dtype).reshape(channel.action_shape)
            elif tag == Tag.ACTORS:
                self.actors.extend(decode_actors(payload))
            elif tag == Tag.ROSTER:
                roster = Roster(tuple(self.actors[number] for number in np.frombuffer(payload, "<u4").tolist()))
            elif tag == Tag.LANES:
                lanes = tuple(payload.decode().split("\n"))
            elif tag == Tag.EVENTS:
                events = json.loads(payload)
            elif tag == Tag.HEIGHTS:
                heights = np.frombuffer(payload, "<f8").tolist()
            elif tag == Tag.SPINES:
                spines = decode_spines(payload)
            elif tag == Tag.NOTES:
                notes = tuple(Event.from_json(note) for note in json.loads(payload))
            elif tag == Tag.STEP:
                step, time_s = _STEP_HEAD.unpack_from(payload)
                rewards = np.frombuffer(payload, "<f8", len(agents), _STEP_HEAD.size)
                data = np.frombuffer(payload, "<f8", offset=_STEP_HEAD.size + 8 * len(agents))
                count = len(roster)
                if step != len(self.all_steps) or len(data) != 4 * count:
                    raise ValueError(f"step {step} follows {len(self.all_steps) - 1}")
                contacts = tuple(Contact(*entry) for entry in events.get("contacts", ()))
                off_road = tuple(events.get("off_road", ()))
                current.step = step
                values = data.tolist()
                points = list(zip(values[: 2 * count : 2], values[1 : 2 * count : 2], strict=True))
                headings, speeds = values[2 * count : 3 * count], values[3 * count :]
                if len(heights) not in (0, 2 * count) or any(row >= count for row in spines):
                    raise ValueError(f"step {step} is about more actors than there are")
                current.scene = Scene(
                    time_s, roster, points, headings, speeds, contacts, off_road, lanes,
                    heights[:count], heights[count:], spines,
                )  # fmt: skip
                current.scene.events = notes
                current.scene.previous = self.all_steps[-1].scene if self.all_steps else None
                current.rewards = {agent.id: float(reward) for agent, reward in zip(agents, rewards, strict=True)}
                self.all_steps.append(current)
                current, lanes, events, notes = StepRecord(step + 1), (), {}, ()
                heights, spines = [], {}
        if current.observations or current.actions:
            self.all_steps.append(current)


def digest_of(*records: bytes | memoryview) -> str:
    """Return the trace digest of encoded records: BLAKE2b of 16 bytes, in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    for part in records:
        digest.update(part)
    return digest.hexdigest()
