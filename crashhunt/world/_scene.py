"""The state of the actors at one step, and the collisions that the simulator reports for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby, islice
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.native import Columns, Core, Part, Vehicles
    from crashhunt.world._events import Event

PERSON = "person "
"""What an id of a person begins with: vehicles and persons may have the same name, and no name has a blank."""

OBSTACLE_KINDS = ("Obstacle", "Landmark")
"""The simulators' names of actors that never move."""

Spine = tuple[tuple[float, float, float], ...]
"""The centre line of a long vehicle in a bend, as (x, y, z) in m, from the front bumper to the back."""


@dataclass(frozen=True, slots=True)
class Actor:
    """The properties of an actor that seldom change.

    Args:
        id: identifier, unique within the episode; for a person, ``person``, a space and the person's name.
        kind: class of the actor in the simulator, such as SUMO's ``passenger``, ``truck`` or ``pedestrian``.
        length: length of the actor, in m.
        width: width of the actor, in m.
        height: height of the actor, in m; 0 if the map is flat.
        parked: whether the simulator has taken the actor out of the traffic, as SUMO does next to the road. A parked
            actor touches no other actor, wherever it is drawn.
    """

    id: str
    kind: str
    length: float
    width: float
    height: float = 0.0
    parked: bool = False


@dataclass(frozen=True, slots=True)
class Contact:
    """A collision that the simulator itself reports.

    Args:
        collider: identifier of the actor that drove into the other actor.
        victim: identifier of the actor that was hit.
        kind: the type of the collision, by the simulator's name.
        lane: name of the lane on which the collision happened.
        collider_speed: speed of the collider, in m/s.
        victim_speed: speed of the victim, in m/s.
    """

    collider: str
    victim: str
    kind: str
    lane: str
    collider_speed: float
    victim_speed: float


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane of the map.

    Args:
        id: name of the lane in the simulator.
        width: width of the lane, in m.
        shape: centre line of the lane, as (x, y) pairs in m.
    """

    id: str
    width: float
    shape: tuple[tuple[float, float], ...]


class Roster:
    """The actors of a scene, in the order of its rows. A roster is shared by all steps between two changes of actors.

    Attributes:
        vehicles: the same actors in the compiled core; None if it does not know them.
    """

    vehicles: Vehicles | None = None

    def __init__(self, actors: tuple[Actor, ...]) -> None:
        self.actors = actors

    @cached_property
    def index(self) -> dict[str, int]:
        """The row of each actor, by the actor's identifier."""
        return {actor.id: row for row, actor in enumerate(self.actors)}

    @cached_property
    def half_sizes(self) -> NDArray[np.float64]:
        """Half the length and half the width of each actor, shape (n, 2), in m."""
        return np.array([(actor.length / 2, actor.width / 2) for actor in self.actors]).reshape(-1, 2)

    @cached_property
    def half_lengths(self) -> list[float]:
        """Half the length of each actor, in m."""
        return [actor.length / 2 for actor in self.actors]

    @cached_property
    def lengths(self) -> list[float]:
        """The length of each actor, in m."""
        return [actor.length for actor in self.actors]

    @cached_property
    def widths(self) -> list[float]:
        """The width of each actor, in m."""
        return [actor.width for actor in self.actors]

    @cached_property
    def reaches(self) -> list[float]:
        """The distance from the centre of each front bumper to the farthest corner of the outline, in m."""
        return [math.hypot(actor.length, actor.width / 2) for actor in self.actors]

    @cached_property
    def traffic(self) -> tuple[Roster, list[int]] | None:
        """The roster without parked actors, and the rows that it keeps; None if no actor is parked."""
        rows = [row for row, actor in enumerate(self.actors) if not actor.parked]
        return None if len(rows) == len(self.actors) else (Roster(tuple(self.actors[row] for row in rows)), rows)

    @cached_property
    def touch_distance(self) -> float:
        """The distance between front bumpers beyond which no two outlines touch, in m."""
        return 2 * max(self.reaches, default=0.0)

    def __len__(self) -> int:
        return len(self.actors)


_NO_SPINES: Mapping[int, Spine] = {}  # shared, so never written to
_NOT_COMPUTED: Any = None  # in place of what is made of the core's columns when it is asked for


