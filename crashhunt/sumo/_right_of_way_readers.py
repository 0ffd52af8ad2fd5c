"""Readers of the next junction: right of way, pedestrian crossings and the stop line."""

from __future__ import annotations

import math
from functools import partial
from math import cos, sin
from typing import TYPE_CHECKING

import libsumo
import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.simulators import center_of
from crashhunt.sumo._reader_protocol import NEVER_S, Reader, RowsReader
from crashhunt.world import PERSON, is_person

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.native import Draft, Streams
    from crashhunt.sumo._conflicts import Conflict, ConflictApproach
    from crashhunt.sumo._lane_graph import LaneLink
    from crashhunt.sumo._reader_protocol import AgentMoment, NetworkPlace, ReaderSetup
    from crashhunt.world import Scene

    Array = NDArray[np.float64]

_NO_PERSON_M = 1000.0  # the distance of the nearest person where there is none
_STANDING_MPS = 0.1
_RED_STATES = frozenset("rRus")
_STOP_STATES = frozenset("sw")
_ALLWAY_STOP = "w"


class RightOfWayReader(RowsReader):
    """Reads the actors on streams that conflict with the route at the next junction."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._graph = setup.graph
        self._takes: dict[tuple[int, str, int, str], list[tuple[Conflict, float]]] = {}
        self._streams: dict[int, Streams] = {}  # of the core, by the identity of the approaches

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of ``right_of_way``."""
        place, core = self._setup.places.find(moment), self._setup.core
        path = path_from(place) if place is not None else None
        approaches = self._setup.conflicts.around(path[0]) if path is not None else {}
        if path is None or core is None or not approaches:
            return
        link, line = path
        streams = self._streams.get(id(approaches))
        if streams is None:
            streams = self._streams[id(approaches)] = core.Streams(
                tuple(approaches), partial(self._taken_by, approaches)
            )
        facts = line, float(link.state in _STOP_STATES), self._setup.limit
        is_usual = not moment.hidden and link.state != _ALLWAY_STOP and not (place and _offset_m(place))
        if not (is_usual and draft.right_of_way(at, streams, facts)):
            super().write(draft, at, moment)

    def _rows(self, moment: AgentMoment) -> list[tuple[float, ...]]:
        place = self._setup.places.find(moment)
        path = path_across(place) if place is not None else None
        if place is None or path is None:
            return []
        link, line = path
        approaches = self._setup.conflicts.around(link)
        if not approaches:
            return []
        scene, row = moment.scene, moment.row
        actors = scene.roster.actors
        front = -line
        rear = front - actors[row].length
        stop_sign, stop_line = float(link.state in _STOP_STATES), line - _offset_m(place)
        rows, speeds = [], scene.speeds
        for other, actor in enumerate(actors):
            if other == row or actor.id in moment.hidden:
                continue
            taken, position = self._taken(actor.id, scene, other, approaches)
            best = None
            for conflict, offset in taken:
                place_m = offset + position
                if rear > conflict.end_m or place_m - actor.length > conflict.other_end_m:
                    continue  # one of them has passed
                speed = max(0.0, speeds[other])
                away = conflict.other_begin_m - place_m
                arrival = max(0.0, away) / speed if speed > _STANDING_MPS else NEVER_S if away > 0.0 else 0.0
                must_yield = conflict.must_yield and self._goes_first(link, line, actor.id, conflict, place_m, arrival)
                values = (min(arrival, NEVER_S), away, actor.id, must_yield, conflict.begin_m - front, speed)
                best = values if best is None else min(best, values)
            if best is not None:
                rows.append(best)
        rows.sort()
        return [
            (1.0, must_yield, stop_line, distance, away, speed, arrival, stop_sign)
            for arrival, away, _, must_yield, distance, speed in rows[: self._setup.limit]
        ]

    def _on_crossing(self, conflict: Conflict, lane: str, position: float, heading: float) -> tuple[Conflict, float]:
        """Return the conflict with a person on a crossing and its position, both in the direction of the person."""
        center, length = self._graph.lines(self._graph.lanes[lane]).center, self._graph.length(lane)
        along = (center[-1] - center[0]) @ (cos(heading), sin(heading))
        if along >= 0.0:
            return conflict, position
        begin, end = length - conflict.other_end_m, length - conflict.other_begin_m
        return conflict._replace(other_begin_m=begin, other_end_m=end), length - position

    def _taken(
        self, name: str, scene: Scene, row: int, approaches: Mapping[str, list[ConflictApproach]]
    ) -> tuple[Sequence[tuple[Conflict, float]], float]:
        """Return the conflicting paths that an actor takes, and the position of its front on its lane, in m.

        Each path has the distance from its stop line to the start of the lane, in m.
        """
        try:
            if is_person(name):
                person = name.removeprefix(PERSON)
                lane, position = sumo.person_getLaneID(person), sumo.person_getLanePosition(person)
                heading = scene.headings[row]
                return [
                    self._on_crossing(one.conflict, lane, position, heading) for one in approaches.get(lane, ())
                ], 0.0
            lane = sumo.vehicle_getLaneID(name)
            if lane not in approaches:
                return (), 0.0
            number, position = sumo.vehicle_getRouteIndex(name), sumo.vehicle_getLanePosition(name)
            key = id(approaches), lane, number, sumo.vehicle_getRouteID(name)
            found = self._takes.get(key)
            if found is None:
                found = self._takes[key] = _paths_of(name, approaches[lane], number)
        except libsumo.TraCIException:  # an actor of a recording that is played back
            return (), 0.0
        return found, position

    def _taken_by(
        self, approaches: Mapping[str, list[ConflictApproach]], name: str, lane: str, number: int, _: str
    ) -> list[tuple[bool, float, float, float, float, float, str, int]]:
        """Return the conflicting paths that a vehicle takes, for the core."""
        found = []
        for conflict, offset in _paths_of(name, approaches[lane], number):
            other = conflict.link
            light = (other.signal, other.signal_index) if other is not None and other.signal else ("", 0)
            found.append((*conflict[:5], offset, *light))
        return found

    def _goes_first(
        self, link: LaneLink, line: float, name: str, conflict: Conflict, place_m: float, arrival: float
    ) -> bool:
        """Return whether an actor that has priority by the rules also has it in this moment."""
        other = conflict.link
        if other is None or place_m > 0.0:
            return True
        if other.signal:
            state = sumo.trafficlight_getRedYellowGreenState(other.signal)[other.signal_index]
            return state not in _RED_STATES
        if link.state == _ALLWAY_STOP:  # the vehicle that has waited longest goes first
            agent = self._setup.agent
            own_speed = max(_STANDING_MPS, float(sumo.vehicle_getSpeed(agent)))
            own = -float(sumo.vehicle_getWaitingTime(agent)), max(0.0, line) / own_speed
            return (-float(sumo.vehicle_getWaitingTime(name)), arrival) < own
        return True


