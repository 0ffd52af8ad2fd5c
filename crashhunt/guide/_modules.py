"""The list of all modules with what each is about, made from what it says first of itself."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["describe_modules"]

_ROOT = Path(__file__).parents[1]
_SAID = {
    ".py": re.compile(r'\A"""(.+?)(?:\n\n|""")', re.DOTALL),
    ".cpp": re.compile(r"\A// (.+?)\n"),
    ".hpp": re.compile(r"\A// (.+?)\n"),
    ".html": re.compile(r"\A<!DOCTYPE html>\n<!-- (.+?) -->"),
}
"""What a file says first of itself; read as text, since importing everything would take seconds."""


def describe_modules() -> str:
    """Return every package with its modules, as Markdown."""
    return "\n".join(_lines())


def _lines() -> Iterator[str]:
    yield "## crashhunt\n"
    yield from _members(_ROOT)
    for door in sorted(_ROOT.rglob("*/__init__.py")):
        folder = door.parent
        yield f"\n## {folder.relative_to(_ROOT.parent).as_posix()}\n"
        yield f"{_said(door)}\n"
        yield from _members(folder)


def _members(folder: Path) -> Iterator[str]:
    for file in sorted(folder.iterdir()):
        if file.suffix in _SAID and file.name != "__init__.py":
            yield f"- `{file.name}`: {_said(file)}"


def _said(file: Path) -> str:
    found = _SAID[file.suffix].match(file.read_text(encoding="utf-8"))
    if found is None:
        raise LookupError(f"{file} does not begin with what it is about")
    return " ".join(found[1].replace("``", "`").split())
