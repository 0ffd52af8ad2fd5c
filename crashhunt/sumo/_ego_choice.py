"""The controlled vehicle of a plain ``.sumocfg``: ``--ego`` names or adds it, or each trial draws it."""

from __future__ import annotations

import io
import os
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, TypedDict, cast

from crashhunt.base.errors import NoValidTrialError, ScenarioError
from crashhunt.scenario import AgentSetup, ArgumentSetup
from crashhunt.sumo._files import nested_files, read_xml

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.json_types import Json
    from crashhunt.scenario import Scenario


_EGO = "ego"
EGO_VEHICLE = "vehicle"
"""The scenario argument that names the vehicle that the controlled one replaces."""
NOT_GIVEN = "no --ego given: "
_BUSY_AFTER_S, _WINDOW_S = 200.0, 300.0
"""An earlier departure meets an empty town; a later one costs simulated time before each trial."""
_MAX_FLOW_VEHICLES = 10_000  # of one flow
_MAX_CANDIDATES = 200  # vehicles to draw from, spread over the window
RAIL = frozenset({"tram", "rail_urban", "rail", "rail_electric", "rail_fast", "subway", "cable_car"})
_OFF_ROAD_CLASSES = RAIL | {"ship", "aircraft"}


@dataclass(frozen=True, slots=True)
class Ego:
    """The controlled vehicle of a scenario."""

    agent: str
    setup: AgentSetup
    note: str
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Departure:
    """A vehicle and its departure time, from the route files, or its entry time, from a simulation."""

    vehicle: str
    depart_s: float
    off_road: bool  # a tram, a train, a ship


def number(text: str, option: str, path: Path) -> float:
    """Return a number from a configuration or a route file.

    Raises:
        ScenarioError: the text is not a number.
    """
    try:
        return float(text)
    except ValueError:
        raise ScenarioError(f"{option} = {text!r} is not a number", fix="give a number", where=str(path)) from None


