"""Readers of the road around the controlled vehicle: lanes, route and speed limit."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.sumo._lane_graph import is_open
from crashhunt.sumo._lane_paths import (
    CENTER_BEHIND_M,
    NEAR_M,
    SQUARE_M,
    LanePaths,
    NearLanes,
    Sampling,
    straight_ahead,
    straight_behind,
)
from crashhunt.sumo._reader_protocol import Reader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from crashhunt.native import Draft, LaneBlock
    from crashhunt.simulators import RequestedPart
    from crashhunt.sumo._lane_graph import GraphLane, LaneGraph, RouteGuide
    from crashhunt.sumo._lane_paths import LanePath, NearLanesOf
    from crashhunt.sumo._reader_protocol import AgentMoment, NetworkPlace, ReaderSetup

    Array = NDArray[np.float64]

_WINDOW_M = 24.0  # within a square, the nearest point of a lane moves less along the lane


class LanesReader(Reader):
    """Reads the lanes around the controlled vehicle."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._graph = setup.graph
        self._lanes, points, self._columns = setup.shape
        self._sampling = _sampling_of(setup.request)
        self._near = _near_lanes(setup.graph, self._sampling, setup.places.vehicle_class, setup.near)
        self._steps = (np.arange(points) - self._sampling.before) * self._sampling.stride
        self._window = 2 * math.ceil(_WINDOW_M / self._sampling.grid_m) + 1
        self._paths: dict[tuple[int, int], LanePaths] = {}
        self._key: tuple[object, ...] = ()
        self._block: _Block | None = None
        self._in_core: LaneBlock | None = None
        self._place: NetworkPlace | None = None
        self._size = self._lanes, points, self._sampling.before, self._sampling.stride, NEAR_M, SQUARE_M

    @staticmethod
    def prepare(graph: LaneGraph, request: RequestedPart, vehicle_class: str, near: NearLanesOf) -> None:
        """Prepare what vehicles of a class share; `near` receives it."""
        _near_lanes(graph, _sampling_of(request), vehicle_class, near).prepare()

    def observe(self, moment: AgentMoment) -> Array:
        """Return the columns of ``lanes``."""
        place = self._setup.places.find(moment)
        if place is None:
            return np.zeros(self._setup.shape)
        self._move_to(place, (math.floor(place.x / SQUARE_M), math.floor(place.y / SQUARE_M)))
        if self._block is None:
            self._block = _block_of(self._candidates(place), *self._middle, np.arange(self._window))
        block = self._block
        # The squared distances, except for a term that all points have in common.
        squared = block.x * (-2.0 * (place.x - block.middle_x))
        squared += block.y * (-2.0 * (place.y - block.middle_y))
        squared += block.squared
        nearest = squared.argmin(axis=1)
        limit = self._limit(place)
        chosen = list(range(min(3, self._lanes)))
        if self._lanes > 3:
            best = squared[3:].min(axis=1).tolist()
            others = sorted(range(len(best)), key=best.__getitem__)[: self._lanes - 3]
            chosen += [3 + one for one in others if best[one] <= limit]
        rows = (block.begin + nearest)[chosen, None] + self._steps
        np.maximum(rows, block.low[chosen], out=rows)
        np.minimum(rows, block.high[chosen], out=rows)
        found = np.zeros(self._setup.shape)
        block.rows.take(rows, axis=0, out=found[: len(chosen)], mode="clip")
        return found

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of ``lanes``."""
        place = self._place = self._setup.places.find(moment)
        if place is not None and not draft.lanes(at, self._block_at, self._size):
            super().write(draft, at, moment)

    def _block_at(self, column: int, row: int) -> LaneBlock:
        """Return the candidates for a square, for the core."""
        core, place = self._setup.core, self._place
        assert core is not None
        assert place is not None
        self._move_to(place, (column, row))
        if self._in_core is None:
            paths = [
                None if one is None else (one.rows, one.places, one.begin if number < 3 else one.first, one.last)
                for number, one in enumerate(self._candidates(place))
            ]
            self._in_core = core.LaneBlock(paths, *self._middle, self._window)
        return self._in_core

    def _move_to(self, place: NetworkPlace, square: tuple[int, int]) -> None:
        """Set the square and the lane, and delete the candidates of another square or lane."""
        key = place.lane, id(place.guide), place.number, square
        if key != self._key:
            self._key, self._square = key, square
            self._middle = (square[0] + 0.5) * SQUARE_M, (square[1] + 0.5) * SQUARE_M
            self._block = self._in_core = None

    def _limit(self, place: NetworkPlace) -> float:
        """Return the largest squared distance of a lane, without the term that all points have in common, in m²."""
        dx, dy = place.x - self._middle[0], place.y - self._middle[1]
        return NEAR_M * NEAR_M - dx * dx - dy * dy

    def _candidates(self, place: NetworkPlace) -> list[LanePath | None]:
        """Return the paths of the own lane, the left and the right lane, then of the lanes near the square."""
        graph, places, lane = self._graph, self._setup.places, place.lane
        own = self._own_paths(place)
        around: list[LanePath | None] = [own.path(lane)]
        sides = []
        for change in (1, -1):
            other = graph.neighbor(lane, change)
            is_usable = other is not None and is_open(other.data, places.vehicle_class)
            sides.append(other if is_usable else None)
            around.append(own.path(other) if other is not None and is_usable else None)
        near = self._near.lanes(self._square) if self._lanes > 3 else []
        taken = {one.id for one in (lane, *sides) if one is not None}
        near = [one for one in near if one[1] not in taken]
        limit = near[min(len(near), self._lanes - 3) - 1][0] + 2 * SQUARE_M if near else 0.0
        around += [path for distance, _, path in near if distance <= limit]
        return around

    def _own_paths(self, place: NetworkPlace) -> LanePaths:
        """Return the paths of the lanes on the vehicle's own road, which follow its route if they can."""
        key = id(place.guide), place.number
        found = self._paths.get(key)
        if found is None:
            guide, number = place.guide, place.number
            before = guide.edges[number - 1] if number > 0 and not place.lane.is_internal else ""
            vehicle_class = self._setup.places.vehicle_class
            found = self._paths[key] = LanePaths(
                self._graph,
                self._sampling,
                partial(_along_route, guide, number),
                partial(straight_behind, self._graph, vehicle_class=vehicle_class, preferred=before),
            )
        return found


