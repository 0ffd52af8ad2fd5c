"""Points along lanes at fixed distances, prepared once per lane and sliced in each step."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.sumo._lane_graph import MAX_PREPARING_S, TURNS, GraphLane, LaneGraph, is_open

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    NearLanesOf = dict[tuple["Sampling", str], "NearLanes"]

    Array = NDArray[np.float64]

NEAR_M = 50.0  # lanes are shown within this distance
SQUARE_M = 16.0  # within squares of this size, the same lanes are candidates
_GRID_M = 0.5  # upper bound of the distance of two prepared points
CENTER_BEHIND_M = 8.0  # the centre of a vehicle may be this far behind its front, which is on the lane
_NONE = -1


class LanePath(NamedTuple):
    """Points along consecutive lanes."""

    rows: Array  # 1, x, y, heading, width, speed limit and index of the lane of each point, shape (N, 7)
    places: Array  # x and y of each point, shape (2, N)
    begin: int  # the first row on the last metres before the lane for which the path was made
    first: int  # the row at the start of this lane
    last: int  # the last row on this lane


class Sampling(NamedTuple):
    """How points along lanes are sampled."""

    spacing_m: float  # distance of two points, in m
    points: int  # number of points
    before: int  # number of points behind the vehicle

    @property
    def stride(self) -> int:
        """The number of prepared points per point."""
        return math.ceil(self.spacing_m / _GRID_M - 1e-9)

    @property
    def grid_m(self) -> float:
        """The distance of two prepared points, in m."""
        return self.spacing_m / self.stride


class LanePaths:
    """Makes and keeps the paths of an agent's vehicle."""

    def __init__(
        self,
        graph: LaneGraph,
        sampling: Sampling,
        ahead: Callable[[GraphLane], Iterable[GraphLane]],  # a lane, then those that follow it
        behind: Callable[[GraphLane], Iterable[GraphLane]],  # those before a lane, the nearest first
    ) -> None:
        self._graph, self._sampling = graph, sampling
        self._ahead, self._behind = ahead, behind
        self._paths: dict[str, LanePath] = {}

    def path(self, lane: GraphLane) -> LanePath:
        """Return the path through a lane."""
        found = self._paths.get(lane.id)
        if found is None:
            found = self._paths[lane.id] = self._made(lane)
        return found

    def _made(self, lane: GraphLane) -> LanePath:
        sampling = self._sampling
        reach_behind = max(CENTER_BEHIND_M, (sampling.before + 1) * sampling.spacing_m)
        reach_ahead = (sampling.points - sampling.before + 1) * sampling.spacing_m
        ahead = iter(self._ahead(lane))
        own = next(ahead, lane)
        before = _within(self._behind(own), self._graph, reach_behind)
        after = _within(ahead, self._graph, reach_ahead)
        lanes = [*reversed(before), own, *after]
        centers = [self._graph.lines(one).center for one in lanes]
        points = np.concatenate(centers)
        owner = np.repeat(np.arange(len(lanes)), [len(center) for center in centers])
        gaps = np.hypot(*np.diff(points, axis=0).T)
        gaps[np.diff(owner) != 0] = 0.0  # a lane change on the route
        along = np.append(0.0, np.cumsum(gaps))
        start = float(along[np.searchsorted(owner, len(before))])
        end = float(along[np.searchsorted(owner, len(before), side="right") - 1])
        grid = sampling.grid_m
        first = min(math.floor(start / grid + 1e-9), math.ceil(reach_behind / grid))
        count = first + math.floor((min(float(along[-1]), end + reach_ahead) - start) / grid + 1e-9) + 1
        at = start + (np.arange(count) - first) * grid
        # The segment in which a point lies; segments without a length are between two lanes.
        segment = np.minimum(np.searchsorted(along, at, side="right") - 1, len(gaps) - 1)
        segment = np.maximum(segment, 0)
        usable = np.where(gaps > 0.0, np.arange(len(gaps)), _NONE)
        segment = np.maximum.accumulate(usable)[segment]
        segment = np.where(segment == _NONE, int(np.argmax(gaps > 0.0)), segment)
        step = points[segment + 1] - points[segment]
        share = (at - along[segment]) / gaps[segment]
        place = points[segment] + share[:, None] * step
        data = np.array([(one.data.width_m, one.data.speed_mps, one.index) for one in lanes])[owner[segment]]
        rows = np.column_stack((np.ones(count), place, np.arctan2(step[:, 1], step[:, 0]), data))
        last = min(count - 1, first + math.ceil((end - start) / grid - 1e-9))
        begin = max(0, first - math.ceil(CENTER_BEHIND_M / grid))
        return LanePath(rows, np.ascontiguousarray(place.T), begin, first, last)


