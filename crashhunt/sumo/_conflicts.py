"""Where paths across a junction conflict, and which vehicle has to yield there."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.sumo._lane_graph import MAX_PREPARING_S

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from crashhunt.sumo._lane_graph import GraphLane, LaneGraph, LaneLink

    Line = NDArray[np.float64]

_UPSTREAM_M = 150.0  # actors further away are out of sight
_CLOSE_SHARE = 0.8  # of the mean width of two lanes, which lets neighbouring lanes pass
_STEP_M = 0.25  # between two points of a path; areas end between points


class Conflict(NamedTuple):
    """A path across a junction that conflicts with the vehicle's path.

    The conflict area is where the two centre lines are closer than 80 % of the mean width of the lanes.
    """

    must_yield: bool  # whether the rules of the junction make the vehicle yield to the path
    begin_m: float  # distance on the vehicle's path from the stop line to the conflict area, in m
    end_m: float  # distance on the vehicle's path from the stop line to the end of the conflict area, in m
    other_begin_m: float  # distance on the other path from its stop line to the conflict area, in m
    other_end_m: float  # distance on the other path to the end of the conflict area, in m
    source: str  # the lane before the other path; empty for a crossing
    link: LaneLink | None  # the other path; None for a crossing, which persons use in both directions


class ConflictApproach(NamedTuple):
    """A lane on which an actor can be that takes a conflicting path."""

    conflict: Conflict
    offset_m: float  # distance from the stop line of the path to the start of the lane, in m; negative before the line
    edges: tuple[str, str]  # the edges that must follow each other in the actor's route
    back: int  # how many places the edge of the lane is behind the first of these edges; -1 inside the junction


class Conflicts:
    """The conflicts at all junctions of a network, computed when they are used for the first time."""

    def __init__(self, graph: LaneGraph) -> None:
        self._graph = graph
        self._rules = {lane: (one, index) for one in graph.rules.values() for index, lane in enumerate(one.inside)}
        self._found: dict[str, dict[str, list[ConflictApproach]]] = {}

    def prepare(self) -> None:
        """Find the conflicts of all paths, so that trials in forks of this process need not; in a limited time."""
        end = time.process_time() + MAX_PREPARING_S
        for lane in self._graph.lanes.values():
            for link in () if lane.is_internal else lane.links:
                if time.process_time() > end:
                    return
                self.around(link)

    def around(self, link: LaneLink) -> dict[str, list[ConflictApproach]]:
        """Return the lanes from which actors come into conflict with a path, by id; the path begins at its stop line.

        Args:
            link: the path; not the rest of a path.
        """
        last = link.inside[-1] if link.inside else ""
        found = self._found.get(last)
        if found is None:
            found = self._found[last] = self._made(link, last)
        return found

    def _made(self, link: LaneLink, last: str) -> dict[str, list[ConflictApproach]]:
        graph = self._graph
        rule = next((self._rules[lane] for lane in reversed(link.inside) if lane in self._rules), None)
        found: dict[str, list[ConflictApproach]] = {}
        if rule is None:
            return found
        junction, own = rule
        source = graph.lanes[last].entries[0][0]
        for other in sorted(junction.foes.get(own, ())):
            lane = graph.lanes.get(junction.inside[other]) if other < len(junction.inside) else None
            if lane is None or (lane.entries and lane.entries[0][0] == source):
                continue
            path = lane.entries[0][1] if lane.entries else None
            area = self._area(link.inside, path.inside if path is not None else (lane.id,))
            if area is None:
                continue
            must_yield = other in junction.yields.get(own, ())
            before = lane.entries[0][0] if path is not None else ""
            conflict = Conflict(must_yield, *area, before, path)
            for name, approach in self._approaches(conflict, lane):
                found.setdefault(name, []).append(approach)
        return found

    def _approaches(self, conflict: Conflict, lane: GraphLane) -> Iterator[tuple[str, ConflictApproach]]:
        graph, link = self._graph, conflict.link
        if link is None:
            yield lane.id, ConflictApproach(conflict, 0.0, ("", ""), -1)
            return
        source = graph.lanes[conflict.source]
        edges = source.edge, graph.lanes[link.target].edge
        offset = 0.0
        for inside in link.inside:
            yield inside, ConflictApproach(conflict, offset, edges, -1)
            offset += graph.length(inside)
        for neighbor in graph.edges[source.edge]:
            if neighbor is source or not any(graph.lanes[one.target].edge == edges[1] for one in neighbor.links):
                yield neighbor.id, ConflictApproach(conflict, -neighbor.data.length_m, edges, 0)
        # Edges further upstream, each with the shortest distance. An actor may still change lanes before the junction.
        waiting, known = [(source, -source.data.length_m, 0)], {source.edge}
        while waiting:
            current, offset, back = waiting.pop(0)
            if offset <= -_UPSTREAM_M:
                continue
            for name, entry in (one for lane in graph.edges[current.edge] for one in lane.entries):
                before = graph.lanes[name]
                place = offset
                for inside in reversed(entry.inside):
                    place -= graph.length(inside)
                    yield inside, ConflictApproach(conflict, place, edges, back + 1)
                if before.edge not in known:
                    known.add(before.edge)
                    for neighbor in graph.edges[before.edge]:
                        yield neighbor.id, ConflictApproach(conflict, place - neighbor.data.length_m, edges, back + 1)
                    waiting.append((before, place - before.data.length_m, back + 1))

    def _area(self, own: tuple[str, ...], other: tuple[str, ...]) -> tuple[float, float, float, float] | None:
        """Return begin and end of the conflict area on two paths, in m; None if the paths are nowhere close."""
        graph = self._graph
        mine, theirs = (_sampled([graph.lines(graph.lanes[lane]).center for lane in path]) for path in (own, other))
        limit = _CLOSE_SHARE * (graph.lanes[own[-1]].data.width_m + graph.lanes[other[-1]].data.width_m) / 2
        apart = np.sqrt(((mine[0][:, None] - theirs[0][None]) ** 2).sum(axis=2))
        found = []
        for (_, along), distances, path in ((mine, apart.min(axis=1), own), (theirs, apart.min(axis=0), other)):
            close = np.flatnonzero(distances < limit)
            if not len(close):
                return None
            scale = sum(graph.length(lane) for lane in path) / float(along[-1])
            for inside, outside in ((close[0], close[0] - 1), (close[-1], close[-1] + 1)):
                place = along[inside]
                if 0 <= outside < len(along):  # the paths are as far apart as the limit between these two points
                    share = (limit - distances[inside]) / (distances[outside] - distances[inside])
                    place += share * (along[outside] - place)
                found.append(float(place * scale))
        begin, end, other_begin, other_end = found
        return begin, end, other_begin, other_end


def _sampled(lines: list[Line]) -> tuple[Line, Line]:
    """Return points along consecutive lines, and their distances from the start in m."""
    points = np.concatenate(lines)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    at = np.linspace(0.0, along[-1], max(2, int(along[-1] / _STEP_M) + 2))
    return np.column_stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)]), at
