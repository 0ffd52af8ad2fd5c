"""``crashhunt init``."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import NoValidTrialError, UsageError
from crashhunt.base.text import command_line
from crashhunt.cli._common import DONE, CommandOptions, Commands, add_json

if TYPE_CHECKING:
    from crashhunt.base.json_types import Plain
    from crashhunt.sumo.maps import MapSource, PlainTrial


def add_init(commands: Commands) -> None:
    """Add the command ``init`` to the parser."""
    init = commands.add_parser(
        "init",
        usage="%(prog)s (--osm FILE | --opendrive FILE | --xosc FILE | --net FILE\n"
        "                       | --grid NxM | --spider NxM) [option]... DIR",
        help="make a scenario from a map",
        description="Make a scenario from a map: the network, traffic that does not jam, a first agent, and a README "
        "with the next commands. The command tries the scenario before it writes DIR. Needs: pip install "
        "'crashhunt[maps]'.",
    )
    init.add_argument("directory", metavar="DIR", type=Path, help="folder of the scenario; must be new or empty")
    maps = init.add_argument_group("the map (exactly one)").add_mutually_exclusive_group(required=True)
    maps.add_argument(
        "--osm", metavar="FILE", type=Path, help="a map of OpenStreetMap: .osm, .osm.xml, .gz of these, or .pbf"
    )
    maps.add_argument("--opendrive", metavar="FILE", type=Path, help="an OpenDRIVE map: .xodr or .xodr.gz")
    maps.add_argument(
        "--xosc", metavar="FILE", type=Path,
        help="instead of a map: the parameters of an OpenSCENARIO file of a test case of UN R157 (.xosc)",
    )  # fmt: skip
    maps.add_argument("--net", metavar="FILE", type=Path, help="a network of SUMO: .net.xml or .net.xml.gz")
    maps.add_argument("--grid", metavar="NxM", default="", help="a generated grid of N by M junctions, such as 4x4")
    maps.add_argument("--spider", metavar="NxM", default="", help="a generated web of N arms and M rings, such as 5x3")
    how = init.add_argument_group("what is made of it")
    how.add_argument(
        "--bbox",
        metavar="W,S,E,N",
        help="use only the part of the map between longitudes W and E and latitudes S and N, in degrees; write "
        "--bbox=W,S,E,N with =, because W may be negative",
    )
    how.add_argument(
        "--demand", metavar="LOW:HIGH", default="0.2:1.5",
        help="range LOW:HIGH of the factor that multiplies the traffic (default: %(default)s); init reduces the "
        "traffic until it does not jam at the factor HIGH",
    )  # fmt: skip
    how.add_argument("--people", action="store_true", help="add pedestrians, and sidewalks and crossings for them")
    how.add_argument("--bicycles", action="store_true", help="add cyclists, and lanes for bicycles")
    how.add_argument("--lefthand", action="store_true", help="make the traffic drive on the left")
    how.add_argument(
        "--agent", metavar="NAME", help="the agent that drives in hunts without --agent (default: car-following)"
    )
    how.add_argument(
        "--workflow", choices=["github"], default="", help="add a workflow file that hunts in this CI service"
    )
    add_json(how)
    init.set_defaults(command=_init)


def _init(options: CommandOptions, _words: list[str]) -> int:
    if options.xosc is not None:
        return _init_from_parameters(options)
    from crashhunt.sumo.maps import MapOptions, describe_place, make_scenario, parse_bbox

    asked = MapOptions(
        bbox=parse_bbox(options.bbox) if options.bbox is not None else None,
        demand=_demand(options.demand),
        people=options.people,
        bicycles=options.bicycles,
        left_hand=options.lefthand,
        agent=options.agent or "",
        workflow=options.workflow,
    )
    if options.agent is not None:
        _check_agent(options.agent)

    def tell(text: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\x1b[K{text} …" if text else "\r\x1b[K", end="", file=sys.stderr, flush=True)

    try:
        made = make_scenario(_source(options), asked, options.directory, try_out=_run_one_trial, tell=tell)
    except KeyboardInterrupt:
        tell("")
        if not (options.directory / layout.SCENARIO).exists():
            print(f"crashhunt: interrupted; {command_line(options.directory)} was not made", file=sys.stderr)
        raise
    finally:
        tell("")
    lines = [f"made {command_line(options.directory)}", "", *describe_place(made), "", "Next:"]
    options.answer("\n".join([*lines, *(f"  {command}" for command in made.commands)]), made.to_json())
    return DONE


def _init_from_parameters(options: CommandOptions) -> int:
    """Make a scenario from an OpenSCENARIO file."""
    from crashhunt.formats import scenario_from_openscenario

    given = {"--bbox": options.bbox, "--agent": options.agent, "--workflow": options.workflow or None}
    for flag, value in given.items():
        if value is not None:
            raise UsageError(f"{flag} cannot be used with --xosc", fix=f"omit {flag}")
    made = scenario_from_openscenario(options.xosc, options.directory)
    read = [f"  {name}: {words}" for name, words in made.read.items()]
    left = [f"  {words}" for words in made.not_read]
    run = command_line("crashhunt", "run", "hunt", "2", "100", "400", "--scenario", options.directory)
    lines = [
        f"made {command_line(options.directory)}, a variant of {made.scenario}", "",
        "Read:", *read, *(["Not read:", *left] if left else []), "",
        "The storyboard of the file is not run: the other road users move as in the scenario of crashhunt.",
        "All other arguments of the scenario keep their values.", "",
        "Next:", f"  {run}",
    ]  # fmt: skip
    options.answer("\n".join(lines), made.to_json())
    return DONE


def _source(options: CommandOptions) -> MapSource:
    from crashhunt.sumo.maps import MapSource, parse_shape

    if options.grid:
        return MapSource(kind="grid", shape=parse_shape(options.grid, "--grid"))
    if options.spider:
        return MapSource(kind="spider", shape=parse_shape(options.spider, "--spider"))
    if options.osm is not None:
        return MapSource(kind="osm", path=options.osm)
    if options.opendrive is not None:
        return MapSource(kind="opendrive", path=options.opendrive)
    if options.net is not None:
        return MapSource(kind="net", path=options.net)
    raise UsageError("no map is given", fix="give one of --osm, --opendrive, --net, --grid, --spider")


def _demand(text: str) -> tuple[float, float]:
    """Return the range of traffic factors in a text.

    Raises:
        UsageError: the text is not a range.
    """
    fix = "give two factors above 0, such as --demand 0.2:1.5"
    low, colon, high = text.partition(":")
    try:
        found = float(low), float(high if colon else low)
    except ValueError:
        raise UsageError(f"--demand {text!r} is not a range", fix=fix) from None
    if not 0 < found[0] <= found[1] <= _MAX_DEMAND:  # NaN is neither
        raise UsageError(f"--demand {text!r} is not a range between 0 and {_MAX_DEMAND:g}", fix=fix)
    return found


_MAX_DEMAND = 100.0


_IMPORT_S = 60.0


def _check_agent(name: str) -> None:
    """Refuse an agent that no trial could create, before the time-consuming work on the map.

    Raises:
        PluginError: the agent does not exist, or its module cannot be imported.
        UsageError: the agent needs an argument.
    """
    from crashhunt.base.isolation import work_apart
    from crashhunt.base.plugins import is_foreign, locate
    from crashhunt.trial import CallSignature, signature_of

    def described(_report: object = None) -> Plain:
        return signature_of(locate("agents", name)).to_json()

    # A module of the user may end or stop the process that imports it.
    task = f"{name!r} cannot be imported"
    data = work_apart(described, task=task, timeout_s=_IMPORT_S) if is_foreign("agents", name) else described()
    required = CallSignature.from_json(data).required
    if required:
        fix = "give the argument a default in the agent's code, because the new scenario sets no value"
        raise UsageError(f"--agent {name}: the agent needs the argument {required[0]!r}", fix=fix)


def _run_one_trial(folder: Path, steps: int) -> PlainTrial:
    """Run one trial in the new scenario, and return its result.

    Raises:
        NoValidTrialError: the controlled vehicle does not enter.
    """
    from crashhunt.api import run
    from crashhunt.base.temporary import temporary_folder
    from crashhunt.sumo.maps import PlainTrial

    began = time.monotonic()
    with temporary_folder("try") as place:
        report = run(place / "hunt", 1, 1, steps, scenario=folder, seed=1)
        outcome = next((str(kind) for kind, count in report.outcomes.items() if count), "")
        steps_run = report.trial_steps
    if report.stopped_because == "interrupted":
        raise KeyboardInterrupt  # the hunt has collected the signal
    if report.stopped_because == "no_valid_trial" or not outcome:
        message = "no trial of the new scenario is valid: the controlled vehicle does not enter"
        raise NoValidTrialError(message, fix="lower --demand, or choose another part of the map")
    return PlainTrial(outcome=outcome, steps=steps_run, wall_s=time.monotonic() - began)
