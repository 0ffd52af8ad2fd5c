"""Functions that several commands share, and the exit codes of all commands."""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import sys
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeAlias

from crashhunt.base import layout
from crashhunt.base.agent_locators import is_program
from crashhunt.base.errors import FULL, CrashhuntError, HuntDirectoryError, UsageError
from crashhunt.base.files import cannot_write, refuse_kept
from crashhunt.base.integrity import MAX_INTEGER
from crashhunt.base.older_versions import removed_fix
from crashhunt.base.text import command_line, did_you_mean, one_of, visible
from crashhunt.plans import hunt_options

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from _typeshed import SupportsWrite
    from rich.console import Console

    from crashhunt.base.progress import Watch
    from crashhunt.crashes import Archive, Bundle
    from crashhunt.plans import Given, HuntOption


DONE: Final = 0
THE_ANSWER_IS_NO: Final = 1
BAD_INPUT: Final = 2
NO_VALID_TRIAL: Final = 3
NO_ANSWER: Final = 3
INTERRUPTED: Final = 130
"""As a shell says it after Ctrl-C."""
OUTPUT_CLOSED: Final = 141
"""As a shell says it after SIGPIPE: neither 0 nor 1, because the reader of the output has not seen the answer."""


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What a command is added to; argparse has no other name for it."""


class CommandOptions(argparse.Namespace):
    """The values of a command's arguments, and the ways to print its answer."""

    json: bool  # whether to print one JSON object to stdout, and all other text to stderr

    def say(self, text: str, *, to_stderr: bool = False) -> None:
        """Print a text for the user, to stderr if the answer has another form or ``to_stderr`` is given."""
        print(visible(text), file=sys.stderr if self.json or to_stderr else sys.stdout)

    def print_json(self, data: object) -> None:
        """Print data as one JSON object if the user requested JSON."""
        if self.json:
            print(json.dumps(data))

    def answer(self, text: str, data: object) -> None:
        """Print the answer of a command: the text for the user, and with ``--json`` the data as one JSON object."""
        self.say(text)
        self.print_json(data)


class Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line, with the most similar name."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown options first. Otherwise, argparse would report an error about the option's value.

        Arguments beyond those of a command are refused here, because argparse would name the help of all commands.

        Raises:
            UsageError: an option does not exist, or there are too many arguments.
        """
        known = [option for option in self._option_string_actions if option.startswith("--")]
        before = ""
        for word in takewhile(lambda word: word != "--", args or ()):
            if any(word in (action.choices or ()) for action in self._actions if action.nargs == argparse.PARSER):
                break  # what follows is for the command
            name = word.partition("=")[0]
            if name.startswith("--") and " " not in name and not any(option.startswith(name) for option in known):
                fix = removed_fix(name) or f"{did_you_mean(name, known)} see {self.prog} --help".lstrip()
                raise UsageError(f"there is no option {name!r}", fix=fix)
            if re.match(r"-[A-Za-z_]", word) and word[:2] not in self._option_string_actions and before[:2] != "--":
                fix = f"see {self.prog} --help; if it is a file or folder, write ./{word}"
                raise UsageError(f"there is no option {word!r}", fix=fix)
            before = word
        found, rest = super().parse_known_args(args, CommandOptions() if namespace is None else namespace)
        ends_in_list = next(
            (one for one in reversed(self._actions) if not one.option_strings and one.nargs == "*"), None
        )
        if ends_in_list is not None and ends_in_list.type is None and not any(word.startswith("-") for word in rest):
            # argparse ends a list of arguments at the first option.
            setattr(found, ends_in_list.dest, [*getattr(found, ends_in_list.dest), *rest])
            rest = []
        if rest and " " in self.prog:
            is_option = rest[0].startswith("-")
            what = f"there is no option {rest[0]!r}" if is_option else f"too many arguments: {' '.join(rest)}"
            raise UsageError(what, fix=f"see {self.prog} --help")
        return found, rest

    def _check_value(self, action: argparse.Action, value: object) -> None:
        choices = [str(choice) for choice in action.choices or ()]
        if choices and value not in choices:
            name = "/".join(action.option_strings) or str(action.metavar or action.dest)
            what = f"there is no command {value!r}" if name == "COMMAND" else f"{name} {value!r} is none of its choices"
            raise UsageError(what, fix=one_of(str(value), choices))

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        if message and file is not None:
            file.write(message)  # argparse would hide that the disk is full

    def error(self, message: str) -> NoReturn:
        """Raise an error that refuses the command line.

        Raises:
            UsageError: in every case.
        """
        if found := re.fullmatch(r"argument (\S+): ignored explicit argument (.+)", message):
            raise UsageError(f"{found[1]} takes no value, but {found[2]} is given", fix=f"write {found[1]} alone")
        if found := re.fullmatch(r"argument (\S+): expected one argument", message):
            fix = f"give one, as {found[1]}=VALUE if it begins with a hyphen"
            raise UsageError(f"{found[1]} has no value", fix=fix)
        raise UsageError(message, fix=f"see {self.prog} --help")


class GivenOnce(argparse.Action):
    """An option that cannot be given twice, because a user would expect both values to count."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        """Store the value.

        Raises:
            UsageError: the option has another value already.
        """
        before = getattr(namespace, self.dest)
        if before not in (self.default, values):
            raise UsageError(f"{option} is given twice: {before} and {values}", fix="give it once")
        setattr(namespace, self.dest, values)


def crash_id(text: str) -> str:
    """Return the value of ``--crash``, which is one or several ids of crashes.

    Raises:
        UsageError: an id is empty, for which a command would select a crash itself.
    """
    if not all(one.strip() for one in text.split(",")):
        fix = "give the id of a crash or the number of its trial, or omit the option"
        raise UsageError(f"--crash {text!r} has an empty id", fix=fix)
    return text


class CrashId(GivenOnce):
    """The option for the id of a crash, which must not be empty."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        """Store the value.

        Raises:
            UsageError: the value is empty, or the option has another value already.
        """
        super().__call__(parser, namespace, crash_id(values), option)


class WordsWithCommas(argparse.Action):
    """An option whose value is a list with commas; if it is given several times, all its values count."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        """Store the value, or append it to the earlier value."""
        before = getattr(namespace, self.dest)
        setattr(namespace, self.dest, values if before == self.default else f"{before},{values}")


def add_json(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the option ``--json``, which is the same for every command."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object to stdout; all other text goes to stderr"
    )


def add_crash(parser: argparse.ArgumentParser, *, default: str = "the crash with the fewest steps") -> None:
    """Add the arguments that select a crash."""
    parser.add_argument(
        "directory",
        metavar="DIR",
        type=Path,
        help="directory of a hunt or of one crash, or a file that crashhunt export wrote",
    )
    parser.add_argument(
        "--crash",
        metavar="ID",
        action=CrashId,
        default="",
        help=f"the id of a crash, or the number of its trial; default: {default}",
    )


@contextmanager
def opened_crash(directory: Path, crash: str) -> Iterator[tuple[Bundle, Archive | None]]:
    """Yield the selected crash; an exported crash is unpacked until the end of the context.

    Raises:
        BundleError: the crash does not exist.
    """
    from crashhunt.crashes import find_bundle

    if not directory.is_file():
        yield find_bundle(directory, crash), None
        return
    from crashhunt.crashes import open_archive

    with open_archive(directory) as archive:
        yield find_bundle(archive.directory, crash), archive


@contextmanager
def opened_hunt(directory: Path) -> Iterator[tuple[Path, bool]]:
    """Yield a hunt's directory, and whether it is an exported hunt that is unpacked until the end of the context.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
    """
    if directory.is_file():
        from crashhunt.crashes import open_archive

        with open_archive(directory) as archive:
            yield archive.directory, True
        return
    from crashhunt.plans import read_settings

    hunt = hunt_of_bundle(directory) if (directory / layout.CRASH).is_file() else directory
    read_settings(hunt / layout.HUNT)  # refuses what is no hunt
    yield hunt, False


def hunt_of_bundle(bundle: Path) -> Path:
    """Return the directory of the hunt that contains a bundle.

    Raises:
        HuntDirectoryError: the bundle is not inside a hunt.
    """
    from crashhunt.results import is_hunt

    hunt = bundle.resolve().parent.parent
    if not is_hunt(hunt):
        raise HuntDirectoryError(
            f"{str(bundle)!r} is a crash outside the directory of its hunt",
            fix="give the directory of the hunt, or a file that crashhunt export wrote",
        )
    return hunt


def chosen_runs(directory: Path, runs: list[str]) -> dict[Path, str]:
    """Return the hunts in a directory, by their names in it.

    Args:
        directory: directory of a hunt or a suite.
        runs: the runs to choose, each as ``ID/N``, or as ``ID`` for all runs of this hunt; empty for all hunts.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
        UsageError: the run does not exist.
    """
    from crashhunt.results import find_searches

    names = {hunt: hunt.relative_to(directory).as_posix() for hunt in find_searches(directory)}
    for run in runs:
        if not any(run in (name, name.partition("/")[0]) for name in names.values()):
            is_hunt = list(names.values()) == ["."]
            fix = f"omit --run, because {directory} is a single hunt" if is_hunt else one_of(run, names.values())
            raise UsageError(f"--run: there is no run {run!r}", fix=fix)
    return {hunt: name for hunt, name in names.items() if not runs or {name, name.partition("/")[0]} & set(runs)}


def pairs(words: list[str], option: str, *, named: bool = True) -> dict[str, str]:
    """Split repeated ``NAME=VALUE`` options.

    Raises:
        UsageError: an option has no name, or a name occurs twice.
    """
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not named and (not equals or is_program(word)):
            name, value = "", word
        elif not equals or not name:
            raise UsageError(f"{option} {word!r} has no name", fix=f"write {option} NAME=VALUE")
        if name in found:
            raise UsageError(
                f"{option} {word!r}: {repr(name) if name else 'an agent without ID='} is given twice",
                fix="give it once",
            )
        found[name] = value
    return found


def integer(text: str) -> int:
    """Convert a text to a whole number."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if abs(value) > MAX_INTEGER:
        raise argparse.ArgumentTypeError(f"{text!r} is out of range (allowed: up to {MAX_INTEGER})")
    return value


