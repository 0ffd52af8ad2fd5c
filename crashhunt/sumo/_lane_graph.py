"""The lanes of a network as a graph with geometry, prepared once per network, and routes on this graph."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property, partial
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.sumo._options import SumoSetup
from crashhunt.sumo.maps import read_network
from crashhunt.world import LaneLines, MapLane, RoadMap, StopLine, lane_lines, spaced_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.scenario import Scenario
    from crashhunt.sumo.maps import NetworkLane, RoadNetwork

    Line = NDArray[np.float64]

USUAL_CLASS = "passenger"  # of vehicles whose type names no class
MAX_PREPARING_S = 0.3  # of lanes, and of conflicts, of a large network; it has no effect on results
_BUCKET_M = 32.0  # edge length of the squares that points of lanes are sorted into
_BLEND_M = 50.0  # length of a lane change of a reference path
_MAX_TURN_PATH = 20  # lanes inside a junction that follow each other; more are a faulty network
# The classes of SUMO's vehicles, which a network file lists only where a lane is not open for all.
VEHICLE_CLASSES = frozenset(
    (
        "private", "emergency", "authority", "army", "vip", "pedestrian", "passenger", "hov", "taxi", "bus", "coach",
        "delivery", "truck", "trailer", "motorcycle", "moped", "bicycle", "evehicle", "tram", "rail_urban", "rail",
        "rail_electric", "rail_fast", "ship", "container", "cable_car", "subway", "aircraft", "wheelchair", "scooter",
        "drone", "custom1", "custom2",
    )
)  # fmt: skip


class LaneLink(NamedTuple):
    """A path from one road's lane to another road's lane."""

    target: str  # the lane that it leads to
    inside: tuple[str, ...]  # the lanes inside the junction, in driving order
    length_m: float  # total length of the lanes inside the junction, in m
    signal: str  # id of the traffic light; empty if there is none
    signal_index: int  # index of the link in the state of the traffic light
    direction: str  # direction as in SUMO: ``s`` straight, ``l`` left and so on
    state: str  # state as in SUMO: ``M`` major, ``m`` minor, ``=`` equal, ``s`` stop, ``w`` allway stop


@dataclass(slots=True, eq=False)
class GraphLane:
    """A lane of the graph."""

    id: str  # id of the lane
    edge: str  # id of its edge
    index: int  # index on its edge
    data: NetworkLane  # the contents of the network file
    # links from the lane; of a lane inside a junction, the rest of its link
    links: list[LaneLink] = field(default_factory=list)
    # the lanes of roads, and the links from them, that lead to the lane or through it
    entries: list[tuple[str, LaneLink]] = field(default_factory=list)
    lines: LaneLines | None = None
    line_m: float | None = None

    @property
    def is_internal(self) -> bool:
        """Whether the lane is inside a junction."""
        return self.id.startswith(":")


class LaneGraph:
    """The lanes of a network, including those inside junctions."""

    def __init__(self, network: RoadNetwork) -> None:
        self.is_left_hand = network.left_hand  # whether traffic drives on the left
        self.rules = network.rules  # the rules of the junctions, by id
        self.lanes: dict[str, GraphLane] = {}  # the lanes by id
        self.edges: dict[str, list[GraphLane]] = {}  # the lanes of each edge, by id of the edge
        self._ends = {edge.id: edge.ends for edge in network.edges.values()}
        self._between: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
        for name, ends in self._ends.items():
            self._between[ends].append(name)
        for edge in (*network.edges.values(), *network.inside.values()):
            lanes = [
                GraphLane(id=f"{edge.id}_{index}", edge=edge.id, index=index, data=lane)
                for index, lane in enumerate(edge.lanes)
            ]
            self.edges[edge.id] = lanes
            self.lanes |= {lane.id: lane for lane in lanes}
        self._yielding = {
            one.inside[index]
            for one in network.rules.values()
            for index, others in one.yields.items()
            if others and index < len(one.inside)
        }
        self._successors: dict[str, tuple[str, ...]] = {}
        self._add_links(network)
        self._guides: dict[tuple[tuple[str, ...], str], RouteGuide] = {}
        self._maps: dict[str, MappingProxyType[str, MapLane]] = {}
        self._indices: dict[str, _PointIndex] = {}

    def _add_links(self, network: RoadNetwork) -> None:
        onward = {one.source: one for one in network.connections if one.source.startswith(":")}
        successors: defaultdict[str, list[str]] = defaultdict(list)
        for one in network.connections:
            if one.source not in self.lanes or one.target not in self.lanes:
                continue
            successors[one.source].append(one.via or one.target)
            if one.source.startswith(":"):
                continue
            inside: list[str] = []
            via = one.via
            while via in self.lanes and len(inside) < _MAX_TURN_PATH:
                inside.append(via)
                via = onward[via].via if via in onward else ""
            link = LaneLink(
                one.target, tuple(inside), sum(self.lanes[lane].data.length_m for lane in inside),
                one.signal, one.signal_index, one.direction, one.state,
            )  # fmt: skip
            self.lanes[one.source].links.append(link)
            self.lanes[one.target].entries.append((one.source, link))
            for number, lane in enumerate(inside):
                rest = tuple(inside[number + 1 :])
                length = sum(self.lanes[later].data.length_m for later in rest)
                self.lanes[lane].links.append(link._replace(inside=rest, length_m=length))
                self.lanes[lane].entries.append((one.source, link))
        self._successors = {lane: tuple(dict.fromkeys(found)) for lane, found in successors.items()}

    def successors(self, lane: str) -> tuple[str, ...]:
        """Return the lanes that a lane leads into, including lanes inside junctions."""
        return self._successors.get(lane, ())

    def length(self, lane: str) -> float:
        """Return the length of a lane as SUMO measures it, in m."""
        found = self.lanes.get(lane)
        return found.data.length_m if found is not None else 0.0

    def lines(self, lane: GraphLane) -> LaneLines:
        """Return the lines of a lane."""
        if lane.lines is None:
            lane.lines = lane_lines(lane.data.shape or ((0.0, 0.0),), lane.data.width_m)
        return lane.lines

    def line_length(self, lane: GraphLane) -> float:
        """Return the length of a lane's centre line, in m."""
        if lane.line_m is None:
            lane.line_m = float(np.hypot(*np.diff(self.lines(lane).center, axis=0).T).sum())
        return lane.line_m

    def open_lanes(self, edge: str, vehicle_class: str) -> list[GraphLane]:
        """Return the lanes of an edge that a class of vehicles may use."""
        return [lane for lane in self.edges.get(edge, ()) if is_open(lane.data, vehicle_class)]

    def neighbor(self, lane: GraphLane, change: int) -> GraphLane | None:
        """Return the neighbouring lane to the left (1) or to the right (-1); None if there is none."""
        index = lane.index + (-change if self.is_left_hand else change)
        lanes = self.edges[lane.edge]
        return lanes[index] if 0 <= index < len(lanes) else None

    def opposite(self, edge: str, median_m: float) -> list[GraphLane]:
        """Return the lanes of the roads that lead back between the junctions of a road, next to it.

        The two directions are at most ``median_m`` apart, half way along the road.
        """
        if edge not in self._ends:
            return []
        own, found = self.edges[edge][-1], []
        middle = self.lines(own).center[len(self.lines(own).center) // 2]
        for other in self._between.get(self._ends[edge][::-1], ()):
            inner = self.edges[other][-1]
            away = float(np.hypot(*(self.lines(inner).center - middle).T).min())
            if away <= median_m + (own.data.width_m + inner.data.width_m) / 2:
                found += self.edges[other]
        return found

    def may_change(self, lane: GraphLane, change: int, vehicle_class: str) -> bool:
        """Return whether a class of vehicles may change to the left (1) or right (-1), by the lanes and the marking."""
        other = self.neighbor(lane, change)
        if other is None or not is_open(other.data, vehicle_class):
            return False
        allowed = lane.data.change_up if other.index > lane.index else lane.data.change_down
        return allowed is None or vehicle_class in allowed or "all" in allowed

    def straightest(self, lane: GraphLane, vehicle_class: str) -> LaneLink | None:
        """Return the link of a lane that turns least."""
        links = [link for link in lane.links if is_open(self.lanes[link.target].data, vehicle_class)]
        return min(links, key=lambda link: TURNS.find(link.direction), default=None)

    def lanes_for(self, vehicle_class: str) -> MappingProxyType[str, MapLane]:
        """Return all lanes for the map of an agent whose vehicle has a class."""
        found = self._maps.get(vehicle_class)
        if found is None:
            predecessors: defaultdict[str, list[str]] = defaultdict(list)
            for lane, targets in self._successors.items():
                for target in targets:
                    predecessors[target].append(lane)
            found = self._maps[vehicle_class] = MappingProxyType(
                {lane.id: self._map_lane(lane, vehicle_class, predecessors[lane.id]) for lane in self.lanes.values()}
            )
        return found

    def _map_lane(self, lane: GraphLane, vehicle_class: str, predecessors: Iterable[str]) -> MapLane:
        left, right = self.neighbor(lane, 1), self.neighbor(lane, -1)
        lines, data = self.lines(lane), lane.data
        return MapLane(
            id=lane.id, road=lane.edge, index=lane.index,
            center=lines.center, left_line=lines.left, right_line=lines.right,
            width=data.width_m, speed_limit=data.speed_mps, length=data.length_m,
            successors=self.successors(lane.id), predecessors=tuple(predecessors),
            left=left.id if left is not None else "", right=right.id if right is not None else "",
            can_change_left=self.may_change(lane, 1, vehicle_class),
            can_change_right=self.may_change(lane, -1, vehicle_class),
            allowed=allowed_classes(data), is_open=is_open(data, vehicle_class), is_internal=lane.is_internal,
        )  # fmt: skip

    @cached_property
    def has_stop_offsets(self) -> bool:
        """Whether a stop line lies before the end of its lane."""
        return any(lane.data.stop_offset_m for lane in self.lanes.values())

    @cached_property
    def stop_lines(self) -> tuple[StopLine, ...]:
        """The stop lines of all lanes that end at a junction where a car may have to stop."""
        return self.stop_lines_for(USUAL_CLASS)

    def stop_lines_for(self, vehicle_class: str) -> tuple[StopLine, ...]:
        """Return the stop lines of all lanes that end at a junction where a vehicle of a class may have to stop."""
        found = []
        for lane in self.lanes.values():
            kind = "" if lane.is_internal else self._stop_kind(lane)
            if not kind:
                continue
            before = lane.data.offset_m(vehicle_class) / max(lane.data.length_m, 1e-9)
            ends = _across(self.lines(lane), 1.0 - before)
            ends.flags.writeable = False
            inside = next((link.inside[0] for link in lane.links if link.inside), "")
            signal = next((link.signal for link in lane.links if link.signal), "")
            found.append(StopLine(lane=lane.id, junction=junction_of(inside), ends=ends, kind=kind, signal=signal))
        return tuple(found)

    def _stop_kind(self, lane: GraphLane) -> str:
        states = {link.state for link in lane.links}
        if any(link.signal for link in lane.links):
            return "traffic_light"
        if "w" in states or "s" in states:
            return "allway_stop" if "w" in states else "stop"
        if "=" in states:
            return "right_before_left"
        yields = any(link.inside and link.inside[-1] in self._yielding for link in lane.links)
        return "yield" if yields and "m" in states else ""

    def guide(self, edges: tuple[str, ...], vehicle_class: str) -> RouteGuide:
        """Return the guide of a route."""
        found = self._guides.get((edges, vehicle_class))
        if found is None:
            found = self._guides[edges, vehicle_class] = RouteGuide(self, edges, vehicle_class)
        return found

    def near(self, x: float, y: float, radius_m: float, vehicle_class: str) -> list[tuple[float, str]]:
        """Return the lanes for a class of vehicles near a point, the nearest first: distance in m, id.

        The distance is that of the nearest point of the centre line, of points that are at most 2 m apart.
        """
        index = self._indices.get(vehicle_class)
        if index is None:
            lanes = [lane for lane in self.lanes.values() if is_open(lane.data, vehicle_class)]
            index = self._indices[vehicle_class] = _PointIndex(lanes, [self.lines(lane).center for lane in lanes])
        return index.near(x, y, radius_m)


TURNS = "sLRlrTt"  # from straight to turning around; a direction that SUMO adds later is first


def is_open(lane: NetworkLane, vehicle_class: str) -> bool:
    """Return whether a class of vehicles may use a lane."""
    return vehicle_class == "ignoring" or lane.admits(vehicle_class)


def allowed_classes(lane: NetworkLane) -> frozenset[str]:
    """Return the vehicle classes that may use a lane."""
    return frozenset(name for name in VEHICLE_CLASSES if lane.admits(name))


def junction_of(lane: str) -> str:
    """Return the junction of a lane inside a junction, such as ``A_1`` of ``:A_1_0_0``; empty for other lanes."""
    return lane[1:].rpartition("_")[0].rpartition("_")[0] if lane.startswith(":") else ""


class _PointIndex:
    """Finds the lanes near a point."""

    def __init__(self, lanes: Sequence[GraphLane], centers: Sequence[Line]) -> None:
        self._names = [lane.id for lane in lanes]
        self._points = np.concatenate(centers) if centers else np.zeros((0, 2))
        self._owner = np.repeat(np.arange(len(lanes)), [len(center) for center in centers])
        squares = np.floor(self._points / _BUCKET_M).astype(int)
        order = np.lexsort((squares[:, 1], squares[:, 0]))
        squares = squares[order]
        begins = np.flatnonzero(np.append(True, np.any(np.diff(squares, axis=0) != 0, axis=1))[: len(order)])
        ends = np.append(begins[1:], len(order))
        self._buckets = {
            (int(squares[begin, 0]), int(squares[begin, 1])): order[begin:end]
            for begin, end in zip(begins, ends, strict=True)
        }

    def near(self, x: float, y: float, radius_m: float) -> list[tuple[float, str]]:
        low_x, low_y, high_x, high_y = (
            math.floor((value + side * radius_m) / _BUCKET_M) for side in (-1.0, 1.0) for value in (x, y)
        )
        parts = [
            part
            for column in range(low_x, high_x + 1)
            for row in range(low_y, high_y + 1)
            if (part := self._buckets.get((column, row))) is not None
        ]
        if not parts:
            return []
        rows = np.concatenate(parts)
        squared = ((self._points[rows] - (x, y)) ** 2).sum(axis=1)
        nearest = np.full(len(self._names), math.inf)
        np.minimum.at(nearest, self._owner[rows], squared)
        found = np.flatnonzero(nearest <= radius_m * radius_m).tolist()
        return sorted((math.sqrt(nearest[owner]), self._names[owner]) for owner in found)


def lane_graph(scenario: Scenario) -> LaneGraph:
    """Return the lanes of a scenario's network.

    Raises:
        ScenarioError: the network file cannot be read.
    """
    path = scenario.folder / scenario.table(SumoSetup).net
    return LaneGraph(read_network(path, with_junctions=True))


class RouteSignal(NamedTuple):
    """A traffic light on a route."""

    distance_m: float  # distance of its stop line from the start of the lane for which it was looked up, in m
    id: str  # id of the traffic light
    link: int  # index of the link in its state


class RouteStep(NamedTuple):
    """What follows from a lane of a road on a route."""

    link: LaneLink | None  # the link to the next road of the route; None if the lane does not lead there, or at the end
    reach: int  # index of the last road of the route that can be reached without a lane change
    changes: int  # number of lane changes that are necessary on this road
    run_m: float  # distance from the start of the lane to where it leaves the route or the route ends, in m
    rest_m: float  # distance from the start of the lane to the end of the route, in m, with lane changes


class RouteGuide:
    """A route on the graph: which lanes to use, and what lies ahead.

    The best lanes of a road are those on which the route can be followed furthest without a lane change. Of these, the
    lanes with the fewest lane changes behind them are the best.
    """

    def __init__(self, graph: LaneGraph, edges: tuple[str, ...], vehicle_class: str) -> None:
        self.graph, self.edges, self.vehicle_class = graph, edges, vehicle_class
        self._steps: list[dict[str, RouteStep]] = [{} for _ in edges]
        self._best: list[list[GraphLane]] = [[] for _ in edges]
        for number in reversed(range(len(edges))):
            self._look_ahead(number)

    def _look_ahead(self, number: int) -> None:
        """Find what follows from each lane of an edge, after the following edges are known."""
        graph, steps = self.graph, self._steps[number]
        lanes = graph.open_lanes(self.edges[number], self.vehicle_class)
        later = self._steps[number + 1] if number + 1 < len(self.edges) else {}
        ends = []
        for lane in lanes:
            links = [link for link in lane.links if link.target in later]
            if not links:
                ends.append(lane)
                continue
            link = min(links, key=partial(self._preference, later, lane.index))
            best = self.best(number + 1, graph.lanes[link.target])
            before = lane.data.length_m + link.length_m
            rest = later[best.id].rest_m if best is not None else 0.0
            after = later[link.target]
            steps[lane.id] = RouteStep(link, after.reach, after.changes, before + after.run_m, before + rest)
        through = [lane for lane in lanes if lane.id in steps]
        top = min(((-steps[lane.id].reach, steps[lane.id].changes) for lane in through), default=None)
        self._best[number] = [lane for lane in through if top == (-steps[lane.id].reach, steps[lane.id].changes)]
        for lane in ends:
            length = lane.data.length_m
            target = self.best(number, lane)
            changes = abs(target.index - lane.index) if target is not None else 0
            rest = steps[target.id].rest_m if target is not None else length
            steps[lane.id] = RouteStep(None, number, changes, length, rest)
        if not through:
            self._best[number] = lanes

    def _preference(self, later: Mapping[str, RouteStep], index: int, link: LaneLink) -> tuple[int, int, int, str]:
        """Return the sort key of the links of a lane along the route; the best link has the smallest key."""
        after = later[link.target]
        return -after.reach, after.changes, abs(self.graph.lanes[link.target].index - index), link.target

    def best(self, number: int, lane: GraphLane) -> GraphLane | None:
        """Return the best lane of an edge of the route that is nearest to a lane of this edge."""
        return min(self._best[number], key=lambda one: (abs(one.index - lane.index), one.index), default=None)

    def step(self, number: int, lane: str) -> RouteStep | None:
        """Return what follows from a lane of an edge of the route; None if the vehicle may not use the lane."""
        return self._steps[number].get(lane) if 0 <= number < len(self._steps) else None

    def follows(self, number: int, lane: GraphLane) -> bool:
        """Return whether a lane is on the route: on an edge of it, or inside the junction behind this edge."""
        if not 0 <= number < len(self.edges):
            return False
        if not lane.is_internal:
            return lane.edge == self.edges[number]
        return number + 1 < len(self.edges) and any(
            self.graph.lanes[link.target].edge == self.edges[number + 1] for link in lane.links
        )

    def walk(self, number: int, lane: GraphLane, *, is_best: bool) -> Iterator[tuple[GraphLane, int, LaneLink | None]]:
        """Yield the lanes ahead, from a lane on: the lane, the index of its edge, and the link that follows.

        Lanes inside junctions are yielded with the index of the edge before and the rest of their link. The number is
        the index of the edge on the route; inside a junction, of the edge before. With ``is_best``, the walk begins on
        the best lane instead; otherwise, a lane that leads on is kept.
        """
        graph, current = self.graph, lane
        if lane.is_internal:
            link = self.link(number, lane)
            yield lane, number, link
            if link is None:
                return
            for inside in link.inside:
                yield graph.lanes[inside], number, self.link(number, graph.lanes[inside])
            number, current = number + 1, graph.lanes[link.target]
        while number < len(self.edges):
            step = self.step(number, current.id)
            if is_best or step is None or step.link is None:
                current = self.best(number, current) or current
                step = self.step(number, current.id)
            link = step.link if step is not None else None
            yield current, number, link
            if link is None:
                return
            for inside in link.inside:
                yield graph.lanes[inside], number, self.link(number, graph.lanes[inside])
            number, current = number + 1, graph.lanes[link.target]

    def link(self, number: int, lane: GraphLane) -> LaneLink | None:
        """Return the link of a lane that leads along the route; inside a junction, the rest of it; None without one.

        The number is the index of the lane's edge on the route; inside a junction, of the edge before.
        """
        if not lane.is_internal:
            step = self.step(number, lane.id)
            return step.link if step is not None else None
        if not 0 <= number < len(self.edges) - 1:
            return None
        wanted = self.edges[number + 1]
        return next((link for link in lane.links if self.graph.lanes[link.target].edge == wanted), None)

    def rest_m(self, number: int, lane: GraphLane) -> float:
        """Return the distance from the start of a lane of the route to the end of the route, in m."""
        step = self.step(number, lane.id)
        return step.rest_m if step is not None else 0.0

    def signals(self, number: int, lane: GraphLane, limit: int) -> list[RouteSignal]:
        """Return the next traffic lights ahead of the start of a lane, along the lane as long as it leads on."""
        found: list[RouteSignal] = []
        distance = 0.0
        for current, _, link in self.walk(number, lane, is_best=False):
            distance += current.data.length_m
            if link is not None and link.signal and not current.is_internal:
                line = distance - current.data.offset_m(self.vehicle_class)
                found.append(RouteSignal(line, link.signal, link.signal_index))
                if len(found) == limit:
                    break
        return found

    def lane_changes(self, number: int, lane: GraphLane) -> int:
        """Return the number of lane changes to the best lane of the edge, positive to the left."""
        best = self.best(number, lane)
        if best is None or lane.is_internal:
            return 0
        changes = best.index - lane.index
        return -changes if self.graph.is_left_hand else changes

    @property
    def goal(self) -> tuple[float, float]:
        """The end of the route, in m."""
        lanes = self._best[-1] if self._best else []
        if not lanes:
            return 0.0, 0.0
        x, y = self.graph.lines(lanes[0]).center[-1]
        return float(x), float(y)

    def lane_sequence(self, number: int, lane: GraphLane) -> tuple[str, ...]:
        """Return the lanes of the route from a lane on; at a lane change, both lanes of the road."""
        found = [lane.id]
        arrived = lane
        for current, _, link in self.walk(number, lane, is_best=True):
            if not current.is_internal and current is not arrived:
                found.append(arrived.id)
            found.append(current.id)
            if link is not None:
                arrived = self.graph.lanes[link.target]
        return tuple(name for place, name in enumerate(found) if not place or name != found[place - 1])

    def reference_path(self, number: int, lane: GraphLane | None) -> Line:
        """Return the centre of the route from a lane on, with smooth lane changes, shape (N, 2); empty without one."""
        parts = []
        if lane is None:
            return spaced_line(np.zeros((0, 2)))
        arrived = lane
        for current, _, link in self.walk(number, lane, is_best=True):
            center = self.graph.lines(current).center
            if not current.is_internal and current is not arrived:
                center = _blended(self.graph.lines(arrived).center, center)
            parts.append(center)
            if link is not None:
                arrived = self.graph.lanes[link.target]
        return spaced_line(np.concatenate(parts))

    def road_map(self, number: int, lane: GraphLane | None) -> RoadMap:
        """Return the map for an agent whose vehicle starts on a lane of the route, or off every lane."""
        is_on_route = lane is not None and self.follows(number, lane)
        return RoadMap(
            lanes=self.graph.lanes_for(self.vehicle_class),
            stop_lines=self.graph.stop_lines_for(self.vehicle_class),
            route=self.lane_sequence(number, lane) if lane is not None and is_on_route else (),
            reference_path=self.reference_path(number, lane if is_on_route else None),
            is_left_hand=self.graph.is_left_hand,
        )


def _across(lines: LaneLines, share: float) -> Line:
    """Return the left and the right end of a line across a lane at a share of its length, shape (2, 2)."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(lines.center, axis=0).T)))
    at = share * along[-1]
    return np.array([[np.interp(at, along, side[:, axis]) for axis in (0, 1)] for side in (lines.left, lines.right)])


def _blended(before: Line, after: Line) -> Line:
    """Return a line that begins on one lane and ends on another lane of the same road."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(after, axis=0).T)))
    total = float(along[-1])
    at = np.linspace(0.0, total, max(2, math.ceil(total) + 1))
    end = np.column_stack([np.interp(at, along, after[:, axis]) for axis in (0, 1)])
    from_along = np.append(0.0, np.cumsum(np.hypot(*np.diff(before, axis=0).T)))
    share_of = at / total * from_along[-1]
    start = np.column_stack([np.interp(share_of, from_along, before[:, axis]) for axis in (0, 1)])
    share = np.clip(at / min(total, _BLEND_M), 0.0, 1.0)
    smooth = (share * share * (3.0 - 2.0 * share))[:, None]
    found: Line = start + smooth * (end - start)
    return found
