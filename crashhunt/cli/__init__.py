"""The command line: parses the arguments, calls the functions, and prints the results."""

from __future__ import annotations

import argparse
import errno
import io
import json
import os
import re
import select
import shutil
import sys
import textwrap
import traceback
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base.errors import DISK, CrashhuntError, InternalError, UsageError, remedy
from crashhunt.base.extras import installation_in
from crashhunt.base.older_versions import refuse_removed_words
from crashhunt.base.resources import error_of_next_thread, is_no_thread, limit_behind
from crashhunt.base.signals import ended_by_signals, is_interrupt
from crashhunt.base.temporary import remove_leftovers
from crashhunt.base.text import one_line
from crashhunt.base.version import __version__
from crashhunt.cli._agent_header import add_agent_header
from crashhunt.cli._bisect import add_bisect
from crashhunt.cli._check import add_check
from crashhunt.cli._common import INTERRUPTED, OUTPUT_CLOSED, Parser, unwritable_output
from crashhunt.cli._compare import add_compare
from crashhunt.cli._completion import add_completion, complete
from crashhunt.cli._corpus import add_corpus
from crashhunt.cli._crashes import add_crashes
from crashhunt.cli._dashboard import add_dashboard
from crashhunt.cli._export import add_export
from crashhunt.cli._gate import add_gate
from crashhunt.cli._guide import add_guide
from crashhunt.cli._init import add_init
from crashhunt.cli._judge import add_judge
from crashhunt.cli._list import add_list, with_list
from crashhunt.cli._logs import add_logs
from crashhunt.cli._note import add_note_command
from crashhunt.cli._rate import add_rate
from crashhunt.cli._replay import add_replay
from crashhunt.cli._report import add_report
from crashhunt.cli._run import add_run
from crashhunt.cli._scorecard import add_scorecard
from crashhunt.cli._show import add_show
from crashhunt.cli._shrink import add_shrink
from crashhunt.cli._signals import add_signals
from crashhunt.cli._split import add_split
from crashhunt.cli._status import add_status
from crashhunt.cli._suite import add_rerun, add_suite
from crashhunt.cli._trials import add_trials
from crashhunt.cli._trust import add_trust_command
from crashhunt.cli._whatif import add_whatif

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

_DESCRIPTION = "Hunt for the crashes of a driving agent, and save each crash so that it can be replayed and fixed."
_EPILOG = """\
examples:
  crashhunt run crash 2 300 1500
      hunt the included scenario `loop`: 2 trials at a time, 300 at most, 1500 steps each
  crashhunt run out 4 1000 1500 --scenario my/town.sumocfg --agent my_pkg.agents:Planner --arg headway_s=0.3:2
      hunt your own agent on your own network
  crashhunt replay crash
      run the crash again in a new process, and check that it is bit-identical
  crashhunt replay crash --code current --expect fixed
      check whether today's code fixes the crash
  crashhunt show crash
      describe the crash in words and numbers

exit codes: 0 done, 1 negative result, 2 wrong usage or input, 3 no valid trial or undecided, 130 interrupted,
  141 the reader of the output has gone
"""


_COMMANDS = {
    "find crashes": (add_run, add_init, add_suite, add_rerun),
    "see what happened": (add_replay, add_show, add_report, add_dashboard, add_export),
    "find out why": (add_judge, add_whatif, add_shrink, add_crashes, add_bisect),
    "keep them fixed": (add_corpus, add_gate, add_split),
    "measure": (add_rate, add_compare, add_scorecard, add_trials),
    "manage hunts": (add_status, add_logs, add_note_command, add_check, add_trust_command),
    "look things up": (add_guide, add_list, add_signals, add_agent_header, add_completion),
}


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    _open_standard_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # not every terminal knows every letter; as on stderr
    try:
        code = _run(words)
        sys.stdout.flush()
    except BrokenPipeError as error:
        code = OUTPUT_CLOSED
        if _is_output_closed():
            _discard_output()
        else:
            code = _report(_explained(error), as_json="--json" in words)
    except KeyboardInterrupt:
        code = _interrupted(words)
    except Exception as error:
        code = _interrupted(words) if is_interrupt(error) else _report(_explained(error), as_json="--json" in words)
    sys.exit(code)


def _interrupted(words: Sequence[str]) -> int:
    """Return the exit code after a Ctrl-C.

    If no thread can be started, report that instead, because OpenBLAS then raises the signal of a Ctrl-C.
    """
    if (error := error_of_next_thread()) is None:
        return INTERRUPTED
    return _report(_explained(error), as_json="--json" in words)


