"""The reference of the command line, made from its parser: so it cannot be out of date."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["describe_commands"]


def describe_commands(parser: argparse.ArgumentParser) -> str:
    """Return every command with its arguments and options, as Markdown.

    Args:
        parser: of the command line.
    """
    return "\n".join(line for command, _ in _commands(parser) for line in _command(command))


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[argparse.ArgumentParser, str]]:
    """The commands that do something, and the commands of these."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                if any(isinstance(below, argparse._SubParsersAction) for below in inner._actions):
                    yield from _commands(inner)
                else:
                    yield inner, name


def _command(command: argparse.ArgumentParser) -> Iterator[str]:
    places = " ".join(_place(action) for action in command._actions if not action.option_strings)
    yield f"## {command.prog}\n"
    yield f"`{command.prog}{' ' if places else ''}{places}`\n"
    yield f"{_plain(command.description)}\n"
    for group in command._action_groups:
        actions = [action for action in group._group_actions if action.dest != "help"]
        if not actions:
            continue
        if group.title not in ("positional arguments", "options"):
            yield f"*{_plain(group.title)}*" + (f": {_plain(group.description)}" if group.description else "") + "\n"
        yield from (f"- `{_written(action)}`: {_plain(_expanded(command, action))}" for action in actions)
        yield ""
    if command.epilog:
        yield f"```text\n{command.epilog.strip()}\n```\n"


def _place(action: argparse.Action) -> str:
    name = str(action.metavar or action.dest)
    return {"?": f"[{name}]", "+": f"{name} [{name} ...]", "*": f"[{name} ...]"}.get(str(action.nargs), name)


def _written(action: argparse.Action) -> str:
    if not action.option_strings:
        return str(action.metavar or action.dest)
    value = ""
    if action.nargs != 0:
        choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
        value = f" {action.metavar or choices}"
    return ", ".join(f"{option}{value}" for option in action.option_strings)


def _expanded(command: argparse.ArgumentParser, action: argparse.Action) -> str:
    return (action.help or "") % {**vars(action), "prog": command.prog}


def _plain(text: str | None) -> str:
    """Text in which nothing is Markdown by accident, such as the name of a placeholder between angle brackets."""
    said = " ".join((text or "").split())
    return "".join(f"\\{letter}" if letter in "*<[`" else letter for letter in said)
