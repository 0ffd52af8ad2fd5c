"""The relation of other actors to a vehicle, by their lanes: ahead on its path, left, right, oncoming or crossing."""

from __future__ import annotations

from math import cos
from typing import TYPE_CHECKING, NamedTuple

from libsumo import _libsumo as sumo

from crashhunt.sumo._drivable_area import offset_from

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from crashhunt.sumo._conflicts import Conflicts
    from crashhunt.sumo._lane_graph import GraphLane, LaneGraph, LaneLink

_MAX_MEDIAN_M = 5.0  # between the two directions of a road
_AGAINST_COS = -0.5  # of the angle between a lane and a vehicle that drives against it
_TURNAROUND = "t"
_LEFT, _SAME, _RIGHT = 1, 0, -1


class PathAhead:
    """The lanes that a vehicle's route continues to, and whether other lanes lead into the vehicle's lane."""

    def __init__(self, vehicle: str, graph: LaneGraph, reach_m: float) -> None:
        self._vehicle, self._graph, self._reach_m = vehicle, graph, reach_m
        self._paths: dict[tuple[str, int, str], frozenset[str]] = {}
        self._entered: dict[str, dict[str, bool]] = {}  # by the vehicle's lane, and the other lane
        self.key = "", 0, ""
        """The vehicle's lane and the place on its route, which determine the path."""
        self.lanes: frozenset[str] = frozenset()
        """The vehicle's lane, and the lanes that its route continues to."""

    def update(self, lane: str) -> PathAhead:
        """Set the vehicle's lane after the last step."""
        key = lane, sumo.vehicle_getRouteIndex(self._vehicle), sumo.vehicle_getRouteID(self._vehicle)
        found = self._paths.get(key)
        if found is None:
            found = self._paths[key] = frozenset(self.reached(lane, on_route=True))
        self.key, self.lanes = key, found
        self._entered.setdefault(lane, {})
        return self

    def is_entered_from(self, lane: str) -> bool:
        """Return whether a lane leads into the vehicle's lane within the reach."""
        known = self._entered[self.key[0]]
        found = known.get(lane)
        if found is None:
            found = known[lane] = self.key[0] in self.reached(lane)
        return found

    @property
    def facts(self) -> tuple[frozenset[str], Callable[[str], bool]]:
        """The lanes that the route continues to, and `is_entered_from`."""
        return self.lanes, self.is_entered_from

    def reached(self, lane: str, *, on_route: bool = False) -> set[str]:
        """Return the lanes that can be reached from a lane within the reach, also on the rest of the route only."""
        edges = None
        if on_route:
            edges = frozenset(sumo.vehicle_getRoute(self._vehicle)[max(sumo.vehicle_getRouteIndex(self._vehicle), 0) :])
        waiting, reached = [(lane, 0.0)], {lane}
        while waiting:
            current, done = waiting.pop()
            for to in self._graph.successors(current) if done <= self._reach_m else ():
                if to in reached or (edges is not None and not self._stays_on(to, edges)):
                    continue
                reached.add(to)
                waiting.append((to, done + self._graph.length(to)))
        return reached

    def _stays_on(self, lane: str, edges: frozenset[str]) -> bool:
        """Return whether a lane belongs to one of the edges, or leads to one of them inside a junction."""
        if not lane.startswith(":"):
            return lane.rpartition("_")[0] in edges
        return any(self._stays_on(to, edges) for to in self._graph.successors(lane))


class _Around(NamedTuple):
    """The lanes around a vehicle, by their relation to it."""

    # `_LEFT`, `_SAME` or `_RIGHT` of the lanes of the road, and of those that the route continues to
    sides: Mapping[str, int]
    opposite: frozenset[str]  # the lanes in the opposite direction
    # the lanes on paths that conflict with the vehicle's path at a junction, and the lanes before them
    crossing: frozenset[str]
    # the side that another lane leads to, or None. A lane is added when it is asked for.
    leading: dict[str, int | None]


