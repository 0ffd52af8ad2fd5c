"""``crashhunt status``."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.text import count_of, one_line, out_of
from crashhunt.cli._common import BAD_INPUT, DONE, CommandOptions, Commands, add_json, make_console

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.console import Console, ConsoleOptions, Group
    from rich.table import Table

    from crashhunt.results import BranchSums, HuntState, ProbeSums

_COLUMNS_WITHOUT_TERMINAL = 120
_NUMBERS = ("trials", "pace", "left", "crashes", "errors")  # columns
_OMITTED_FIRST = ("pace", "errors", "left", "outcomes", "crashes", "trials")  # columns, in a narrow terminal
_MIN_NAME_COLUMNS = 12  # of the name of a hunt, which is folded
_WIDEST = 10_000
_MAX_NOTES = 3  # of a hunt, the latest ones
_MAX_LISTED_NODES = 20  # of a hunt, one a line
_STATE_COLORS = {"crashed": "red", "error": "red", "killed": "red", "running": "green", "interrupted": "yellow"}


def add_status(commands: Commands) -> None:
    """Add the command ``status`` to the parser."""
    status = commands.add_parser(
        "status",
        help="show the progress of hunts",
        description="Show the progress and results of hunts: running, finished, interrupted or killed ones.",
    )
    status.add_argument("directories", metavar="DIR", type=Path, nargs="+", help="directory of a hunt or a suite")
    status.add_argument(
        "--watch", action="store_true", help="refresh the output every second until all hunts have ended"
    )
    add_json(status)
    status.set_defaults(command=_status)


def _status(options: CommandOptions, _words: list[str]) -> int:
    from rich.live import Live

    if options.json:
        states = _states(options.directories)
        print(json.dumps({"hunts": [state.to_json() for state in states]}))
        return _exit_code(states)
    console = states_console()
    states = _states(options.directories)
    if not options.watch:
        show_states(states, console)
        return _exit_code(states)
    with Live(states_table(states), console=console, auto_refresh=False) as live:
        while any(state.state in ("running", "queued") for state in states):
            time.sleep(1.0)
            states = _states(options.directories)
            live.update(states_table(states), refresh=True)
    return 0


def _states(directories: list[Path]) -> list[HuntState]:
    from crashhunt.results import find_searches, hunt_state

    return [hunt_state(hunt) for directory in directories for hunt in find_searches(directory)]


def states_console(*, stderr: bool = False) -> Console:
    """Return the console for the table of states; it has 120 columns if it is not a terminal."""
    console = make_console(stderr=stderr)
    return console if console.is_terminal else make_console(stderr=stderr, width=_COLUMNS_WITHOUT_TERMINAL)


def states_table(states: list[HuntState]) -> Group:
    """Return hunts as a table for a terminal, followed by the other facts of each hunt, one line each."""
    from rich.console import Group
    from rich.text import Text

    lines = [Text(one_line(f"{state.dir}: {line}"), overflow="fold") for state in states for line in _facts(state)]
    return Group(_FittingTable(states), *lines)


class _FittingTable:
    """A table of hunts that omits columns for which the terminal is too narrow, because a cut number is a wrong one."""

    def __init__(self, states: Sequence[HuntState]) -> None:
        self._states = states

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        from rich.measure import Measurement

        table, wide = _table(self._states), options.update(max_width=_WIDEST)
        for count in range(1, len(_OMITTED_FIRST) + 1):
            folded = max(0, _longest_name(self._states) - _MIN_NAME_COLUMNS)
            if Measurement.get(console, wide, table).minimum - folded <= options.max_width + 1:  # its edge is blank
                break
            table = _table(self._states, _OMITTED_FIRST[:count])
        yield table


def _longest_name(states: Sequence[HuntState]) -> int:
    return max((len(one_line(state.dir)) for state in states), default=0)


def _table(states: Sequence[HuntState], omitted: Sequence[str] = ()) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from crashhunt.report import format_pace, format_seconds

    rows = [
        {
            "trials": out_of(state.trials_run, state.trials_planned, "/"),
            "pace": format_pace(state.rate_per_s) if state.rate_per_s else "-",
            "left": format_seconds(state.seconds_left) if state.seconds_left is not None else "-",
            "crashes": str(state.crashes),
            "errors": str(state.errors),
            "outcomes": ", ".join(f"{name} {count}" for name, count in state.outcomes.items()),
        }
        for state in states
    ]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("hunt", overflow="fold", min_width=min(_longest_name(states), _MIN_NAME_COLUMNS))
    table.add_column(
        "state", min_width=max((len(word) for state in states for word in _state(state).split()), default=0)
    )
    for name in _NUMBERS:
        if name not in omitted:
            width = max(len(row[name]) for row in rows) if rows else 0
            table.add_column(name, justify="right", no_wrap=True, min_width=max(width, len(name)))
    if "outcomes" not in omitted:
        table.add_column("outcomes", overflow="fold", min_width=13)
    for state, row in zip(states, rows, strict=True):
        table.add_row(
            Text(one_line(state.dir)),
            Text(_state(state), style=_STATE_COLORS.get(state.state, ""), no_wrap=state.phase is None),
            *(Text(cell) for name, cell in row.items() if name not in omitted),
        )
        for node in (state.nodes or [])[:_MAX_LISTED_NODES]:
            name = one_line(f"  {node['name']} ({node['parallel']} at a time)")
            pace = [] if "pace" in omitted else [format_pace(node["rate_per_s"])]
            table.add_row(Text(name), "", str(node["trials"]), *pace)
        if len(state.nodes or []) > _MAX_LISTED_NODES:
            table.add_row(f"  and {len(state.nodes or []) - _MAX_LISTED_NODES} more")
    return table


def _facts(state: HuntState) -> list[str]:
    """Return the facts of a hunt that are not in a column, one line each."""
    from crashhunt.report import describe_note, describe_running, describe_versions

    crashes = _crashes(state)
    lines = [f"{count_of(state.crashes, 'crash')}: {crashes}"] if crashes else []
    lines += [describe_running(state.rate) + _not_counted(state)] if state.rate is not None else []
    lines += [describe_versions(state.code_versions)] if state.code_versions else []
    lines += fork_lines(state)
    lines += [one_line(notice) for notice in state.notices or ()]
    notes = state.notes or []
    lines += [describe_note(note, whole=False) for note in notes[-_MAX_NOTES:]]
    lines += [f"and {len(notes) - _MAX_NOTES} earlier notes: see crashhunt note"] * (len(notes) > _MAX_NOTES)
    return [*lines, *([f"compiled core {state.core}"] if state.core is not None else [])]


def _not_counted(state: HuntState) -> str:
    """Return why the rate is of fewer trials than have finished; empty if it is of all valid trials.

    The trials of a rate are the first ones without a gap: which trials finish early depends on how long they take, and
    so on whether they crash.
    """
    rate = state.rate
    if rate is None or rate["method"] == "rare" or rate["per"] != "trial" or rate["bar"] is not None:
        return ""
    if rate["certain"] is None or rate["origin"] or rate.get("trained_on") or state.code_versions:
        return ""  # trials are excluded for other reasons
    count = state.trials_run - state.outcomes.get("invalid", 0) - rate["trials"]
    if count <= 0:
        return ""
    are = "is" if count == 1 else "are"
    return f"; {count_of(count, 'trial')} after a trial that has not ended {are} excluded"


def _state(state: HuntState) -> str:
    """Return the state or, after the last trial of a running hunt, its phase."""
    from crashhunt.report import describe_phase

    if state.phase is None:
        return "finished" if state.state == "crashed" else state.state  # a column has the number of crashes
    return describe_phase(state.phase["name"], state.phase["done"], state.phase["total"], None)


def state_words(state: HuntState) -> str:
    """Return the state of a hunt as text; a hunt that has ended with crashes is finished, with their number."""
    return f"finished, {count_of(state.crashes, 'crash')}" if state.state == "crashed" else state.state


def fork_lines(state: HuntState) -> list[str]:
    """Return the present results of the forks of a hunt's trials, one line each; empty if it has no forks."""
    lines = []
    if (probes := state.probes) is not None:
        least = "no robustness margin yet"
        if probes["least"] is not None:
            least = f"least robustness margin {probes['least']:.2f} (trial {probes['trial']})"
        crashed = f"{probes['crashed_trials']} of {probes['trials'] + probes['not_fully_asked']} trials"
        said = f"{least}; probes {probes['probes']}, made to crash {crashed}{_confirmed(probes)}"
        lines.append(said + _not_fully_asked(probes))
    if (branches := state.branches) is not None:
        asked = f"branches {branches['branches']} (moments {branches['moments']})"
        crashed = f"crashed {branches['crashed']} (in {branches['crashed_trials']} of {branches['trials']} trials)"
        lines.append(f"{asked}, {crashed}{_confirmed(branches)}{_not_fully_asked(branches)}")
    return lines


