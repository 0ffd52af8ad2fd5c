"""Positions over time as arrays: the path of one agent, and the paths of all actors that came near it."""

from __future__ import annotations

import base64
import json
import math
import zlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from crashhunt.base.codec import JsonObject, Serializable
from crashhunt.world._geometry import levels, outlines
from crashhunt.world._scene import Actor, Frame, Scene, Spine, core_of, part_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]


_APART_S = 0.3  # lower bound between samples: actors move little in that time, and every sample costs time
_AT_MOST_S = 0.3  # longer steps get samples between two scenes


def spacing_s(step_length_s: float) -> float:
    """Return the time between samples, in s."""
    return _every(step_length_s) * step_length_s / _between_steps(step_length_s)


def _every(step_length_s: float) -> int:
    """Return the stride between sampled steps; it is above 1 if steps are short."""
    return max(1, round(_APART_S / step_length_s))


def _between_steps(step_length_s: float) -> int:
    """Return the number of samples per step; it is above 1 if steps are long."""
    return max(1, math.ceil(step_length_s / _AT_MOST_S - 1e-9))


class Track(NamedTuple):
    """The path of an agent as arrays, each of shape (samples,)."""

    time: Array  # time in s since the first scene
    x: Array  # x of the centre of the outline, in m
    y: Array  # y of the centre of the outline, in m
    heading: Array  # heading in rad, without jumps by whole turns
    z: Array  # z of the front bumper, in m
    half_length: Array  # half the length of the agent, in m
    half_width: Array  # half the width of the agent, in m
    height: Array  # height of the agent, in m


class Others(NamedTuple):
    """The actors near an agent as arrays, each of shape (pairs,); all further fields are as in `Track`."""

    sample: NDArray[np.intp]  # index of the sample in the track
    who: NDArray[np.intp]  # number of the actor, as assigned by `tracks`
    x: Array
    y: Array
    heading: Array
    z: Array
    half_length: Array
    half_width: Array
    height: Array


def sampled(frames: Sequence[Frame], step_length_s: float) -> Iterator[tuple[Frame, Array]]:
    """Yield the sampled scenes and the times of their rows, in s; if steps are short, some scenes are skipped."""
    every, step = _every(step_length_s), 0
    for frame in frames:
        steps = np.arange(step, step + len(frame.columns))
        step += len(steps)
        rows = np.flatnonzero(steps % every == 0)
        if len(rows):
            spines = tuple(frame.spines[row] for row in rows) if frame.spines is not None else None
            heights = frame.heights[rows] if frame.heights is not None else None
            part = frame._replace(columns=frame.columns[rows], heights=heights, spines=spines)
            instants: Array = steps[rows].astype(float) * step_length_s
            yield part, instants


class Reach(NamedTuple):
    """The part of an agent's path in which other actors matter; actors that do not touch this part are irrelevant."""

    ahead: float = 0.0  # length of the relevant part ahead along the path, in m; 0 if all actors matter
    behind: float = 0.0  # length of the relevant part backwards along the path, in m
    unknown: float = 0.0  # length by which the path is continued straight at its end, in m


def ways(
    frames: Sequence[Frame], agent: str, within_m: float, step_length_s: float, reach: Reach | None = None
) -> tuple[Track, Others, list[str]] | None:
    """Return the result of `tracks` for times that are `spacing_s` apart, computed by the core if possible.

    If steps are long, samples between two scenes are interpolated along straight lines.

    Args:
        frames: frames of an episode.
        agent: identifier of the controlled vehicle.
        within_m: maximum distance, as for `tracks`.
        step_length_s: step length in s.
        reach: part of the path that matters; if given, the core may skip irrelevant actors, and returns no numbers of
            actors.
    """
    between = _between_steps(step_length_s)
    if between > 1:
        reach = None  # an actor off the agent's way in two scenes may be on it in between
    seen = _fronts_from_core(frames, agent, within_m, step_length_s, reach)
    seen = seen or _fronts(list(sampled(frames, step_length_s)), agent, within_m)
    if not len(seen.time):
        return None
    if between > 1:
        seen = _filled(seen, between, step_length_s)
    return _track(seen.time, seen.own), _others(seen.theirs), seen.names


