"""The ways that actors have driven, as they were recorded: who was where at each step, and of what size."""

from __future__ import annotations

import base64
import json
import math
import zlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypedDict

from crashhunt.world._scene import Actor

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from crashhunt.world._scene import Scene, Spine

__all__ = ["Path", "Paths", "PathsData", "State", "paths_of"]

_MOST_BYTES = 1 << 28  # of what was packed; nobody has recorded that much


class State(NamedTuple):
    """Where an actor was after a step.

    Args:
        x: of the centre of the front bumper, in m.
        y: likewise.
        heading: in rad, counter-clockwise from the x axis.
        speed: in m/s.
        z: of the front bumper, in m; 0 where the map is flat.
        grade: how far the road rises a metre there.
    """

    x: float
    y: float
    heading: float
    speed: float
    z: float = 0.0
    grade: float = 0.0


@dataclass(frozen=True, slots=True)
class Path:
    """The way of an actor while it was in sight; of one who came back, there are several.

    Args:
        actor: its id, kind and size.
        first: the step after which it was first seen; 0 is before the first step.
        states: after that step and each that followed.
        lanes: on which lane it was, as (step, lane), after those steps of which that was written down.
        spines: the centre line of a long vehicle in a bend, as (step, centre line).
    """

    actor: Actor
    first: int
    states: tuple[State, ...]
    lanes: tuple[tuple[int, str], ...] = ()
    spines: tuple[tuple[int, Spine], ...] = ()

    @property
    def last(self) -> int:
        """The step after which it was last seen."""
        return self.first + len(self.states) - 1

    def at(self, step: int, step_length_s: float) -> State:
        """Return where it was after a step; after its last one, straight on at an unchanged speed."""
        state = self.states[min(step, self.last) - self.first]
        if step <= self.last:
            return state
        away = state.speed * (step - self.last) * step_length_s
        return state._replace(x=state.x + away * math.cos(state.heading), y=state.y + away * math.sin(state.heading))

    def cut(self, begin: int, end: int) -> Path | None:
        """Return what there is of it after the steps ``begin`` to ``end``, counted from ``begin``; None for nothing."""
        first, last = max(self.first, begin), min(self.last, end)
        if first > last:
            return None
        before = [lane for step, lane in self.lanes if step <= first][-1:]
        return Path(
            self.actor,
            first - begin,
            self.states[first - self.first : last - self.first + 1],
            (
                *((first - begin, lane) for lane in before),
                *((step - begin, lane) for step, lane in self.lanes if first < step <= last),
            ),
            tuple((step - begin, spine) for step, spine in self.spines if first <= step <= last),
        )


class PathsData(TypedDict):
    """Of `Paths`: what a person may want to read, and the rest as compressed JSON in base64."""

    time_s: float
    steps: int
    agents: list[str]
    others: list[str]
    packed: str


@dataclass(frozen=True, slots=True)
class Paths:
    """The recorded ways of several actors.

    Args:
        time_s: simulation time before the first step, in s.
        steps: how many there are; there is a state more, that before the first.
        agents: of the controlled vehicles.
        others: of everybody else, in the order in which they came.
    """

    time_s: float
    steps: int
    agents: tuple[Path, ...]
    others: tuple[Path, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the others, each once."""
        return tuple(dict.fromkeys(path.actor.id for path in self.others))

    def only(self, names: Collection[str]) -> Paths:
        """Return them with those of the others only that are named."""
        return replace(self, others=tuple(path for path in self.others if path.actor.id in names))

    def driven_by(self, agents: Collection[str]) -> Paths:
        """Return them with those agents only that are named; the rest are among the others."""
        more = tuple(path for path in self.agents if path.actor.id not in agents)
        left = tuple(path for path in self.agents if path.actor.id in agents)
        return replace(self, agents=left, others=(*more, *self.others))

    def cut(self, begin: int, end: int, step_length_s: float) -> Paths:
        """Return what there is of them from after step ``begin`` to after step ``end``, counted from ``begin``."""
        parts = [[part for path in some if (part := path.cut(begin, end))] for some in (self.agents, self.others)]
        time_s = self.time_s + begin * step_length_s
        return Paths(time_s, min(end, self.steps) - begin, tuple(parts[0]), tuple(parts[1]))

    def placing(self) -> Paths:
        """Return them with no more of the agents' ways than where these begin."""
        starts = (replace(path, states=path.states[:1], lanes=path.lanes[:1], spines=()) for path in self.agents)
        return replace(self, agents=tuple(starts))

    def to_json(self) -> PathsData:
        """Return plain data; numbers come back as they are."""
        plain = [[_plain(path) for path in some] for some in (self.agents, self.others)]
        text = json.dumps(plain, separators=(",", ":"))
        return {
            "time_s": self.time_s,
            "steps": self.steps,
            "agents": [path.actor.id for path in self.agents],
            "others": list(self.names),
            "packed": base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii"),
        }

    @classmethod
    def from_json(cls, data: PathsData) -> Paths:
        """Rebuild what `to_json` returned.

        Raises:
            ValueError: it is something else.
        """
        try:
            unpacking = zlib.decompressobj()
            text = unpacking.decompress(base64.b64decode(data["packed"], validate=True), _MOST_BYTES)
            agents, others = ([_path(*plain) for plain in some] for some in json.loads(text))
            return cls(float(data["time_s"]), int(data["steps"]), tuple(agents), tuple(others))
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, zlib.error, RecursionError) as error:
            raise ValueError(f"recorded paths are damaged: {error}") from None


