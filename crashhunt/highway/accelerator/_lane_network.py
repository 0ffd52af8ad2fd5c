"""The lanes of a road network in highway-env's order, and in the compiled kernel."""

from __future__ import annotations

import inspect
import math
from typing import TYPE_CHECKING

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, SineLane, StraightLane
from highway_env.road.road import RoadNetwork

from crashhunt.highway.accelerator._kernel import CompiledNetwork, Contents, kernel
from crashhunt.highway.accelerator._supported import are_numbers, contents_of, is_plain

if TYPE_CHECKING:
    from highway_env.road.road import LaneIndex


class Network:
    """The lanes of a network, numbered in the order in which highway-env compares them.

    Attributes:
        lanes: All lanes, by number.
        index: The number of each lane, by its key.
        keys: The keys of all lanes, ordered by number.
        compiled: The lanes in the kernel, separately for roads that also search connected lanes for neighbours and for
            others.
        plain: Whether all lanes have a known class; otherwise the object must not be used.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        self.keys, self.lanes = _ordered_lanes(network)
        self._lane_extensions = _lane_extensions()
        self._contents = _contents(network, self.lanes)
        self.index = {key: number for number, key in enumerate(self.keys)}
        self.compiled: dict[bool, CompiledNetwork] = {}
        self.plain = type(network) is RoadNetwork and all(map(_is_known, self.lanes)) and bool(self.lanes)

    def is_of(self, network: RoadNetwork) -> bool:
        """Return whether the network still has the same lane objects, with unchanged keys and attributes."""
        return network is self.network and self._contents.is_same() and self._lane_extensions == _lane_extensions()

    def number_of(self, key: LaneIndex) -> int | None:
        """Return the number of a lane; None for a key that is unknown, such as a list, which is not hashable."""
        return self.index.get(key) if type(key) is tuple else None

    def in_kernel(self, *, looks_further: bool) -> CompiledNetwork:
        """Return the lanes in the kernel, which must already exist.

        Args:
            looks_further: Whether the road also searches connected lanes for neighbours.
        """
        found = self.compiled.get(looks_further)
        if found is None:
            module = kernel()
            assert module is not None
            count = len(self.keys) if looks_further else 0
            connected = [self.connected_lanes(number) for number in range(count)]
            found = module.Network(self.keys, self.lanes, self.index, _table(self), connected)
            self.compiled[looks_further] = found
        return found

    def connected_lanes(self, lane: int) -> list[tuple[int, float]]:
        """Return a lane, its successors and its predecessors, each with the offset of its coordinates, in m."""
        graph = self.network.graph
        start, end, number = self.keys[lane]
        found = [(lane, 0.0)]
        for after, lanes in graph.get(end, {}).items():
            if lanes:
                chosen = number if number < len(lanes) else 0
                found.append((self.index[end, after, chosen], self.lanes[lane].length))
        for before, ends in graph.items():
            lanes = ends.get(start, [])
            if lanes:
                chosen = self.index[before, start, number if number < len(lanes) else 0]
                found.append((chosen, -self.lanes[chosen].length))
        return found


def _ordered_lanes(network: RoadNetwork) -> tuple[list[tuple[str, str, int]], list[AbstractLane]]:
    """Return all keys and lanes in highway-env's order of comparison; empty if the network is unusual.

    A network is unusual if it has methods of its own, or if its graph has containers of other types.
    """
    keys: list[tuple[str, str, int]] = []
    lanes: list[AbstractLane] = []
    if type(network) is RoadNetwork and vars(network).keys() == {"graph"} and type(network.graph) is dict:
        for start, ends in network.graph.items():
            if type(ends) is not dict or any(type(row) is not list for row in ends.values()):
                return [], []
            for end, row in ends.items():
                for number, lane in enumerate(row):
                    keys.append((start, end, number))
                    lanes.append(lane)
    return keys, lanes


def _contents(network: RoadNetwork, lanes: list[AbstractLane]) -> Contents:
    """Return all properties of a network that must stay unchanged: its lanes in their order, and their attributes."""
    containers: list[object] = []
    if type(network) is RoadNetwork:
        graph = vars(network).get("graph")
        ends = [*graph.values()] if type(graph) is dict else []
        rows = [row for by_end in ends if type(by_end) is dict for row in by_end.values()]
        containers += [network, *[part for part in (graph, *ends, *rows) if type(part) in (dict, list)]]
    known = [lane for lane in lanes if type(lane) in _KNOWN]
    containers += [*known, *[value for lane in known for value in vars(lane).values() if _is_array(value)]]
    return contents_of(containers)


def _is_array(value: object) -> bool:
    return type(value) is np.ndarray and value.dtype in _DTYPES and value.flags.c_contiguous


def _lane_extensions() -> list[float]:
    """Return for each class of lanes how far beyond its end a vehicle still counts as on the lane, in m."""
    return [kind.VEHICLE_LENGTH for kind in _KNOWN]


def _is_known(lane: AbstractLane) -> bool:
    kind = type(lane)
    if kind not in _KNOWN:
        return False
    values = vars(lane)
    if "VEHICLE_LENGTH" in values or kind.VEHICLE_LENGTH != 5 or not _KNOWN[kind].isdisjoint(values):
        return False
    arrays = [values.get(name) for name in _ARRAYS[kind]]
    return (
        are_numbers(values.get(name) for name in _NUMBERS[kind])
        and (values.get("speed_limit") is None or are_numbers([values["speed_limit"]]))
        and "forbidden" in values
        and all(type(array) is np.ndarray and array.shape == (2,) and _is_array(array) for array in arrays)
    )


_KNOWN = {
    kind: frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name)))
    for kind in (StraightLane, SineLane, CircularLane)
}
_NUMBERS = {
    StraightLane: ("length", "width", "heading"),
    SineLane: ("length", "width", "heading", "amplitude", "pulsation", "phase"),
    CircularLane: ("length", "width", "radius", "start_phase", "direction"),
}
_ARRAYS = {
    StraightLane: ("start", "direction", "direction_lateral"),
    SineLane: ("start", "direction", "direction_lateral"),
    CircularLane: ("center",),
}
_DTYPES = (np.dtype(np.float64), np.dtype(np.int64))


def _table(network: Network) -> bytes:
    """Return the numbers that describe all lanes, in the order of the kernel's structure ``LaneRow``."""
    roads: dict[tuple[str, str], int] = {}
    rows = []
    for number, ((start, end, of_road), lane) in enumerate(zip(network.keys, network.lanes, strict=True)):
        left = number - 1 if of_road > 0 else -1
        right = network.index.get((start, end, of_road + 1), -1)
        rows.append([*_geometry(lane), left, right, roads.setdefault((start, end), len(roads))])
    return np.array(rows, float).tobytes()


def _geometry(lane: AbstractLane) -> list[float]:
    limit = math.nan if lane.speed_limit is None else lane.speed_limit
    if isinstance(lane, CircularLane):
        x, y = lane.center.tolist()
        shape = [2, x, y, 0, 0, 0, 0, lane.length, lane.width, 0, limit, bool(lane.forbidden), 0, 0, 0]
        return [*shape, lane.radius, lane.start_phase, lane.direction]
    vectors = (lane.start, lane.direction, lane.direction_lateral)
    shape = [*[number for vector in vectors for number in vector.tolist()], lane.length, lane.width, lane.heading]
    wave = [lane.amplitude, lane.pulsation, lane.phase] if isinstance(lane, SineLane) else [0, 0, 0]
    return [int(isinstance(lane, SineLane)), *shape, limit, bool(lane.forbidden), *wave, 0, 0, 0]