def tracks(parts: Sequence[tuple[Frame, Array]], agent: str, within_m: float) -> tuple[Track, Others, list[str]] | None:
    """Return the path of an agent, the paths of the actors that came within a distance of it, and their names.

    Args:
        parts: the sampled scenes, as yielded by `sampled`.
        agent: identifier of the controlled vehicle.
        within_m: maximum distance between centres, in m; actors slightly further away may be included.

    Returns:
        The paths and the names; None if no scene contains the agent.
    """
    seen = _fronts(parts, agent, within_m)
    return (_track(seen.time, seen.own), _others(seen.theirs), seen.names) if len(seen.time) else None


class _Fronts(NamedTuple):
    """The data of tracks, with front bumpers instead of centres."""

    time: Array  # time in s, shape (samples,)
    own: Array  # shape (7, samples): x, y, heading, z, half the length and the width, and height of the agent
    # sample, actor number, and the same seven values of each near actor, each of shape (pairs,)
    theirs: Sequence[NDArray[Any]]
    names: list[str]  # names of the numbered actors


def _fronts_from_core(
    frames: Sequence[Frame], agent: str, within_m: float, step_length_s: float, reach: Reach | None
) -> _Fronts | None:
    core = core_of(frames)
    if core is None:
        return None
    numbers: dict[str, int] = {}
    every, step = _every(step_length_s), 0
    parts = []
    for frame in frames:
        whose = None
        after = step + len(frame.columns)
        # Only where the agent has a sample; actor numbers are undefined where a reach is given.
        if reach is None and agent in frame.roster.index and -(-step // every) * every < after:
            whose = [numbers.setdefault(actor.id, len(numbers)) for actor in frame.roster.actors]
        parts.append(part_of(frame, agent, whose))
        step = after
    found = core.tracks(parts, every, within_m, *(reach or Reach()))
    if found is None:
        return None
    (own, steps), (theirs, pairs) = found
    if not steps:
        return _NO_FRONTS
    x, y, heading, *half = np.frombuffer(own).reshape(5, -1)
    flat = np.zeros(len(x))
    tall = np.full(len(x), next(one.height for frame in frames for one in frame.roster.actors if one.id == agent))
    time = np.frombuffer(steps, np.int64).astype(float) * step_length_s
    mine = np.array([x, y, heading, flat, *half, tall])
    sample, who = np.frombuffer(pairs, np.int64).reshape(2, -1)
    other_x, other_y, other_heading, *other_half = np.frombuffer(theirs).reshape(5, -1)
    z = np.zeros(len(sample))
    return _Fronts(
        time=time,
        own=mine,
        theirs=[sample, who, other_x, other_y, other_heading, z, *other_half, z],
        names=list(numbers),
    )


def _fronts(parts: Sequence[tuple[Frame, Array]], agent: str, within_m: float) -> _Fronts:
    numbers: dict[str, int] = {}
    times: list[Array] = []
    own: list[Array] = []
    theirs: list[tuple[Any, ...]] = []
    first = 0
    for frame, instants in parts:
        row = frame.roster.index.get(agent)
        if row is None:
            continue
        names = np.array([numbers.setdefault(actor.id, len(numbers)) for actor in frame.roster.actors])
        mine, near = (_straight if frame.spines is None else _bent)(frame, row, names, within_m)
        times.append(instants)
        own.append(mine)
        theirs.append((near[0] + first, *near[1:]))
        first += len(instants)
    if not times:
        return _NO_FRONTS
    columns = [np.concatenate(column) for column in zip(*theirs, strict=True)]
    return _Fronts(time=np.concatenate(times), own=np.concatenate(own, axis=1), theirs=columns, names=list(numbers))


_NO_FRONTS = _Fronts(time=np.zeros(0), own=np.zeros((7, 0)), theirs=[np.zeros(0)] * 9, names=[])


def _filled(seen: _Fronts, between: int, step_length_s: float) -> _Fronts:
    """Return fronts with further samples between two scenes, on a straight line for each actor in both scenes."""
    time, own, theirs, names = seen
    joined = np.diff(time) < 1.5 * step_length_s  # the agent may have been absent for some steps
    size = np.append(np.where(joined, between, 1), 1)
    first = np.cumsum(size) - size
    share = np.arange(1, between) / between
    whole = np.empty((len(own) + 1, int(size.sum())))
    whole[:, first] = np.vstack((time, own))
    start = np.flatnonzero(joined)
    whole[:, (first[start, None] + np.arange(1, between)).ravel()] = _between(
        whole[:, first], start, start + 1, share, 3
    )
    # Each part of a long vehicle in a bend counts, from front to back; missing parts are equal to the last one.
    sample, who, *_ = theirs
    order = np.lexsort((sample, who))
    pairs = np.array([np.asarray(column, float)[order] for column in theirs])
    begins = np.flatnonzero(np.append(True, (np.diff(pairs[0]) != 0) | (np.diff(pairs[1]) != 0))[: len(order)])
    parts = np.diff(np.append(begins, len(order)))
    here = np.flatnonzero((np.diff(pairs[1, begins]) == 0) & (np.diff(pairs[0, begins]) == 1))
    here = here[joined[pairs[0, begins[here]].astype(int)]]
    most = np.maximum(parts[here], parts[here + 1])
    part = np.arange(most.sum()) - np.repeat(np.cumsum(most) - most, most)
    here = np.repeat(here, most)
    old, new = (begins[at] + np.minimum(part, parts[at] - 1) for at in (here, here + 1))
    put_in = _between(pairs, old, new, share, 4)
    put_in[0] = (first[pairs[0, old].astype(int), None] + np.arange(1, between)).ravel()
    pairs[0] = first[pairs[0].astype(int)]
    return _Fronts(time=whole[0], own=whole[1:], theirs=list(np.hstack((pairs, put_in))), names=names)


def _between(columns: Array, old: NDArray[np.intp], new: NDArray[np.intp], share: Array, heading: int) -> Array:
    """Interpolate between two sets of columns, once for each share of the step; headings are interpolated as angles."""
    before, after = columns[:, old, None], columns[:, new, None].copy()
    turned = after[heading] - before[heading]
    after[heading] -= math.tau * np.round(turned / math.tau)  # the short way round
    found: Array = (before * (1 - share) + after * share).reshape(len(columns), -1)
    return found


def _track(time: Array, fronts: Array) -> Track:
    x, y, heading, z, *sizes = fronts
    forward = np.cos(heading), np.sin(heading)
    return Track(time, x - sizes[0] * forward[0], y - sizes[0] * forward[1], np.unwrap(heading), z, *sizes)


def _others(fronts: Sequence[NDArray[Any]]) -> Others:
    sample, who, x, y, heading, z, *sizes = fronts
    x, y = x - sizes[0] * np.cos(heading), y - sizes[0] * np.sin(heading)
    return Others(sample.astype(np.intp), who.astype(np.intp), x, y, heading, z, *sizes)


def _straight(frame: Frame, row: int, names: NDArray[np.intp], within_m: float) -> tuple[Array, tuple[Any, ...]]:
    """Return the agent and the actors near it, by their fronts."""
    roster, columns, count = frame.roster, frame.columns, len(frame.roster)
    half = roster.half_sizes
    places = columns[:, : 2 * count].reshape(-1, count, 2)
    apart = places - places[:, row : row + 1]
    apart *= apart
    reach = within_m + 2 * half[:, 0] + 2 * half[row, 0]
    near = apart[:, :, 0] + apart[:, :, 1] < reach * reach
    near[:, row] = False
    sample, who = np.nonzero(near)
    rows = len(columns)
    own = np.zeros((7, rows))
    own[0], own[1] = places[:, row, 0], places[:, row, 1]
    own[2] = columns[:, 2 * count + row]
    own[4], own[5] = half[row]
    own[6] = roster.actors[row].height
    z = np.zeros(len(sample))
    tall = z
    if frame.heights is not None:
        own[3], z = frame.heights[:, row], frame.heights[sample, who]
        tall = np.array([actor.height for actor in roster.actors])[who]
    at = places[sample, who]
    size = half[who]
    return own, (sample, names[who], at[:, 0], at[:, 1], columns[sample, 2 * count + who], z, size[:, 0], size[:, 1],
                 tall)  # fmt: skip


def _bent(frame: Frame, row: int, names: NDArray[np.intp], within_m: float) -> tuple[Array, tuple[Any, ...]]:
    """Return the same for articulated vehicles in bends: each part counts as an actor, of the agent only the first."""
    own: list[tuple[float, ...]] = []
    theirs: list[tuple[float, ...]] = []
    for sample in range(len(frame.columns)):
        scene = frame.scene(sample)
        for who in range(len(frame.roster)):
            tall = frame.roster.actors[who].height
            for (x, y, heading, length, width), (z, _) in zip(outlines(scene, who), levels(scene, who), strict=True):
                found = x, y, heading, z, length / 2, width / 2, tall
                if who != row:
                    theirs.append((sample, names[who], *found))
                elif len(own) == sample:
                    own.append(found)
    mine, rest = np.array(own).T, np.array(theirs).reshape(-1, 9).T
    at = rest[0].astype(int)
    near = np.hypot(rest[2] - mine[0, at], rest[3] - mine[1, at]) < within_m + 2 * rest[6] + 2 * mine[4, at]
    return mine, tuple(rest[:, near])


# Recorded ways of actors: pose and speed at each step, and size.

_MOST_BYTES = 1 << 28  # of unpacked data: more is damage or an attack, not a recording


class ActorState(NamedTuple):
    """The state of an actor after a step."""

    x: float  # x of the centre of the front bumper, in m
    y: float  # y of the centre of the front bumper, in m
    heading: float  # heading in rad, counter-clockwise from the x axis
    speed: float  # speed in m/s
    z: float = 0.0  # z of the front bumper, in m; 0 if the map is flat
    grade: float = 0.0  # rise of the road per metre


@dataclass(frozen=True, slots=True)
class Path:
    """The path of an actor while it was visible; an actor that returns has several paths."""

    actor: Actor  # id, kind and size of the actor
    first: int  # the step after which the actor was first visible; 0 is before the first step
    states: tuple[ActorState, ...]  # states after this step and after each following step
    # lanes of the actor as (step, lane), after the steps for which they were recorded
    lanes: tuple[tuple[int, str], ...] = ()
    spines: tuple[tuple[int, Spine], ...] = ()  # the centre lines of a long vehicle in bends, as (step, centre line)

    @property
    def last(self) -> int:
        """The step after which the actor was last visible."""
        return self.first + len(self.states) - 1

    def at(self, step: int, step_length_s: float) -> ActorState:
        """Return the state of the actor after a step; after the last step, it continues straight at constant speed."""
        state = self.states[min(step, self.last) - self.first]
        if step <= self.last:
            return state
        away = state.speed * (step - self.last) * step_length_s
        return state._replace(x=state.x + away * math.cos(state.heading), y=state.y + away * math.sin(state.heading))

    def cut(self, begin: int, end: int) -> Path | None:
        """Return the part of the path from after step ``begin`` to after step ``end``; None if this part is empty."""
        first, last = max(self.first, begin), min(self.last, end)
        if first > last:
            return None
        before = [lane for step, lane in self.lanes if step <= first][-1:]
        return Path(
            actor=self.actor,
            first=first - begin,
            states=self.states[first - self.first : last - self.first + 1],
            lanes=(
                *((first - begin, lane) for lane in before),
                *((step - begin, lane) for step, lane in self.lanes if first < step <= last),
            ),
            spines=tuple((step - begin, spine) for step, spine in self.spines if first <= step <= last),
        )


@dataclass(frozen=True, slots=True)
class Paths(Serializable):
    """The recorded paths of several actors."""

    time_s: float  # simulation time before the first step, in s
    steps: int  # number of steps; there is one more state, the state before the first step
    agents: tuple[Path, ...]  # paths of the controlled vehicles
    others: tuple[Path, ...]  # paths of all other actors, in the order of their appearance

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the other actors, each name once."""
        return tuple(dict.fromkeys(path.actor.id for path in self.others))

    def only(self, names: Collection[str]) -> Paths:
        """Return the paths reduced to the named other actors."""
        return replace(self, others=tuple(path for path in self.others if path.actor.id in names))

    def driven_by(self, agents: Collection[str]) -> Paths:
        """Return the paths with only the named agents as agents; all other agents count as other actors."""
        more = tuple(path for path in self.agents if path.actor.id not in agents)
        left = tuple(path for path in self.agents if path.actor.id in agents)
        return replace(self, agents=left, others=(*more, *self.others))

    def cut(self, begin: int, end: int, step_length_s: float) -> Paths:
        """Return the paths from after step ``begin`` to after step ``end``, with steps counted from ``begin``."""
        parts = [[part for path in some if (part := path.cut(begin, end))] for some in (self.agents, self.others)]
        time_s = self.time_s + begin * step_length_s
        return Paths(time_s=time_s, steps=min(end, self.steps) - begin, agents=tuple(parts[0]), others=tuple(parts[1]))

    def placing(self) -> Paths:
        """Return the paths, reduced to the first states of the agents."""
        starts = (replace(path, states=path.states[:1], lanes=path.lanes[:1], spines=()) for path in self.agents)
        return replace(self, agents=tuple(starts))

    def to_json(self) -> JsonObject:
        """Return the paths as data for JSON: a readable summary, and exact numbers in compressed form."""
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
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild paths from the data of `to_json`.

        Raises:
            ValueError: the data are damaged.
        """
        try:
            unpacking = zlib.decompressobj()
            text = unpacking.decompress(base64.b64decode(data["packed"], validate=True), _MOST_BYTES)
            agents, others = ([_path(*plain) for plain in some] for some in json.loads(text))
            return cls(float(data["time_s"]), int(data["steps"]), tuple(agents), tuple(others))
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, zlib.error, RecursionError) as error:
            raise ValueError(f"recorded paths are damaged: {error}") from None


