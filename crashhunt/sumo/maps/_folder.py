"""Writes the readable files of a scenario: ``scenario.toml``, ``agent.py``, ``README.md`` and the CI workflow."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.text import command_line
from crashhunt.base.version import __version__

if TYPE_CHECKING:
    from crashhunt.sumo.maps._traffic import Demand

AGENT = "agent:Driver"
"""The agent of ``agent.py``."""
DEFAULT_AGENT = "crashhunt.agents:CarFollowing"


@dataclass(frozen=True, slots=True, kw_only=True)
class MapArgument:
    """An argument of the scenario, in the form of ``scenario.toml``."""

    name: str
    default: float | int | str
    range: str
    help: str
    unit: str = ""
    option: str = ""


def arguments_of(demand: Demand, scales: tuple[float, float], *, bicycles: bool) -> list[MapArgument]:
    """Return the arguments of a scenario that is made from a map."""
    low, high = scales
    found = [
        MapArgument(
            name="demand", default=min(max(1.0, low), high), range=f"{low:g}:{high:g}", option="scale",
            help=f"factor on the traffic; 1 is {demand.vehicles_per_hour:.0f} vehicles/h on the whole map",
        ),
        MapArgument(
            name="imperfection", default=0.5, range="0:1", help="sigma of the drivers' car-following model"
        ),
        MapArgument(
            name="speed_spread", default=0.1, range="0:0.2", help="standard deviation of the speed factor"
        ),
        MapArgument(
            name="trucks_per_100_cars", default=10, range="0:30", unit="trucks",
            help="to every 100 cars, where trucks may drive",
        ),
    ]  # fmt: skip
    if bicycles:
        found.append(
            MapArgument(
                name="cyclists_per_100_cars", default=15, range="0:50", unit="cyclists",
                help="to every 100 cars, where bicycles may ride",
            )
        )  # fmt: skip
    if demand.walks:
        found.append(
            MapArgument(
                name="persons_per_path", default=30, range="10:120", unit="persons/h",
                help=f"on each of {len(demand.walks)} ways on foot",
            )
        )  # fmt: skip
    routes = demand.ego_routes
    found.append(
        MapArgument(
            name="ego_route", default=routes[0], range="|".join(routes) if len(routes) > 1 else "",
            help="of the controlled vehicle, in traffic.rou.xml",
        )
    )  # fmt: skip
    return found


_CAR_FOLLOWING = """
[agents.ego.arguments.delay_s]
default = 0.3
range = "0:1"
unit = "s"
help = "acts on observations this old"

[agents.ego.arguments.headway_s]
default = 1.5
range = "0.5:2.5"
unit = "s"
help = "time gap that it keeps"