def seconds(text: str, path: Path) -> float:
    """Return a time in SUMO's notation, ``90`` or ``0:01:30``, in s.

    Raises:
        ScenarioError: the text is not a time.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        raise ScenarioError(f"{text!r} is not a time", fix="give seconds", where=str(path)) from None
    return sum((part * 60.0**power for power, part in enumerate(reversed(parts))), 0.0)


def choose_ego(ego: str, files: list[Path], begin: float, path: Path) -> Ego:
    """Return the controlled vehicle that `--ego` selects.

    ``ego`` is ``VEHICLE``, ``vehicle=ID``, ``route=ID``, ``edges=FROM,TO`` or ``any``; empty for ``any`` if a vehicle
    departs.

    Raises:
        ScenarioError: the text has another form, or no vehicle matches.
    """
    kind, _, value = ego.partition("=")
    if ego in ("", "any"):
        return _draw_ego(ego, files, begin, path)
    if not value:
        kind, value = "vehicle", ego
    if kind == "route":
        return Ego(
            agent=_EGO,
            setup=AgentSetup(route=value),
            note=f"the controlled vehicle is added on the route {value!r}",
        )
    if kind == "edges":
        edges = tuple(edge for edge in value.split(",") if edge)
        note = f"the controlled vehicle is added on the edges {', '.join(edges)}"
        return Ego(agent=_EGO, setup=AgentSetup(edges=edges), note=note)
    if kind == "vehicle":
        depart = _departure_of(value, files)
        return Ego(
            agent=value,
            setup=AgentSetup(existing=True, depart_s=depart),
            note=f"the controlled vehicle is the vehicle {value!r}",
        )
    raise ScenarioError(
        f"--ego {ego!r} is not valid", fix="write VEHICLE, route=ID, edges=FROM,TO or any", where=str(path)
    )


def _draw_ego(ego: str, files: list[Path], begin: float, path: Path) -> Ego:
    """Draw a vehicle in each trial from those that depart amid traffic; if no vehicle departs, add one."""
    why = "" if ego else NOT_GIVEN
    # Who would have departed before the simulation begins never does.
    known = [one for one in _departures(files) if one.depart_s >= begin and not one.off_road]
    known.sort(key=lambda one: one.depart_s)
    if not known:
        return _on_any_route(files, path)
    return draw_among(known, why=why, verb="depart")


def draw_among(
    known: Sequence[Departure], *, why: str = "", verb: str = "enter", few: int = 1, keep_agent: str = ""
) -> Ego:
    """Return a controlled vehicle that replaces another vehicle in each trial, drawn from those entering amid traffic.

    The vehicles are in the order of their times, at which they enter or depart, as ``verb`` says. If fewer than ``few``
    vehicles do so in the time window, all are candidates. The note begins with ``why``. The controlled vehicle keeps
    the id ``keep_agent`` if possible.
    """
    first, last = known[0].depart_s, known[-1].depart_s
    since = first + min(_BUSY_AFTER_S, (last - first) / 3)
    found = [one for one in known if since <= one.depart_s <= since + _WINDOW_S]
    names = _nameable(found)
    if not found or (few > 1 and len(names) < few and len(_nameable(known)) > len(names)):
        found, names = list(known), _nameable(known)
    names = names or [known[0].vehicle]
    count = len(names)
    if count == 1 and not (keep_agent and "|" not in names[0]):
        depart = next(one.depart_s for one in known if one.vehicle == names[0])
        when = "" if len(known) == 1 else f" from {since:.0f} to {since + _WINDOW_S:.0f} s"
        note = f"{why}the controlled vehicle is {names[0]!r}, the only one that {verb}s{when}"
        return Ego(agent=names[0], setup=AgentSetup(existing=True, depart_s=depart), note=note)
    if count > _MAX_CANDIDATES:
        names = [names[index * count // _MAX_CANDIDATES] for index in range(_MAX_CANDIDATES)]
    others = {one.vehicle for one in known}
    agent = next(name for name in (keep_agent or _EGO, _EGO, f"crashhunt.{_EGO}") if name not in others)
    note = (
        f"{why}each trial replaces one random vehicle ({len(names)} candidate{'s' * (len(names) > 1)}, "
        f"{verb}ing at {found[0].depart_s:.0f}-{found[-1].depart_s:.0f} s)"
    )
    return Ego(
        agent=agent,
        setup=AgentSetup(replaces=EGO_VEHICLE, depart_s=found[-1].depart_s),
        note=note,
        arguments={
            EGO_VEHICLE: ArgumentSetup(
                range="|".join(names) if len(names) > 1 else "",
                default=names[0],
                help="whose place the controlled vehicle takes",
            )
        },
    )


def _nameable(vehicles: Sequence[Departure]) -> list[str]:
    """Return the ids of vehicles that contain no ``|``, which separates the ids in a specification."""
    return list(dict.fromkeys(one.vehicle for one in vehicles if "|" not in one.vehicle))


def _on_any_route(files: list[Path], path: Path) -> Ego:
    for route in _elements(files, "route"):
        if route.get("id"):
            note = f"no vehicle departs that the files name: one is added on the route {route.get('id')!r}"
            return Ego(agent=_EGO, setup=AgentSetup(route=str(route.get("id"))), note=note)
    raise ScenarioError(
        "the files of the scenario define no vehicle and no route", fix="give --ego edges=FROM,TO", where=str(path)
    )


def _departures(files: list[Path]) -> list[Departure]:
    """Return the vehicles whose names are known before the simulation; for a flow, only vehicles that depart soon."""
    found = []
    elements = _elements(files, "vehicle", "trip", "flow", "vType")
    elsewhere = {one.get("id") for one in elements if one.tag == "vType" and one.get("vClass") in _OFF_ROAD_CLASSES}
    for element in elements:
        name, begin = element.get("id", ""), element.get("depart", element.get("begin", "0"))
        if not name or element.tag == "vType":  # no name: the flow of a calibrator
            continue
        try:
            depart = seconds(begin, Path())
        except ScenarioError:  # "triggered" and similar: the time is unknown
            continue
        if element.tag == "flow":
            found += _of_flow(element, name, depart, element.get("type") in elsewhere)
        else:
            found.append(Departure(name, depart, element.get("type") in elsewhere))
    return found


def _of_flow(flow: ET.Element, name: str, begin: float, off_road: bool) -> list[Departure]:
    """Return the vehicles of a flow that may be drawn."""
    try:
        interval = _interval(flow, begin)
        end = seconds(flow.get("end", "inf"), Path())
        most = (
            int(number(flow.get("number", "inf"), "number", Path())) if "number" in flow.attrib else _MAX_FLOW_VEHICLES
        )
        span = min(end - begin, 2 * (_BUSY_AFTER_S + _WINDOW_S))
        count = max(1, min(most, _MAX_FLOW_VEHICLES, int(span / interval) if interval > 0 else 1))
    except (ScenarioError, ZeroDivisionError, OverflowError, ValueError):
        return [Departure(f"{name}.0", begin, off_road)]
    return [Departure(f"{name}.{index}", begin + index * interval, off_road) for index in range(count)]


def _departure_of(vehicle: str, files: list[Path]) -> float:
    """Return the departure of a vehicle in the files; SUMO names the vehicles of a flow ``FLOW.0``, ``FLOW.1``, …."""
    flow, _, place = vehicle.rpartition(".")
    for element in _elements(files, "flow"):
        if element.get("id") == flow and place.isdecimal():
            try:
                begin = seconds(element.get("begin", "0"), Path())
                return begin + int(place) * _interval(element, begin)
            except (ScenarioError, ZeroDivisionError):
                return 0.0
    return next((found.depart_s for found in _departures(files) if found.vehicle == vehicle), 0.0)


def _interval(flow: ET.Element, begin: float) -> float:
    """Return the mean time between two consecutive vehicles of a flow, in s."""

    def value(attribute: str) -> float:
        return number(flow.get(attribute, "").removeprefix("exp(").removesuffix(")"), attribute, Path())

    for attribute in ("vehsPerHour", "perHour"):
        if attribute in flow.keys():  # noqa: SIM118 - an element is no mapping
            return 3600.0 / value(attribute)
    if "probability" in flow.keys():  # noqa: SIM118
        return 1.0 / value("probability")
    if "number" in flow.keys() and "end" in flow.keys():  # noqa: SIM118
        return (seconds(flow.get("end", ""), Path()) - begin) / value("number")
    if flow.get("period", "").startswith("exp("):
        return 1.0 / value("period")  # exp(rate), in 1/s
    return value("period")


def _elements(files: list[Path], *tags: str) -> list[ET.Element]:
    found = []
    for file in (*files, *_nested(files)):
        try:
            for _, element in ET.iterparse(io.BytesIO(read_xml(file))):
                if element.tag in tags:
                    found.append(element)
                elif element.tag not in ("routes", "additional"):
                    element.clear()
        except (ET.ParseError, LookupError, ValueError) as error:
            raise ScenarioError(f"not valid XML: {error}", fix="correct the file", where=str(file)) from None
    return found


def _nested(files: list[Path]) -> list[Path]:
    if not files:
        return []
    folder = files[0].parent
    names = tuple(os.path.relpath(file, folder) for file in files)
    # Vehicles come with <include> only; what else is read is small, and may be no XML at all.
    return [path for name in nested_files(folder, names) if (path := folder / name).suffix in (".xml", ".gz")]


# From simulated plain traffic to the vehicles that ``--ego any`` draws from.

NOT_ON_A_ROAD = _OFF_ROAD_CLASSES | {"container", "drone", "pedestrian", "wheelchair", "bicycle", "scooter"}
"""SUMO's vehicle classes that an agent for cars cannot drive: on rails, on water, in the air, or no motor vehicles."""
FEW_CANDIDATES = 3
"""Below this the window of entry times is extended to all entries, so that trials differ."""
GRIDLOCK_BUILDS_UP_S = 60.0
"""Before a gridlock, the seed decides whether a vehicle finds room to enter. In SUMO's game bs3d, 5 of 60 trials with
vehicles that entered up to 40 s before it were invalid. With this margin, 1 of 60 was."""
LONG_WAIT_S = 300.0
"""A wait for the first vehicle that is worth a warning: every trial simulates it."""


