"""A bare ``.sumocfg`` that nobody wrote for us, as a scenario."""

from __future__ import annotations

import gzip
import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from crashhunt.errors import ScenarioError
from crashhunt.scenario import Scenario
from crashhunt.setups import AgentSetup, ArgumentSetup, ObservationSetup, SumoSetup
from crashhunt.simulators._sumo_files import RESERVED

__all__ = ["load_sumocfg"]

_SYNONYMS = {
    "net": "net-file",
    "n": "net-file",
    "route": "route-files",
    "r": "route-files",
    "additional": "additional-files",
}
_SYNONYMS |= {"a": "additional-files", "b": "begin", "e": "end", "routes": "route-files"}
# Sections whose options concern files written, windows and remote control, none of which a trial has.
_DROPPED_SECTIONS = {"output", "gui_only", "traci_server", "report", "random_number"}
# What a trial decides itself, and what would be written by every worker at once.
_DROPPED = {"seed", "random", "threads", "remote-port", "num-clients", "begin", "end", "step-length", "scale"}
_DROPPED |= {"gui-settings-file", "registry-viewport", "save-configuration", "load-state", "quit-on-end", "start"}
_FILE_OPTIONS = {"net-file", "route-files", "additional-files"}
# A flow is not punctual, and a full road lets nobody in.
_PATIENCE_S = 300.0


@dataclass(frozen=True, slots=True)
class _Departure:
    """The first vehicle that the route files promise."""

    vehicle: str
    depart_s: float


def load_sumocfg(path: Path, *, ego: str = "") -> Scenario:
    """Turn a SUMO configuration into a scenario.

    Its network, routes, additional files and options are kept; what it would write is dropped, as is what a trial
    decides itself (the seed, the number of threads). The demand becomes the scenario argument ``scale``.

    Args:
        path: the configuration.
        ego: ``VEHICLE``, ``vehicle=ID``, ``route=ID`` or ``edges=FROM,TO``; empty: the first vehicle to depart.

    Raises:
        ScenarioError: the configuration is not one, or names no vehicle and no route.
    """
    options = _read_options(path)
    if "net-file" not in options:
        raise ScenarioError("the configuration names no net-file", fix="add <net-file value=…/>", where=str(path))
    base = path.resolve().parent
    files = {key: _split(options.pop(key, "")) for key in _FILE_OPTIONS}
    for key in sorted(key for key in options if key.endswith(("-file", "-files"))):
        raise ScenarioError(
            f"the option {key} = {options[key]!r} names a file that a trial would not archive",
            fix="move what it needs into the additional-files, or remove it",
            where=str(path),
        )
    everything = [Path(os.path.normpath(base / file)) for group in files.values() for file in group]
    for file in everything:
        if not file.is_file():
            raise ScenarioError(f"the file {str(file)!r} does not exist", fix="mend the path", where=str(path))
    folder = Path(os.path.commonpath([base, *(str(file.parent) for file in everything)]))
    net, routes, additional = (
        tuple(os.path.relpath(os.path.normpath(base / file), folder) for file in files[key])
        for key in ("net-file", "route-files", "additional-files")
    )
    begin = _seconds(options.get("begin", "0"), path)
    step_length = _seconds(options.get("step-length", "1"), path)
    kept = {key: value for key, value in options.items() if key not in _DROPPED | RESERVED}
    agent, setup, note = _choose_ego(ego, [folder / file for file in (*routes, *additional)], path)
    scale = _number(options.get("scale", "1"), "scale", path)
    return Scenario(
        title=f"{path.name}, as it is",
        name=path.name.removesuffix(".sumocfg"),
        folder=folder,
        file=os.path.relpath(path.resolve(), folder),
        step_length_s=step_length,
        warmup_s=0.0,
        insertion_timeout_s=_PATIENCE_S,
        observation=ObservationSetup(),
        agents={agent: setup},
        arguments={"scale": ArgumentSetup(default=scale, help="scales the traffic demand", option="scale")},
        sumo=SumoSetup(net=net[0], routes=routes, additional=additional, options={"begin": begin, **kept}),
        notes=(note,),
    )


def _read_options(path: Path) -> dict[str, str]:
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise ScenarioError(f"not valid XML: {error}", fix="mend the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", where=str(path)) from None
    options: dict[str, str] = {}
    for element in root.iter():
        value = element.get("value", element.get("v"))
        if value is not None:
            options[_SYNONYMS.get(element.tag, element.tag)] = value
    for section in root:
        if section.tag in _DROPPED_SECTIONS:
            for element in section.iter():
                options.pop(_SYNONYMS.get(element.tag, element.tag), None)
    return {key: value for key, value in options.items() if not key.endswith(("-output", ".output"))}


