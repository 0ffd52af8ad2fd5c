"""Traffic events that are relevant to a traffic engineer even without a crash."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base.codec import OMIT_DEFAULT, Serializable, null_is

if TYPE_CHECKING:
    from collections.abc import Mapping


EVENT_WORDS = {
    "red_light": ("red light run", "red lights run"),
    "wrong_way": ("wrong-way drive", "wrong-way drives"),
    "off_route": ("route missed", "routes missed"),
    "stop_missed": ("scheduled stop missed", "scheduled stops missed"),
    "not_moving": ("long standstill", "long standstills"),
    "others_collided": ("collision of others", "collisions of others"),
    "hard_braking": ("hard braking of another", "hard brakings of others"),
    "teleport": ("teleport", "teleports"),
    "stop_sign": ("stop sign run", "stop signs run"),
    "kerb": ("drive over a kerb", "drives over a kerb"),
}
"""Each kind, in words: of one and of several."""

LIMITS: Mapping[str, tuple[float, str]] = {"not_moving": (60.0, "s"), "hard_braking": (math.nan, "m/s²")}
"""The event types with a limit, written ``KIND:LIMIT``: the default limit and its unit. NaN means the ``decel`` of the
braking vehicle's own type."""


@dataclass(frozen=True, slots=True)
class Event(Serializable):
    """An event in the traffic around a controlled vehicle.

    Args:
        kind: one of `EVENT_WORDS`.
        agent: the controlled vehicle that caused the event, or that was nearest to it.
        what: description of the event, as a clause such as ``ego ran the red light 'c'``.
        others: the other vehicles that took part.
        lane: lane of the controlled vehicle.
        x: x of the front bumper of the controlled vehicle, in m.
        y: y of the front bumper of the controlled vehicle, in m.
        speed: speed of the controlled vehicle, in m/s.
        name: name of the violated requirement; empty for other events.
        details: the parts of the requirement that are violated, one line each; empty for other events.
    """

    kind: str
    agent: str
    what: str
    others: tuple[str, ...] = ()
    lane: str = ""
    x: float = field(default=math.nan, metadata=null_is(math.nan))
    y: float = field(default=math.nan, metadata=null_is(math.nan))
    speed: float = field(default=math.nan, metadata=null_is(math.nan))
    name: str = field(default="", metadata=OMIT_DEFAULT)
    details: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)

    def __eq__(self, other: object) -> bool:
        return self.equals(other)

    @property
    def label(self) -> str:
        """The kind of the event, and the name of a violated requirement."""
        return self.kind if self.name in ("", self.kind) else f"{self.kind} {self.name}"


def event_counts(counts: Mapping[str, int]) -> str:
    """Return the number of events of each kind as text, such as ``2 red lights run, 1 teleport``."""
    return ", ".join(
        f"{count} {EVENT_WORDS.get(kind, (kind, kind))[count != 1]}" for kind, count in counts.items() if count
    )


# Right of way at junctions, from the map.


@dataclass(frozen=True, slots=True)
class Link:
    """A path across a junction, from an incoming lane to an outgoing lane."""

    junction: str  # name of the junction
    source: str  # the incoming lane
    target: str  # the outgoing lane
    inside: tuple[str, ...]  # the lanes inside the junction
    signalised: bool  # whether a traffic light controls the path
    shape: tuple[tuple[float, float], ...]  # the centre line inside the junction, as (x, y) pairs in m

    def distance(self, x: float, y: float) -> float:
        """Return the distance of a point from the path, in m."""
        found = math.inf
        for (x0, y0), (x1, y1) in zip(self.shape, self.shape[1:], strict=False):
            dx, dy = x1 - x0, y1 - y0
            along = dx * dx + dy * dy
            share = min(1.0, max(0.0, ((x - x0) * dx + (y - y0) * dy) / along)) if along else 0.0
            found = min(found, math.hypot(x - x0 - share * dx, y - y0 - share * dy))
        return found


@dataclass(frozen=True, slots=True)
class RightOfWay:
    """The paths across all junctions of a map, and which path must yield to which."""

    links: tuple[Link, ...]
    gives_way: frozenset[tuple[int, int]]  # indices of links: the first must yield to the second

    def places(self, lanes: tuple[str, ...], x: float, y: float) -> tuple[int, ...]:
        """Return the indices of the links on which an actor may be, or which it may just have left.

        The lanes are in order, and a lane may occur several times. The point is that of the actor's front bumper, in m.
        """
        for back in range(len(lanes) - 1, -1, -1):
            lane, later = lanes[back], lanes[back + 1 :]
            through = [place for place, link in enumerate(self.links) if lane in link.inside]
            if through:
                return tuple(through)
            leaving = [
                place
                for place, link in enumerate(self.links)
                if link.source == lane and all(one in (lane, link.target) for one in later)
            ]
            if leaving and (later or self._is_near(leaving, x, y)):
                if later and any(one != lane for one in later):
                    return tuple(place for place in leaving if self.links[place].target in later)
                return tuple(place for place in leaving if self.links[place].distance(x, y) < _ON_IT_M)
        return ()

    def _is_near(self, places: list[int], x: float, y: float) -> bool:
        return any(self.links[place].distance(x, y) < _ON_IT_M for place in places)


_ON_IT_M = 1.5
