"""The contents of a SUMO network: roads, lanes, permitted vehicle classes and junctions."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

Point = tuple[float, float]
CAR, TRUCK, BICYCLE, PERSON = "passenger", "truck", "bicycle", "pedestrian"


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkLane:
    """One lane of a road.

    Args:
        length_m: length of the lane, in m.
        speed_mps: the speed limit, in m/s.
        allowed: the vehicle classes that may use the lane; None for all.
        disallowed: the vehicle classes that may not use the lane.
        shape: centre line of the lane, in m.
    """

    length_m: float
    speed_mps: float
    allowed: frozenset[str] | None
    disallowed: frozenset[str]
    shape: tuple[Point, ...]

    def admits(self, vehicle_class: str) -> bool:
        """Return whether vehicles of a class may use the lane."""
        if self.allowed is not None:
            return vehicle_class in self.allowed or "all" in self.allowed
        return vehicle_class not in self.disallowed and "all" not in self.disallowed


@dataclass(frozen=True, slots=True)
class Edge:
    """A road in one direction, from one junction to the next.

    Args:
        id: SUMO's id of the road.
        name: name of the street; empty if the map has none.
        lanes: lanes from right to left in right-hand traffic.
    """

    id: str
    name: str
    lanes: tuple[NetworkLane, ...]

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


@dataclass(slots=True)
class RoadNetwork:
    """A road network, without the lanes inside junctions.

    Args:
        edges: edges by id, in the order of the file.
        junctions: number of junctions of each type; ends of roads are not counted.
        crossings: number of pedestrian crossings.
        left_hand: whether traffic drives on the left.
        areas: the outlines of junctions, in m.
    """

    edges: dict[str, Edge] = field(default_factory=dict)
    junctions: Counter[str] = field(default_factory=Counter)
    crossings: int = 0
    left_hand: bool = False
    areas: list[tuple[Point, ...]] = field(default_factory=list)

    def drivable(self) -> list[Edge]:
        """Return the roads that cars may use."""
        return [edge for edge in self.edges.values() if edge.admits(CAR)]


_DEAD_END_TYPES = {"dead_end", "unregulated", "district"}


def read_network(path: Path) -> RoadNetwork:
    """Return the contents of a network file.

    Raises:
        ScenarioError: the file is not a network of SUMO.
    """
    found = RoadNetwork()
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        with gzip.open(path) if packed else path.open("rb") as file:
            _read(ET.iterparse(file, events=("start", "end")), found)
    except (ET.ParseError, UnicodeDecodeError, LookupError, ValueError) as error:
        fix = "make the network again with netconvert"
        raise ScenarioError(f"not a valid network: {error}", fix=fix, where=str(path)) from None
    return found


def _read(events: Iterator[tuple[str, ET.Element]], found: RoadNetwork) -> None:
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
            elif function == "normal":
                edge = _edge(element)
                if edge.lanes:
                    found.edges[edge.id] = edge
        elif element.tag == "junction" and element.get("type") != "internal":
            if element.get("type", "") not in _DEAD_END_TYPES:
                found.junctions[element.get("type", "")] += 1
            area = tuple(_point(word) for word in element.get("shape", "").split())
            found.areas += [area] if len(area) > 2 else []
        if element.tag in ("edge", "junction", "connection", "tlLogic") and root is not None:
            root.clear()  # a network may have hundreds of megabytes


def _edge(element: ET.Element) -> Edge:
    lanes = []
    for lane in element.iter("lane"):
        allow = lane.get("allow")
        shape = tuple(_point(word) for word in lane.get("shape", "").split())
        lanes.append(
            NetworkLane(
                length_m=float(lane.get("length", "0")),
                speed_mps=float(lane.get("speed", "13.89")),
                allowed=frozenset(allow.split()) if allow is not None else None,
                disallowed=frozenset(lane.get("disallow", "").split()),
                shape=shape,
            )
        )
    return Edge(element.get("id", ""), element.get("name", ""), tuple(lanes))


def _point(word: str) -> Point:
    x, y, *_ = word.split(",")
    return float(x), float(y)