def number(text: str) -> float:
    """Convert a text to a number."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def add_parallel(parser: argparse._ActionsContainer, what: str = "trials that run at a time") -> None:
    """Add the option ``--parallel``."""
    parser.add_argument(
        "--parallel", metavar="N", type=integer, default=0, help=f"number of {what}; default: one per core"
    )


def refuse_below(options: argparse.Namespace, **least: int) -> None:
    """Refuse whole numbers below their least value, such as ``runs=1`` for an option ``--runs``.

    Raises:
        UsageError: a value is too small.
    """
    for name, minimum in least.items():
        value = getattr(options, name)
        if value is not None and value < minimum:
            also = " (0: one per core)" if name == "parallel" else ""
            raise UsageError(f"--{name.replace('_', '-')} is {value}", fix=f"give at least {minimum}{also}")


def duration_s(text: str, option: str) -> float:
    """Return a time such as ``1h30m`` in s; infinite for an empty text.

    Raises:
        UsageError: the value of the option is not a time.
    """
    from crashhunt.plans import check_duration, seconds_of

    if fix := check_duration(text):
        raise UsageError(f"{option} is {text!r}", fix=fix)
    return seconds_of(text)


_BUILD_TIMEOUT = "1h"


def add_build(parser: argparse._ActionsContainer, what: str) -> None:
    """Add the options ``--build`` and ``--build-timeout``, for commands that check out commits."""
    parser.add_argument(
        "--build", metavar="COMMAND", default="",
        help=f"run this shell command in the work tree of {what} before its trials, such as 'make'; it runs in the "
        "folder that corresponds to the current folder",
    )  # fmt: skip
    parser.add_argument(
        "--build-timeout", metavar="TIME", default=_BUILD_TIMEOUT,
        help=f"the longest time of a build, such as 10m; default: {_BUILD_TIMEOUT}",
    )  # fmt: skip


def build_limit_s(options: argparse.Namespace) -> float:
    """Return the value of ``--build-timeout``, in s.

    Raises:
        UsageError: the value is not a time.
    """
    if not options.build_timeout:
        raise UsageError("--build-timeout is ''", fix="give a time, such as 10m")
    return duration_s(options.build_timeout, "--build-timeout")


# The bar of `film`, `export` and whatever takes its time; what a hunt shows while it runs is in `report`.


def make_console(*, stderr: bool = False, width: int | None = None) -> Console:
    """Return a console that prints text as it is, and that raises `BrokenPipeError` if its reader has gone.

    Rich would end this process with exit code 1, which is an answer of several commands.
    """
    from rich.console import Console

    class Raising(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    return Raising(stderr=stderr, highlight=False, markup=False, emoji=False, width=width)


def unwritable_output(error: OSError, descriptor: int) -> CrashhuntError:
    """Return the error for output that cannot be written, which names the stream and its file."""
    stream = {1: "standard output", 2: "standard error"}[descriptor]
    try:  # Linux knows the file; Python has only the name "<stdout>"
        file = command_line(Path(f"/proc/self/fd/{descriptor}").readlink())
    except OSError:
        file = "closed"
    fix = f"{'free some space or ' if error.errno in FULL else ''}redirect {stream} to another file"
    return CrashhuntError(
        f"{stream} ({file}) cannot be written: {error.strerror or error}", fix=f"{fix}, and run the same command again"
    )


@contextmanager
def shown_progress(what: str, *, as_json: bool) -> Iterator[Watch | None]:
    """Yield a function that shows progress in one line; the line is removed at the end, also after Ctrl-C.

    With ``as_json``, no progress is shown.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = make_console(stderr=True)
    if as_json or not console.is_terminal:
        yield None
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as line:
        task = line.add_task(what, total=None)
        yield lambda done, total: line.update(task, completed=done, total=total)