class NearLanes:
    """The lanes near each square of a network for one class of vehicles, and the paths straight through them."""

    def __init__(self, graph: LaneGraph, sampling: Sampling, vehicle_class: str) -> None:
        self._graph, self._class = graph, vehicle_class
        ahead = partial(straight_ahead, graph, vehicle_class=vehicle_class)
        behind = partial(straight_behind, graph, vehicle_class=vehicle_class)
        self.paths = LanePaths(graph, sampling, ahead, behind)
        self._squares: dict[tuple[int, int], list[tuple[float, str, LanePath]]] = {}

    def prepare(self) -> None:
        """Find the lanes of all squares and their paths, so that trials in forks of this process need not."""
        end = time.process_time() + MAX_PREPARING_S
        for lane in self._graph.lanes.values():
            if time.process_time() > end:
                return
            if is_open(lane.data, self._class):
                for square in {(int(x), int(y)) for x, y in np.floor(self._graph.lines(lane).center / SQUARE_M)}:
                    self.lanes(square)
                self.paths.path(lane)

    def lanes(self, square: tuple[int, int]) -> list[tuple[float, str, LanePath]]:
        """Return the lanes near a square, the nearest first: distance from its middle in m, id, path."""
        found = self._squares.get(square)
        if found is None:
            x, y = ((number + 0.5) * SQUARE_M for number in square)
            near = self._graph.near(x, y, NEAR_M + SQUARE_M, self._class)
            found = [(distance, name, self.paths.path(self._graph.lanes[name])) for distance, name in near]
            self._squares[square] = found
        return found


def _within(lanes: Iterable[GraphLane], graph: LaneGraph, reach_m: float) -> list[GraphLane]:
    """Return the first lanes until their centre lines have a total length."""
    found: list[GraphLane] = []
    total = 0.0
    for lane in lanes:
        if total >= reach_m:
            break
        found.append(lane)
        total += graph.line_length(lane)
    return found


def straight_ahead(graph: LaneGraph, lane: GraphLane, vehicle_class: str) -> Iterator[GraphLane]:
    """Yield a lane and the lanes that follow it with the smallest turns."""
    current = lane
    while True:
        yield current
        link = graph.straightest(current, vehicle_class)
        if link is None:
            return
        current = graph.lanes[link.inside[0] if link.inside else link.target]


def straight_behind(graph: LaneGraph, lane: GraphLane, vehicle_class: str, preferred: str = "") -> Iterator[GraphLane]:
    """Yield the lanes that lead into a lane with the smallest turns, the nearest first.

    The nearest road is from the edge ``preferred``, if any lane of it leads into the lane.
    """
    current = lane
    while True:
        entries = [
            (source, link)
            for source, link in current.entries
            if vehicle_class == "ignoring" or graph.lanes[source].data.admits(vehicle_class)
        ]
        if preferred:
            entries = [one for one in entries if graph.lanes[one[0]].edge == preferred] or entries
            preferred = ""
        if not entries:
            return
        source, link = min(entries, key=lambda one: (TURNS.find(one[1].direction), one[0]))
        inside = link.inside
        if current.is_internal:
            inside = inside[: inside.index(current.id)]
        for name in reversed(inside):
            yield graph.lanes[name]
        current = graph.lanes[source]
        yield current
