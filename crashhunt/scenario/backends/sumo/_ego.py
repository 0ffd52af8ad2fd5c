"""Who is controlled in a bare ``.sumocfg``: a vehicle that ``--ego`` names or adds, or another one in each trial."""

from __future__ import annotations

import io
import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario._tables import AgentSetup, ArgumentSetup
from crashhunt.scenario.backends.sumo._xml import nested_files, read_xml

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["EGO_VEHICLE", "NOT_GIVEN", "Departure", "Ego", "choose_ego", "draw_among", "number", "seconds"]

_EGO = "ego"
EGO_VEHICLE = "vehicle"
"""The scenario argument that names the vehicle that the controlled one replaces."""
NOT_GIVEN = "no --ego given: "
_BUSY_AFTER_S, _WINDOW_S = 200.0, 300.0
"""Whoever departs in an empty town meets nobody; and what is simulated before a trial is paid in every trial."""
_MANY = 10_000  # of one flow
_AT_MOST = 200  # vehicles to draw from, spread over the window
_NO_ROAD = {"rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car", "ship", "aircraft"}


@dataclass(frozen=True, slots=True)
class Ego:
    """Who is controlled.

    Args:
        agent: its id.
        setup: how it gets there.
        note: what to tell the user.
        arguments: those of the scenario that it needs.
    """

    agent: str
    setup: AgentSetup
    note: str
    arguments: dict[str, ArgumentSetup]


@dataclass(frozen=True, slots=True)
class Departure:
    """A vehicle that departs, as the route files promise, or that enters, as a simulation has shown."""

    vehicle: str
    depart_s: float
    off_road: bool  # a tram, a train, a ship


def number(text: str, option: str, path: Path) -> float:
    """Return a number of a configuration or a route file.

    Raises:
        ScenarioError: it is none.
    """
    try:
        return float(text)
    except ValueError:
        raise ScenarioError(f"{option} = {text!r} is not a number", fix="give a number", where=str(path)) from None


