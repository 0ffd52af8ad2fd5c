"""The contents of a SUMO network: roads, lanes, permitted vehicle classes and junctions."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, BinaryIO, cast

from crashhunt.base.errors import ScenarioError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

Point = tuple[float, float]
CAR, TRUCK, BICYCLE, PERSON = "passenger", "truck", "bicycle", "pedestrian"
DEFAULT_WIDTH_M = 3.2  # SUMO's, of a lane without a width


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkLane:
    """One lane of a road."""

    length_m: float  # length of the lane, in m
    speed_mps: float  # the speed limit, in m/s
    allowed: frozenset[str] | None  # the vehicle classes that may use the lane; None for all
    disallowed: frozenset[str]  # the vehicle classes that may not use the lane
    shape: tuple[Point, ...]  # centre line of the lane, in m
    width_m: float = DEFAULT_WIDTH_M  # width of the lane, in m
    # the vehicle classes that may change to the lane with the next index; None for all
    change_up: frozenset[str] | None = None
    # the vehicle classes that may change to the lane with the previous index; None for all
    change_down: frozenset[str] | None = None
    stop_offset_m: float = 0.0  # distance of the stop line before the end of the lane, in m (SUMO's ``stopOffset``)
    # the vehicle classes with this stop line; None for all. All others stop at the end of the lane.
    offset_for: frozenset[str] | None = None
    not_offset_for: frozenset[str] = frozenset()  # the vehicle classes without this stop line

    def offset_m(self, vehicle_class: str) -> float:
        """Return the distance of the stop line for a class of vehicles before the end of the lane, in m."""
        meant = self.offset_for is None or vehicle_class in self.offset_for or "all" in self.offset_for
        return self.stop_offset_m if meant and vehicle_class not in self.not_offset_for else 0.0

    def admits(self, vehicle_class: str) -> bool:
        """Return whether vehicles of a class may use the lane."""
        if self.allowed is not None:
            return vehicle_class in self.allowed or "all" in self.allowed
        return vehicle_class not in self.disallowed and "all" not in self.disallowed


@dataclass(frozen=True, slots=True)
class Edge:
    """A road in one direction, from one junction to the next."""

    id: str  # SUMO's id of the road
    name: str  # name of the street; empty if the map has none
    lanes: tuple[NetworkLane, ...]  # lanes from right to left in right-hand traffic
    ends: tuple[str, str] = ("", "")  # ids of the junctions from which and to which it leads; empty inside junctions

    def admits(self, vehicle_class: str) -> bool:
        """Return whether vehicles of a class may use a lane of the road."""
        return any(lane.admits(vehicle_class) for lane in self.lanes)

    def open_lanes(self, vehicle_class: str) -> tuple[NetworkLane, ...]:
        """Return the lanes of the road that vehicles of a class may use."""
        return tuple(lane for lane in self.lanes if lane.admits(vehicle_class))

    @property
    def length_m(self) -> float:
        """The length of the road, in m."""
        return self.lanes[0].length_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Connection:
    """A connection from a lane to a following lane."""

    source: str  # the lane from which the connection starts; it may be inside a junction
    target: str  # the lane to which the connection leads; it is never inside a junction
    via: str  # the next lane inside the junction; empty if there is none
    signal: str  # id of the traffic light that controls the connection; empty if there is none
    signal_index: int  # index of the connection in the state of the traffic light; -1 if there is none
    direction: str  # direction of the turn: ``s`` straight, ``l`` left, ``r`` right, ``t`` turnaround and so on
    # state of the connection, as in SUMO: ``M`` major, ``m`` minor, ``=`` equal, ``s`` stop, ``w`` all-way stop
    state: str


@dataclass(frozen=True, slots=True)
class Junction:
    """The rules of a junction."""

    id: str  # id of the junction
    type: str  # type of the junction, such as ``priority`` or ``traffic_light``
    inside: tuple[str, ...]  # the last lane inside the junction of each path across it, in the order of the rules
    yields: Mapping[int, frozenset[int]]  # for each path, the indices of the paths that it has to yield to
    foes: Mapping[int, frozenset[int]]  # for each path, the indices of the paths that it conflicts with


@dataclass(slots=True)
class RoadNetwork:
    """A road network. Roads and the lanes inside junctions are apart."""

    edges: dict[str, Edge] = field(default_factory=dict)  # edges by id, in the order of the file
    # number of junctions of each type; ends of roads are not counted
    junctions: Counter[str] = field(default_factory=Counter)
    crossings: int = 0  # number of pedestrian crossings
    left_hand: bool = False  # whether traffic drives on the left
    areas: list[tuple[Point, ...]] = field(default_factory=list)  # the outlines of junctions, in m
    # paths across junctions and crossings as edges, by id; empty if they were not read
    inside: dict[str, Edge] = field(default_factory=dict)
    # the connections of all lanes; empty if they were not read
    connections: list[Connection] = field(default_factory=list)
    rules: dict[str, Junction] = field(default_factory=dict)  # the junctions by id; empty if they were not read

    def drivable(self) -> list[Edge]:
        """Return the roads that cars may use."""
        return [edge for edge in self.edges.values() if edge.admits(CAR)]


_DEAD_END_TYPES = {"dead_end", "unregulated", "district"}


def read_network(path: Path, *, with_junctions: bool = False) -> RoadNetwork:
    """Return the contents of a network file.

    The file may be compressed. With ``with_junctions``, lanes inside junctions, connections and the rules of junctions
    are read, too.

    Raises:
        ScenarioError: the file is not a network of SUMO.
    """
    found = RoadNetwork()
    try:
        with _open(path) as file:
            _read(ET.iterparse(file, events=("start", "end")), found, with_junctions=with_junctions)
    except (ET.ParseError, UnicodeDecodeError, LookupError, ValueError) as error:
        fix = "make the network again with netconvert"
        raise ScenarioError(f"not a valid network: {error}", fix=fix, where=str(path)) from None
    return found


def is_left_hand(path: Path) -> bool:
    """Return whether traffic drives on the left in a network file, which may be compressed."""
    with _open(path) as file:
        _, root = next(iter(ET.iterparse(file, events=("start",))))
    return bool(root.get("lefthand") == "true")


def _open(path: Path) -> BinaryIO:
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    return cast("BinaryIO", gzip.open(path)) if packed else path.open("rb")


def _read(events: Iterator[tuple[str, ET.Element]], found: RoadNetwork, *, with_junctions: bool) -> None:
    root: ET.Element | None = None
    for event, element in events:
        if event == "start":
            if root is None:
                root = element
                found.left_hand = element.get("lefthand") == "true"
            continue
        if element.tag == "edge":
            function = element.get("function", "normal")
            if function == "crossing":
                found.crossings += 1
            if element.get("id", "").startswith(":"):
                if with_junctions and function != "walkingarea":
                    found.inside[element.get("id", "")] = _edge(element)
            elif function == "normal":
                edge = _edge(element)
                if edge.lanes:
                    found.edges[edge.id] = edge
        elif element.tag == "junction" and element.get("type") != "internal":
            if element.get("type", "") not in _DEAD_END_TYPES:
                found.junctions[element.get("type", "")] += 1
            area = tuple(_point(word) for word in element.get("shape", "").split())
            found.areas += [area] if len(area) > 2 else []
            if with_junctions:
                junction = _junction(element)
                found.rules[junction.id] = junction
        elif element.tag == "connection" and with_junctions:
            found.connections.append(_connection(element))
        if element.tag in ("edge", "junction", "connection", "tlLogic") and root is not None:
            root.clear()  # a network may have hundreds of megabytes


def _edge(element: ET.Element) -> Edge:
    lanes = []
    of_edge = element.find("stopOffset")
    for lane in element.iter("lane"):
        own = lane.find("stopOffset")
        offset = own if own is not None else of_edge if of_edge is not None else ET.Element("stopOffset")
        shape = tuple(_point(word) for word in lane.get("shape", "").split())
        lanes.append(
            NetworkLane(
                length_m=float(lane.get("length", "0")),
                speed_mps=float(lane.get("speed", "13.89")),
                allowed=_classes(lane, "allow"),
                disallowed=_classes(lane, "disallow") or frozenset(),
                shape=shape,
                width_m=float(lane.get("width", DEFAULT_WIDTH_M)),
                change_up=_classes(lane, "changeLeft"),
                change_down=_classes(lane, "changeRight"),
                stop_offset_m=float(offset.get("value", "0")),
                offset_for=_classes(offset, "vClasses"),
                not_offset_for=_classes(offset, "exceptions") or frozenset(),
            )
        )
    ends = element.get("from", ""), element.get("to", "")
    return Edge(element.get("id", ""), element.get("name", ""), tuple(lanes), ends=ends)


def _classes(element: ET.Element, attribute: str) -> frozenset[str] | None:
    text = element.get(attribute)
    return None if text is None else frozenset(text.split())


def _connection(element: ET.Element) -> Connection:
    source, target = (f"{element.attrib[end]}_{element.attrib[f'{end}Lane']}" for end in ("from", "to"))
    return Connection(
        source=source,
        target=target,
        via=element.get("via", ""),
        signal=element.get("tl", ""),
        signal_index=int(element.get("linkIndex", "-1")),
        direction=element.get("dir", ""),
        state=element.get("state", ""),
    )


def _junction(element: ET.Element) -> Junction:
    yields, foes = (
        {int(request.attrib["index"]): _indices(request.get(bits, "")) for request in element.iter("request")}
        for bits in ("response", "foes")
    )
    return Junction(
        id=element.get("id", ""),
        type=element.get("type", ""),
        inside=tuple(element.get("intLanes", "").split()),
        yields=yields,
        foes=foes,
    )


def _indices(bits: str) -> frozenset[int]:
    """Return the indices of a bit set; SUMO writes the bit with index 0 last."""
    return frozenset(index for index, bit in enumerate(reversed(bits)) if bit == "1")


def _point(word: str) -> Point:
    x, y, *_ = word.split(",")
    return float(x), float(y)
