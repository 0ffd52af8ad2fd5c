"""What SUMO's files define: the vehicles, types, routes and edges that a scenario may name.

SUMO itself finds out that there is no such thing only when a trial begins, and of a vehicle of the traffic never: it
waits for it in vain. So names are looked up before a hunt, wherever the files can tell. They are searched and not
parsed, as a network may have hundreds of megabytes.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.base.names import did_you_mean, listed
from crashhunt.scenario.backends.sumo._table import SumoSetup
from crashhunt.scenario.backends.sumo._xml import read_xml

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from crashhunt.scenario._scenario import Scenario
    from crashhunt.scenario._tables import AgentSetup

__all__ = ["check_names", "line_of"]

# Where one of these is, things may be defined that are not written there as `id="NAME"`.
_SECRETIVE = re.compile(rb"""\bid\s*=\s*["'][^"']*(?:\$\{|&#)""")
_TAGS = {"type": b"vType|vTypeDistribution", "route": b"route|routeDistribution", "edge": b"edge"}
_VEHICLES = b"vehicle|trip|flow"


def check_names(scenario: Scenario, ego: str = "") -> None:
    """Refuse a controlled vehicle whose type, route, edges or, of the traffic, id are in none of the files.

    Args:
        scenario: whose files exist.
        ego: as it was given on the command line, for the message.

    Raises:
        ScenarioError: with what was probably meant.
    """
    demand = [read_xml(scenario.folder / name) for name in scenario.texts()]
    open_ended = any(_SECRETIVE.search(text) for text in demand)
    for agent, setup in scenario.agents.items():
        key = f"agents.{agent}"
        if not open_ended:
            if setup.existing:
                _check_vehicle(agent, demand, f"--ego {ego!r}" if ego else key, scenario.origin)
            elif setup.replaces:
                _check_replaced(scenario, setup, demand)
            elif not setup.type.startswith("DEFAULT_"):
                _check(f"{key}.type", "type", setup.type, demand, scenario.origin)
            if setup.route and not setup.route.startswith("!"):  # SUMO's own name for the route of a vehicle
                _check(f"--ego {ego!r}" if ego else f"{key}.route", "route", setup.route, demand, scenario.origin)
        _check_edges(scenario, setup, f"--ego {ego!r}" if ego else f"{key}.edges")


def line_of(name: str, files: Iterable[Path]) -> str:
    """Return ``FILE, line N`` of the first definition of an id; empty where there is none."""
    for file in files:
        text = read_xml(file)
        found = _definition(name).search(text)
        if found is not None:
            line = text.count(b"\n", 0, found.start()) + 1
            return f"{file}, line {line}"
    return ""


def _check_replaced(scenario: Scenario, setup: AgentSetup, demand: list[bytes]) -> None:
    """Look up the default alone: a range may name hundreds, and whoever is not there costs a trial, which says so."""
    name = scenario.arguments[setup.replaces].default
    if isinstance(name, str):
        _check_vehicle(name, demand, f"arguments.{setup.replaces}.default", scenario.origin)


def _check_edges(scenario: Scenario, setup: AgentSetup, key: str) -> None:
    if setup.edges:
        net = [read_xml(scenario.folder / scenario.table(SumoSetup).net)]
        for edge in setup.edges:
            _check(key, "edge", edge, net, scenario.origin)


def _check(key: str, kind: str, name: str, texts: list[bytes], where: str) -> None:
    if _defined(name, texts):
        return
    known = [other for other in _ids(_TAGS[kind], texts) if not other.startswith(":")]
    fix = f"{did_you_mean(name, known)} there are {listed(known)}".lstrip()
    raise ScenarioError(f"{key}: there is no {kind} {name!r} in its files", fix=fix, where=where)


def _check_vehicle(name: str, texts: list[bytes], key: str, where: str) -> None:
    flows = _ids(b"flow", texts)
    if name in flows and name not in _ids(b"vehicle|trip", texts):
        fix = f"name one of its vehicles: {name}.0, {name}.1, …"
        raise ScenarioError(f"{key}: {name!r} is a flow", fix=fix, where=where)
    # A flow's vehicles are FLOW.0, those of a calibrator CALIBRATOR.FLOW.0, the car of a person PERSON_0.
    parts = name.split(".")
    makers = [".".join(parts[:count]) for count in range(1, len(parts))]
    if name in _ids(b"vehicle|trip", texts):
        return
    if any(_defined(maker, texts) for maker in (name.rpartition("_")[0], *makers) if maker):
        return
    known = [f"{other}.0" if other in flows else other for other in _ids(_VEHICLES, texts)]
    fix = f"{did_you_mean(name, known)} there are {listed(known)}".lstrip()
    raise ScenarioError(f"{key}: there is no vehicle {name!r} in its files", fix=fix, where=where)


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
