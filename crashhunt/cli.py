"""The command line: parses, calls, prints."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from crashhunt import __version__
from crashhunt.errors import CrashhuntError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

_DESCRIPTION = "Hunts for the crashes of a driving agent, and hands them over so that they can be fixed."
_EPILOG = """\
examples:
  crashhunt run crash 2 300 1500
      hunt the shipped scenario `loop`: 2 trials at a time, 300 at most, 1500 steps each
  crashhunt run out 4 1000 1500 --scenario my/town.sumocfg --agent my_pkg.agents:Planner --arg headway_s=0.3:2
      hunt your own agent on your own network
  crashhunt replay crash
      run the crash again in a fresh process and prove that it is the same

exit codes: 0 done, 1 the answer is no, 2 bad usage or input, 3 not one valid trial, 130 interrupted
"""
_SPEC = "a value (20), a range (5:40, 5:40:5), a log range (log:1e-3:1) or a choice (a|b|c)"


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    as_json = "--json" in words
    try:
        options = _parser().parse_args(words)
        code = options.command(options, words)
    except CrashhuntError as error:
        if as_json:
            print(json.dumps(error.to_json()))
        print(f"crashhunt: {error}", file=sys.stderr)
        code = error.exit_code
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        code = 0
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message, fix=f"see {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        "crashhunt", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"crashhunt {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_run(commands)
    _add_replay(commands)
    for name, command, text in (
        ("agents", _agents, "list the agents that come with crashhunt or are installed, with their arguments"),
        ("scenarios", _scenarios, "list the scenarios that come with crashhunt, with their arguments"),
    ):
        listing = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        listing.add_argument("--json", action="store_true", help="print one JSON object")
        listing.set_defaults(command=command)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser(
        "run",
        help="hunt for a crash",
        description="Hunt for a crash: run trials in parallel, each with its own seed and arguments, and stop as soon "
        "as one crashes. The same command on the same DIR goes on from where it was.",
    )
    run.add_argument("directory", metavar="DIR", type=Path, help="where everything is kept; made if it is not there")
    run.add_argument("parallel", metavar="PARALLEL", type=_integer, help="trials at a time; 0: one per core")
    run.add_argument("trials", metavar="TRIALS", type=_integer, help="how many trials at most")
    run.add_argument("max_steps", metavar="MAX_STEPS", type=_integer, help="the bound on each trial, in steps")
    what = run.add_argument_group("what is hunted")
    what.add_argument(
        "--scenario", metavar="NAME|PATH", default="loop",
        help="a shipped scenario (see crashhunt scenarios), a folder, a scenario.toml or a .sumocfg; default: loop",
    )  # fmt: skip
    what.add_argument(
        "--ego", metavar="VEHICLE", default="",
        help="for a .sumocfg: the vehicle to control, or route=ID or edges=FROM,TO to add one; default: the first",
    )  # fmt: skip
    what.add_argument(
        "--agent", metavar="[ID=]MODULE:ATTR", action="append", default=[],
        help="who drives (see crashhunt agents); ID= where the scenario has several controlled vehicles",
    )  # fmt: skip
    what.add_argument(
        "--arg", metavar="NAME=SPEC", action="append", default=[],
        help=f"what to try for an argument of the agent: {_SPEC}; ID.NAME=SPEC for one of several agents",
    )  # fmt: skip
    what.add_argument(
        "--set", metavar="NAME=SPEC", action="append", default=[], dest="sets",
        help="the same for an argument of the scenario, such as its traffic demand",
    )  # fmt: skip
    how = run.add_argument_group("how it is hunted")
    how.add_argument("--sampler", metavar="NAME", default="random", help="random, grid or sweep; default: random")
    how.add_argument(
        "--points", metavar="N", type=_integer, default=10,
        help="values that grid and sweep try of a range without a step; default: 10",
    )  # fmt: skip
    how.add_argument("--seed", metavar="N", type=_integer, help="of the hunt; default: a new one, which is printed")
    how.add_argument(
        "--crash-on", metavar="KIND,…",
        help="the outcomes that count as a crash: collision, off_road, agent_error, simulator_error, process_died, "
        "hang; default: all",
    )  # fmt: skip
    how.add_argument("--keep-going", action="store_true", help="collect all crashes instead of stopping at the first")
    how.add_argument(
        "--deterministic", action="store_true",
        help="at a crash, let running trials of lower numbers finish: the same seed gives the same crash",
    )  # fmt: skip
    how.add_argument(
        "--timeout", metavar="S", type=float, default=60.0, help="wall-clock limit of a trial, in s; default: 60"
    )
    how.add_argument("--keep-trials", action="store_true", help="keep the logs of every trial, not of crashes only")
    how.add_argument(
        "--recycle-after", metavar="N", type=_integer, default=1000,
        help="replace a worker after so many trials; 0: never; default: 1000",
    )  # fmt: skip
    how.add_argument("--overwrite", action="store_true", help="begin anew, whatever hunt is in DIR")
    how.add_argument("--fail-on-crash", action="store_true", help="exit with 1 if a crash was found")
    how.add_argument("--json", action="store_true", help="print one JSON object; what is for people goes to stderr")
    run.set_defaults(command=_run)


def _add_replay(commands: Any) -> None:
    replay = commands.add_parser(
        "replay",
        help="run a saved crash again and say whether it is the same",
        description="Run a saved crash again in a fresh process, from its bundle alone, and compare every observation, "
        "action and scene with the log. Exits with 1 if it did not reproduce.",
    )
    replay.add_argument("directory", metavar="DIR", type=Path, help="of the hunt, or of one crash")
    replay.add_argument("--crash", metavar="ID", default="", help="which one; default: the one with the fewest steps")
    replay.add_argument(
        "--from-log", action="store_true", help="drive with the recorded actions, without the agent's code"
    )
    replay.add_argument("--json", action="store_true", help="print one JSON object; what is for people goes to stderr")
    replay.set_defaults(command=_replay)


def _run(options: argparse.Namespace, words: list[str]) -> int:
    # From here to where the hunt takes over there is nothing to keep, and an exception would be lost where somebody
    # else's import swallows it.
    signal.signal(signal.SIGINT, lambda *_: _leave_at_once(as_json=options.json))
    from rich.console import Console

    from crashhunt.hunt import Hunt
    from crashhunt.plan import Request, plan
    from crashhunt.report import Watcher, describe_hunt
    from crashhunt.settings import RunSettings
    from crashhunt.trial import CRASHES

    parallel = options.parallel or len(os.sched_getaffinity(0))
    request = Request(
        trials=options.trials,
        max_steps=options.max_steps,
        scenario=options.scenario,
        ego=options.ego,
        agents=_pairs(options.agent, "--agent", named=False),
        arguments=_pairs(options.arg, "--arg"),
        scenario_arguments=_pairs(options.sets, "--set"),
        sampler=options.sampler,
        points=options.points,
        seed=options.seed,
        crash_on=CRASHES if options.crash_on is None else [name for name in options.crash_on.split(",") if name],
        run=RunSettings(
            parallel=parallel,
            keep_going=options.keep_going,
            deterministic=options.deterministic,
            keep_trials=options.keep_trials,
            timeout_s=options.timeout,
            recycle_after=options.recycle_after,
        ),
    )
    scenario, settings = plan(request)
    console = Console(stderr=options.json, highlight=False)
    for note in scenario.notes:
        console.print(note, markup=False, soft_wrap=True)
    hunt = Hunt(
        options.directory,
        scenario,
        settings,
        command=["crashhunt", *words],
        overwrite=options.overwrite,
        seed_given=options.seed is not None,
    )
    agents = ", ".join(setup.agent for setup in settings.agents.values())
    with Watcher(console, f"crashhunt: {scenario.name}, {agents}") as watcher:
        report = hunt.run(watcher)
    console.print(describe_hunt(report), markup=False, soft_wrap=True)
    if options.json:
        print(json.dumps(report.to_json()))
    if report.stopped_because == "no_valid_trial":
        return 3
    if report.stopped_because == "interrupted":
        return 130
    return 1 if report.crashes and options.fail_on_crash else 0


def _leave_at_once(*, as_json: bool) -> NoReturn:
    error = CrashhuntError("interrupted before the hunt began")
    if as_json:
        os.write(1, json.dumps(error.to_json()).encode() + b"\n")
    os.write(2, f"crashhunt: {error}\n".encode())
    os._exit(130)


def _replay(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.bundle import find_bundle
    from crashhunt.replay import replay
    from crashhunt.report import describe_replay

    report = replay(find_bundle(options.directory, options.crash), from_log=options.from_log)
    print(describe_replay(report), file=sys.stderr if options.json else sys.stdout)
    if options.json:
        print(json.dumps(report.to_json()))
    return 0 if report.verdict == "reproduced" else 1


def _agents(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.listing import list_agents

    return _print_listing("agents", list_agents(), as_json=options.json)


def _scenarios(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.listing import list_scenarios

    return _print_listing("scenarios", list_scenarios(), as_json=options.json)


def _print_listing(name: str, entries: list[dict[str, Any]], *, as_json: bool) -> int:
    from crashhunt.listing import describe

    for entry in entries:
        if "warning" in entry:
            print(f"crashhunt: warning: {entry['warning']}", file=sys.stderr)
    print(json.dumps({name: entries}) if as_json else describe(entries))
    return 0


def _pairs(words: list[str], option: str, *, named: bool = True) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals and not named:
            name, value = "", word
        elif not equals or not name:
            raise UsageError(f"{option} {word!r} has no name", fix=f"write {option} NAME=VALUE")
        if name in pairs:
            raise UsageError(f"{option} {word!r}: {name or 'it'!r} was given already", fix="give it once")
        pairs[name] = value
    return pairs


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
