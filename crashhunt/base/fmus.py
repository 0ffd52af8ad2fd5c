"""Locators of agents that are FMUs: ``fmu:FILE.fmu``, and a table of their variables in ``FILE.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from crashhunt.base.errors import PluginError

if TYPE_CHECKING:
    from collections.abc import Mapping

PREFIX: Final = "fmu:"
_FMU_FIX = "give the path of an FMU, such as fmu:./planner.fmu"


def is_fmu(locator: str) -> bool:
    """Return whether the locator of an agent names an FMU."""
    return locator.startswith(PREFIX)


def files_of(locator: str) -> dict[str, Path]:
    """Return the FMU and its table of variables, by the text that names them.

    Raises:
        PluginError: the FMU does not exist.
    """
    word = locator.removeprefix(PREFIX)
    path = Path(word).absolute()
    if not word or not path.is_file():
        raise PluginError(f"{locator!r}: {word!r} is not a file", fix=_FMU_FIX)
    table = path.with_suffix(".toml")
    return {word: path, **({_table_word(word): table} if table.is_file() else {})}


def places_of(locator: str, files: Mapping[str, str]) -> tuple[Path, Path | None]:
    """Return the FMU to run, and its table of variables; None if it has none.

    Args:
        locator: locator of the agent.
        files: file of the snapshot by the text that names the original file; empty if there is no snapshot.

    Raises:
        PluginError: the FMU does not exist.
    """
    word = locator.removeprefix(PREFIX)
    found = files if word in files else {name: str(path) for name, path in files_of(locator).items()}
    table = found.get(_table_word(word))
    return Path(found[word]), None if table is None else Path(table)


def _table_word(word: str) -> str:
    return str(Path(word).with_suffix(".toml"))