[agents.ego.arguments.desired_speed]
default = {speed:.1f}
range = "{low:.1f}:{high:.1f}"
unit = "m/s"
help = "on a free road"
"""


def scenario_toml(
    title: str, arguments: list[MapArgument], *, warmup_s: float, speed_limit_mps: float, agent: str = ""
) -> str:
    """Return the contents of ``scenario.toml``.

    Agents want to drive at about the speed limit, which is the usual one on the routes. By default, crashhunt's
    car-following agent drives.
    """
    lines = [
        f"title = {_text(title)}",
        "schema = 1",
        'simulator = "sumo"',
        "step_length_s = 0.1",
        f"warmup_s = {warmup_s:.1f}",
        "",
        "[sumo]",
        'net = "map.net.xml"',
        'routes = ["traffic.rou.xml"]',
    ]
    for argument in arguments:
        lines += ["", f"[arguments.{argument.name}]", f"default = {_value(argument.default)}"]
        for key in ("range", "unit", "help", "option"):
            value = str(getattr(argument, key))
            lines += [f"{key} = {_text(value)}"] if value else []
    lines += [
        "",
        "[agents.ego]",
        f"agent = {_text(agent or DEFAULT_AGENT)}",
        'type = "ego"',
        'route = "ego-route"',
        'depart_lane = "best"',
        'depart_speed = "max"',
    ]
    text = "\n".join([*lines, ""])
    if agent in ("", DEFAULT_AGENT, "car-following"):
        text += _CAR_FOLLOWING.format(speed=speed_limit_mps, low=0.6 * speed_limit_mps, high=1.3 * speed_limit_mps)
    return text


def _value(value: float | str) -> str:
    return _text(value) if isinstance(value, str) else repr(value)


def _text(text: str) -> str:
    # A basic string of TOML is one of JSON; a lone surrogate, as of a name that is no UTF-8, is in neither.
    return json.dumps(text.encode("utf-8", "replace").decode(), ensure_ascii=False).replace("\x7f", "\\u007f")


def agent_module(speed_limit_mps: float) -> str:
    """Return the contents of ``agent.py``: a simple agent as a starting point."""
    return _AGENT_MODULE.replace("SPEED", f"{speed_limit_mps:.1f}").replace("HIGH", f"{1.3 * speed_limit_mps:.1f}")


_AGENT_MODULE = '''"""A driver to begin with: it follows the vehicle ahead. It knows neither priority nor lights."""

from typing import Annotated

from crashhunt.space import Argument, Range

CAR_LENGTH_M = 5.0
STEP_S = 0.1


class Driver:
    """Keeps a time gap to the vehicle ahead.

    The parameters are the arguments of the agent. A hunt draws those that have a range. To set one yourself, give
    `crashhunt run` the option --arg headway_s=1.0, or --arg headway_s=0.5:2 for another range.

    Args:
        headway_s: the time gap, in s.
        speed: on a free road, in m/s.
        brake: the hardest that it brakes, in m/s2.
    """

    def __init__(
        self,
        headway_s: Annotated[float, Argument("headway_s", distribution=Range(0.5, 2.5), unit="s")] = 1.5,
        speed: Annotated[float, Argument("speed", distribution=Range(5.0, HIGH), unit="m/s")] = SPEED,
        brake: float = 6.0,
    ) -> None:
        self.headway_s, self.speed, self.brake = headway_s, speed, brake

    def reset(self, seed: int) -> None:
        """Begin a trial. All randomness of the agent has to come from this seed."""

    def act(self, observation):
        """Return the target speed in m/s, and the lane change: 1 to the left, -1 to the right, 0 for none.

        Row 0 of the observation is the vehicle itself. The other rows are the nearest actors, relative to it:
        present, ahead (m), to the right (m), speed ahead (m/s), speed to the right (m/s), cosine and sine of heading.
        """
        own_speed = float(observation[0, 3])
        target = min(self.speed, own_speed + 2.0 * STEP_S)
        for present, ahead, right, closing, _, cosine, _ in observation[1:]:
            if not present or ahead <= 0 or abs(right) > 1.7 or cosine < 0:
                continue  # absent, behind, in another lane, or oncoming
            gap = ahead - CAR_LENGTH_M - 2.0
            # The speed from which it can still stop behind the vehicle ahead, if that brakes as hard.
            ahead_speed = max(0.0, own_speed + closing)
            safe = max(0.0, ahead_speed + (gap - ahead_speed * self.headway_s) / (self.headway_s + 1.0))
            target = min(target, safe)
        # What you may add: stop for vehicles that cross, and change lanes.
        return max(0.0, own_speed - self.brake * STEP_S, target), 0
'''


def next_commands(folder: str, steps: int) -> list[str]:
    """Return the commands that the user can run next.

    The folder is as the user named it; empty for the current folder.
    """
    enter = [command_line("cd", folder)] if folder else []
    return [
        *enter,
        f"crashhunt run hunt 0 200 {steps} --scenario . --agent {AGENT} --seed 1",
        "crashhunt show hunt --last-seconds 3",
        "crashhunt replay hunt",
    ]


_README = """# {title}