class Gridlock(TypedDict):
    """A traffic jam that lasts to the end of the run: ``standing`` of ``vehicles`` have not moved since ``since_s``."""

    since_s: float
    standing: int
    vehicles: int


class SurveyedRun(TypedDict):
    """One run of the unmodified traffic; an entry is (vehicle, time in s, vehicle class, whether it is parked)."""

    begin_s: float
    end_s: float
    steps: int
    entries: list[tuple[str, float, str, bool]]
    gridlock: Gridlock | None
    cut_short: bool
    out_of_time: NotRequired[bool]  # the other limits are the same on every machine


def refine(scenario: Scenario, answer: Json) -> Scenario:
    """Return the scenario with the vehicles that entered in every run as candidates, and with notes on the traffic.

    The answer has at least one `SurveyedRun`.

    Raises:
        ScenarioError: an agent can drive none of the vehicles that enter.
        NoValidTrialError: no vehicle enters.
    """
    runs = cast("list[SurveyedRun]", answer)
    known = _entering_in_all_runs(runs)
    (agent,) = scenario.agents
    setup = scenario.agents[agent]
    if not known and any(run["cut_short"] for run in runs):
        steps = max(run["steps"] for run in runs)
        note = f"warning: no vehicle that an agent can drive enters before step {steps}, where the look ahead ended"
        return replace(scenario, notes=(scenario.notes[0], note, *scenario.notes[1:]))
    if not known:
        _refuse_undrivable(scenario, runs)
        if setup.route:
            return scenario  # no vehicle enters, and the controlled one is added
        raise _no_entry_error(scenario, runs)
    notes = _warnings(scenario, runs, known)
    if setup.existing and any(one.vehicle == agent for one in known):
        return replace(scenario, notes=(scenario.notes[0], *notes, *scenario.notes[1:]))
    stuck_s = min((run["gridlock"]["since_s"] for run in runs if run["gridlock"]), default=None)
    kept = agent if setup.replaces else ""
    drawn = draw_among(
        _entering_before_gridlock(stuck_s, known), few=FEW_CANDIDATES, keep_agent=kept, why=_entry_failure(scenario)
    )
    return replace(
        scenario,
        agents={drawn.agent: drawn.setup},
        arguments={
            **{name: argument for name, argument in scenario.arguments.items() if name != EGO_VEHICLE},
            **drawn.arguments,
        },
        notes=(drawn.note, *notes, *scenario.notes[1:]),
    )