def _paths_of(vehicle: str, approaches: Sequence[ConflictApproach], number: int) -> list[tuple[Conflict, float]]:
    """Return the conflicting paths that a vehicle takes, each with the distance in m from its stop line to the lane."""
    edges = tuple(sumo.vehicle_getRoute(vehicle))
    return [
        (one.conflict, one.offset_m)
        for one in approaches
        if one.back < 0 or edges[number + one.back : number + one.back + 2] == one.edges
    ]


def path_across(place: NetworkPlace) -> tuple[LaneLink, float] | None:
    """Return the path across the next junction, or the present one, and the distance to its beginning, in m.

    The distance is negative inside the junction. The result is None if the lane does not lead along the route.
    """
    found = path_from(place)
    return None if found is None else (found[0], found[1] - place.position_m)


def path_from(place: NetworkPlace) -> tuple[LaneLink, float] | None:
    """Return the path across the next junction, or the present one, and its distance from the lane's start, in m."""
    lane = place.lane
    link = place.guide.link(place.number, lane) if place.number >= 0 else None
    if link is None:
        return None
    if not lane.is_internal:
        return link, lane.data.length_m
    entry = next((one for _, one in lane.entries if one.target == link.target), None)
    if entry is None:
        return None
    return entry, -(entry.length_m - link.length_m - lane.data.length_m)


