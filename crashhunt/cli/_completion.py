"""Shell completion: ``crashhunt completion SHELL``, and the possible completions."""

from __future__ import annotations

import argparse
import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from crashhunt.base.plugins import Group
    from crashhunt.cli._common import CommandOptions, Commands

    Completer = Callable[..., Iterable[str]]

_OPTUNA = ("tpe", "cma-es", "gp", "nsgaii", "nsgaiii", "qmc", "random")  # to ask it itself takes most of a second
_INSTRUCTIONS = """\
put one of these lines where your shell starts:
  ~/.bashrc                      eval "$(crashhunt completion bash)"
  ~/.zshrc, after compinit       eval "$(crashhunt completion zsh)"
  ~/.config/fish/config.fish     crashhunt completion fish | source
"""


def add_completion(commands: Commands) -> None:
    """Add the command ``completion`` to the parser."""
    completion = commands.add_parser(
        "completion",
        help="print a shell script that adds tab completion",
        description="Print a script for a shell. With the script, the tab key completes commands,\n"
        "options, scenarios, agents, samplers, arguments, outcomes, directories and\ncrashes.",
        epilog=_INSTRUCTIONS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    completion.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="bash, zsh or fish")
    completion.set_defaults(command=_completion)


def _completion(options: CommandOptions, _words: list[str]) -> int:
    from argcomplete.shell_integration import shellcode

    print(shellcode(["crashhunt"], shell=options.shell))
    return 0


def complete(parser: argparse.ArgumentParser) -> None:
    """If a shell has called for completions, print them and end the process; otherwise do nothing."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    from argcomplete import autocomplete
    from argcomplete.completers import SuppressCompleter

    _attach(parser)
    autocomplete(parser, always_complete_options=False, default_completer=SuppressCompleter())


def _attach(parser: argparse.ArgumentParser) -> None:
    known: dict[str, Completer] = {
        "--scenario": lambda prefix, **_: [*_scenarios(), *_paths(*_file_suffixes())(prefix)],
        "--agent": lambda **_: _registered("agents"),
        "--sampler": lambda **_: [*_registered("samplers"), *(f"optuna:{name}" for name in _OPTUNA)],
        "--executor": lambda **_: _registered("executors"),
        "--disturb": _several(lambda **_: [f"{name}=" for name in _registered("disturbances")]),
        "--crash-on": _several(lambda **_: _outcomes(crashes=True)),
        "--outcome": _several(lambda **_: _outcomes(crashes=False)),
        "--print": _several(lambda **_: _BREAKPOINT_FIELDS),
        "--crash": _several(_crashes),
        "--run": _runs,
        "--arg": lambda parsed_args, **_: [f"{name}=" for name in _arguments(parsed_args, of_agents=True)],
        "--set": lambda parsed_args, **_: [f"{name}=" for name in _arguments(parsed_args, of_agents=False)],
        "DIR": _paths(".zip"),
        "TOPIC": lambda **_: _topics(),
    }
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                _attach(inner)
            continue
        name = action.option_strings[0] if action.option_strings else str(action.metavar)
        completer = known.get(name) or (_paths("") if action.type is Path else None)
        if completer is not None:
            action.completer = completer  # type: ignore[attr-defined]


_BREAKPOINT_FIELDS = (
    "x",
    "y",
    "heading",
    "speed",
    "reward",
    "time_to_collision_s",
    "gap_m",
    "required_deceleration",
    "action",
)


def _scenarios() -> list[str]:
    from crashhunt.scenario import shipped_scenarios

    return list(shipped_scenarios())


def _topics() -> list[str]:
    from crashhunt.guide import list_pages

    return [page.topic for page in list_pages()]


def _file_suffixes() -> tuple[str, ...]:
    from crashhunt.scenario import endings

    return endings()


def _registered(group: Group) -> list[str]:
    from crashhunt.base.plugins import registered

    return list(registered(group))


def _outcomes(*, crashes: bool) -> list[str]:
    from crashhunt.trial import CRASHES, EVENTS, Outcome

    return [str(outcome) for outcome in ((*CRASHES, *EVENTS) if crashes else Outcome)]


def _crashes(parsed_args: CommandOptions, **_: object) -> list[str]:
    folder = vars(parsed_args).get("directory")
    if not folder:
        return []
    places = (layout.CRASHES, *layout.BESIDE)
    return sorted(path.parent.name for place in places for path in Path(folder).glob(f"{place}/*/{layout.CRASH}"))


def _runs(parsed_args: CommandOptions, **_: object) -> list[str]:
    folder = vars(parsed_args).get("directory")
    if not folder:
        return []
    return sorted(path.parent.relative_to(folder).as_posix() for path in Path(folder).glob(f"*/*/{layout.HUNT}"))


def _arguments(parsed_args: CommandOptions, *, of_agents: bool) -> list[str]:
    """Return the arguments of the scenario, read only from its file, because a shell does not wait for long."""
    from crashhunt.scenario import configurations, shipped_folder

    name = vars(parsed_args).get("scenario") or "loop"
    for file in (shipped_folder() / name / layout.SCENARIO, Path(name) / layout.SCENARIO, Path(name)):
        try:
            said = tomllib.loads(file.read_text(encoding="utf-8"))
            tables = [agent.get("arguments", {}) for agent in said.get("agents", {}).values()]
            return list(dict.fromkeys(key for table in tables for key in table)) if of_agents else [*said["arguments"]]
        except (OSError, ValueError, KeyError, AttributeError, TypeError):
            continue
    found = (known.arguments for known in configurations() if name.endswith(known.endings))
    return [] if of_agents else list(next(found, ()))


def _several(one: Completer) -> Completer:
    """Complete the last of several values that are separated by commas."""

    def last(prefix: str, **given: object) -> list[str]:
        before = prefix.rpartition(",")[0]
        taken = before.split(",")
        return [f"{before},{name}" if before else name for name in one(prefix=prefix, **given) if name not in taken]

    return last


def _paths(*endings: str) -> Completer:
    """Complete folders, and files with one of the given endings."""

    def inside(prefix: str, **_: object) -> list[str]:
        folder, _slash, start = prefix.rpartition("/")
        place = Path(folder or ("/" if prefix.startswith("/") else "."))
        try:
            found = sorted(path for path in place.expanduser().iterdir() if path.name.startswith(start))
        except (OSError, RuntimeError):  # the latter of a user without a home, as in ~NAME/
            return []
        hidden = start.startswith(".")
        names = [(path.name, path.is_dir()) for path in found if hidden or not path.name.startswith(".")]
        before = prefix[: len(prefix) - len(start)]
        return [f"{before}{name}{'/' * is_dir}" for name, is_dir in names if is_dir or name.endswith(endings)]

    return inside
