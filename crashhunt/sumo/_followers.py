"""Lets SUMO's vehicles react to the part of an agent's vehicle that is in another lane than its front.

SUMO assigns a vehicle to the lane below its front, and to the lanes that lead to it. Its vehicles do not see the rest:
the tail of a vehicle that waits to turn, or the half of a vehicle that changes lanes gradually. They drive into it. No
option of SUMO changes this.

Before each step, this module intersects the outline of the agent's vehicle with the paths of the vehicles behind it.
It looks along all lanes that the outline touches, and along the lanes that lead there. The first vehicle whose path is
blocked receives an upper bound of its speed: the speed that its own car-following model chooses behind a vehicle at
that place (``getFollowSpeed``). SUMO lowers it for vehicles ahead, lights and junctions. There is no bound if the
vehicle cannot be faster in this step, or if SUMO already reports the agent's vehicle as its leader at that place.
Vehicles next to such a part, or behind it without a safe gap, do not change to its lane. Nor do vehicles ahead of it,
if the agent's vehicle would have no safe gap behind them: SUMO's own lane changes have the same rule.

If a disturbance sets the speed of a vehicle, the vehicle receives the smaller speed. Commands that also set SUMO's
speed mode take precedence (``ignore_priority``, ``keep_speed``), and so does a user's code that sets a speed.

Cost: nothing while the outline is inside a straight part of its lane.
"""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.sumo._agent_calls import commanded_elsewhere
from crashhunt.sumo._bent_vehicles import height_at
from crashhunt.sumo._driving import VehicleCommand
from crashhunt.sumo._lane_graph import VEHICLE_CLASSES, LaneGraph, LaneLink, is_open
from crashhunt.world import LEVEL_M

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    Polygon = Sequence[tuple[float, float]]

_SIDE_GAP_M = 0.2
"""Distance at which vehicles pass each other: a part that is further off the path of a vehicle does not block it."""
_WIDEST_M = 3.0  # of SUMO's vehicles
_SQUARE_M = 16.0  # edge length of the squares that pieces of lanes are sorted into
_TIME_S = 2.0  # with the braking distance, how far behind a part vehicles are examined
_BRAKING_MPS2 = 4.0
_MAX_LOOK_M = 250.0
_SAME_PLACE = 0.5
"""A leader that SUMO reports further away than the part by at most this share of the minimum gap is the part."""
_DECELERATION_LIMIT = 4  # bit of SUMO's speed mode
_NO_LANE_CHANGES = 0  # lane change mode
_ON_FOOT = frozenset(("pedestrian", "wheelchair"))


class Piece(NamedTuple):
    """A straight piece of the centre line of a lane."""

    lane: str  # id of the lane
    x: float  # start of the piece, in m
    y: float  # start of the piece, in m
    cos: float  # direction of the piece
    sin: float  # direction of the piece
    length: float  # length of the piece, in m
    start: float  # position of its start on the lane, in SUMO's metres of the lane
    scale: float  # SUMO's metres of the lane in a metre of the piece


class _Part(NamedTuple):
    """The part of an outline that is on a lane."""

    # the pieces of the lane that the outline touches, each with the outline in the frame of the piece
    pieces: list[tuple[Piece, Polygon]]
    speed: float  # speed of the agent's vehicle along the lane, in m/s; 0 if it drives against the lane

    def reach(self, right: float, left: float) -> tuple[float, float] | None:
        """Return the positions on the lane, in m, between which the outline is on a path; None if it is not.

        The borders of the path are in m to the left of the centre line.
        """
        found: list[float] = []
        for piece, outline in self.pieces:
            cut = _clipped(_clipped(outline, 1, right, above=True), 1, left, above=False)
            cut = _clipped(_clipped(cut, 0, 0.0, above=True), 0, piece.length, above=False)
            found += (piece.start + along * piece.scale for along, _ in cut)
        return (min(found), max(found)) if found else None