def _not_fully_asked(sums: ProbeSums | BranchSums) -> str:
    count = sums["not_fully_asked"]
    return f", not fully asked {count_of(count, 'trial')}" if count else ""


def _confirmed(sums: ProbeSums | BranchSums) -> str:
    return f", confirmed {sums['confirmed']} of {sums['run_again']}" if sums["run_again"] else ""


def _crashes(state: HuntState) -> str:
    """Return the numbers of saved and disturbed crashes, the number of types, and the age of the last new type."""
    from crashhunt.report import describe_types, format_seconds

    said = [] if state.crashes_saved is None else [f"{state.crashes_saved} saved"]
    said += [] if state.disturbed is None else [f"{state.disturbed} disturbed"]
    if state.kinds:
        said.append(describe_types(len(state.kinds), state.types_by_cause))
        if state.state == "running" and state.newest_kind_s is not None:
            said.append(f"last new {format_seconds(state.newest_kind_s)} ago")
    return ", ".join(said)


def show_states(states: list[HuntState], console: Console) -> None:
    """Print hunts as a table, followed by the errors of failed hunts."""
    console.print(states_table(states))
    for state in states:
        if state.detail:
            why = one_line(state.detail.splitlines()[0])
            console.print(f"{one_line(state.dir)}: {why}", soft_wrap=True)


def _exit_code(states: list[HuntState]) -> int:
    return BAD_INPUT if any(state.damaged for state in states) else DONE