class Frame(NamedTuple):
    """Consecutive scenes with the same actors, as plain columns."""

    roster: Roster  # the actors of all scenes
    # float64, shape (scenes, 4 n): x and y alternating, then all headings, then all speeds
    columns: NDArray[np.float64]
    # float64, shape (scenes, 2 n): all heights, then all grades; None if the map is flat
    heights: NDArray[np.float64] | None = None
    spines: tuple[Mapping[int, Spine], ...] | None = None  # spines of each scene; None if no long vehicle is in a bend
    core: Core | None = None  # compiled core that computes with the scene, if there is one; results are bit-identical

    def scene(self, number: int) -> Scene:
        """Return one of the scenes as a `Scene` whose time is not set."""
        count, row = len(self.roster), self.columns[number].tolist()
        points = list(zip(row[: 2 * count : 2], row[1 : 2 * count : 2], strict=True))
        heights = self.heights[number].tolist() if self.heights is not None else []
        spines = self.spines[number] if self.spines is not None else _NO_SPINES
        return Scene(
            0.0,
            self.roster,
            points,
            row[2 * count : 3 * count],
            row[3 * count :],
            heights=heights[:count],
            grades=heights[count:],
            spines=spines,
        )


def core_of(frames: Sequence[Frame]) -> Core | None:
    """Return the compiled core that all given frames have; None if a frame has no core."""
    core = frames[0].core if frames else None
    if any(frame.core is None or frame.heights is not None or frame.spines is not None for frame in frames):
        return None
    return core


def part_of(frame: Frame, agent: str, numbers: list[int] | None = None) -> Part:
    """Return a frame around an agent in the form that the core needs; ``numbers`` of actors are their rows if None."""
    roster = frame.roster
    sizes = (roster.lengths, roster.widths) if roster.vehicles is None else (roster.vehicles, None)
    return frame.columns, roster.index.get(agent, -1), *sizes, numbers


def joined_frame(
    roster: Roster, columns: NDArray[np.float64], scenes: Sequence[Scene | None], core: Core | None = None
) -> Frame:
    """Return scenes with the same roster as a frame; parked actors are excluded, because nothing can approach them.

    Args:
        roster: the roster of all scenes.
        columns: positions, headings and speeds of all scenes, as in `Frame`.
        scenes: the scenes; None if no actor has a height or is bent.
        core: the compiled core for this frame.
    """
    heights = spines = None
    has_scenes = any(scenes)
    if has_scenes and any(scene is not None and scene.heights for scene in scenes):
        flat = [0.0] * (2 * len(roster))
        rows = [[*scene.heights, *scene.grades] if scene is not None and scene.heights else flat for scene in scenes]
        heights = np.array(rows).reshape(len(scenes), 2 * len(roster))
    if has_scenes and any(scene is not None and scene.spines for scene in scenes):
        spines = tuple(scene.spines if scene is not None else _NO_SPINES for scene in scenes)
    if roster.traffic is not None:
        count, (roster, kept) = len(roster), roster.traffic
        of_points = [2 * row + side for row in kept for side in (0, 1)]
        of_values = [times * count + row for times in (2, 3) for row in kept]
        columns = np.ascontiguousarray(columns[:, np.array([*of_points, *of_values], np.intp)])
        if heights is not None:
            heights = heights[:, np.array([times * count + row for times in (0, 1) for row in kept], np.intp)]
        if spines is not None:
            spines = tuple({kept.index(row): one for row, one in each.items() if row in kept} for each in spines)
    return Frame(roster=roster, columns=columns, heights=heights, spines=spines, core=core)


_MAX_JOINED_SCENES = 256


def join_frames(scenes: Iterable[Scene]) -> Iterator[Frame]:
    """Yield scenes as frames; consecutive scenes with the same roster are in one frame, up to 256 of them."""
    for _, same in groupby(scenes, key=attrgetter("roster")):
        while run := [*islice(same, _MAX_JOINED_SCENES)]:
            columns = [[*chain.from_iterable(scene.points), *scene.headings, *scene.speeds] for scene in run]
            yield joined_frame(run[0].roster, np.array(columns).reshape(len(run), -1), run)


