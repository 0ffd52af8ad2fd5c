"""A bare ``.sumocfg`` that nobody wrote for us, as a scenario."""

from __future__ import annotations

import io
import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario._scenario import Scenario
from crashhunt.scenario._tables import AgentSetup, ArgumentSetup, ObservationSetup
from crashhunt.scenario.backends.sumo._check import check_options
from crashhunt.scenario.backends.sumo._config import changes, is_left_out, read_config, split_names
from crashhunt.scenario.backends.sumo._options import INPUTS, RESERVED
from crashhunt.scenario.backends.sumo._table import SumoSetup
from crashhunt.scenario.backends.sumo._xml import nested_files, read_xml, written_by

__all__ = ["load_sumocfg"]

_FILES = ("net-file", "route-files", "additional-files")
_TAKEN = {"begin", "step-length", "scale"}  # a scenario has a key of its own for each of them
_TELEPORT_S = "300"  # SUMO's own
# A flow is not punctual, and a full road lets nobody in.
_PATIENCE_S = 300.0


@dataclass(frozen=True, slots=True)
class _Departure:
    """The first vehicle that the route files promise."""

    vehicle: str
    depart_s: float


def load_sumocfg(path: Path, *, ego: str = "") -> Scenario:
    """Turn a SUMO configuration into a scenario.

    Its network, routes, additional files and options are kept. What it would write is not written, and what a trial
    decides itself is left out (the seed, the number of threads); the notes say so. The demand becomes the scenario
    argument ``scale``.

    Args:
        path: the configuration.
        ego: ``VEHICLE``, ``vehicle=ID``, ``route=ID`` or ``edges=FROM,TO``; empty: the first vehicle to depart.

    Raises:
        ScenarioError: the configuration is not one, or names no vehicle and no route.
    """
    options, notes = read_config(path)
    if "net-file" not in options:
        raise ScenarioError("the configuration names no net-file", fix="add <net-file value=…/>", where=str(path))
    changed = changes(options)
    options = {key: value for key, value in options.items() if not is_left_out(key)}
    if "phemlight-path" in options:  # a folder of the installation, and the same for everybody
        options["phemlight-path"] = str(path.resolve().parent / options["phemlight-path"]) + os.sep
        notes.append(f"phemlight-path is {options['phemlight-path']}, which is not archived")
    folder, files = _files(options, path, "; ".join(note for note in notes if note.endswith("is not set")))
    (net, *_), routes, additional = (files[key] for key in _FILES)
    begin, step_length = _times(options, path)
    agent, setup, note = _choose_ego(ego, [folder / file for file in (*routes, *additional)], begin, path)
    scale = _number(options.get("scale", "1"), "scale", path)
    kept = {key: value for key, value in options.items() if key not in _TAKEN | RESERVED}
    check_options(kept, str(path))
    kept |= {key: ",".join(files[key]) for key in INPUTS & files.keys()}
    changed += written_by(folder, (*routes, *additional))
    if changed:
        notes.append(f"of {path.name}, a trial does not take over: {'; '.join(changed)}")
    literal = any(b"${" in read_xml(folder / file) for file in (*routes, *additional))
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
        tables={
            "sumo": SumoSetup(
                net=net,
                routes=routes,
                additional=additional,
                options={"begin": begin, "time-to-teleport": _TELEPORT_S, **kept},
                literal=literal or None,
            )
        },
        notes=(note, *notes),
    )


def _files(options: dict[str, str], path: Path, unset: str) -> tuple[Path, dict[str, tuple[str, ...]]]:
    """Return the folder that holds all files of the configuration, and their names in it by option."""
    base = path.resolve().parent
    named: dict[str, list[str]] = {key: [] for key in _FILES}
    for key in [key for key in options if key in _FILES or key in INPUTS]:
        for name in split_names(options.pop(key)):
            file = os.path.normpath(base / name)
            if not os.path.isfile(file):  # noqa: PTH113
                fix = f"set it ({unset})" if unset else "mend the path"
                raise ScenarioError(f"{key}: the file {file!r} does not exist", fix=fix, where=str(path))
            named.setdefault(key, []).append(file)
    for key in sorted(key for key in options if key.endswith(("-file", "-files"))):
        raise ScenarioError(
            f"the option {key} = {options[key]!r} names a file that a trial would not archive",
            fix="move what it needs into the additional-files, or remove it",
            where=str(path),
        )
    if len(named["net-file"]) != 1:
        raise ScenarioError("the configuration names several net-files", fix="name one", where=str(path))
    everything = [file for files in named.values() for file in files]
    read = [file for key in ("route-files", "additional-files") for file in named[key]]
    everything += [os.path.normpath(base / file) for file in nested_files(base, tuple(read))]
    folder = Path(os.path.commonpath([base, *map(os.path.dirname, everything)]))
    return folder, {key: tuple(os.path.relpath(file, folder) for file in files) for key, files in named.items()}


def _times(options: dict[str, str], path: Path) -> tuple[float, float]:
    """Return when the simulation begins, and its step length, in s."""
    begin = _seconds(options.get("begin", "0"), path)
    end = _seconds(options.get("end", "-1"), path)
    if 0 <= end < begin:
        raise ScenarioError(f"end = {end:g} is before begin = {begin:g}", fix="mend one of the two", where=str(path))
    # SUMO counts in whole milliseconds.
    step_length = round(_seconds(options.get("step-length", "1"), path), 3)
    if not 0 < step_length < float("inf"):
        raise ScenarioError(
            f"step-length = {options['step-length']!r} is no time step", fix="give at least 0.001", where=str(path)
        )
    return begin, step_length


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


def _choose_ego(ego: str, files: list[Path], begin: float, path: Path) -> tuple[str, AgentSetup, str]:
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
    # Who would have departed before the simulation begins never does.
    departures = [departure for departure in _departures(files) if departure.depart_s >= begin]
    first = min(departures, key=lambda departure: departure.depart_s, default=None)
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
        if not name:  # the flow of a calibrator
            continue
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
