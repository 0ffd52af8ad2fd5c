"""Checks a scenario for SUMO: its files, arguments and options, and the names to which it may refer.

SUMO itself reports a missing name only when a trial begins, and never reports a missing vehicle of the traffic. Names
are therefore checked before a hunt, as far as the files contain them. The files are searched and not parsed, because a
network may have hundreds of megabytes.
"""

from __future__ import annotations

import re
import string
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.base.text import did_you_mean, listed
from crashhunt.scenario import refuse
from crashhunt.sumo._files import read_xml
from crashhunt.sumo._options import RESERVED, SumoSetup, arguments_of, canonical, is_true

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.scenario import AgentSetup, Scenario


def check(scenario: Scenario, where: str) -> None:
    """Refuse a scenario whose table, arguments, files and controlled vehicles are not consistent.

    Raises:
        ScenarioError: the scenario is not consistent; the message names key, value and fix.
    """
    sumo = scenario.table(SumoSetup)
    check_options(sumo.options, where)
    for name, argument in scenario.arguments.items():
        if argument.option:
            check_options({argument.option: ""}, f"{where}: arguments.{name}")
    for file in scenario.files():
        if "," in Path(file).name:
            refuse(where, "sumo", file, "has a comma, at which SUMO begins another file", "rename it")
    for file in () if sumo.literal else scenario.texts():
        for name in _asked_for(read_xml(scenario.folder / file)):
            if name not in scenario.arguments:
                message = f"has no {name!r}, which {file} asks for"
                refuse(where, "arguments", sorted(scenario.arguments), message, "declare it")
    for name in arguments_of(sumo.manoeuvre, scenario.arguments) if sumo.manoeuvre else ():
        if name not in scenario.arguments:
            message = f"has no {name!r}, which the manoeuvre {sumo.manoeuvre!r} needs"
            refuse(where, "arguments", sorted(scenario.arguments), message, "declare it")
    if sumo.manoeuvre and len(scenario.agents) != 1:
        refuse(where, "agents", sorted(scenario.agents), "must be one vehicle for a manoeuvre", "declare one agent")
    for agent, setup in scenario.agents.items():
        named = [key for key in ("existing", "route", "edges", "replaces") if getattr(setup, key)]
        if len(named) != 1:
            message = "must have one of existing, route, edges, replaces"
            refuse(where, f"agents.{agent}", named, message, "give exactly one of them")
        if setup.replaces and setup.replaces not in scenario.arguments:
            message = "is no scenario argument"
            refuse(where, f"agents.{agent}.replaces", setup.replaces, message, "declare it: a vehicle's name as a text")
        speeds = setup.target_speeds
        if not speeds or list(speeds) != sorted(set(speeds)):
            refuse(where, f"agents.{agent}.target_speeds", speeds, "does not rise", "list speeds from low to high")


def check_options(options: Mapping[str, object], where: str) -> None:
    """Refuse options of SUMO that would change the meaning of a trial.

    Raises:
        ScenarioError: an option would change the meaning of a trial; the message names the option.
    """
    seen: dict[str, str] = {}
    for option, value in options.items():
        name = canonical(option)
        if name in RESERVED:
            refuse(where, "sumo.options", option, "is an option that crashhunt sets itself", "remove it")
        if name == "mesosim" and (value == "" or is_true(value)):
            message = "simulates queues: vehicles jump from one to the next, and none can be driven"
            refuse(where, f"sumo.options.{option}", value, message, "remove it, to simulate every vehicle")
        if name in ("configuration-file", "load-state"):
            message = "names a file that says more than a trial may take over"
            refuse(where, "sumo.options", option, message, "write its options here instead, and begin at a time")
        if name in seen:
            refuse(where, "sumo.options", option, f"is another name of {seen[name]!r}", "give it once")
        seen[name] = option


def _asked_for(content: bytes) -> list[str]:
    """Return the arguments that a file uses as ``${NAME}``."""
    if b"${" not in content:
        return []
    return string.Template(content.decode("utf-8", "replace")).get_identifiers()


# Where one of these is, things may be defined that are not written there as `id="NAME"`.
_GENERATED_ID = re.compile(rb"""\bid\s*=\s*["'][^"']*(?:\$\{|&#)""")
_TAGS = {"type": b"vType|vTypeDistribution", "route": b"route|routeDistribution", "edge": b"edge"}
_VEHICLES = b"vehicle|trip|flow"
_DEMAND_TAGS = "vehicle|trip|flow|person|personFlow|container|containerFlow|calibrator"