class Followers:
    """Bounds the speeds of the vehicles behind agents' vehicles that are in several lanes.

    Args:
        agents: the agents whose whole outline other vehicles see.
        controlled: all agents, which are never bounded.
        graph: function that returns the lanes of the network.
        step_length_s: step length, in s.
        ignored_ahead: agents whose parts are ignored by vehicles that change lanes ahead of them.
    """

    def __init__(
        self,
        agents: Collection[str],
        controlled: Collection[str],
        graph: Callable[[], LaneGraph],
        step_length_s: float,
        ignored_ahead: Collection[str] = (),
    ) -> None:
        self.agents, self._controlled, self._read_graph = agents, controlled, graph
        self._dt, self._ignored_ahead = step_length_s, ignored_ahead
        self._squares: dict[tuple[int, int], list[Piece]] = {}
        self._parts: dict[str, tuple[tuple[float, ...], dict[str, _Part]]] = {}
        self._speed_modes = VehicleCommand.speed_modes  # of the vehicles that are bounded
        self._change_modes = VehicleCommand.change_modes  # of the vehicles that may not change lanes

    def prepare(self) -> None:
        """Read the network, once for all trials in forks of this process."""
        if not self.agents or self._squares:
            return
        graph = self._graph = self._read_graph()
        squares: defaultdict[tuple[int, int], list[Piece]] = defaultdict(list)
        kinds = VEHICLE_CLASSES - _ON_FOOT
        for lane in graph.lanes.values():
            data = lane.data
            if not any(is_open(data, kind) for kind in kinds):
                continue
            total = sum(math.dist(one, two) for one, two in pairwise(data.shape))
            done, scale = 0.0, data.length_m / total if total else 1.0
            for (ax, ay), (bx, by) in pairwise(data.shape):
                length = math.dist((ax, ay), (bx, by))
                if length:
                    cos, sin = (bx - ax) / length, (by - ay) / length
                    piece = Piece(lane.id, ax, ay, cos, sin, length, done * scale, scale)
                    for square in _squares_along(piece):
                        squares[square].append(piece)
                done += length
        self._squares = dict(squares)

    def begin(self) -> None:
        """Reset the state of the last episode."""
        self._parts.clear()

    def react(self, agents: Collection[str], is_inside: Callable[[str], bool]) -> None:
        """Bound the speeds of vehicles in the next step, and release those that are not blocked any more.

        ``is_inside`` returns whether an agent's vehicle is inside a straight part of its own lane.
        """
        bounds: dict[str, float] = {}
        waiting: set[str] = set()
        for agent in self.agents:
            if agent not in agents:
                continue
            try:
                if not is_inside(agent):
                    self._look_behind(agent, bounds, waiting)
            except libsumo.TraCIException:
                continue  # a user's code has removed a vehicle
        if bounds or self._speed_modes:
            self._bound(bounds)
        if waiting or self._change_modes:
            self._keep_lanes(waiting)

    def _bound(self, bounds: dict[str, float]) -> None:
        for vehicle in [one for one in self._speed_modes if one not in bounds]:
            mode = self._speed_modes.pop(vehicle)
            if VehicleCommand.speeds.get(vehicle, 0.0) is None or vehicle in commanded_elsewhere:
                continue  # another command has begun
            try:
                sumo.vehicle_setSpeedMode(vehicle, mode)
                if vehicle not in VehicleCommand.speeds:
                    sumo.vehicle_setSpeed(vehicle, -1.0)
            except libsumo.TraCIException:
                continue  # it has left
        for vehicle, bound in bounds.items():
            if vehicle not in self._speed_modes:
                self._speed_modes[vehicle] = sumo.vehicle_getSpeedMode(vehicle)
            mode = self._speed_modes[vehicle]
            is_emergency = bound < sumo.vehicle_getSpeed(vehicle) - sumo.vehicle_getDecel(vehicle) * self._dt
            sumo.vehicle_setSpeedMode(vehicle, mode & ~_DECELERATION_LIMIT if is_emergency else mode)
            sumo.vehicle_setSpeed(vehicle, bound)

    def _keep_lanes(self, waiting: Collection[str]) -> None:
        for vehicle in [one for one in self._change_modes if one not in waiting]:
            mode = self._change_modes.pop(vehicle)
            if vehicle in VehicleCommand.lanes:
                continue
            try:
                sumo.vehicle_setLaneChangeMode(vehicle, mode)
            except libsumo.TraCIException:
                continue  # it has left
        for vehicle in sorted(waiting):
            if vehicle not in self._change_modes:
                self._change_modes[vehicle] = sumo.vehicle_getLaneChangeMode(vehicle)
                sumo.vehicle_setLaneChangeMode(vehicle, _NO_LANE_CHANGES)

    def _look_behind(self, agent: str, bounds: dict[str, float], waiting: set[str]) -> None:
        """Find the vehicles that a part of an agent's vehicle blocks, and those that must not change lanes to it."""
        decel, own = sumo.vehicle_getDecel(agent), sumo.vehicle_getLaneID(agent)
        # SUMO's lane changes consider the tail of a vehicle in a lane that leads to the lane of its front.
        before = {source for source, _ in self._graph.lanes[own].entries} if own in self._graph.lanes else set()
        for lane, part in self._parts_of(agent).items():
            for vehicle, gap in self._blocked(lane, part):
                bound = self._bound_of(vehicle, gap, agent, part.speed, decel)
                if bound is not None:
                    bounds[vehicle] = min(bound, bounds.get(vehicle, math.inf))
            if not lane.startswith(":") and lane not in before:
                waiting.update(self._near_in_next_lanes(lane, part, agent, decel))

    def _parts_of(self, agent: str) -> dict[str, _Part]:
        """Return the parts of the outline by lane, without the lane below the front."""
        (x, y), angle = sumo.vehicle_getPosition(agent), sumo.vehicle_getAngle(agent)
        length, width, speed = (
            get(agent) for get in (sumo.vehicle_getLength, sumo.vehicle_getWidth, sumo.vehicle_getSpeed)
        )
        pose = x, y, angle, length, width, speed
        known = self._parts.get(agent)
        if known is not None and known[0] == pose:
            return known[1]
        heading = math.radians(90.0 - angle)
        cos, sin = math.cos(heading), math.sin(heading)
        outline = [
            (x - back * cos - left * sin, y - back * sin + left * cos)
            for back, left in ((0.0, width / 2), (length, width / 2), (length, -width / 2), (0.0, -width / 2))
        ]
        pieces: defaultdict[str, list[tuple[Piece, Polygon]]] = defaultdict(list)
        own, path = sumo.vehicle_getLaneID(agent), _WIDEST_M / 2 + _SIDE_GAP_M
        for piece in self._near(outline, path):
            if piece.lane == own:
                continue
            turned = [
                (
                    (px - piece.x) * piece.cos + (py - piece.y) * piece.sin,
                    (py - piece.y) * piece.cos - (px - piece.x) * piece.sin,
                )
                for px, py in outline
            ]
            along, aside = zip(*turned, strict=True)
            if min(along) < piece.length and max(along) > 0.0 and min(aside) < path and max(aside) > -path:
                pieces[piece.lane].append((piece, turned))
        height = sumo.vehicle_getPosition3D(agent)[2]
        found = {
            lane: _Part(pieces[lane], max(0.0, speed * (piece.cos * cos + piece.sin * sin)))
            for lane in sorted(pieces)
            for piece, turned in pieces[lane][:1]
            if abs(height_at(lane, piece.start + turned[0][0] * piece.scale) - height) < LEVEL_M  # below no bridge
        }
        self._parts[agent] = pose, found
        return found

    def _near(self, outline: Polygon, path: float) -> list[Piece]:
        """Return the pieces of lanes near an outline."""
        xs, ys = zip(*outline, strict=True)
        reach = path + 1.0  # the squares of a piece are found at points that are 2 m apart
        squares = (
            (column, row)
            for column in range(
                math.floor((min(xs) - reach) / _SQUARE_M), math.floor((max(xs) + reach) / _SQUARE_M) + 1
            )
            for row in range(math.floor((min(ys) - reach) / _SQUARE_M), math.floor((max(ys) + reach) / _SQUARE_M) + 1)
        )
        return list(dict.fromkeys(piece for square in squares for piece in self._squares.get(square, ())))

    def _blocked(self, lane: str, part: _Part) -> Iterator[tuple[str, float]]:
        """Yield the first vehicle that a part blocks on each way to it, with its distance from the part in m."""
        found = self._first(sumo.lane_getLastStepVehicleIDs(lane), part, 0.0, ())
        if found is None:
            yield from self._blocked_before(lane, part, 0.0, ())
        elif found[0] not in self._controlled:
            yield found

    def _blocked_before(
        self, lane: str, part: _Part, start: float, links: tuple[LaneLink, ...]
    ) -> Iterator[tuple[str, float]]:
        """Yield the first vehicle that a part blocks on each way to the start of a lane.

        The lane starts at ``start`` in the frame of the part's lane, in m, not above 0. The links lead from this lane
        to the part, in driving order.
        """
        graph = self._graph
        for source, link in graph.lanes[lane].entries:
            inside = link.inside[: link.inside.index(lane)] if lane in link.inside else link.inside
            ways = [*((one, links) for one in reversed(inside)), (source, (link, *links))]
            end = start
            for name, needed in ways:
                if -end > _look_m(graph.lanes[name].data.speed_mps):
                    break
                end -= graph.lanes[name].data.length_m
                found = self._first(sumo.lane_getLastStepVehicleIDs(name), part, end, needed)
                if found is not None:
                    if found[0] not in self._controlled:
                        yield found
                    break
            else:
                yield from self._blocked_before(source, part, end, (link, *links))

    def _first(
        self, vehicles: Sequence[str], part: _Part, start: float, links: tuple[LaneLink, ...]
    ) -> tuple[str, float] | None:
        """Return the first vehicle of a lane that a part blocks, and its distance from the part in m.

        The last vehicle comes first. The lane starts at ``start`` in the frame of the part's lane, in m. A vehicle must
        take the links to reach the part.
        """
        for vehicle in reversed(vehicles):
            aside = sumo.vehicle_getWidth(vehicle) / 2 + _SIDE_GAP_M
            middle = 0.0 if links else self._side * sumo.vehicle_getLateralLanePosition(vehicle)
            reach = part.reach(middle - aside, middle + aside)
            if reach is None:
                continue
            gap = reach[0] - start - sumo.vehicle_getLanePosition(vehicle)
            if gap >= 0.0 and _takes(vehicle, links):
                return vehicle, gap
        return None

    @property
    def _side(self) -> float:
        """The sign of SUMO's lateral positions: SUMO mirrors left-hand traffic."""
        return -1.0 if self._graph.is_left_hand else 1.0

    def _bound_of(self, vehicle: str, gap: float, agent: str, speed: float, decel: float) -> float | None:
        """Return the highest speed of a vehicle in the next step; None if it is not bounded, or sees the part.

        The gap is that to the part, in m. Speed and deceleration are those of the agent's vehicle, in m/s and m/s².
        """
        commanded = VehicleCommand.speeds.get(vehicle, math.inf)
        if commanded is None or vehicle in commanded_elsewhere:
            return None
        now, least = sumo.vehicle_getSpeed(vehicle), sumo.vehicle_getMinGap(vehicle)
        bound = max(0.0, sumo.vehicle_getFollowSpeed(vehicle, now, gap - least, speed, decel, agent))
        if bound >= min(
            now + sumo.vehicle_getAccel(vehicle) * self._dt, sumo.vehicle_getAllowedSpeed(vehicle), commanded
        ):
            return None
        leader = sumo.vehicle_getLeader(vehicle, gap + 2 * least)
        if leader is not None and leader[0] == agent and leader[1] + least <= gap + _SAME_PLACE * least:
            return None
        least_speed = now - sumo.vehicle_getEmergencyDecel(vehicle) * self._dt
        return float(max(bound, least_speed))

    def _near_in_next_lanes(self, lane: str, part: _Part, agent: str, decel: float) -> Iterator[str]:
        """Yield the vehicles in the neighbouring lanes that are too near to a part to change to its lane."""
        graph = self._graph
        own = graph.lanes[lane]
        for other in (one for one in graph.edges[own.edge] if abs(one.index - own.index) == 1):
            for vehicle in sumo.lane_getLastStepVehicleIDs(other.id):
                if vehicle in self._controlled or vehicle in VehicleCommand.lanes:
                    continue
                aside = sumo.vehicle_getWidth(vehicle) / 2 + _SIDE_GAP_M
                reach = part.reach(-aside, aside)
                place = sumo.vehicle_getLanePosition(vehicle)
                if reach is None:
                    continue
                speed, ahead = sumo.vehicle_getSpeed(vehicle), place - sumo.vehicle_getLength(vehicle) - reach[1]
                if ahead <= 0.0:
                    gap, behind = reach[0] - place, vehicle
                    safe = sumo.vehicle_getSecureGap(vehicle, speed, part.speed, decel, agent)
                elif agent not in self._ignored_ahead:
                    gap, behind = ahead, agent
                    safe = sumo.vehicle_getSecureGap(agent, part.speed, speed, sumo.vehicle_getDecel(vehicle), vehicle)
                else:
                    continue
                if gap < safe + sumo.vehicle_getMinGap(behind):
                    yield vehicle


