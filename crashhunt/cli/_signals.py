"""``crashhunt signals``: the signals that requirements may name."""

from __future__ import annotations

import json

from crashhunt.base.text import aligned, visible
from crashhunt.cli._common import CommandOptions, Commands, add_json, add_options, chosen_options

_HUNT_OPTIONS = ("ego", "action", "observe", "agents", "arguments", "scenario_arguments")


def add_signals(commands: Commands) -> None:
    """Add the command ``signals`` to the parser."""
    signals = commands.add_parser(
        "signals",
        help="list the signals that requirements may name in a scenario",
        description="List the signals that the formulas of --require may name in a scenario, with their units. Runs "
        "one step of a trial, because a Gymnasium environment adds keys of info in its steps.",
    )
    signals.add_argument("scenario", metavar="SCENARIO", help="name of an included scenario, or a path")
    add_options({"what": signals.add_argument_group("as for crashhunt run")}, _HUNT_OPTIONS)
    add_json(signals)
    signals.set_defaults(command=_signals)


_ANY_STEPS = 1_000_000  # so that windows of requirements in the scenario fit; only one step runs


def _signals(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.hunts import list_signals
    from crashhunt.plans import Request, plan

    given = chosen_options(options, _HUNT_OPTIONS)
    asked = Request(scenario=options.scenario, trials=1, max_steps=_ANY_STEPS, **given)
    found = list_signals(*plan(asked))
    if options.json:
        print(json.dumps(found))
        return 0
    rows = [["signal", "unit", "meaning"], *([one["name"], one["unit"], one["meaning"]] for one in found["signals"])]
    lines = aligned(rows, left=range(3))
    if len(found["agents"]) > 1:
        lines.append(f"each agent has these signals; {found['agents'][0]}.speed names one of an agent")
    print(visible("\n".join(lines)))
    return 0