def restore(scenario: Scenario, kept: Scenario) -> Scenario | None:
    """Return the scenario with the candidates of the hunt whose scenario is ``kept``; None if that hunt drew none."""
    agent, *others = kept.agents
    before = kept.agents[agent]
    if others or before.replaces != EGO_VEHICLE or EGO_VEHICLE not in kept.arguments:
        return None
    argument = kept.arguments[EGO_VEHICLE]
    count = argument.range.count("|") + 1
    return replace(
        scenario,
        agents={agent: AgentSetup(replaces=EGO_VEHICLE, depart_s=before.depart_s)},
        arguments={**scenario.arguments, EGO_VEHICLE: argument},
        notes=(
            f"{_entry_failure(scenario)}each trial replaces one of the {count} candidates of this hunt",
            *scenario.notes[1:],
        ),
    )


def _entry_failure(scenario: Scenario) -> str:
    return NOT_GIVEN if scenario.notes[0].startswith(NOT_GIVEN) else ""


def _entering_in_all_runs(runs: Sequence[SurveyedRun]) -> list[Departure]:
    """Return the drivable vehicles that entered in every run, sorted by the latest of their entry times.

    A run that was cut short is ignored for later vehicles. If no vehicle entered in every run, the vehicles of the run
    with the most entries are returned. A demand scaled to 0 at one end of a range is therefore not refused.
    """
    found: list[dict[str, float]] = []
    for run in runs:
        usable = [one for one in run["entries"] if one[2] not in NOT_ON_A_ROAD and not one[3]]
        found.append({vehicle: time_s for vehicle, time_s, _, _ in usable})
    first = found[0]
    in_every_run = (vehicle for vehicle in first if all(vehicle in run for run in found))
    times = {vehicle: max(run[vehicle] for run in found) for vehicle in in_every_run}
    if not times:
        times = max(found, key=len)
    return sorted(
        (Departure(vehicle, time_s, off_road=False) for vehicle, time_s in times.items()), key=lambda one: one.depart_s
    )