def _offset_m(place: NetworkPlace) -> float:
    """Return the distance of the stop line before the next junction, or before the present one, in m."""
    if not place.guide.graph.has_stop_offsets:
        return 0.0
    lane = place.lane
    link = place.guide.link(place.number, lane) if lane.is_internal else None
    if link is not None:
        lane = place.guide.graph.lanes[next(name for name, one in lane.entries if one.target == link.target)]
    return lane.data.offset_m(place.guide.vehicle_class)


class CrossingsReader(RowsReader):
    """Reads the pedestrian crossings within the next junction, and the persons near them."""

    def _rows(self, moment: AgentMoment) -> list[tuple[float, ...]]:
        place = self._setup.places.find(moment)
        path = path_across(place) if place is not None else None
        if path is None:
            return []
        link, line = path
        graph, scene = self._setup.graph, moment.scene
        middles = [
            center_of(scene, row)
            for row, actor in enumerate(scene.roster.actors)
            if is_person(actor.id) and actor.id not in moment.hidden
        ]
        rows = []
        for lane, approaches in self._setup.conflicts.around(link).items():
            for conflict in (one.conflict for one in approaches if one.conflict.link is None):
                center = graph.lines(graph.lanes[lane]).center
                share = (conflict.other_begin_m + conflict.other_end_m) / 2 / max(graph.length(lane), 1e-9)
                area = _point_at(center, share)
                near = [one for one in middles if _distance_to(center, *one) <= self._setup.settings["near"]]
                nearest = min((math.dist(area, one) for one in middles), default=_NO_PERSON_M)
                rows.append((line + conflict.begin_m, conflict.must_yield, len(near), min(nearest, _NO_PERSON_M)))
        return [(1.0, *values) for values in sorted(rows)[: self._setup.limit]]


def _point_at(line: Array, share: float) -> tuple[float, float]:
    """Return the point at a share of the length of a line."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    x, y = (float(np.interp(share * along[-1], along, line[:, axis])) for axis in (0, 1))
    return x, y


def _distance_to(line: Array, x: float, y: float) -> float:
    """Return the distance of a point from a line, in m."""
    start, step = line[:-1], np.diff(line, axis=0)
    share = np.clip((((x, y) - start) * step).sum(axis=1) / np.maximum((step * step).sum(axis=1), 1e-12), 0.0, 1.0)
    return float(np.hypot(*(start + share[:, None] * step - (x, y)).T).min())


class StopLineReader(Reader):
    """Reads the stop line of the next junction."""

    def observe(self, moment: AgentMoment) -> Array:
        """Return the columns of ``stop_line``."""
        place = self._setup.places.find(moment)
        path = path_across(place) if place is not None else None
        if place is None or path is None:
            return np.zeros(self._setup.shape)
        return np.array(self._values(path[0], path[1] - _offset_m(place)), float)

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of ``stop_line``."""
        place = self._setup.places.find(moment)
        path = path_from(place) if place is not None else None
        if place is None or path is None:
            return
        line = path[1] - _offset_m(place)
        if not draft.along(at, self._values(path[0], line), [(1, 0.0, line, -math.inf)]):
            super().write(draft, at, moment)

    def _values(self, link: LaneLink, line: float) -> tuple[float, ...]:
        around = self._setup.conflicts.around(link)
        yields = any(one.conflict.must_yield for approaches in around.values() for one in approaches)
        return 1.0, line, yields, link.state in _STOP_STATES, bool(link.signal)