A scenario for [crashhunt](https://crashhunt.github.io/crashhunt), made by `crashhunt init` {version}.

## Next

In this folder, hunt for a crash of the agent in `agent.py`, see what happened, and run the crash again:

```sh
{commands}
```

## The place

```text
{place}
```

![The map with its busiest roads](map.png)

## Files

| file | content |
| --- | --- |
| `scenario.toml` | the scenario: arguments with their ranges, warm-up, the controlled vehicle |
| `map.net.xml` | the network for SUMO |
| `traffic.rou.xml` | {routes} routes with a flow of vehicles each{walks} |
| `agent.py` | an agent to begin with: change it |
| `map.png` | the map, with the traffic of {run_s} simulated seconds |{workflow}

To change the traffic, edit the ranges in `scenario.toml`, or give `crashhunt run` the option `--set demand=0.5`.
{licence}"""
_OSM_LICENCE = """
The map is from OpenStreetMap: © OpenStreetMap contributors, Open Database License (openstreetmap.org/copyright). Keep
this notice with the map.
"""


def readme(
    title: str, place: list[str], *, demand: Demand, steps: int, run_s: int, from_osm: bool, workflow_file: str
) -> str:
    """Return the contents of the scenario's ``README.md``.

    Without an agent, the traffic was simulated for ``run_s``.
    """
    walks = f", {len(demand.walks)} flows of persons" if demand.walks else ""
    row = (
        f"\n| `{workflow_file}` | hunts on every push; it works from the top of a repository |" if workflow_file else ""
    )
    return _README.format(
        title=title, version=__version__, commands="\n".join(next_commands("", steps)), place="\n".join(place),
        routes=len(demand.routes), walks=walks, run_s=run_s, workflow=row, licence=_OSM_LICENCE if from_osm else "",
    )  # fmt: skip


WORKFLOW = ".github/workflows/crashhunt.yml"
_SET_UP = """\
      - uses: actions/checkout@v4
      - uses: actions/setup-python@v5
        with: { python-version: "3.12" }
"""
_WORKFLOW = """# Hunts for crashes of the agent on every push, and runs kept crashes again.
# GitHub reads this file at .github/workflows/crashhunt.yml of the top of a repository.
name: crashhunt
on: [push]
permissions: { contents: read }
env:
  PYTHONPATH: FOLDER # where agent.py is
jobs:
  hunt:
    runs-on: ubuntu-latest
    steps:
SET_UP      - uses: crashhunt/crashhunt/.github/actions/hunt@vVERSION
        with:
          arguments: ARGUMENTS
          trials: "200"
          max-steps: "STEPS"
          known: KNOWN # crash types that are kept are not new
  corpus:
    runs-on: ubuntu-latest
    steps:
SET_UP      - uses: crashhunt/crashhunt/.github/actions/corpus@vVERSION
        if: EXISTS # crashhunt corpus add keeps the first crash
        with: { corpus: CRASHES }
"""


def workflow(folder: str, steps: int) -> str:
    """Return a GitHub workflow that uses both actions of crashhunt.

    The folder is relative to the root of the repository.
    """
    crashes = "crashes" if folder == "." else f"{folder}/crashes"
    # The action splits these words with shlex, which does not know all that a shell knows.
    words = f"--scenario {shlex.quote(folder)} --agent {AGENT} --seed 1"
    exists = f"hashFiles({_expression(f'{crashes}/**')}) != ''"
    values = {
        "SET_UP": _SET_UP, "CRASHES": _scalar(crashes), "FOLDER": _scalar(folder), "VERSION": __version__,
        "ARGUMENTS": _scalar(words), "STEPS": str(steps), "EXISTS": _scalar(exists),
        "KNOWN": _scalar(f"${{{{ {exists} && {_expression(crashes)} || '' }}}}"),
    }  # fmt: skip
    # In one pass: a folder may have any of these names.
    return re.sub("|".join(values), lambda found: values[found[0]], _WORKFLOW)


def _scalar(text: str) -> str:
    """Return a text in double quotes for YAML: as in JSON, but with letters outside of ASCII unchanged."""
    ascii_only = json.dumps(text, ensure_ascii=False)
    return "".join(one if one.isascii() and one != "\x7f" else f"\\U{ord(one):08x}" for one in ascii_only)


def _expression(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"  # as GitHub's expressions write a text
