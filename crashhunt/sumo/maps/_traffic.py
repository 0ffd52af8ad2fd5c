"""Traffic of a new scenario: drivable routes, flows on them, and a simulation that measures whether it flows."""

from __future__ import annotations

import string
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from crashhunt.base.codec import Serializable
from crashhunt.base.errors import ScenarioError
from crashhunt.sumo.maps._road_network import BICYCLE, CAR, TRUCK, RoadNetwork
from crashhunt.sumo.maps._tools import Tools, first_error

if TYPE_CHECKING:
    from pathlib import Path


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
    """A route through the network that vehicles take."""

    id: str  # id of the route, such as ``r7``
    edges: tuple[str, ...]  # ids of the route's edges
    weight: int  # number of drawn trips on this route
    length_m: float  # length of the route, in m
    free_s: float  # travel time on the route without other traffic, in s


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """The traffic in a network."""

    routes: tuple[Route, ...]  # routes of vehicles
    vehicles_per_hour: float  # vehicles per hour on all routes together, at demand 1
    walks: tuple[tuple[str, ...], ...]  # for each flow of pedestrians, the edges along which they walk
    ego_routes: tuple[str, ...]  # ids of the routes from which the route of the controlled vehicle is drawn

    def rates(self) -> Iterator[tuple[Route, float]]:
        """Yield each route with its vehicles per hour at demand 1."""
        total = sum(route.weight for route in self.routes)
        for route in self.routes:
            yield route, self.vehicles_per_hour * route.weight / total