def paths_of(scenes: Sequence[Scene], agents: Collection[str]) -> Paths:
    """Return the ways of everybody in successive scenes.

    Args:
        scenes: before the first step and after each.
        agents: the ids of the controlled vehicles.
    """
    found: list[_Open] = []
    current: dict[str, _Open] = {}
    for step, scene in enumerate(scenes):
        present: dict[str, _Open] = {}
        for row, actor in enumerate(scene.roster.actors):
            way = current.get(actor.id)
            if way is None:
                way = _Open(actor, step)
                found.append(way)
            present[actor.id] = way
            way.add(scene, row, step)
        current = present
    paths = [way.path() for way in found]
    mine = [path for path in paths if path.actor.id in agents]
    others = [path for path in paths if path.actor.id not in agents]
    return Paths(scenes[0].time_s if scenes else 0.0, max(0, len(scenes) - 1), tuple(mine), tuple(others))


class _Open:
    """The way of an actor that is still in sight."""

    def __init__(self, actor: Actor, first: int) -> None:
        self._actor, self._first = actor, first
        self._states: list[State] = []
        self._lanes: list[tuple[int, str]] = []
        self._spines: list[tuple[int, Spine]] = []

    def add(self, scene: Scene, row: int, step: int) -> None:
        x, y = scene.points[row]
        high = (float(scene.heights[row]), float(scene.grades[row])) if scene.heights else (0.0, 0.0)
        self._states.append(State(float(x), float(y), float(scene.headings[row]), float(scene.speeds[row]), *high))
        if scene.lanes:
            self._lanes.append((step, scene.lanes[row]))
        if row in scene.spines:
            self._spines.append((step, tuple(tuple(map(float, point)) for point in scene.spines[row])))  # type: ignore[misc]

    def path(self) -> Path:
        return Path(self._actor, self._first, tuple(self._states), tuple(self._lanes), tuple(self._spines))


def _plain(path: Path) -> list[object]:
    actor = path.actor
    who = [actor.id, actor.kind, actor.length, actor.width, actor.height]
    is_flat = not any(state.z or state.grade for state in path.states)
    states = [state[:4] if is_flat else state for state in path.states]
    return [who, path.first, states, path.lanes, path.spines]


def _path(
    who: Sequence[str | float],
    first: int,
    states: Iterable[Iterable[float]],
    lanes: Iterable[tuple[int, str]],
    spines: Iterable[tuple[int, Iterable[Iterable[float]]]],
) -> Path:
    name, kind, *size = who
    actor = Actor(str(name), str(kind), *map(float, size))
    centre_lines = tuple((int(step), tuple(tuple(map(float, point)) for point in line)) for step, line in spines)
    where = tuple((int(step), str(lane)) for step, lane in lanes)
    seen = tuple(State(*map(float, state)) for state in states)
    if not seen:
        raise ValueError(f"{name} is nowhere")
    return Path(actor, int(first), seen, where, centre_lines)  # type: ignore[arg-type]