def paths_of(scenes: Sequence[Scene], agents: Collection[str]) -> Paths:
    """Return the paths of all actors in consecutive scenes; the path of another actor is interrupted where it parks."""
    found: list[_Open] = []
    current: dict[str, _Open] = {}
    for step, scene in enumerate(scenes):
        present: dict[str, _Open] = {}
        for row, actor in enumerate(scene.roster.actors):
            if actor.parked and actor.id not in agents:
                continue
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
    return Paths(
        time_s=scenes[0].time_s if scenes else 0.0,
        steps=max(0, len(scenes) - 1),
        agents=tuple(mine),
        others=tuple(others),
    )


class _Open:
    """The path of an actor that is still visible."""

    def __init__(self, actor: Actor, first: int) -> None:
        self._actor, self._first = actor, first
        self._states: list[ActorState] = []
        self._lanes: list[tuple[int, str]] = []
        self._spines: list[tuple[int, Spine]] = []

    def add(self, scene: Scene, row: int, step: int) -> None:
        x, y = scene.points[row]
        high = (float(scene.heights[row]), float(scene.grades[row])) if scene.heights else (0.0, 0.0)
        self._states.append(ActorState(float(x), float(y), float(scene.headings[row]), float(scene.speeds[row]), *high))
        if scene.lanes:
            self._lanes.append((step, scene.lanes[row]))
        if row in scene.spines:
            self._spines.append((step, tuple(tuple(map(float, point)) for point in scene.spines[row])))  # type: ignore[misc]

    def path(self) -> Path:
        return Path(
            actor=self._actor,
            first=self._first,
            states=tuple(self._states),
            lanes=tuple(self._lanes),
            spines=tuple(self._spines),
        )


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
    length, width, height = (*map(float, size), 0.0)[:3]
    actor = Actor(id=str(name), kind=str(kind), length=length, width=width, height=height)
    centre_lines = tuple((int(step), tuple(tuple(map(float, point)) for point in line)) for step, line in spines)
    where = tuple((int(step), str(lane)) for step, lane in lanes)
    seen = tuple(ActorState(*map(float, state)) for state in states)
    if not seen:
        raise ValueError(f"{name} is nowhere")
    return Path(actor=actor, first=int(first), states=seen, lanes=where, spines=centre_lines)  # type: ignore[arg-type]
