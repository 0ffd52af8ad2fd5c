"""Data of SUMO's network that readers of observations need, each read once."""

from __future__ import annotations

from libsumo import _libsumo as sumo


class RoadNetwork:
    """The lanes of a network; data are read from libsumo when they are used for the first time, and then kept."""

    def __init__(self) -> None:
        self._successors: dict[str, tuple[str, ...]] = {}
        self._lengths: dict[str, float] = {}

    def successors(self, lane: str) -> tuple[str, ...]:
        """Return the lanes that a lane leads into, inside junctions included."""
        found = self._successors.get(lane)
        if found is None:
            links = sumo.lane_getLinks(lane) if lane else ()
            found = self._successors[lane] = tuple(dict.fromkeys(via or to for to, _, _, _, via, *_ in links))
        return found

    def length(self, lane: str) -> float:
        """Return the length of a lane, in m."""
        found = self._lengths.get(lane)
        if found is None:
            found = self._lengths[lane] = float(sumo.lane_getLength(lane))
        return found