class Relations:
    """Finds the relation of actors to a vehicle in one episode."""

    def __init__(self, path: PathAhead, graph: LaneGraph, conflicts: Conflicts, reach_m: float) -> None:
        self._path, self._graph, self._conflicts, self._reach_m = path, graph, conflicts, reach_m
        self._known: dict[tuple[str, int, str], _Around] = {}
        self._around = _Around(sides={}, opposite=frozenset(), crossing=frozenset(), leading={})
        self._is_along_lane = True

    def update(self, x: float, y: float, heading: float) -> None:
        """Set the pose of the vehicle after the last step, after its path is set."""
        lane = self._path.key[0]
        if self._path.key not in self._known and lane in self._graph.lanes:
            self._known[self._path.key] = self._found(self._graph.lanes[lane])
        self._around = self._known.get(self._path.key, self._around)
        self._is_along_lane = self._is_along(lane, x, y, heading)

    def of(self, lane: str, x: float, y: float, heading: float, *, is_same: bool) -> tuple[float, float, float, float]:
        """Return the columns ``left``, ``right``, ``oncoming`` and ``crossing`` of an actor."""
        around = self._around
        is_opposite = lane in around.opposite
        side = None if is_opposite else self._side(lane)
        is_oncoming = (side is not None or is_opposite) and is_opposite == (
            self._is_along(lane, x, y, heading) == self._is_along_lane
        )
        turned = _SAME if is_same or side is None else side if self._is_along_lane else -side
        return float(turned == _LEFT), float(turned == _RIGHT), float(is_oncoming), float(lane in around.crossing)

    def _side(self, lane: str) -> int | None:
        """Return the side of a lane; None if it leads to no lane that has one, or to lanes on several sides."""
        sides, leading, lanes = self._around.sides, self._around.leading, self._graph.lanes
        if lane in sides:
            return sides[lane]
        if lane not in leading:
            found, seen, waiting = set[int](), {lane}, [(lane, 0.0)] if lane in lanes else []
            while waiting:
                current, done = waiting.pop()
                for link in lanes[current].links if done <= self._reach_m else ():
                    if hits := [sides[one] for one in (*link.inside, link.target) if one in sides]:
                        found.add(hits[0])
                    elif link.target not in seen and link.direction != _TURNAROUND:
                        seen.add(link.target)
                        waiting.append((link.target, done + link.length_m + self._graph.length(link.target)))
            leading[lane] = found.pop() if len(found) == 1 else None
        return leading[lane]

    def _is_along(self, lane: str, x: float, y: float, heading: float) -> bool:
        """Return whether a heading at a point is along a lane, and not against it.

        A vehicle that has just turned into a lane may stand across it.
        """
        found = self._graph.lanes.get(lane)
        return found is None or cos(heading - offset_from(found.data.shape, x, y)[1]) > _AGAINST_COS

    def _found(self, own: GraphLane) -> _Around:
        lanes = self._graph.lanes
        path = [lanes[one] for one in sorted(self._path.lanes) if one in lanes]
        before = {own.edge} if not own.is_internal else {lanes[one].edge for one, _ in own.entries}
        opposite = {
            lane.id
            for edge in before | {one.edge for one in path}
            for lane in self._graph.opposite(edge, _MAX_MEDIAN_M)
        }
        links = (link for lane in opposite for link in lanes[lane].links if link.target in opposite)
        inside = {one for link in links for one in link.inside}
        return _Around(
            sides=self._sides(path),
            opposite=frozenset(opposite | inside),
            crossing=frozenset(lane for link in self._links(own, path) for lane in self._conflicting(link)),
            leading={},
        )

    def _sides(self, path: list[GraphLane]) -> dict[str, int]:
        """Return the side of the lanes next to a path, and of the lanes on the route that only one side leads to."""
        sides = {lane.id: _SAME for lane in path}
        up = _RIGHT if self._graph.is_left_hand else _LEFT
        for edge in dict.fromkeys(lane.edge for lane in path):
            indices = [lane.index for lane in path if lane.edge == edge]
            for lane in self._graph.edges[edge]:
                if not min(indices) <= lane.index <= max(indices):
                    sides[lane.id] = up if lane.index > max(indices) else -up
        beyond = {
            side: {one for lane, its in sides.items() if its == side for one in self._path.reached(lane, on_route=True)}
            for side in (_LEFT, _RIGHT)
        }
        for side in beyond:
            sides.update(dict.fromkeys(beyond[side] - beyond[-side] - sides.keys(), side))
        return sides

    def _links(self, own: GraphLane, path: list[GraphLane]) -> Iterator[LaneLink]:
        """Yield the whole paths across junctions that a path takes, also the one that the vehicle is on."""
        if own.is_internal:
            yield from (link for _, link in own.entries)
        for lane in path:
            if not lane.is_internal:
                yield from (link for link in lane.links if link.target in self._path.lanes)

    def _conflicting(self, link: LaneLink) -> Iterator[str]:
        for lane, approaches in self._conflicts.around(link).items():
            if any(one.back < 0 or one.conflict.source == lane for one in approaches):
                yield lane