def find_demand(network: RoadNetwork, tools: Tools, folder: Path, *, net: str, people: bool) -> Demand:
    """Return traffic for a network.

    SUMO's randomTrips.py draws the trips, most of them between ends of the network. duarouter computes their routes, so
    every route is drivable.

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


# The simulation of the traffic without an agent.

RUN_S = 600
"""Simulated time: a road that jams does so within a few cycles of its lights, and these have up to 90 s."""
_STEP_S = 0.1  # as in trials
_ROUGH_STEP_S = 0.5
"""Of the search for a demand that flows: five times as fast, and the result is verified with the step of trials."""
_FILLED_ROUTES = "filled.rou.xml"
_PROBE_ROUTES = "probes.rou.xml"
_MAX_CALIBRATIONS = 6
_DEMAND_DIVISOR = 1.6
"""By how much the traffic is reduced from one try to the next."""
# A place flows if most vehicles that want to enter do, few are moved on after standing for 300 s, and most drive.
_MAX_WAITING_SHARE = 0.15
_MAX_TELEPORT_SHARE = 0.01
_MAX_HALTING_SHARE = 0.6
_MAX_PROBE_DELAY_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlainRun(Serializable):
    """The result of a simulation of the traffic without an agent for `RUN_S` seconds."""

    demand: float  # traffic factor
    wanted: int  # number of vehicles that should have entered
    entered: int  # number of vehicles that entered
    arrived: int  # number of vehicles that reached their destination
    running: int  # number of vehicles on the road at the end
    halting: int  # number of these vehicles that stood still
    teleports: int  # number of vehicles that SUMO teleported after they had stood still for 300 s
    collisions: int  # number of collisions between vehicles of the traffic
    mean_speed_mps: float  # mean speed of the vehicles that arrived, in m/s
    persons: int  # number of pedestrians
    edge_vehicles: Mapping[str, float] = field(default_factory=dict)  # number of vehicles that entered each road
    # time that a probe vehicle waited to enter on each route, in s; routes without such a vehicle are missing
    probe_delays_s: Mapping[str, float] = field(default_factory=dict)

    json_keys = (
        "demand", "simulated_s", "wanted", "entered", "arrived", "running", "halting", "teleports", "collisions",
        "mean_speed_mps", "persons",
    )  # fmt: skip

    @property
    def simulated_s(self) -> float:
        """The simulated time, in s."""
        return RUN_S

    @property
    def jam(self) -> str:
        """The reason why the traffic does not flow, as text; empty if the traffic flows."""
        if not self.entered:
            return "no vehicle enters"
        if self.wanted - self.entered > max(5, _MAX_WAITING_SHARE * self.wanted):
            return f"{self.wanted - self.entered} of {self.wanted} vehicles cannot enter"
        if self.teleports > max(2, _MAX_TELEPORT_SHARE * self.entered):
            return f"{self.teleports} of {self.entered} vehicles stand for 300 s"
        if self.running >= 10 and self.halting > _MAX_HALTING_SHARE * self.running:
            return f"{self.halting} of {self.running} vehicles stand still at the end"
        if self.arrived == 0 and self.entered >= 10 and self.mean_speed_mps == 0 and self.halting > self.running / 2:
            return "no vehicle arrives"
        return ""


def run_plain_traffic(
    demand: Demand, network: RoadNetwork, tools: Tools, folder: Path, values: Mapping[str, object], *, net: str,
    scale: float, probes_at_s: float, bicycles: bool, step_s: float = _STEP_S,
) -> PlainRun:  # fmt: skip
    """Simulate the traffic, with a probe vehicle on each route that the agent may get.

    The folder contains the network, and files are written into it. The probe vehicles are to enter at ``probes_at_s``.

    Raises:
        ScenarioError: SUMO refuses the network or the traffic.
    """
    # SUMO's option scale would duplicate or discard the probes too.
    scaled = replace(demand, vehicles_per_hour=demand.vehicles_per_hour * scale)
    text = route_file(scaled, network, bicycles=bicycles)
    filled = {name: str(value) for name, value in {**values, "ego_route": demand.ego_routes[0]}.items()}
    (folder / _FILLED_ROUTES).write_text(string.Template(text).substitute(filled), encoding="utf-8")
    probes = "".join(
        f'<vehicle id="probe.{route}" type="ego" route="{route}" depart="{probes_at_s:g}" departLane="best" '
        'departSpeed="max"/>\n'
        for route in demand.ego_routes
    )
    (folder / _PROBE_ROUTES).write_text(f"<routes>\n{probes}</routes>\n", encoding="utf-8")
    words = [
        "--net-file", net, "--route-files", f"{_FILLED_ROUTES},{_PROBE_ROUTES}",
        "--step-length", f"{step_s:g}", "--end", f"{RUN_S}",
        "--seed", "42", "--collision.action", "warn", "--collision.check-junctions", "true",
        "--collision.mingap-factor", "0", "--time-to-teleport", "300", "--no-step-log", "true", "--xml-validation",
        "never", "--statistic-output", "statistics.xml", "--summary-output", "summary.xml", "--summary-output.period",
        f"{RUN_S // 10}", "--edgedata-output", "edges.xml", "--tripinfo-output", "trips.out.xml",
        "--tripinfo-output.write-unfinished", "true",
    ]  # fmt: skip
    done = tools.run("sumo", words, folder)
    if done.code:
        error = first_error(done.output) or f"exit code {done.code}"
        raise ScenarioError(f"SUMO cannot load the scenario of this map: {error}", fix="choose another part of the map")
    return _measured(folder, scale, len(demand.ego_routes))


def _measured(folder: Path, scale: float, probes: int) -> PlainRun:
    statistics = ET.parse(folder / "statistics.xml").getroot()

    def count(tag: str, name: str) -> int:
        found = statistics.find(tag)
        return int(float(found.get(name, "0"))) if found is not None else 0

    last = ET.parse(folder / "summary.xml").getroot().findall("step")[-1]
    edges = {
        edge.get("id", ""): float(edge.get("entered", "0")) + float(edge.get("departed", "0"))
        for edge in ET.parse(folder / "edges.xml").getroot().iter("edge")
    }
    delays, arrived, speeds = {}, 0, 0.0
    for trip in ET.parse(folder / "trips.out.xml").getroot().iter("tripinfo"):
        name = trip.get("id", "")
        if name.startswith("probe."):
            if float(trip.get("depart", "-1")) >= 0:
                delays[name.removeprefix("probe.")] = float(trip.get("departDelay", "0"))
        elif float(trip.get("arrival", "-1")) >= 0:
            arrived += 1
            speeds += float(trip.get("routeLength", "0")) / max(float(trip.get("duration", "0")), _STEP_S)
    waiting = count("vehicles", "waiting")
    entered = count("vehicles", "inserted")
    return PlainRun(
        demand=scale,
        wanted=entered + waiting - probes,
        entered=entered - len(delays),
        arrived=arrived,
        running=count("vehicles", "running"),
        halting=int(last.get("halting", "0")),
        teleports=count("teleports", "total"),
        collisions=count("safety", "collisions"),
        mean_speed_mps=speeds / arrived if arrived else 0.0,
        persons=count("persons", "loaded"),
        edge_vehicles=edges,
        probe_delays_s=delays,
    )


def calibrate(
    demand: Demand, network: RoadNetwork, tools: Tools, folder: Path, values: Mapping[str, object], *, net: str,
    scales: tuple[float, float], probes_at_s: float, bicycles: bool,
) -> tuple[Demand, PlainRun, PlainRun]:  # fmt: skip
    """Return the demand at which traffic flows with the usual and largest factor, and the two runs that show it.

    ``scales`` has the usual and the largest traffic factor. The folder contains the network. The probe vehicles are to
    enter at ``probes_at_s``.

    Raises:
        ScenarioError: even a tenth of the traffic jams, or no vehicle of an agent can enter.
    """
    usual, most = scales

    def run(demand: Demand, scale: float, step_s: float = _STEP_S) -> PlainRun:
        return run_plain_traffic(
            demand, network, tools, folder, values, net=net, scale=scale, probes_at_s=probes_at_s, bicycles=bicycles,
            step_s=step_s,
        )  # fmt: skip

    busy = run(demand, most)
    for _ in range(_MAX_CALIBRATIONS - 1):
        if not busy.jam:
            break
        demand = replace(demand, vehicles_per_hour=demand.vehicles_per_hour / _DEMAND_DIVISOR)
        busy = run(demand, most, _ROUGH_STEP_S)
        if not busy.jam:
            busy = run(demand, most)
    if busy.jam:
        rate = demand.vehicles_per_hour * most
        raise ScenarioError(
            f"the traffic on this map jams even with {rate:,.0f} vehicles/h: {busy.jam}",
            fix="choose another part of the map, or correct its traffic lights and lanes",
        )
    ready = tuple(route for route in demand.ego_routes if busy.probe_delays_s.get(route, 1e9) <= _MAX_PROBE_DELAY_S)
    if not ready:
        message = f"no vehicle of an agent can enter within {_MAX_PROBE_DELAY_S:g} s"
        raise ScenarioError(message, fix=f"lower the upper end of --demand, which is {most:g}")
    demand = replace(demand, ego_routes=ready)
    return demand, run(demand, usual), busy