def check_names(scenario: Scenario, ego: str = "") -> None:
    """Refuse a controlled vehicle whose type, route, edges or traffic vehicle is not defined in any file.

    The message contains the value of ``--ego``.

    Raises:
        ScenarioError: a name is unknown; the message contains the most similar known name.
    """
    demand = [read_xml(scenario.folder / name) for name in scenario.texts()]
    open_ended = any(_GENERATED_ID.search(text) for text in demand)
    for agent, setup in scenario.agents.items():
        key = f"agents.{agent}"
        if not open_ended:
            if setup.existing:
                _check_vehicle(agent, demand, f"--ego {ego!r}" if ego else key, scenario.origin)
            elif setup.replaces:
                _check_replaced(scenario, setup, demand)
            elif not setup.type.startswith("DEFAULT_"):
                _check_name(f"{key}.type", "type", setup.type, demand, scenario.origin)
            if setup.route and not setup.route.startswith("!"):  # SUMO's own name for the route of a vehicle
                _check_name(f"--ego {ego!r}" if ego else f"{key}.route", "route", setup.route, demand, scenario.origin)
        _check_edges(scenario, setup, f"--ego {ego!r}" if ego else f"{key}.edges")


def _check_replaced(scenario: Scenario, setup: AgentSetup, demand: list[bytes]) -> None:
    """Check that the default of the argument for the replaced vehicle exists.

    Other values of the argument are not checked: there may be hundreds of them, and a missing vehicle costs only one
    trial, which reports it.
    """
    name = scenario.arguments[setup.replaces].default
    if isinstance(name, str):
        _check_vehicle(name, demand, f"arguments.{setup.replaces}.default", scenario.origin)


def _check_edges(scenario: Scenario, setup: AgentSetup, key: str) -> None:
    if setup.edges:
        net = [read_xml(scenario.folder / scenario.table(SumoSetup).net)]
        for edge in setup.edges:
            _check_name(key, "edge", edge, net, scenario.origin)


def _check_name(key: str, kind: str, name: str, texts: list[bytes], where: str) -> None:
    if _defined(name, texts):
        return
    known = [other for other in _ids(_TAGS[kind], texts) if not other.startswith(":")]
    fix = f"{did_you_mean(name, known)} there are {listed(known)}".lstrip()
    raise ScenarioError(f"{key}: the files of the scenario have no {kind} {name!r}", fix=fix, where=where)


def _check_vehicle(name: str, texts: list[bytes], key: str, where: str) -> None:
    flows = _ids(b"flow", texts)
    if name in flows and name not in _ids(b"vehicle|trip", texts):
        fix = f"name one of its vehicles: {name}.0, {name}.1, …"
        raise ScenarioError(f"{key}: {name!r} is a flow, not a vehicle", fix=fix, where=where)
    # A flow's vehicles are FLOW.0, those of a calibrator CALIBRATOR.FLOW.0, the car of a person PERSON_0.
    parts = name.split(".")
    makers = [".".join(parts[:count]) for count in range(1, len(parts))]
    if name in _ids(b"vehicle|trip", texts):
        return
    if any(_defined(maker, texts) for maker in (name.rpartition("_")[0], *makers) if maker):
        return
    known = [f"{other}.0" if other in flows else other for other in _ids(_VEHICLES, texts)]
    fix = f"{did_you_mean(name, known)} there are {listed(known)}".lstrip()
    raise ScenarioError(f"{key}: the files of the scenario have no vehicle {name!r}", fix=fix, where=where)


def _defined(name: str, texts: list[bytes]) -> bool:
    return not name.isascii() or any(_definition(name).search(text) for text in texts)


def _definition(name: str) -> re.Pattern[bytes]:
    from xml.sax.saxutils import escape  # which imports urllib and ssl

    written = re.escape(escape(name, {'"': "&quot;", "'": "&apos;"}).encode())
    return re.compile(rb"""\bid\s*=\s*["'](?:%b|%b)["']""" % (written, re.escape(name.encode())))