def _sampling_of(request: RequestedPart) -> Sampling:
    spacing, points = request.settings["spacing"], request.shape[1]
    return Sampling(spacing, points, min(points - 1, math.floor(request.settings["behind"] / spacing + 1e-9)))


def _near_lanes(graph: LaneGraph, sampling: Sampling, vehicle_class: str, near: NearLanesOf) -> NearLanes:
    found = near.get((sampling, vehicle_class))
    if found is None:
        found = near[sampling, vehicle_class] = NearLanes(graph, sampling, vehicle_class)
    return found


def _along_route(guide: RouteGuide, number: int, lane: GraphLane) -> Iterator[GraphLane]:
    """Yield a lane and the lanes that follow it, on the route as long as the lane leads there, then straight ahead."""
    graph, current = guide.graph, lane
    while (link := guide.link(number, current)) is not None:
        yield current
        yield from (graph.lanes[inside] for inside in link.inside)
        number, current = number + 1, graph.lanes[link.target]
    yield from straight_ahead(graph, current, guide.vehicle_class)


class _Block(NamedTuple):
    """The candidates of the lanes around a square, with the own lane, the left and the right lane first."""

    rows: Array  # points of all lanes, with an empty row before and behind each lane
    low: NDArray[np.intp]  # the empty row before each lane, shape (lanes, 1)
    high: NDArray[np.intp]  # the empty row behind each lane, shape (lanes, 1)
    begin: NDArray[np.intp]  # first row of the window of each lane, in which the nearest point is
    x: Array  # x of the points in the windows, from the middle of the square, shape (lanes, points)
    y: Array  # y of the points in the windows, from the middle of the square
    squared: Array  # squared distance of these points from the middle of the square
    middle_x: float  # x of the middle of the square
    middle_y: float  # y of the middle of the square


_EMPTY = np.zeros((1, 6))


