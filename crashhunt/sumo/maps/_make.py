"""Creation of a scenario folder from a map; if it fails, no folder remains."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError, ScenarioError, UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.files import cannot_write, is_empty_folder, sync_tree
from crashhunt.base.git import work_tree
from crashhunt.base.temporary import new_folder, temporary_folder
from crashhunt.base.text import count_of
from crashhunt.sumo.maps._convert import NET, ConvertOptions, convert
from crashhunt.sumo.maps._folder import (
    DEFAULT_AGENT,
    WORKFLOW,
    agent_module,
    arguments_of,
    next_commands,
    readme,
    scenario_toml,
    workflow,
)
from crashhunt.sumo.maps._picture import draw_map
from crashhunt.sumo.maps._road_network import CAR, RoadNetwork
from crashhunt.sumo.maps._source import BBox, MapSource, check_source
from crashhunt.sumo.maps._tools import Tools, find_tools
from crashhunt.sumo.maps._traffic import ROUTES, RUN_S, Demand, PlainRun, calibrate, find_demand, route_file

if TYPE_CHECKING:
    from collections.abc import Callable


DEMAND = (0.2, 1.5)
"""The usual range of the argument ``demand``."""
PICTURE, README, AGENT_FILE = "map.png", "README.md", "agent.py"
_WARMUP_S = (20.0, 90.0)
_STEPS = (300, 3000)
_STEPS_ROUNDED = 100
_STEP_S = 0.1
_MAX_LISTED_ROADS = 5
_THIN_PER_KM = 1.0
_KMH = 3.6


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions:
    """The options of a scenario that is made from a map."""

    bbox: BBox | None = None  # bounding box of the part of the map to convert, in degrees; None for the whole map
    demand: tuple[float, float] = DEMAND  # the smallest and the largest traffic factor
    people: bool = False  # whether pedestrians walk, on sidewalks and crossings
    bicycles: bool = False  # whether cyclists ride
    left_hand: bool = False  # whether traffic drives on the left
    agent: str = ""  # agent that drives; by default crashhunt's car-following agent
    workflow: Literal["", "github"] = ""  # name of the CI system for which a workflow is written; empty for none
    picture: bool = True  # whether ``map.png`` is drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class PlainTrial:
    """The result of one trial in the new scenario."""

    outcome: str  # outcome of the trial
    steps: int  # number of steps
    wall_s: float  # wall time of the trial in s, including the start of its processes


@dataclass(frozen=True, slots=True, kw_only=True)
class MadeScenario:
    """A scenario that was made from a map and then checked."""

    folder: Path  # folder of the scenario
    source: MapSource  # the map from which the scenario was made
    network: RoadNetwork  # contents of the network
    demand: Demand  # traffic of the scenario
    plain: PlainRun  # result of the traffic at its usual demand
    busy: PlainRun  # result of the traffic at its largest demand
    steps: int  # maximum number of steps of a trial, derived from the longest route
    notes: tuple[str, ...] = ()  # notes for the user
    trial: PlainTrial | None = None  # the result of one trial; None if none ran
    agent: str = ""  # agent of the trial
    commands: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, object]:
        """Return the scenario in the form that ``crashhunt init --json`` prints."""
        drivable = self.network.drivable()
        return {
            "dir": str(self.folder),
            "map": self.source.title,
            "lanes_km": round(_lanes_km(self.network), 3),
            "roads": len(drivable),
            "junctions": sum(self.network.junctions.values()),
            "traffic_lights": _lights(self.network),
            "crossings": self.network.crossings,
            "routes": len(self.demand.routes),
            "ego_routes": len(self.demand.ego_routes),
            "vehicles_per_hour": round(self.demand.vehicles_per_hour, 1),
            "plain": [self.plain.to_json(), self.busy.to_json()],
            "trial": None
            if self.trial is None
            else {"outcome": self.trial.outcome, "steps": self.trial.steps, "wall_s": round(self.trial.wall_s, 3)},
            "max_steps": self.steps,
            "notes": list(self.notes),
            "next": self.commands,
        }


def make_scenario(
    source: MapSource,
    options: MapOptions,
    directory: Path,
    *,
    try_out: Callable[[Path, int], PlainTrial] | None = None,
    tell: Callable[[str], None] | None = None,
) -> MadeScenario:
    """Make the folder of a scenario from a map, and check the scenario.

    Args:
        source: the map file or the shape of a generated map.
        options: options of the scenario.
        directory: path of the new folder; an existing folder must be empty.
        try_out: function that runs one trial, given the folder and the maximum number of steps.
        tell: function that receives a short description of the current stage.

    Raises:
        ScenarioError: the map cannot be used; the message gives the fix.
        HuntDirectoryError: the directory contains files, or cannot be written.
        UsageError: an option does not fit the map.
    """
    _check_directory(directory)
    _check_options(source, options)
    check_source(source)
    tools = find_tools()
    say = tell or (lambda _text: None)
    target = directory.absolute()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with new_folder(target, mode=0o755) as building:
            found = _build(source, options, tools, building, target, say)
            if try_out is not None:
                say("running one trial")
                trial = try_out(building, found.steps)
                found = replace(found, trial=trial, notes=(*found.notes, *_trial_notes(trial, found.agent)))
            _write_texts(found, options, building, target)
            sync_tree(building)
    except OSError as error:
        raise cannot_write(directory, error) from error
    named = "" if target == Path.cwd() else str(directory)
    return replace(found, folder=directory, commands=next_commands(named, found.steps))


def _check_directory(directory: Path) -> None:
    if directory.is_symlink() or directory.exists():
        try:
            if is_empty_folder(directory):
                return
        except OSError as error:
            raise cannot_write(directory, error) from error
        what = "exists and is not empty" if directory.is_dir() else "exists and is not a folder"
        raise HuntDirectoryError(what, fix="name another folder, or remove it", where=str(directory))


def _check_options(source: MapSource, options: MapOptions) -> None:
    if options.bbox is not None and source.path is None:
        raise UsageError(
            f"--bbox cannot be used with --{source.kind}",
            fix=f"omit --bbox, and choose the size of the map with --{source.kind}",
        )
    if options.left_hand and source.kind == "net":
        fix = "omit the option: a network keeps the side that it was made for"
        raise UsageError("--lefthand cannot be used with --net", fix=fix)


def _build(
    source: MapSource, options: MapOptions, tools: Tools, building: Path, target: Path, say: Callable[[str], None]
) -> MadeScenario:
    """Write the network, the routes and the picture into the folder."""
    with temporary_folder("map") as work:
        say("making the network")
        made = convert(
            source,
            ConvertOptions(
                bbox=options.bbox, people=options.people, bicycles=options.bicycles, left_hand=options.left_hand
            ),
            tools,
            work,
        )
        say("drawing trips")
        try:
            demand = find_demand(made.network, tools, work, net=NET, people=options.people)
            warmup_s = _warmup_s(demand)
            say(f"simulating {RUN_S} s of the plain traffic")
            arguments = arguments_of(demand, options.demand, bicycles=options.bicycles)
            values = {argument.name: argument.default for argument in arguments}
            low, high = options.demand
            demand, plain, busy = calibrate(
                demand, made.network, tools, work, values, net=NET, scales=(min(max(1.0, low), high), high),
                probes_at_s=warmup_s, bicycles=options.bicycles,
            )  # fmt: skip
        except ScenarioError as error:
            raise ScenarioError(error.message, fix=error.fix, where=error.where or source.title) from None
        shutil.copyfile(work / NET, building / NET)
    text = route_file(demand, made.network, bicycles=options.bicycles)
    (building / ROUTES).write_text(text, encoding="utf-8")
    notes = list(made.notes)
    notes += _thin_traffic(plain, _lanes_km(made.network), high)
    if options.people and not demand.walks:
        notes.append("warning: no persons walk: the map has no connected ways for pedestrians")
    found = MadeScenario(
        folder=target, source=source, network=made.network, demand=demand, plain=plain, busy=busy,
        steps=_steps(demand), notes=tuple(notes), agent=options.agent or DEFAULT_AGENT,
    )  # fmt: skip
    (building / layout.SCENARIO).write_text(
        scenario_toml(
            f"{source.name}: made from {source.title}",
            arguments_of(demand, options.demand, bicycles=options.bicycles),
            warmup_s=warmup_s,
            speed_limit_mps=_speed_limit_mps(demand),
            agent=options.agent,
        ),
        encoding="utf-8",
    )
    if options.picture:
        _draw(found, building)
    return found


def _thin_traffic(plain: PlainRun, lanes_km: float, high: float) -> list[str]:
    """Return a note with the fix if few vehicles are on the road at the usual demand."""
    density = plain.running / lanes_km
    if density >= _THIN_PER_KM:
        return []
    thin = f"the traffic is thin: {density:.2g} vehicles on a km of lane"
    if density / plain.demand >= _THIN_PER_KM:
        return [f"{thin}, because --demand ends at {high:g}; raise it, such as --demand 0.2:1.5"]
    return [f"{thin}, because each vehicle costs time in every trial; a part of the map has more: --bbox=W,S,E,N"]


def _draw(found: MadeScenario, folder: Path) -> None:
    try:
        draw_map(
            found.network,
            found.busy.edge_vehicles,
            folder / PICTURE,
            title=f"{found.source.name}: traffic at demand {found.busy.demand:g}",
            hours=RUN_S / 3600,
            busiest=_busiest(found),
        )
    except ImportError:
        raise ScenarioError("the picture of the map needs Pillow", fix=install_command("maps")) from None


def _write_texts(found: MadeScenario, options: MapOptions, building: Path, target: Path) -> None:
    """Write the files that describe the scenario, after its trial has run."""
    (building / AGENT_FILE).write_text(agent_module(_speed_limit_mps(found.demand)), encoding="utf-8")
    (building / README).write_text(
        readme(
            found.source.name, describe_place(found), demand=found.demand, steps=found.steps, run_s=RUN_S,
            from_osm=found.source.kind == "osm", workflow_file=WORKFLOW if options.workflow else "",
        ),
        encoding="utf-8", errors="replace",
    )  # fmt: skip
    if options.workflow:
        top = work_tree(target.parent)
        folder = os.path.relpath(os.path.realpath(target), top) if top is not None else "."
        file = building / WORKFLOW
        file.parent.mkdir(parents=True)
        file.write_text(workflow(folder, found.steps), encoding="utf-8", errors="replace")


def _warmup_s(demand: Demand) -> float:
    """Return the duration of the warm-up, in s, in which traffic fills the roads: the duration of a usual trip."""
    weight = sum(route.weight for route in demand.routes)
    low, high = _WARMUP_S
    return round(min(max(1.2 * sum(route.free_s * route.weight for route in demand.routes) / weight, low), high))


def _steps(demand: Demand) -> int:
    """Return the maximum number of steps of trials: twice the time of the agent's longest route on free roads."""
    longest = max(route.free_s for route in demand.routes if route.id in demand.ego_routes)
    low, high = _STEPS
    return min(max(round(2 * longest / _STEP_S / _STEPS_ROUNDED) * _STEPS_ROUNDED, low), high)