def _ids(tags: bytes, texts: list[bytes]) -> list[str]:
    from xml.sax.saxutils import unescape  # which imports urllib and ssl

    found = re.compile(rb"""<(?:%b)\s[^<>]*?\bid\s*=\s*["']([^"']*)["']""" % tags)
    names = (name.decode(errors="replace") for text in texts for name in found.findall(text))
    return list(dict.fromkeys(unescape(name, {"&quot;": '"', "&apos;": "'"}) for name in names))


# SUMO's complaints about an episode that it could not set up, as file, key and value that the user can correct.

_NEWLINE = b"\n"
_SET_UP_ERROR = "SUMO could not set up the episode: "
_FIX_IN_FILE = "correct it there"
# SUMO raises one of these, and says on its output what it means.
_VAGUE_ERRORS = ("Process Error", "TraCIException", "Could not parse commandline options.")
_STAGED_PATH = re.compile(r"/\S*?/stage-\d+/")
_OPTION_ERROR = re.compile(r"No option with the name '([^']+)' exists|On processing option '--([^']+)'")
_NUMBER_ERROR = re.compile(r"Invalid (?:Number|Bool) Format(?: \([\w ]+\))? (\S+)")
_LINE_ERROR = re.compile(r"In file '([^']+)' At line/column (\d+)")
_VEHICLE_ERROR = re.compile(r"(?:Invalid|departing) (\w+?)(?: definition)?(?: '[^']*')? for vehicle '([^']+)'")
_KEY_BY_ATTRIBUTE = {"type": "type", "route": "route", "departLane": "depart_lane", "departPos": "depart_pos"}
_KEY_BY_ATTRIBUTE |= {"departSpeed": "depart_speed"}
# In a message, an element is named by its kind and its id; the one that is unknown is not the one to correct.
_NAMED_ID = re.compile(r"(\w+(?: type)?)(?: with the id)? '([^']+)'")
_BARE_ID = re.compile(r"\b(edge|lane) ([^'\s]+) to use\b")
_UNKNOWN = re.compile(r"(?i)unknown|not (?:yet )?(?:known|defined)|does not exist|no such")
_TAGS_BY_WORD = {
    **dict.fromkeys(("vehicle", "trip"), "vehicle|trip"),
    "flow": "flow|personFlow|containerFlow",
    **dict.fromkeys(("vehicle type", "type", "vtype"), "vType|vTypeDistribution"),
    "route": "route|routeDistribution",
    "distribution": "routeDistribution|vTypeDistribution",
    "e1detector": "inductionLoop|e1Detector",
    "e2detector": "laneAreaDetector|e2Detector",
    "e3detector": "entryExitDetector|e3Detector",
    "mslanespeedtrigger": "variableSpeedSign",
    "tls": "tlLogic",
    "access": "busStop|trainStop|parkingArea|containerStop",
}
"""The tags of the elements that SUMO's messages call by another word."""


def explained(message: str, output: str, scenario: Scenario) -> ScenarioError | None:
    """Return the error of a scenario in which no episode could be set up; None if SUMO is not the cause.

    The message is that of the worker's exception. The scenario is the loaded one, not the worker's copy.
    """
    said, errors = message.removeprefix(_SET_UP_ERROR), _errors(output)
    died = message.startswith("the process died") and errors
    if not (died or message.startswith(_SET_UP_ERROR)):
        return None
    if died or (errors and said in _VAGUE_ERRORS):
        said = f"{errors[0]} ({message})" if died else errors[0]
    said = _STAGED_PATH.sub(f"{scenario.folder}/", said).rstrip(".")
    return _about_an_option(said, scenario) or _about_a_vehicle(said, scenario) or _about_a_file(said, scenario)


def _errors(output: str) -> list[str]:
    """Return the error messages in SUMO's output, each as one line; indented lines belong to the message above them."""
    found: list[str] = []
    open_ = False
    for line in output.splitlines():
        if line.startswith("Error: "):
            found.append(line.removeprefix("Error: "))
            open_ = True
        elif open_ and line.startswith(" "):
            found[-1] += f" {line.strip()}"
        else:
            open_ = False
    return found


def _about_an_option(said: str, scenario: Scenario) -> ScenarioError | None:
    options = scenario.table(SumoSetup).options
    keys = {name: f"sumo.options.{name}" for name in options}
    keys |= {setup.option: f"arguments.{name}.option" for name, setup in scenario.arguments.items() if setup.option}
    found, number = _OPTION_ERROR.search(said), _NUMBER_ERROR.search(said)
    if found is not None:
        name = found[1] or found[2]
        if name in keys:
            fix = "see https://sumo.dlr.de/docs/sumo.html for its options"
            return ScenarioError(f"{keys[name]}: SUMO says: {said}", fix=fix, where=scenario.origin)
    if number is not None:
        for name, value in options.items():
            if str(value) == number[1]:
                what = f"{keys[name]} = {value!r}: SUMO says: {said}"
                return ScenarioError(what, fix="change the value", where=scenario.origin)
    return None


