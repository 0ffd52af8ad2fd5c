"""What several commands share."""

from __future__ import annotations

import argparse
import sys
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.base.names import did_you_mean, one_of
from crashhunt.base.text import visible

if TYPE_CHECKING:
    from collections.abc import Iterator

    from _typeshed import SupportsWrite

    from crashhunt.crashes import Archive, Bundle

__all__ = [
    "Commands", "Parser", "add_crash", "add_json", "chosen_runs", "integer", "is_trusted", "number", "opened_crash",
    "opened_hunt", "pairs", "refuse_strangers", "say",
]  # fmt: skip


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What a command is added to; argparse has no other name for it."""


class Parser(argparse.ArgumentParser):
    """Reports mistakes as every other error is reported, and says what was probably meant."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown options first: argparse would take the value of one for an argument, and complain of that.

        Raises:
            UsageError: there is no such option.
        """
        known = [option for option in self._option_string_actions if option.startswith("--")]
        for word in takewhile(lambda word: word != "--", args or ()):
            if any(word in (action.choices or ()) for action in self._actions if action.nargs == argparse.PARSER):
                break  # what follows is for the command
            name = word.partition("=")[0]
            if name.startswith("--") and " " not in name and not any(option.startswith(name) for option in known):
                fix = f"{did_you_mean(name, known)} see {self.prog} --help".lstrip()
                raise UsageError(f"there is no option {name!r}", fix=fix)
        return super().parse_known_args(args, namespace)

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
        """Refuse a command line.

        Raises:
            UsageError: always.
        """
        raise UsageError(message, fix=f"see {self.prog} --help")


def add_json(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add ``--json``, the same for every command."""
    parser.add_argument("--json", action="store_true", help="print one JSON object; what is for people goes to stderr")


def add_crash(parser: argparse.ArgumentParser) -> None:
    """Add what chooses a crash."""
    parser.add_argument(
        "directory", metavar="DIR", type=Path, help="of the hunt, of one crash, or a file that crashhunt export wrote"
    )
    parser.add_argument(
        "--crash",
        metavar="ID",
        default="",
        help="its id, or its trial's number; default: the one with the fewest steps",
    )


@contextmanager
def opened_crash(directory: Path, crash: str) -> Iterator[tuple[Bundle, Archive | None]]:
    """Yield the crash that is meant, unpacked for so long where it was exported into a file.

    Raises:
        BundleError: there is no such crash.
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
    """Yield the directory of a hunt, and whether it was exported into a file and is only unpacked for so long.

    Raises:
        HuntDirectoryError: it is not the directory of a hunt.
    """
    if directory.is_file():
        from crashhunt.crashes import open_archive

        with open_archive(directory) as archive:
            yield archive.directory, True
        return
    from crashhunt.plans import read_settings

    hunt = directory.resolve().parent.parent if (directory / layout.CRASH).is_file() else directory
    read_settings(hunt / layout.HUNT)  # refuses what is no hunt
    yield hunt, False


def chosen_runs(directory: Path, runs: list[str]) -> dict[Path, str]:
    """Return the hunts of a directory, with their names in it.

    Args:
        directory: of a hunt or a suite.
        runs: ``ID/N``, or ``ID`` for all runs of it; empty for every hunt.

    Raises:
        HuntDirectoryError: there is none.
        UsageError: there is no such run.
    """
    from crashhunt.hunts import find_hunts

    names = {hunt: hunt.relative_to(directory).as_posix() for hunt in find_hunts(directory)}
    for run in runs:
        if not any(run in (name, name.partition("/")[0]) for name in names.values()):
            raise UsageError(f"--run: there is no run {run!r}", fix=one_of(run, names.values()))
    return {hunt: name for hunt, name in names.items() if not runs or {name, name.partition("/")[0]} & set(runs)}


def say(text: str, *, as_json: bool) -> None:
    """Print what is for people."""
    print(visible(text), file=sys.stderr if as_json else sys.stdout)


def pairs(words: list[str], option: str, *, named: bool = True) -> dict[str, str]:
    """Split repeated ``NAME=VALUE`` options.

    Raises:
        UsageError: one has no name, or a name comes twice.
    """
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals and not named:
            name, value = "", word
        elif not equals or not name:
            raise UsageError(f"{option} {word!r} has no name", fix=f"write {option} NAME=VALUE")
        if name in found:
            raise UsageError(f"{option} {word!r}: {name or 'it'!r} was given already", fix="give it once")
        found[name] = value
    return found


def integer(text: str) -> int:
    """Read a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def number(text: str) -> float:
    """Read a number."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def is_trusted(archive: Archive | None, said: bool) -> bool:
    """Return whether the code of a crash may run: this user made it on this machine, or has ``said`` ``--trust``."""
    return archive is None or archive.made_here or said


def refuse_strangers(archive: Archive, bundle: Bundle, path: Path, *, fix: str) -> UsageError:
    """Return the refusal to run the code of an archive that nobody here has made."""
    from crashhunt.plans import read_settings

    agents = {agent.agent for agent in read_settings(bundle.hunt / layout.HUNT).agents.values()}
    return UsageError(
        f"it says that {archive.made_by} made it on {archive.made_at}, and a replay runs the code in it "
        f"({', '.join(sorted(agents))})",
        fix=fix,
        where=str(path),
    )