def _speed_limit_mps(demand: Demand) -> float:
    """Return the mean speed limit on the routes of the agent, in m/s."""
    routes = [route for route in demand.routes if route.id in demand.ego_routes]
    mean = sum(route.length_m for route in routes) / max(sum(route.free_s for route in routes), 0.1)
    return float(min(max(round(mean, 1), 5.0), 40.0))


def _busiest(found: MadeScenario) -> list[tuple[str, float]]:
    """Return the edges with the most vehicles per hour, at most one of each street."""
    order = sorted(found.busy.edge_vehicles.items(), key=lambda item: -item[1])
    chosen: dict[str, tuple[str, float]] = {}
    for name, count in order:
        edge = found.network.edges.get(name)
        if edge is not None and count:
            chosen.setdefault(edge.name or name, (name, count * 3600 / RUN_S))
        if len(chosen) == _MAX_LISTED_ROADS:
            break
    return list(chosen.values())


def _lanes_km(network: RoadNetwork) -> float:
    return sum(lane.length_m for edge in network.drivable() for lane in edge.open_lanes(CAR)) / 1000


def _lights(network: RoadNetwork) -> int:
    return sum(count for kind, count in network.junctions.items() if kind.startswith("traffic_light"))


def describe_place(found: MadeScenario) -> list[str]:
    """Return a description of the place in about ten lines."""
    network, demand, plain, busy = found.network, found.demand, found.plain, found.busy
    drivable = network.drivable()
    roads_km = sum(edge.length_m for edge in drivable) / 1000
    lanes = [edge.open_lanes(CAR) for edge in drivable]
    counts = [len(open_lanes) for open_lanes in lanes]
    speeds = [lane.speed_mps * _KMH for open_lanes in lanes for lane in open_lanes]
    side = "left" if network.left_hand else "right"
    others = [
        f"{count} {kind.replace('_', ' ')}"
        for kind, count in network.junctions.most_common()
        if not kind.startswith("traffic_light")
    ]
    busiest = "; ".join(
        f"{network.edges[name].name or name} {rate:,.0f}/h" for name, rate in _busiest(found)[:3]
    )  # fmt: skip
    walkers = f", {len(demand.walks)} flows of persons" if demand.walks else ""
    waits = [busy.probe_delays_s[route] for route in demand.ego_routes]
    lines = [
        f"map: {found.source.title}; traffic keeps to the {side}",
        f"roads: {roads_km:,.1f} km in {len(drivable)} edges, {_lanes_km(network):,.1f} km of lanes",
        f"lanes: {_span(counts, 'd')} per direction; speed limits {_span(speeds, '.0f')} km/h",
        f"junctions: {sum(network.junctions.values())}: {_lights(network)} with traffic lights"
        + "".join(f", {words}" for words in others[:3])
        + f"; {network.crossings} pedestrian crossings",
        f"traffic: {len(demand.routes)} routes, {demand.vehicles_per_hour:,.0f} vehicles/h at demand 1{walkers}",
        # With --demand 3, the usual and the largest factor are equal.
        *dict.fromkeys(f"at demand {run.demand:g}: {_run_in_words(run)}" for run in (plain, busy)),
        f"busiest: {busiest or 'no road'}",
        f"agent: {len(demand.ego_routes)} routes; it enters within {max(waits):.1f} s at demand {busy.demand:g}",
    ]
    if found.trial is not None:
        lines.append(
            f"one trial of {found.agent}: {found.trial.outcome} after {count_of(found.trial.steps, 'step')} "
            f"({found.trial.wall_s:.1f} s, with the start of its processes)"
        )
    return [*lines, *(f"note: {note}" for note in found.notes)]


def _trial_notes(trial: PlainTrial, agent: str) -> list[str]:
    """Return a note with the fix if the trial ended by a software fault."""
    fix = {
        "hang": "the trial took too long; hunt with a larger --timeout, or choose a smaller map with --bbox=W,S,E,N",
        "agent_error": f"the agent {agent} failed; crashhunt show describes its error after a hunt with this agent",
        "process_died": f"the process of the agent {agent} died; crashhunt show describes its end after a hunt",
        "simulator_error": "the simulator failed; crashhunt show describes its error after a hunt",
    }.get(trial.outcome)
    return [f"warning: {fix}"] if fix else []


def _span(values: list[int] | list[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"


def _run_in_words(run: PlainRun) -> str:
    teleports = f"{run.teleports} stood for 300 s" if run.teleports else "no jam"
    collisions = f", {run.collisions} collision{'s' * (run.collisions != 1)} among them" if run.collisions else ""
    return (
        f"{run.entered} of {run.wanted} vehicles entered in {RUN_S} s, {run.arrived} arrived at "
        f"{run.mean_speed_mps:.1f} m/s on average, {teleports}{collisions}"
    )
