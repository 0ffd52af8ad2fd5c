"""Right of way in a network, from the request matrix of each junction."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import lru_cache
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.sumo._files import read_xml
from crashhunt.sumo._options import SumoSetup
from crashhunt.world import Link, RightOfWay

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.scenario import Scenario

_MAX_NETWORK_BYTES = 50_000_000  # a larger network is not worth the wait
_UNREGULATED_TYPES = ("unregulated", "internal", "dead_end", "rail_signal", "rail_crossing")


def right_of_way(scenario: Scenario) -> RightOfWay | None:
    """Return the right of way at the junctions of a scenario; None if its network cannot be read."""
    path = scenario.folder / scenario.table(SumoSetup).net
    try:
        return _read(path, path.stat().st_mtime_ns)
    except (OSError, ScenarioError, ET.ParseError, ValueError, KeyError):
        return None


@lru_cache(maxsize=4)
def _read(path: Path, _changed: int) -> RightOfWay | None:
    content = read_xml(path)
    if len(content) > _MAX_NETWORK_BYTES or b"<!DOCTYPE" in content:
        return None
    root = ET.fromstring(content)
    shapes = {lane.attrib["id"]: _points(lane.get("shape", "")) for lane in root.iter("lane")}
    onward = {
        f"{one.attrib['from']}_{one.attrib['fromLane']}": one.get("via", "")
        for one in root.iter("connection")
        if one.attrib["from"].startswith(":")
    }
    places: dict[str, int] = {}  # lane inside a junction to its link
    links: list[Link] = []
    for one in root.iter("connection"):
        via = one.get("via", "")
        if one.attrib["from"].startswith(":") or not via:
            continue
        inside = [via]
        while (more := onward.get(inside[-1], "")) and more not in inside:
            inside.append(more)
        places |= dict.fromkeys(inside, len(links))
        points = tuple(point for lane in inside for point in shapes.get(lane, ()))
        source, target = (f"{one.attrib[end]}_{one.attrib[f'{end}Lane']}" for end in ("from", "to"))
        junction = via[1:].rpartition("_")[0].rpartition("_")[0]
        links.append(
            Link(
                junction=junction,
                source=source,
                target=target,
                inside=tuple(inside),
                signalised=bool(one.get("tl")),
                shape=points,
            )
        )
    gives_way = set()
    for node in root.iter("junction"):
        if node.get("type", "") in _UNREGULATED_TYPES:
            continue
        ways = [places.get(lane) for lane in node.get("intLanes", "").split()]
        for request in node.iter("request"):
            own, response = int(request.attrib["index"]), request.attrib["response"][::-1]
            mine = ways[own] if own < len(ways) else None
            for other, bit in zip(ways, response, strict=False):
                if bit == "1" and mine is not None and other is not None:
                    gives_way.add((mine, other))
    return RightOfWay(tuple(links), frozenset(gives_way))


def _points(shape: str) -> tuple[tuple[float, float], ...]:
    pairs = (point.split(",") for point in shape.split())
    return tuple((float(x), float(y)) for x, y, *_ in pairs)
