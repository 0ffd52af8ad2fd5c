"""Who has to give way to whom at junctions, as the map says it."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Link", "RightOfWay"]


@dataclass(frozen=True, slots=True)
class Link:
    """A way across a junction, from a lane that leads to it to one that leads away.

    Args:
        junction: its name.
        source: the lane from which it comes.
        target: the lane to which it leads.
        inside: the lanes inside the junction.
        signalised: whether a traffic light says when.
        shape: the centre line inside the junction, as (x, y) pairs in m.
    """

    junction: str
    source: str
    target: str
    inside: tuple[str, ...]
    signalised: bool
    shape: tuple[tuple[float, float], ...]

    def distance(self, x: float, y: float) -> float:
        """How far a point is from it, in m."""
        found = math.inf
        for (x0, y0), (x1, y1) in zip(self.shape, self.shape[1:], strict=False):
            dx, dy = x1 - x0, y1 - y0
            along = dx * dx + dy * dy
            share = min(1.0, max(0.0, ((x - x0) * dx + (y - y0) * dy) / along)) if along else 0.0
            found = min(found, math.hypot(x - x0 - share * dx, y - y0 - share * dy))
        return found


@dataclass(frozen=True, slots=True)
class RightOfWay:
    """The ways across all junctions of a map.

    Args:
        links: all of them.
        gives_way: pairs of places in ``links``: the first has to give way to the second.
    """

    links: tuple[Link, ...]
    gives_way: frozenset[tuple[int, int]]

    def places(self, lanes: tuple[str, ...], x: float, y: float) -> tuple[int, ...]:
        """Return the places of the links that an actor may be on, or has just been on.

        Args:
            lanes: on which it was, in this order; the same lane may come again.
            x: where it is, in m.
            y: likewise.
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