def _about_a_vehicle(said: str, scenario: Scenario) -> ScenarioError | None:
    found = _VEHICLE_ERROR.search(said)
    if found is None or found[2] not in scenario.agents or found[1] not in _KEY_BY_ATTRIBUTE:
        return None
    key = _KEY_BY_ATTRIBUTE[found[1]]
    value = getattr(scenario.agents[found[2]], key)
    what = f"agents.{found[2]}.{key} = {value!r}: SUMO says: {said}"
    return ScenarioError(what, fix="change the value", where=scenario.origin)


def _about_a_file(said: str, scenario: Scenario) -> ScenarioError:
    """Return an error with the file and line that SUMO names, or in which the named element is defined."""
    line = _LINE_ERROR.search(said)
    if line is not None:
        text = said[: line.start()].strip()
        return ScenarioError(f"SUMO says: {text}", fix=_FIX_IN_FILE, where=f"{line[1]}, line {line[2]}")
    named: list[tuple[str, str]] = _NAMED_ID.findall(_BARE_ID.sub(r"\1 '\2'", said))
    texts = {scenario.folder / name: read_xml(scenario.folder / name) for name in scenario.texts()}
    unknown = None
    if _UNKNOWN.search(said) and named:
        unknown = named.pop("': " in said and len(named) > 1)
    fix = _FIX_IN_FILE
    if unknown is not None and (defined := _places(*unknown, texts)):
        later, _, _ = defined[0].rpartition(", line ")
        fix = f"{unknown[1]!r} is defined in {later}, which SUMO reads later; list that file first in additional-files"
    for word, name in named:
        places = _places(word, name, texts)
        if not places and word.lower() == "vehicle":
            places = _places("flow", name.rpartition(".")[0], texts)  # FLOW.0, FLOW.1, …
        if len(places) == 1:
            return ScenarioError(f"SUMO says: {said}", fix=fix, where=places[0])
    if unknown is not None and len(places := _uses(unknown[1], texts)) == 1:
        return ScenarioError(f"SUMO says: {said}", fix=fix, where=places[0])
    if unknown is None:
        net = scenario.folder / scenario.table(SumoSetup).net
        for word, name in named:
            if word.lower() in ("edge", "lane", "junction") and (places := _places(word, name, {net: read_xml(net)})):
                return ScenarioError(f"SUMO says: {said}", fix=fix, where=places[0])
    fix = "see [sumo] and the files that it names" if fix == _FIX_IN_FILE else fix
    return ScenarioError(f"SUMO says: {said}", fix=fix, where=scenario.origin)


def places_of(name: str, scenario: Scenario) -> list[str]:
    """Return ``FILE, line N``, without the folder, of each vehicle, flow, person or calibrator with an id."""
    texts = {Path(file): read_xml(scenario.folder / file) for file in scenario.texts()}
    return _places(_DEMAND_TAGS, name, texts)


def _places(word: str, name: str, texts: Mapping[Path, bytes]) -> list[str]:
    """Return ``FILE, line N`` of each element that a word of SUMO's messages and an id name."""
    tags = _TAGS_BY_WORD.get(word.lower(), word).encode()
    return _lines(re.compile(rb"<(?i:%b)\s[^<>]*?%b" % (tags, _definition(name).pattern)), texts)


def _uses(name: str, texts: Mapping[Path, bytes]) -> list[str]:
    """Return ``FILE, line N`` of each element with an attribute other than its id that is a name."""
    value = re.escape(name.encode())
    return _lines(re.compile(rb"""<\w+\s(?:[^<>]*\s)?(?!id\b)\w+\s*=\s*(?:"%b"|'%b')""" % (value, value)), texts)


def _lines(pattern: re.Pattern[bytes], texts: Mapping[Path, bytes]) -> list[str]:
    return [
        f"{path}, line {text.count(_NEWLINE, 0, found.start()) + 1}"
        for path, text in texts.items()
        for found in pattern.finditer(text)
    ]
