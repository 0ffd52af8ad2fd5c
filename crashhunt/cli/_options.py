"""The options of a hunt on the command line, as the list has them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.cli._common import integer, number, pairs
from crashhunt.plans import hunt_options

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from crashhunt.plans import Given, HuntOption

__all__ = ["add_options", "add_options_of_machine", "chosen_of_machine", "chosen_options"]


def add_options(groups: Mapping[str, argparse._ArgumentGroup]) -> None:
    """Add every option that has a flag to its group of the help."""
    for option in hunt_options():
        if option.about.flag:
            _add(groups[option.about.group], option)


def chosen_options(given: argparse.Namespace) -> Given:
    """Return the options that were given, as `crashhunt.prepare` takes them.

    Raises:
        UsageError: a value has no name, or a name comes twice.
    """
    return {option.name: _value(option, getattr(given, option.name)) for option in hunt_options() if option.about.flag}


def add_options_of_machine(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where all the hunts of a command run, whatever each of them says."""
    for option in hunt_options():
        if option.about.anywhere:
            _add(parser, option, help_text=option.help_with("as each hunt says"))
    parser.set_defaults(**{option.name: None for option in hunt_options() if option.about.anywhere})


def chosen_of_machine(given: argparse.Namespace) -> Given:
    """Return those of them that were given."""
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
    elif option.form == "table" or (option.form == "list" and not about.separator):
        words = {"action": "append", "default": [], "type": Path if about.metavar == "PATH" else None}
    group.add_argument(about.flag, metavar=about.metavar, dest=option.name, help=help_text or option.help, **words)


def _value(option: HuntOption, given: Any) -> object:
    about = option.about
    if option.form == "table":
        return pairs(given, about.flag, named=about.named)
    if about.separator and isinstance(given, str):
        return tuple(word for word in given.split(about.separator) if word)
    return (given or option.default) if option.form == "list" else given
