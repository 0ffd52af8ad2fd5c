"""Right of way in a network, from the request matrix of each junction."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

from crashhunt.base.errors import ScenarioError
from crashhunt.sumo._files import read_xml
from crashhunt.sumo._lane_graph import LaneGraph, junction_of
from crashhunt.sumo._options import SumoSetup
from crashhunt.sumo.maps import read_network
from crashhunt.world import Link, RightOfWay

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from crashhunt.scenario import Scenario
    from crashhunt.sumo.maps import RoadNetwork
    from crashhunt.world import StopLine

_MAX_NETWORK_BYTES = 50_000_000  # a larger network is not worth the wait
_UNREADABLE = (OSError, ScenarioError, ET.ParseError, ValueError, KeyError)
_UNREGULATED_TYPES = ("unregulated", "internal", "dead_end", "rail_signal", "rail_crossing")


def right_of_way(scenario: Scenario) -> RightOfWay | None:
    """Return the right of way at the junctions of a scenario; None if its network cannot be read."""
    return _derived(scenario, _right_of_way_in)


def stop_lines(scenario: Scenario) -> tuple[StopLine, ...]:
    """Return the stop lines of a scenario's network; none if the network cannot be read."""
    return _derived(scenario, _stop_lines_in) or ()


Found = TypeVar("Found")


def _derived(scenario: Scenario, derive: Callable[[RoadNetwork], Found]) -> Found | None:
    path = scenario.folder / scenario.table(SumoSetup).net
    try:
        return _read(path, path.stat().st_mtime_ns, derive)
    except _UNREADABLE:
        return None


@lru_cache(maxsize=8)
def _read(path: Path, _changed: int, derive: Callable[[RoadNetwork], Found]) -> Found | None:
    content = read_xml(path)
    if len(content) > _MAX_NETWORK_BYTES or b"<!DOCTYPE" in content:
        return None
    return derive(read_network(path, with_junctions=True))


def _stop_lines_in(network: RoadNetwork) -> tuple[StopLine, ...]:
    return LaneGraph(network).stop_lines


def _right_of_way_in(network: RoadNetwork) -> RightOfWay:
    """Return the right of way at the junctions of a network that was read with its junctions."""
    shapes = {
        f"{edge.id}_{index}": lane.shape for edge in network.inside.values() for index, lane in enumerate(edge.lanes)
    }
    onward = {one.source: one.via for one in network.connections if one.source.startswith(":")}
    places: dict[str, int] = {}  # lane inside a junction to its link
    links: list[Link] = []
    for one in network.connections:
        if one.source.startswith(":") or not one.via:
            continue
        inside = [one.via]
        while (more := onward.get(inside[-1], "")) and more not in inside:
            inside.append(more)
        places |= dict.fromkeys(inside, len(links))
        links.append(
            Link(
                junction=junction_of(one.via),
                source=one.source,
                target=one.target,
                inside=tuple(inside),
                signalised=bool(one.signal),
                shape=tuple(point for lane in inside for point in shapes.get(lane, ())),
            )
        )
    gives_way = set()
    for junction in network.rules.values():
        if junction.type in _UNREGULATED_TYPES:
            continue
        ways = [places.get(lane) for lane in junction.inside]
        for own, others in junction.yields.items():
            mine = ways[own] if own < len(ways) else None
            theirs = (ways[other] for other in others if other < len(ways))
            gives_way |= {(mine, other) for other in theirs if mine is not None and other is not None}
    return RightOfWay(tuple(links), frozenset(gives_way))