def _look_m(speed_mps: float) -> float:
    """Return how far behind a part vehicles of a lane are examined."""
    return min(_MAX_LOOK_M, speed_mps * _TIME_S + speed_mps * speed_mps / (2 * _BRAKING_MPS2))


def _takes(vehicle: str, links: Sequence[LaneLink]) -> bool:
    """Return whether a vehicle takes the links to a part."""
    if not links:
        return True
    found = sumo.vehicle_getNextLinks(vehicle)
    return len(found) >= len(links) and all(one[0] == link.target for one, link in zip(found, links, strict=False))


def _squares_along(piece: Piece) -> set[tuple[int, int]]:
    """Return the squares in which a piece has points that are 2 m apart."""
    count = math.ceil(piece.length / 2.0)
    return {
        (
            math.floor((piece.x + piece.length * number / count * piece.cos) / _SQUARE_M),
            math.floor((piece.y + piece.length * number / count * piece.sin) / _SQUARE_M),
        )
        for number in range(count + 1)
    }


def _clipped(outline: Polygon, axis: int, border: float, *, above: bool) -> Polygon:
    """Return the part of a convex polygon above or below a border (Sutherland and Hodgman, 1974)."""
    found = []
    for before, after in zip((outline[-1], *outline[:-1]) if outline else (), outline, strict=True):
        one, two = before[axis] - border, after[axis] - border
        if (one > 0.0) != (two > 0.0):
            share = one / (one - two)
            found.append((before[0] + share * (after[0] - before[0]), before[1] + share * (after[1] - before[1])))
        if (two > 0.0) == above or two == 0.0:
            found.append(after)
    return found
