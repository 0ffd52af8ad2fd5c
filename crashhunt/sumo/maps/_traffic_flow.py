"""Simulation of the traffic of a new scenario without an agent, to measure whether the traffic flows."""

from __future__ import annotations

import string
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base.codec import Serializable
from crashhunt.base.errors import ScenarioError
from crashhunt.sumo.maps._demand import route_file
from crashhunt.sumo.maps._tools import first_error

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.sumo.maps._demand import Demand
    from crashhunt.sumo.maps._road_network import RoadNetwork
    from crashhunt.sumo.maps._tools import Tools

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
    """The result of a simulation of the traffic without an agent for `RUN_S` seconds.

    Args:
        demand: traffic factor.
        wanted: number of vehicles that should have entered.
        entered: number of vehicles that entered.
        arrived: number of vehicles that reached their destination.
        running: number of vehicles on the road at the end.
        halting: number of these vehicles that stood still.
        teleports: number of vehicles that SUMO teleported after they had stood still for 300 s.
        collisions: number of collisions between vehicles of the traffic.
        mean_speed_mps: mean speed of the vehicles that arrived, in m/s.
        persons: number of pedestrians.
        edge_vehicles: number of vehicles that entered each road.
        probe_delays_s: time that a probe vehicle waited to enter on each route, in s; routes without such a vehicle are
            missing.
    """

    demand: float
    wanted: int
    entered: int
    arrived: int
    running: int
    halting: int
    teleports: int
    collisions: int
    mean_speed_mps: float
    persons: int
    edge_vehicles: Mapping[str, float] = field(default_factory=dict)
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

    Args:
        demand: the traffic of the scenario.
        network: network in which the traffic drives.
        tools: the programs of eclipse-sumo.
        folder: folder that contains the network, and into which files are written.
        values: values of the scenario's arguments.
        net: name of the network file.
        scale: traffic factor.
        probes_at_s: times at which the probe vehicles are to enter, in s.
        bicycles: whether cyclists take part.
        step_s: step length of the simulation, in s.

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

    Args:
        demand: the traffic before calibration.
        network: network in which the traffic drives.
        tools: the programs of eclipse-sumo.
        folder: folder that contains the network.
        values: values of the scenario's arguments.
        net: name of the network file.
        scales: the usual and the largest traffic factor.
        probes_at_s: times at which the probe vehicles are to enter, in s.
        bicycles: whether cyclists take part.

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