def _split(value: str) -> list[str]:
    return [part for part in value.replace(" ", ",").split(",") if part]


def _number(text: str, option: str, path: Path) -> float:
    try:
        return float(text)
    except ValueError:
        raise ScenarioError(f"{option} = {text!r} is not a number", fix="give a number", where=str(path)) from None


def _seconds(text: str, path: Path) -> float:
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        raise ScenarioError(f"{text!r} is not a time", fix="give seconds", where=str(path)) from None
    return sum((part * 60.0**power for power, part in enumerate(reversed(parts))), 0.0)


def _choose_ego(ego: str, files: list[Path], path: Path) -> tuple[str, AgentSetup, str]:
    """Return the id of the controlled vehicle, how it gets there, and what to tell the user."""
    kind, _, value = ego.partition("=")
    if ego and not value:
        kind, value = "vehicle", ego
    if kind == "route":
        return "ego", AgentSetup(route=value), f"the controlled vehicle is added on the route {value!r}"
    if kind == "edges":
        edges = tuple(edge for edge in value.split(",") if edge)
        return "ego", AgentSetup(edges=edges), f"the controlled vehicle is added on the edges {', '.join(edges)}"
    if kind == "vehicle":
        depart = _departure_of(value, files)
        return value, AgentSetup(existing=True, depart_s=depart), f"the controlled vehicle is the vehicle {value!r}"
    if kind:
        raise ScenarioError(
            f"--ego {ego!r} is not understood", fix="write VEHICLE, route=ID or edges=FROM,TO", where=str(path)
        )
    first = min(_departures(files), key=lambda departure: departure.depart_s, default=None)
    if first is not None:
        note = f"no --ego was given: the controlled vehicle is {first.vehicle!r}, the first to depart"
        return first.vehicle, AgentSetup(existing=True, depart_s=first.depart_s), note
    for route in _elements(files, "route"):
        if route.get("id"):
            note = f"no --ego was given and no vehicle departs: one is added on the route {route.get('id')!r}"
            return "ego", AgentSetup(route=str(route.get("id"))), note
    raise ScenarioError(
        "no vehicle and no route is defined in its files", fix="give --ego edges=FROM,TO", where=str(path)
    )


def _departures(files: list[Path]) -> list[_Departure]:
    """The vehicles that can be named before the simulation has run; the first one of each flow."""
    found = []
    for element in _elements(files, "vehicle", "trip", "flow"):
        name, begin = element.get("id", ""), element.get("depart", element.get("begin", "0"))
        try:
            depart = _seconds(begin, Path())
        except ScenarioError:  # "triggered" and the like: nobody knows when
            continue
        found.append(_Departure(f"{name}.0" if element.tag == "flow" else name, depart))
    return found


def _departure_of(vehicle: str, files: list[Path]) -> float:
    """When a vehicle departs, as far as its files tell; SUMO calls the vehicles of a flow ``FLOW.0``, ``FLOW.1``."""
    flow, _, number = vehicle.rpartition(".")
    for element in _elements(files, "flow"):
        if element.get("id") == flow and number.isdecimal():
            try:
                begin = _seconds(element.get("begin", "0"), Path())
                return begin + int(number) * _interval(element, begin)
            except (ScenarioError, ZeroDivisionError):
                return 0.0
    return next((found.depart_s for found in _departures(files) if found.vehicle == vehicle), 0.0)


def _interval(flow: ET.Element, begin: float) -> float:
    """The mean time from one vehicle of a flow to the next, in s."""

    def value(attribute: str) -> float:
        return _number(flow.get(attribute, "").removeprefix("exp(").removesuffix(")"), attribute, Path())

    for attribute in ("vehsPerHour", "perHour"):
        if attribute in flow.keys():  # noqa: SIM118 - an element is no mapping
            return 3600.0 / value(attribute)
    if "probability" in flow.keys():  # noqa: SIM118
        return 1.0 / value("probability")
    if "number" in flow.keys() and "end" in flow.keys():  # noqa: SIM118
        return (_seconds(flow.get("end", ""), Path()) - begin) / value("number")
    if flow.get("period", "").startswith("exp("):
        return 1.0 / value("period")  # exp(rate), in 1/s
    return value("period")


def _elements(files: list[Path], *tags: str) -> list[ET.Element]:
    found = []
    for file in files:
        opened = gzip.open if file.suffix == ".gz" else open
        try:
            with opened(file, "rb") as content:
                for _, element in ET.iterparse(content):
                    if element.tag in tags:
                        found.append(element)
                    elif element.tag not in ("routes", "additional"):
                        element.clear()
        except (ET.ParseError, gzip.BadGzipFile, EOFError) as error:
            raise ScenarioError(f"not valid XML: {error}", fix="mend the file", where=str(file)) from None
    return found
