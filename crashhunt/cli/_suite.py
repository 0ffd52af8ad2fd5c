"""``crashhunt suite`` and ``crashhunt rerun``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from crashhunt.base.errors import UntrustedError
from crashhunt.base.text import command_line
from crashhunt.cli._common import (
    DONE,
    THE_ANSWER_IS_NO,
    add_json,
    add_options_of_machine,
    add_parallel,
    chosen_of_machine,
    chosen_runs,
    integer,
    pairs,
)
from crashhunt.cli._crashes import add_known, checked_cases, compare_with_corpus
from crashhunt.cli._status import show_states, state_words, states_console, states_table
from crashhunt.cli._trust import add_trust, ask_to_trust

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.codec import JsonObject
    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.results import HuntState

T = TypeVar("T")


def add_suite(commands: Commands) -> None:
    """Add the command ``suite`` to the parser."""
    suite = commands.add_parser(
        "suite",
        help="run many hunts from one file",
        description="Run many hunts from one file, each several times with its own seeds.",
    )
    verbs = suite.add_subparsers(title="commands", metavar="COMMAND", required=True)
    run = verbs.add_parser(
        "run",
        help="run the hunts of a suite that have not ended",
        description="Make a folder in DIR for each run of each hunt, and start all runs that have not ended. If a run "
        "fails, the others continue. The same command resumes the suite. Exits with 1 if a hunt could not run.",
    )
    run.add_argument("file", metavar="FILE", type=Path, help="the file that lists the hunts, such as suite.toml")
    run.add_argument("directory", metavar="DIR", type=Path, help="directory of the suite; created if it does not exist")
    run.add_argument("parallel", metavar="PARALLEL", type=integer, nargs="?", default=0,
                     help="number of trials that run at a time, "
                     "counted over all hunts; default: one per core")  # fmt: skip
    add_options_of_machine(run)
    add_known(run)
    add_trust(run)
    add_json(run)
    run.set_defaults(command=_run)
    defaults = verbs.add_parser(
        "defaults",
        help="print a suite file with a hunt for every included scenario",
        description="Print a suite file with a hunt for every included scenario, which you can edit.",
    )
    defaults.set_defaults(command=_defaults)


def add_rerun(commands: Commands) -> None:
    """Add the command ``rerun`` to the parser."""
    rerun = commands.add_parser(
        "rerun",
        help="run failed hunts again, or a hunt with other settings in another directory",
        description="Run failed hunts again: restart hunts that ended in an error, resume interrupted and killed "
        "hunts, and repeat trials with a failed setup. The command keeps replaced files next to the new "
        "files. With --to, run one hunt with other settings in another directory.",
    )
    rerun.add_argument("directory", metavar="DIR", type=Path, help="directory of a hunt or a suite")
    rerun.add_argument("--run", metavar="ID", action="append", default=[],
                       help="in a suite: run again only this run, such as town/0, or all runs of a hunt, such as town; "
                       "the option may be given several times")  # fmt: skip
    which = rerun.add_mutually_exclusive_group()
    which.add_argument("--failed", action="store_true", help="run only failed hunts and trials again (the default)")
    which.add_argument("--all", action="store_true", help="run all hunts again from the start")
    rerun.add_argument("--set", metavar="NAME=SPEC", action="append", default=[], dest="sets",
                       help="with --to or --all: new values for an argument, or a new number for trials, max_steps or "
                       "seed; if there are several agents, write ID.NAME for the argument NAME of the agent "
                       "ID")  # fmt: skip
    rerun.add_argument(
        "--to",
        metavar="NEW",
        type=Path,
        help="keep DIR as it is, and run the hunt in the new directory NEW; if the same command was interrupted or "
        "killed in NEW, it continues",
    )
    add_parallel(rerun, "trials that run at a time, counted over all hunts")
    add_options_of_machine(rerun)
    add_trust(rerun)
    add_json(rerun)
    rerun.set_defaults(command=_rerun)


def _run(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.results import find_hunts, hunt_state
    from crashhunt.suites import Suite, describe_finished

    suite = Suite.read(options.file)
    cases = checked_cases(options)
    if options.directory.is_dir() and (kept := describe_finished(options.directory)):
        options.say(kept)
    watch, finish = states_watcher(as_json=options.json)
    try:
        machine = chosen_of_machine(options)
        states = run_with_trust(
            lambda trusted: suite.run(
                options.directory, options.parallel, watch=watch, machine=machine, trusted=trusted
            ),
            options,
        )
    except KeyboardInterrupt:
        finish()
        _print_states(
            [hunt_state(hunt) for hunt in find_hunts(options.directory)], options.directory, as_json=options.json
        )
        options.say("Interrupted. Run the same command to resume.")
        raise
    finally:
        finish()
    if cases is None:
        return _print_states(states, options.directory, as_json=options.json)
    types, has_news = compare_with_corpus(options, cases)
    code = _print_states(states, options.directory, as_json=options.json, more=types)
    return THE_ANSWER_IS_NO if options.fail_on_new and has_news else code


def _defaults(_options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.suites import default_suite

    print(default_suite(), end="")
    return 0


def _rerun(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.suites import rerun

    hunts = list(chosen_runs(options.directory, options.run))
    watch, finish = states_watcher(as_json=options.json)
    try:
        changes, machine = pairs(options.sets, "--set"), chosen_of_machine(options)
        states, replaced = run_with_trust(
            lambda trusted: rerun(
                hunts, everything=options.all, changes=changes, to=options.to, parallel=options.parallel, watch=watch,
                machine=machine, trusted=trusted,
            ),
            options,
        )  # fmt: skip
    except KeyboardInterrupt:
        resume = command_line("crashhunt", "rerun", options.to or options.directory)
        options.say(f"Interrupted. {resume} resumes the hunts that have begun.")
        raise
    finally:
        finish()
    for place in replaced:
        options.say(f"replaced: {command_line(place)}")
    return _print_states(
        states,
        options.to or options.directory,
        as_json=options.json,
        more={"replaced": [str(place) for place in replaced]},
    )


def run_with_trust(run: Callable[[bool], T], options: CommandOptions) -> T:
    """Run hunts; ask at the terminal for each hunt that is not trusted, before the first hunt runs.

    Raises:
        UntrustedError: a hunt is not trusted, and there is no terminal for a question, or the user declines.
    """
    from crashhunt.suites import trust_hunt

    asked: set[str] = set()
    while True:
        try:
            return run(options.trust)
        except UntrustedError as refusal:
            if refusal.where in asked or not ask_to_trust(refusal, as_json=options.json):
                raise
            asked.add(refusal.where)
            trust_hunt(Path(refusal.where), Path(refusal.where))


def states_watcher(*, as_json: bool) -> tuple[Callable[[list[HuntState]], None], Callable[[], None]]:
    """Return a function that shows the progress as a table or as lines, and a function that ends the display."""
    from rich.live import Live

    console = states_console(stderr=as_json)
    if console.is_terminal:
        live = Live(console=console, auto_refresh=False, transient=True)
        live.start()
        return (lambda states: live.update(states_table(states), refresh=True)), live.stop
    known: dict[str, str] = {}

    def tell(states: list[HuntState]) -> None:
        for state in states:
            if known.get(state.dir, "queued") != state.state:
                console.print(f"{state.dir}: {state_words(state)}", soft_wrap=True)
            known[state.dir] = state.state

    return tell, lambda: None


def _print_states(states: list[HuntState], directory: Path, *, as_json: bool, more: JsonObject | None = None) -> int:
    if as_json:
        print(json.dumps({"hunts": [state.to_json() for state in states], **(more or {})}))
    console = states_console(stderr=as_json)
    show_states(states, console)
    # After Ctrl-C, a hunt has no reason; a hunt that could not resume has one.
    errors = [state for state in states if state.state == "error" or (state.failed and state.detail)]
    if errors:
        some = f"{len(errors)} hunt{'s' if len(errors) > 1 else ''} could not run"
        logs = command_line("crashhunt", "logs", directory, "--errors-only")
        fix = f"see {logs}, then {command_line('crashhunt', 'rerun', directory)}"
        console.print(f"{some}; {fix}", soft_wrap=True)
    return THE_ANSWER_IS_NO if errors else DONE