class Scene:
    """The state of the actors at one time.

    Args:
        time_s: simulation time, in s.
        roster: the actors, in the order of the rows.
        points: x and y of the centre of each front bumper, in m.
        headings: headings in rad, counter-clockwise from the x axis.
        speeds: speeds in m/s.
        contacts: the collisions that the simulator reports for this step.
        off_road: the controlled vehicles that left the road in this step.
        lanes: the lane of each actor; empty if the step did not read them.
        heights: z of each front bumper, in m; empty if the map is flat.
        grades: slope of the road at each actor, in m per m, positive if it rises ahead; empty if the map is flat.
        spines: centre lines of long vehicles in a bend, by row.
        swept: whether all actors have driven from the previous scene to their positions along the path that the
            headings describe. Contacts between the two scenes can then be found. A lane change of SUMO, a jump
            sideways, is at the end of the path.
        core: compiled core that computes with the scene, if there is one; results are bit-identical.
        columns: arrays of the compiled core that replace ``points``, ``headings`` and ``speeds``.

    Attributes:
        events: traffic events of this step.
        agent_lanes: the lane of each controlled vehicle, if the simulator reports it; not recorded.
        previous: the scene one step before; None at the start. The previous scene has no previous scene itself, so
            memory stays bounded.
    """

    __slots__ = (
        "_headings",
        "_neighbors",
        "_points",
        "_speeds",
        "agent_lanes",
        "columns",
        "contacts",
        "core",
        "events",
        "grades",
        "heights",
        "lanes",
        "off_road",
        "previous",
        "roster",
        "spines",
        "swept",
        "time_s",
    )

    def __init__(
        self,
        time_s: float,
        roster: Roster,
        points: Sequence[tuple[float, float]] = _NOT_COMPUTED,
        headings: Sequence[float] = _NOT_COMPUTED,
        speeds: Sequence[float] = _NOT_COMPUTED,
        contacts: tuple[Contact, ...] = (),
        off_road: tuple[str, ...] = (),
        lanes: tuple[str, ...] = (),
        heights: Sequence[float] = (),
        grades: Sequence[float] = (),
        spines: Mapping[int, Spine] = _NO_SPINES,
        *,
        swept: bool = False,
        core: Core | None = None,
        columns: Columns | None = None,
    ) -> None:
        self.time_s = time_s
        self.roster = roster
        self.columns = columns
        self._points = points
        self._headings = headings
        self._speeds = speeds
        self.contacts = contacts
        self.off_road = off_road
        self.lanes = lanes
        self.heights = heights
        self.grades = grades
        self.spines = spines
        self.swept = swept
        self.core = core
        self.events: tuple[Event, ...] = ()
        self.agent_lanes: dict[str, str] = {}
        self.previous: Scene | None = None
        self._neighbors: dict[int, list[tuple[float, int]]] = {}

    # Most steps do without these lists. No `__getattr__`: with one, every attribute of a scene takes longer.
    @property
    def points(self) -> Sequence[tuple[float, float]]:
        """The centre of each front bumper, as x and y, in m."""
        if self._points is _NOT_COMPUTED and self.columns is not None:
            self._points = self.columns.points
        return self._points

    @property
    def headings(self) -> Sequence[float]:
        """The heading of each actor, in rad, counter-clockwise from the x axis."""
        if self._headings is _NOT_COMPUTED and self.columns is not None:
            self._headings = self.columns.headings
        return self._headings

    @property
    def speeds(self) -> Sequence[float]:
        """The speed of each actor, in m/s."""
        if self._speeds is _NOT_COMPUTED and self.columns is not None:
            self._speeds = self.columns.speeds
        return self._speeds

    def speed(self, row: int) -> float:
        """Return the speed of an actor, in m/s."""
        return self.speeds[row] if self.columns is None else self.columns.speed(row)

    def follow(self, previous: Scene | None) -> None:
        """Set the scene one step before."""
        if previous is self:
            return  # a simulator that hands out the same object again
        if previous is not None:
            previous.previous = None
        self.previous = previous

    @property
    def frame(self) -> Frame:
        """The scene as plain columns."""
        flat = [value for point in self.points for value in point]
        return joined_frame(self.roster, np.array([[*flat, *self.headings, *self.speeds]]), [self])

    @property
    def data(self) -> NDArray[np.float64]:
        """The x, y, heading and speed of every actor, shape (n, 4)."""
        columns = np.empty((len(self.points), 4))
        columns[:, :2] = np.reshape(self.points, (-1, 2))
        columns[:, 2] = self.headings
        columns[:, 3] = self.speeds
        return columns

    @property
    def centers(self) -> NDArray[np.float64]:
        """The centre of each outline, shape (n, 2), in m."""
        columns = self.data
        forward = np.stack((np.cos(columns[:, 2]), np.sin(columns[:, 2])), axis=1)
        centers: NDArray[np.float64] = columns[:, :2] - self.roster.half_sizes[:, :1] * forward
        return centers

    def neighbors(self, row: int) -> list[tuple[float, int]]:
        """Return (squared distance of front bumpers in m², row) of all other actors, the nearest first."""
        found = self._neighbors.get(row)
        if found is None:
            x, y = self.points[row]
            found = [((px - x) * (px - x) + (py - y) * (py - y), other) for other, (px, py) in enumerate(self.points)]
            del found[row]
            found.sort()
            self._neighbors[row] = found
        return found


def is_person(actor: str) -> bool:
    """Return whether an actor's id is the id of a person."""
    return actor.startswith(PERSON)
