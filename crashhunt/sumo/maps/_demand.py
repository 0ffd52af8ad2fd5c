"""Traffic for a network: drivable routes, and vehicle flows on them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from crashhunt.base.errors import ScenarioError
from crashhunt.sumo.maps._road_network import BICYCLE, CAR, TRUCK

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from crashhunt.sumo.maps._road_network import RoadNetwork
    from crashhunt.sumo.maps._tools import Tools

ROUTES = "traffic.rou.xml"
_SEED = "42"  # the same map gives the same traffic
_MAX_ROUTES = 300
"""More than a trial of a few minutes shows; SUMO reads each in every trial."""
_WALKS = 24
_WALKS_PER_HOUR = 30
_FLOWS_END_S = 86400
_MIN_DISTANCE_M = 300.0
_EGO_ROUTES = 12
_EGO_WAY_M = 250.0
"""At least, where the map has such routes: shorter ones end before anything happens."""
_DENSITY_PER_KM = 6.0
"""Vehicles for each km of lane on the routes at demand 1, where the traffic flows with it: a busy town."""
_MAX_VEHICLES = 100
"""On the road at a time at demand 1: each costs about 4 µs a step."""
_FEWEST_VEHICLES = 4.0
_DELAY_AT_JUNCTIONS = 1.6
"""By how much longer than on free roads a trip takes in a town."""
_MAX_PER_LANE_PER_HOUR = 800.0
"""On the first road of a route: half of what a lane can take."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """A route through the network that vehicles take.

    Args:
        id: id of the route, such as ``r7``.
        edges: ids of the route's edges.
        weight: number of drawn trips on this route.
        length_m: length of the route, in m.
        free_s: travel time on the route without other traffic, in s.
    """

    id: str
    edges: tuple[str, ...]
    weight: int
    length_m: float
    free_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """The traffic in a network.

    Args:
        routes: routes of vehicles.
        vehicles_per_hour: vehicles per hour on all routes together, at demand 1.
        walks: for each flow of pedestrians, the edges along which they walk.
        ego_routes: ids of the routes from which the route of the controlled vehicle is drawn.
    """

    routes: tuple[Route, ...]
    vehicles_per_hour: float
    walks: tuple[tuple[str, ...], ...]
    ego_routes: tuple[str, ...]

    def rates(self) -> Iterator[tuple[Route, float]]:
        """Yield each route with its vehicles per hour at demand 1."""
        total = sum(route.weight for route in self.routes)
        for route in self.routes:
            yield route, self.vehicles_per_hour * route.weight / total


def find_demand(network: RoadNetwork, tools: Tools, folder: Path, *, net: str, people: bool) -> Demand:
    """Return traffic for a network.

    SUMO's randomTrips.py draws the trips, most of them between ends of the network. duarouter computes their routes, so
    every route is drivable.

    Args:
        network: contents of the network file.
        tools: the programs of eclipse-sumo.
        folder: folder in which the programs run.
        net: name of the network file in the folder.
        people: whether pedestrians take part.

    Raises:
        ScenarioError: no route for cars exists in the network.
    """
    routes = _routes(network, tools, folder, net)
    walks = _walks(tools, folder, net) if people else ()
    if not routes:
        raise ScenarioError("the map has no route that a car can drive", fix="choose a larger part of the map")
    covered = {edge for route in routes for edge in route.edges}
    lanes_km = sum(
        lane.length_m / 1000 for name in covered for lane in network.edges[name].open_lanes(CAR)
    )  # fmt: skip
    weight = sum(route.weight for route in routes)
    trip_s = sum(route.free_s * route.weight for route in routes) / weight * _DELAY_AT_JUNCTIONS
    wanted = max(_FEWEST_VEHICLES, min(_MAX_VEHICLES, _DENSITY_PER_KM * lanes_km))
    per_hour = wanted / max(trip_s, 1.0) * 3600
    per_hour = min(per_hour, _entry_capacity(network, routes, weight))
    return Demand(routes=routes, vehicles_per_hour=per_hour, walks=walks, ego_routes=_ego_routes(routes))


def _entry_capacity(network: RoadNetwork, routes: Sequence[Route], weight: int) -> float:
    """Return the maximum number of vehicles per hour on all routes, so that no first road of a route is overloaded."""
    first: dict[str, int] = {}
    for route in routes:
        first[route.edges[0]] = first.get(route.edges[0], 0) + route.weight
    limits = (
        _MAX_PER_LANE_PER_HOUR * len(network.edges[name].open_lanes(CAR)) * weight / count
        for name, count in first.items()
    )
    return min(limits)


def _routes(network: RoadNetwork, tools: Tools, folder: Path, net: str) -> tuple[Route, ...]:
    words = [
        "--net-file", net, "--output-trip-file", "trips.xml", "--route-file", "routes.xml", "--end", str(_MAX_ROUTES),
        "--period", "1", "--seed", _SEED, "--vehicle-class", CAR, "--fringe-factor", "10", "--lanes", "--length",
        "--remove-loops", "--validate", "--threads", "1", "--min-distance",
    ]  # fmt: skip
    counts: dict[tuple[str, ...], int] = {}
    for distance in (_MIN_DISTANCE_M, 0.0):  # a small map has none as long as that
        (folder / "routes.xml").unlink(missing_ok=True)
        tools.run("randomTrips.py", [*words, f"{distance:g}"], folder)
        counts = _counted(folder / "routes.xml", "route")
        if len(counts) >= 2:
            break
    if not counts:
        # One straight road: a trip needs two edges, a route does not.
        counts = {(edge.id,): 1 for edge in network.drivable() if edge.length_m >= 50.0}
    found: list[Route] = []
    for edges, weight in counts.items():
        way = [network.edges[name] for name in edges if name in network.edges]
        if len(way) < len(edges) or not all(edge.admits(CAR) for edge in way):
            continue
        free_s = sum(edge.length_m / max(lane.speed_mps for lane in edge.open_lanes(CAR)) for edge in way)
        length_m = sum(edge.length_m for edge in way)
        found.append(Route(id=f"r{len(found)}", edges=edges, weight=weight, length_m=length_m, free_s=free_s))
    return tuple(found)


def _walks(tools: Tools, folder: Path, net: str) -> tuple[tuple[str, ...], ...]:
    words = [
        "--net-file", net, "--output-trip-file", "walks.trips.xml", "--route-file", "walks.xml", "--end",
        str(4 * _WALKS), "--period", "1", "--seed", _SEED, "--persons", "--max-distance", "600", "--validate",
        "--threads", "1",
    ]  # fmt: skip
    tools.run("randomTrips.py", words, folder)
    return tuple(edges for edges in _counted(folder / "walks.xml", "walk") if len(edges) >= 2)[:_WALKS]


def _counted(path: Path, tag: str) -> dict[tuple[str, ...], int]:
    """Return how often each route occurs in a file, in the order of the file; empty if the file is missing."""
    if not path.is_file():
        return {}
    counts: dict[tuple[str, ...], int] = {}
    for element in ET.parse(path).getroot().iter(tag):
        edges = tuple(element.get("edges", "").split())
        if edges:
            counts[edges] = counts.get(edges, 0) + 1
    return counts


def _ego_routes(routes: Sequence[Route]) -> tuple[str, ...]:
    """Return routes that begin at different places, the routes with the most traffic first."""
    # Where all are short, the longest are the best there is.
    by_length = sorted(routes, key=lambda route: -route.length_m)
    long = sum(route.length_m >= _EGO_WAY_M for route in routes)
    order = sorted(by_length[: max(long, _EGO_ROUTES)], key=lambda route: -route.weight)
    chosen: dict[str, str] = {}
    for route in order:
        chosen.setdefault(route.edges[0], route.id)
    rest = [route.id for route in order if route.id not in chosen.values()]
    return tuple([*chosen.values(), *rest][:_EGO_ROUTES])


def route_file(demand: Demand, network: RoadNetwork, *, bicycles: bool) -> str:
    """Return the contents of the route file, with ``${NAME}`` for each argument of the scenario."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<!-- What stands in braces after a dollar sign is filled in per trial, from [arguments] of scenario.toml. -->",
        "<routes>",
        '    <vType id="car" sigma="${imperfection}" speedFactor="normc(1,${speed_spread},0.5,1.5)"/>',
        (
            '    <vType id="truck" vClass="truck" sigma="${imperfection}" '
            'speedFactor="normc(0.85,${speed_spread},0.5,1.1)"/>'
        ),
        '    <vType id="ego" color="yellow" accel="3" decel="8" emergencyDecel="9"/>',
    ]
    mixes = [("cars", "car", "100"), ("cars-trucks", "car truck", "100 ${trucks_per_100_cars}")]
    if bicycles:
        lines.append('    <vType id="cyclist" vClass="bicycle" sigma="${imperfection}"/>')
        mixes.append(("cars-cyclists", "car cyclist", "100 ${cyclists_per_100_cars}"))
        both = "100 ${trucks_per_100_cars} ${cyclists_per_100_cars}"
        mixes.append(("cars-trucks-cyclists", "car truck cyclist", both))
    for name, types, shares in mixes:
        lines.append(f'    <vTypeDistribution id="{name}" vTypes="{types}" probabilities="{shares}"/>')
    lines += [f'    <route id="{route.id}" edges={_quoted(route.edges)}/>' for route in demand.routes]
    lines.append('    <routeDistribution id="ego-route" routes="${ego_route}"/>')
    for route, rate in demand.rates():
        way = [network.edges[name] for name in route.edges]
        kind = "cars"
        kind += "-trucks" if all(edge.admits(TRUCK) for edge in way) else ""
        kind += "-cyclists" if bicycles and all(edge.admits(BICYCLE) for edge in way) else ""
        lines.append(
            f'    <flow id="{route.id}" type="{kind}" route="{route.id}" begin="0" end="{_FLOWS_END_S}" '
            f'period="exp({rate / 3600:.6g})" departLane="best" departSpeed="max" departPos="base"/>'
        )
    for number, walk in enumerate(demand.walks):
        begin = number * 3600 / _WALKS_PER_HOUR / len(demand.walks)
        lines += [
            f'    <personFlow id="w{number}" begin="{begin:.1f}" end="{_FLOWS_END_S}" perHour="${{persons_per_path}}">',
            f"        <walk edges={_quoted(walk)}/>",
            "    </personFlow>",
        ]
    return "\n".join([*lines, "</routes>", ""])


def _quoted(edges: Sequence[str]) -> str:
    return quoteattr(" ".join(edges)).replace("$", "$$")  # the file is a template