# What commands tell a CI besides what they print: a summary in a file, annotations of GitHub's.


def add_ci_options(parser: argparse.ArgumentParser) -> None:
    """Add the options ``--summary`` and ``--annotate``."""
    parser.add_argument(
        "--summary", metavar="FILE", type=Path,
        help="add a summary in Markdown to the end of FILE, such as $GITHUB_STEP_SUMMARY",
    )  # fmt: skip
    parser.add_argument(
        "--annotate",
        action="store_true",
        help="also print up to ten annotations, which GitHub shows next to the code",
    )


def tell(options: CommandOptions, summary: str, annotations: Sequence[str]) -> None:
    """Write the summary and print the annotations, if the user requested them.

    Raises:
        HuntDirectoryError: the summary file cannot be written.
    """
    if options.summary is not None:
        refuse_kept(options.summary)
        try:
            with options.summary.open("a", encoding="utf-8") as file:
                file.write(f"{summary}\n")
        except OSError as error:
            raise cannot_write(options.summary, error) from error
    if options.annotate:
        for line in annotations:
            options.say(line)


# The options of a hunt on the command line, as the list has them.


def add_options(groups: Mapping[str, argparse._ArgumentGroup], names: Collection[str] = ()) -> None:
    """Add each option of the command line to its group in the help.

    Without ``names``, all options are added.
    """
    for option in _options(names):
        _add(groups[option.about.group], option)


def chosen_options(given: argparse.Namespace, names: Collection[str] = ()) -> Given:
    """Return the options that the user gave, in the form for `crashhunt.prepare`.

    Raises:
        UsageError: a value has no name, or a name occurs twice.
    """
    return {option.name: _value(option, getattr(given, option.name)) for option in _options(names)}


def _options(names: Collection[str]) -> list[HuntOption]:
    return [option for option in hunt_options() if option.about.flag and (not names or option.name in names)]


def add_options_of_machine(parser: argparse.ArgumentParser) -> None:
    """Add the options for all hunts of a command, such as ``--executor``, which override the options of each hunt."""
    for option in hunt_options():
        if option.about.anywhere:
            _add(parser, option, help_text=option.help_with("as in each hunt"))
    parser.set_defaults(**{option.name: None for option in hunt_options() if option.about.anywhere})


def chosen_of_machine(given: argparse.Namespace) -> Given:
    """Return those options of `add_options_of_machine` that the user gave."""
    found = {option.name: getattr(given, option.name) for option in hunt_options() if option.about.anywhere}
    return {name: value for name, value in found.items() if value is not None}


def _add(group: argparse._ActionsContainer, option: HuntOption, help_text: str = "") -> None:
    about = option.about
    if option.form == "flag":
        action = "store_false" if option.default else "store_true"
        group.add_argument(about.flag, action=action, dest=option.name, help=help_text or option.help)
        return
    words: dict[str, Any] = {"default": option.default}
    if option.form in ("integer", "number"):
        words["type"] = integer if option.form == "integer" else number
    elif option.form == "list" and about.separator:
        words["action"] = WordsWithCommas
    elif option.form in ("table", "list"):
        words = {"action": "append", "default": [], "type": Path if about.metavar == "PATH" else None}
    group.add_argument(about.flag, metavar=about.metavar, dest=option.name, help=help_text or option.help, **words)


def _value(option: HuntOption, given: Any) -> object:
    about = option.about
    if option.form == "table":
        return pairs(given, about.flag, named=about.named)
    if about.separator and isinstance(given, str):
        return tuple(filter(None, map(str.strip, given.split(about.separator))))
    return (given or option.default) if option.form == "list" else given