def _entering_before_gridlock(stuck_s: float | None, known: list[Departure]) -> list[Departure]:
    """Return the vehicles that enter before a gridlock; if there are enough, only those before it builds up."""
    if stuck_s is None:
        return known
    early = [one for one in known if one.depart_s < stuck_s - GRIDLOCK_BUILDS_UP_S]
    return early if len(early) >= FEW_CANDIDATES else [one for one in known if one.depart_s < stuck_s] or known


def _refuse_undrivable(scenario: Scenario, runs: Sequence[SurveyedRun]) -> None:
    classes = Counter(vehicle_class for run in runs for _, _, vehicle_class, _ in run["entries"])
    if not classes:
        return
    simulated_s = max(run["end_s"] - run["begin_s"] for run in runs)
    kind = "only rail vehicles enter" if classes.keys() <= RAIL else "no vehicle that an agent can drive enters"
    if classes.keys() - NOT_ON_A_ROAD:
        kind = "only parked vehicles enter"
    shown = ", ".join(sorted(classes))
    raise ScenarioError(
        f"{kind} in {simulated_s:g} s of simulation (vehicle classes: {shown})",
        fix="name a vehicle with --ego VEHICLE, add one with --ego edges=FROM,TO, or add road traffic",
        where=scenario.origin,
    )


def _no_entry_error(scenario: Scenario, runs: Sequence[SurveyedRun]) -> NoValidTrialError:
    longest = max(runs, key=lambda run: run["steps"])
    return NoValidTrialError(
        f"no vehicle enters in {longest['end_s'] - longest['begin_s']:g} s of simulation "
        f"({longest['steps']} steps from {longest['begin_s']:g} s)",
        fix="set begin in the configuration shortly before the first departure, or raise --set scale",
        where=scenario.origin,
    )


def _warnings(scenario: Scenario, runs: Sequence[SurveyedRun], known: Sequence[Departure]) -> list[str]:
    notes = []
    begin_s, first_s = runs[0]["begin_s"], known[0].depart_s
    if first_s - begin_s > LONG_WAIT_S:
        steps = round((first_s - begin_s) / scenario.step_length_s)
        notes.append(
            f"warning: no vehicle enters before step {steps} ({first_s:g} s), and every trial simulates these steps. "
            f"Fix: set begin to {max(begin_s, first_s - 1.0):g} in {scenario.file}"
        )
    jammed = [run["gridlock"] for run in runs if run["gridlock"]]
    if jammed:
        jam = min(jammed, key=lambda one: one["since_s"])
        notes.append(
            f"warning: the traffic is gridlocked from {jam['since_s']:g} s on: {jam['standing']} of {jam['vehicles']} "
            f"vehicles stand still, in {len(jammed)} of {len(runs)} runs. "
            "Fix: lower the demand (--set scale=0.5), or correct the traffic lights"
        )
    if any(run.get("out_of_time") for run in runs):
        until_s = min(run["end_s"] for run in runs)
        notes.append(
            f"warning: the look ahead ended at {until_s:g} s, as its processor time was used up: on another machine, "
            "candidates and trials of the same seed may differ. Fix: name vehicles with --set vehicle=A|B"
        )
    return notes
