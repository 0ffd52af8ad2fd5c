"""Files of the user that a trial needs and that its snapshot lacks: which they are, why, and what to do.

A snapshot has the code of a project, and files that arguments name. What git ignores is not a part of the project, such
as a planner that a build makes. What lies elsewhere is unknown before a trial opens it.
"""

from __future__ import annotations

import os
import re
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.exceptions import is_users, shown_path
from crashhunt.base.git import query
from crashhunt.base.text import command_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from crashhunt.snapshots._snapshot import Snapshot

_SYSTEM = tuple(
    f"{place}/"
    for place in ("/bin", "/boot", "/etc", "/lib", "/lib32", "/lib64", "/nix", "/proc", "/run", "/sbin",
                  "/snap", "/sys", "/usr", "/var", *{sys.prefix, sys.base_prefix, sys.exec_prefix})
)  # fmt: skip
# What libraries keep for a user: settings, fonts and caches, on which results do not depend.
_OF_LIBRARIES = re.compile(
    r"/(\.git|__pycache__|\.config|\.fonts|\.nv|\.local/share|\.cache/(matplotlib|fontconfig|mesa_\w+|crashhunt|pip))/"
)
_ENDS_OF_PATHS = re.compile(r"['\":,;)\s]|$")
_MAX_FILES = 3  # named one by one


def describe_unsaved(paths: Iterable[str], snapshot: Snapshot, *, since: float) -> list[str]:
    """Return a sentence for each file of the user that was opened, loaded or started, and that the snapshot lacks.

    Files that were written after ``since`` are results, and not inputs.
    """
    found: dict[str, str] = {}
    kept = f"{snapshot.path.resolve()}{os.sep}"
    modules = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    for path in dict.fromkeys(map(os.path.realpath, paths)):
        if path.endswith(".pyc"):
            continue
        if path.startswith(kept):
            if not os.path.lexists(path) and (original := _original(path, snapshot)) is not None:
                found[path] = _missing(original)
        elif path not in modules and _is_input(path, since) and not _is_copied(path, snapshot):
            found[path] = _outside(Path(path), snapshot)
    said = list(found.values())
    more = [f"the snapshot lacks {len(said) - _MAX_FILES} more such files"] if len(said) > _MAX_FILES else []
    return said[:_MAX_FILES] + more


def describe_missing(text: str, snapshot: Snapshot) -> str:
    """Return why the snapshot lacks a file that an error message names, and the fix; empty if it lacks none."""
    for path in _paths_in(text, snapshot):
        if not path.exists() and (original := _original(str(path), snapshot)) is not None:
            return _missing(original)
    return ""


def with_original_paths(text: str, snapshot: Snapshot) -> str:
    """Return a text with the paths of the user's files instead of those of their copies in the snapshot."""
    origins = _origins(snapshot)
    for place, original in sorted(origins, key=lambda origin: -len(origin[0])):
        is_unique = sum(other == place for other, _ in origins) == 1  # the folders of several modules may have one copy
        shown, copy = shown_path(original) if is_unique else ".", snapshot.path.resolve()
        for folder in (str(copy), str(snapshot.path), shown_path(str(copy))):  # a relative one is a part of the first
            text = text.replace(f"{folder}/{place}/", "" if shown == "." else f"{shown}/")
    return text


def _origins(snapshot: Snapshot) -> list[tuple[str, str]]:
    return [(str(place), str(original)) for place, original in snapshot.environment.get("origins", ())]


def _paths_in(text: str, snapshot: Snapshot) -> Iterator[Path]:
    """Yield what may be a path in the snapshot, the longest first: a name may contain spaces and colons."""
    for folder in {f"{snapshot.path}/", f"{snapshot.path.resolve()}/"}:
        for found in re.finditer(re.escape(folder), text):
            line = text[found.start() :].partition("\n")[0]
            ends = [end.start() for end in _ENDS_OF_PATHS.finditer(line, len(folder))]
            yield from (Path(line[:end]) for end in reversed(ends))


def _original(path: str, snapshot: Snapshot) -> Path | None:
    """Return the user's file of which a place in the snapshot would be the copy; None if there is none."""
    whole, top = Path(path).resolve(), snapshot.path.resolve()
    if not whole.is_relative_to(top):
        return None
    place = whole.relative_to(top)
    for folder, original in sorted(_origins(snapshot), key=lambda origin: -len(origin[0])):
        if place.is_relative_to(folder) and (found := Path(original, place.relative_to(folder))).is_file():
            return found
    return None


def _is_copied(path: str, snapshot: Snapshot) -> bool:
    if path in {*snapshot.argument_files, *map(os.path.realpath, snapshot.argument_files)}:
        return True
    places = (f"{folder}{path.removeprefix(top)}" for folder, top in _origins(snapshot) if path.startswith(f"{top}/"))
    return any(place in snapshot.manifest["files"] for place in places)


def _is_input(path: str, since: float) -> bool:
    """Return whether a file is the user's, and was there before the trial."""
    if path.startswith(_SYSTEM) or not is_users(path) or _OF_LIBRARIES.search(path):
        return False
    try:
        return os.path.isfile(path) and os.stat(path).st_ctime < since  # noqa: PTH113, PTH116 - of hundreds of files
    except OSError:
        return False


@cache
def _is_ignored(path: Path) -> bool:
    return query(path.parent, "check-ignore", "--quiet", "--", path.name) is not None


def _missing(original: Path) -> str:
    shown = shown_path(str(original))
    why = "is ignored by git" if _is_ignored(original) else "is not a part of the code"
    return f"{shown} {why}, so the snapshot lacks it; add {command_line('--snapshot-root', shown)}"


def _outside(path: Path, snapshot: Snapshot) -> str:
    shown = shown_path(str(path))
    if any(path.is_relative_to(original) for _, original in _origins(snapshot)):
        why = "is ignored by git" if _is_ignored(path) else "is not a part of the code"
        fix = f"add {command_line('--snapshot-root', shown)}, and name it relative to __file__ in the code"
    else:
        why, fix = "lies outside of the agent's project", "give its path to the agent with --arg NAME=PATH"
    return f"{shown} {why}, so the snapshot lacks it, and a replay needs the same file there; {fix}"