def seconds(text: str, path: Path) -> float:
    """Return a time as SUMO writes it, ``90`` or ``0:01:30``, in s.

    Raises:
        ScenarioError: it is none.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        raise ScenarioError(f"{text!r} is not a time", fix="give seconds", where=str(path)) from None
    return sum((part * 60.0**power for power, part in enumerate(reversed(parts))), 0.0)


def choose_ego(ego: str, files: list[Path], begin: float, path: Path) -> Ego:
    """Return who is controlled.

    Args:
        ego: ``VEHICLE``, ``vehicle=ID``, ``route=ID``, ``edges=FROM,TO`` or ``any``; empty: any, if one departs.
        files: routes and additional files.
        begin: of the simulation, in s.
        path: the configuration, for errors.

    Raises:
        ScenarioError: it says something else, or there is nobody.
    """
    kind, _, value = ego.partition("=")
    if ego in ("", "any"):
        return _anybody(ego, files, begin, path)
    if not value:
        kind, value = "vehicle", ego
    if kind == "route":
        return Ego(_EGO, AgentSetup(route=value), f"the controlled vehicle is added on the route {value!r}", {})
    if kind == "edges":
        edges = tuple(edge for edge in value.split(",") if edge)
        note = f"the controlled vehicle is added on the edges {', '.join(edges)}"
        return Ego(_EGO, AgentSetup(edges=edges), note, {})
    if kind == "vehicle":
        depart = _departure_of(value, files)
        return Ego(
            value, AgentSetup(existing=True, depart_s=depart), f"the controlled vehicle is the vehicle {value!r}", {}
        )
    raise ScenarioError(
        f"--ego {ego!r} is not understood", fix="write VEHICLE, route=ID, edges=FROM,TO or any", where=str(path)
    )


def _anybody(ego: str, files: list[Path], begin: float, path: Path) -> Ego:
    """Draw the vehicle in each trial, of those that depart when there is traffic; where none departs, add one."""
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
    """Return a controlled vehicle that replaces another one in each trial, drawn from those that enter amid traffic.

    Args:
        known: the vehicles, at least one, by time.
        why: the beginning of the note.
        verb: of the note: what the vehicles do at their times.
        few: with fewer candidates than this in the window of times, all of ``known`` are candidates.
        keep_agent: the id that the controlled vehicle keeps, where that is possible; empty to choose one.
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
        return Ego(names[0], AgentSetup(existing=True, depart_s=depart), note, {})
    if count > _AT_MOST:
        names = [names[index * count // _AT_MOST] for index in range(_AT_MOST)]
    others = {one.vehicle for one in known}
    agent = next(name for name in (keep_agent or _EGO, _EGO, f"crashhunt.{_EGO}") if name not in others)
    note = (
        f"{why}each trial replaces one random vehicle ({len(names)} candidate{'s' * (len(names) > 1)}, "
        f"{verb}ing at {found[0].depart_s:.0f}-{found[-1].depart_s:.0f} s)"
    )
    return Ego(
        agent,
        AgentSetup(replaces=EGO_VEHICLE, depart_s=found[-1].depart_s),
        note,
        {
            EGO_VEHICLE: ArgumentSetup(
                range="|".join(names) if len(names) > 1 else "",
                default=names[0],
                help="whose place the controlled vehicle takes",
            )
        },
    )


def _nameable(vehicles: Sequence[Departure]) -> list[str]:
    """Return the ids that a specification can list: its separator is ``|``."""
    return list(dict.fromkeys(one.vehicle for one in vehicles if "|" not in one.vehicle))


def _on_any_route(files: list[Path], path: Path) -> Ego:
    for route in _elements(files, "route"):
        if route.get("id"):
            note = f"no vehicle departs that the files name: one is added on the route {route.get('id')!r}"
            return Ego(_EGO, AgentSetup(route=str(route.get("id"))), note, {})
    raise ScenarioError(
        "no vehicle and no route is defined in its files", fix="give --ego edges=FROM,TO", where=str(path)
    )


def _departures(files: list[Path]) -> list[Departure]:
    """The vehicles that can be named before the simulation has run; of a flow, those that soon depart."""
    found = []
    elements = _elements(files, "vehicle", "trip", "flow", "vType")
    elsewhere = {one.get("id") for one in elements if one.tag == "vType" and one.get("vClass") in _NO_ROAD}
    for element in elements:
        name, begin = element.get("id", ""), element.get("depart", element.get("begin", "0"))
        if not name or element.tag == "vType":  # no name: the flow of a calibrator
            continue
        try:
            depart = seconds(begin, Path())
        except ScenarioError:  # "triggered" and the like: nobody knows when
            continue
        if element.tag == "flow":
            found += _of_flow(element, name, depart, element.get("type") in elsewhere)
        else:
            found.append(Departure(name, depart, element.get("type") in elsewhere))
    return found


def _of_flow(flow: ET.Element, name: str, begin: float, off_road: bool) -> list[Departure]:
    """The vehicles of a flow that depart until whoever is drawn has."""
    try:
        interval = _interval(flow, begin)
        end = seconds(flow.get("end", "inf"), Path())
        most = int(number(flow.get("number", "inf"), "number", Path())) if "number" in flow.attrib else _MANY
        span = min(end - begin, 2 * (_BUSY_AFTER_S + _WINDOW_S))
        count = max(1, min(most, _MANY, int(span / interval) if interval > 0 else 1))
    except (ScenarioError, ZeroDivisionError, OverflowError, ValueError):
        return [Departure(f"{name}.0", begin, off_road)]
    return [Departure(f"{name}.{index}", begin + index * interval, off_road) for index in range(count)]


def _departure_of(vehicle: str, files: list[Path]) -> float:
    """When a vehicle departs, as far as its files tell; SUMO calls the vehicles of a flow ``FLOW.0``, ``FLOW.1``."""
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
    """The mean time from one vehicle of a flow to the next, in s."""

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
            raise ScenarioError(f"not valid XML: {error}", fix="mend the file", where=str(file)) from None
    return found


def _nested(files: list[Path]) -> list[Path]:
    if not files:
        return []
    folder = files[0].parent
    names = tuple(os.path.relpath(file, folder) for file in files)
    # Vehicles come with <include> only; what else is read is small, and may be no XML at all.
    return [path for name in nested_files(folder, names) if (path := folder / name).suffix in (".xml", ".gz")]