def _open_standard_streams() -> None:
    """Open standard streams that were closed at the start as null devices, for child processes as well.

    Otherwise, the next opened file would get the descriptor of a standard stream, and everything that libraries and
    child processes print.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # in the order of their descriptors
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115 - open until the process ends
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def _run(words: Sequence[str]) -> int:
    try:
        _check_names(words)
        parser = make_parser()
        complete(parser)
        options = parser.parse_args(_spell_out(words))
        _check_folder()
        remove_leftovers()
        with ended_by_signals():
            code: int = options.command(options, words)
    except CrashhuntError as error:
        code = _report(error, as_json="--json" in words)
        _offer_extra(error, words)
        return code
    except SystemExit as leaving:  # of --help and --version
        return leaving.code if isinstance(leaving.code, int) else 0
    return code


def _offer_extra(error: CrashhuntError, words: Sequence[str]) -> None:
    """Offer to install a missing extra and run the command again; only to a user at a terminal, and not in CI."""
    command = installation_in(error.fix)
    is_asked = sys.stdin.isatty() and sys.stderr.isatty() and "--json" not in words and not os.environ.get("CI")
    if not command or not is_asked:
        return
    print("Install it now, and run the command again? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        return
    import subprocess

    if subprocess.run(command, check=False).returncode == 0:
        os.execv(sys.executable, [sys.executable, "-P", "-m", "crashhunt", *words])


def _check_folder() -> None:
    """Refuse a current directory that was removed, because the processes of trials would fail for unclear reasons."""
    try:
        os.getcwd()  # noqa: PTH109
    except OSError as error:
        raise UsageError(
            f"the current directory cannot be used: {error.strerror}", fix="change to an existing directory"
        ) from None


def _report(error: CrashhuntError, *, as_json: bool) -> int:
    if isinstance(error, InternalError) and os.environ.get("CRASHHUNT_TRACEBACK"):
        with suppress(OSError):
            print(error.traceback, file=sys.stderr, flush=True)
    with suppress(OSError):
        print(one_line(f"crashhunt: {error.line}"), file=sys.stderr, flush=True)
        if error.excerpt:
            print(error.excerpt, file=sys.stderr, flush=True)
    if as_json:
        try:
            print(json.dumps(error.to_json()), flush=True)
        except OSError:
            _discard_output()
    return error.exit_code


def _explained(error: Exception) -> CrashhuntError:
    """Return an unexpected error as one line; if CRASHHUNT_TRACEBACK is set, print its traceback first."""
    if os.environ.get("CRASHHUNT_TRACEBACK"):
        traceback.print_exc()
    if isinstance(error, OSError):
        if error.filename is None and error.errno in DISK | {errno.EBADF}:
            explained = unwritable_output(error, 1)
            _discard_output()
            return explained
        if fix := remedy(error):
            return CrashhuntError(str(error.strerror or error), fix=fix, where=str(error.filename or ""))
    if limit := limit_behind(error):
        what = "no thread could be started" if is_no_thread(error) else "the memory does not suffice"
        return CrashhuntError(f"{what}: {type(error).__name__}", fix=limit)
    from crashhunt.base.exceptions import in_words

    frames = traceback.extract_tb(error.__traceback__)
    where = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    fix = "set CRASHHUNT_TRACEBACK=1 to see the traceback; if none of your modules is to blame, please report it"
    return CrashhuntError(f"this should not happen: {in_words(error)}", fix=fix, where=where)


def _is_output_closed() -> bool:
    """Return whether the reader of standard output or standard error has closed the stream."""
    closed = select.poll()
    for descriptor in (1, 2):
        closed.register(descriptor, 0)  # which reports errors and hang-ups alone
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in closed.poll(0))


def _discard_output() -> None:
    """Discard the output that has not been written, so that Python does not fail to write it at exit."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _check_names(words: Sequence[str]) -> None:
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise UsageError(
                f"the argument {word!a} is not valid UTF-8", fix="rename the file, or write the argument in UTF-8"
            ) from None


def _spell_out(words: Sequence[str]) -> list[str]:
    """Return the command line in the form that argparse reads.

    ``--bbox=-122.3,…`` replaces ``--bbox -122.3,…``, whose second word argparse takes for an option. ``list
    agents`` replaces ``agents``.

    Raises:
        UsageError: a word is of an earlier version.
    """
    refuse_removed_words(words)
    if "--bbox" in words[:-1]:
        at = words.index("--bbox")
        if re.match(r"-[\d.]", words[at + 1]):
            words = [*words[:at], f"--bbox={words[at + 1]}", *words[at + 2 :]]
    return with_list(words)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = Parser("crashhunt", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=_ByPurpose)
    parser.add_argument("--version", action="version", version=f"crashhunt {__version__}")
    parser.set_defaults(parser=parser)  # `guide` describes all of it
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, help="crashhunt COMMAND --help describes each"
    )
    for purpose, adders in _COMMANDS.items():
        known = len(commands._choices_actions)
        for add in adders:
            add(commands)
        added = commands._choices_actions[known:]
        parser.add_argument_group(purpose, "\n".join(_listed(one.dest, str(one.help)) for one in added))
    return parser


class _ByPurpose(argparse.RawDescriptionHelpFormatter):
    """Omits argparse's own list of the commands, which is one long block; lists grouped by purpose replace it."""

    def _iter_indented_subactions(self, action: argparse.Action) -> Generator[argparse.Action, None, None]:
        yield from ()


def _listed(name: str, text: str) -> str:
    """Return the lines that list a command in the help, wrapped at the width of argparse."""
    width = shutil.get_terminal_size().columns - 2 - 2  # argparse indents them, and keeps off the edge
    first = f"{name:<12}" if len(name) < 12 else f"{name}\n{'':12}"
    return first + textwrap.fill(text, max(20, width - 12)).replace("\n", f"\n{'':12}")