def _block_of(paths: list[LanePath | None], middle_x: float, middle_y: float, window: NDArray[np.intp]) -> _Block:
    parts: list[Array] = [_EMPTY]
    places = np.zeros((len(paths), 4), np.intp)  # low, high, begin, last row of the window
    total = 1
    for number, path in enumerate(paths):
        if path is None:
            continue
        start = path.first if number > 2 else path.begin
        own = path.rows[start : path.last + 1]
        nearest = start + int(((own[:, 1] - middle_x) ** 2 + (own[:, 2] - middle_y) ** 2).argmin())
        first = max(start, min(nearest - len(window) // 2, path.last + 1 - len(window)))
        parts += (path.rows[:, :6], _EMPTY)
        places[number] = total - 1, total + len(path.rows), total + first, total + path.last
        total += len(path.rows) + 1
    rows = np.concatenate(parts)
    low, high, begin, last = places.T
    index = np.minimum(begin[:, None] + window, last[:, None])
    x, y = rows[index, 1] - middle_x, rows[index, 2] - middle_y
    return _Block(
        rows=rows, low=low[:, None], high=high[:, None], begin=begin, x=x, y=y, squared=x * x + y * y,
        middle_x=middle_x, middle_y=middle_y,
    )  # fmt: skip


class RouteReader(Reader):
    """Reads points along the route."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        spacing, points = setup.settings["spacing"], setup.shape[0]
        self._before = min(points - 1, math.floor(setup.settings["behind"] / spacing + 1e-9))
        rear = self._before + math.ceil(CENTER_BEHIND_M / spacing) if self._before else 0
        self._sampling = Sampling(spacing, points - self._before + rear, rear)
        self._steps = np.arange(points) * self._sampling.stride
        self._paths: dict[tuple[int, int], LanePaths] = {}

    def observe(self, moment: AgentMoment) -> Array:
        """Return the columns of ``route``."""
        found = np.zeros(self._setup.shape)
        place = self._setup.places.find(moment)
        if place is None or place.number < 0:
            return found
        path = self._path(place)
        part = path.rows[path.begin : path.last + 1]
        start = path.begin + int(((part[:, 1] - place.x) ** 2 + (part[:, 2] - place.y) ** 2).argmin())
        start -= min(self._before, start // self._sampling.stride) * self._sampling.stride
        rows = path.rows[start + self._steps[self._steps < len(path.rows) - start]]
        found[: len(rows)] = rows[:, _ROUTE_COLUMNS]
        return found

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of ``route``."""
        place = self._setup.places.find(moment)
        if place is None or place.number < 0:
            return
        path = self._path(place)
        window = path.begin, path.last, self._setup.shape[0], self._sampling.stride
        if self._before or not draft.route(at, path.rows, window):  # the core writes the points ahead only
            super().write(draft, at, moment)

    def _path(self, place: NetworkPlace) -> LanePath:
        key = id(place.guide), place.number
        paths = self._paths.get(key)
        if paths is None:
            paths = self._paths[key] = self._made(place)
        return paths.path(place.lane)

    def _made(self, place: NetworkPlace) -> LanePaths:
        guide, number = place.guide, place.number
        before = guide.edges[number - 1] if number > 0 and not place.lane.is_internal else ""
        graph, vehicle_class = guide.graph, guide.vehicle_class

        def ahead(lane: GraphLane) -> Iterator[GraphLane]:
            return (one for one, _, _ in guide.walk(number, lane, is_best=True))

        behind = partial(straight_behind, graph, vehicle_class=vehicle_class, preferred=before)
        return LanePaths(graph, self._sampling, ahead, behind)


_ROUTE_COLUMNS = (0, 1, 2, 3, 5, 6)


class RouteStateReader(Reader):
    """Reads the state of the controlled vehicle on its route."""

    def observe(self, moment: AgentMoment) -> Array:
        """Return the columns of ``route_state``."""
        place = self._setup.places.find(moment)
        if place is None or place.number < 0:
            return np.zeros(self._setup.shape)
        rest, changes, run, after = self._distances(place)
        left = -place.position_m + after
        return np.array((max(0.0, rest + left), changes, max(0.0, run + left), *place.guide.goal))

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of ``route_state``."""
        place = self._setup.places.find(moment)
        if place is None or place.number < 0:
            return
        rest, changes, run, after = self._distances(place)
        values = 0.0, changes, 0.0, *place.guide.goal
        if not draft.along(at, values, [(0, rest, after, 0.0), (2, run, after, 0.0)]):
            super().write(draft, at, moment)

    @staticmethod
    def _distances(place: NetworkPlace) -> tuple[float, int, float, float]:
        """Return what is left of the route behind the end of the lane, and the changes to its best lane.

        Returns:
            - The rest of the route, from the start of the lane, in m. Inside a junction, the lane is the next one.
            - The number of lane changes.
            - The distance until a lane change is needed, from there, in m.
            - The distance from the start of the vehicle's lane to there, in m.
        """
        guide, lane = place.guide, place.lane
        changes, number, after = 0, place.number, 0.0
        if lane.is_internal:
            link = guide.link(number, lane)
            assert link is not None
            after = lane.data.length_m + link.length_m
            number, lane = number + 1, guide.graph.lanes[link.target]
        else:
            changes = guide.lane_changes(number, lane)
        step = guide.step(number, lane.id)
        if step is None:  # a lane that the vehicle may not use
            best = guide.best(number, lane)
            rest, run = (guide.rest_m(number, best) if best is not None else 0.0), 0.0
        else:
            rest, run = step.rest_m, step.run_m
        return rest, changes, run, after


class SpeedLimitReader(Reader):
    """Reads the speed limit of the controlled vehicle's lane."""

    def observe(self, moment: AgentMoment) -> Array:
        """Return the speed limit, which can differ from that of the network file while a sign changes it."""
        return np.array((float(sumo.lane_getMaxSpeed(moment.lane)),))

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the speed limit."""
        if not draft.speed_limit(at):
            super().write(draft, at, moment)
