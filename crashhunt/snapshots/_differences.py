"""The files of today's code that differ from a snapshot, for a replay with today's code."""

from __future__ import annotations

import os
import platform
import sys
from collections import defaultdict
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.agent_locators import can_fork, files_of, is_program, libraries_folder, words_of
from crashhunt.base.binaries import describe_binary
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.exceptions import shown_path
from crashhunt.base.integrity import changed_file
from crashhunt.base.plugins import registered
from crashhunt.snapshots._environment import differing_versions
from crashhunt.snapshots._snapshot import Snapshot, may_run
from crashhunt.snapshots._take import code_of_tree

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


# Differences between two snapshots on which the results of trials may depend.
#
# Every file of a project counts, because the files that a trial reads are not known. There are two exceptions:
#
# - A page such as a README is no condition of a trial.
# - A new file that Python cannot import is mostly an output, such as a report or a film. It is returned separately, so
#   that the caller can name it.


_OWN_CODE = f"{layout.CODE}/crashhunt/"
_PAGES = frozenset((
    "AUTHORS", "CHANGELOG", "CHANGES", "CITATION", "CODE_OF_CONDUCT", "CONTRIBUTING", "COPYING", "LICENCE", "LICENSE",
    "NOTICE", "README", "SECURITY", "TODO",
))  # fmt: skip
_PAGE_SUFFIXES = ("", ".md", ".rst", ".txt", ".cff", ".adoc")
_FILES_OF_TOOLS = (".gitignore", ".gitattributes", ".gitmodules", ".editorconfig", ".mailmap")


@dataclass(frozen=True, slots=True)
class CodeChanges:
    """The differences between two snapshots."""

    changed: tuple[str, ...] = ()  # the files and versions on which the results of trials may depend, as texts
    added: tuple[str, ...] = ()  # the new files that do not count as a change


def code_changes(then: Snapshot, now: Snapshot) -> CodeChanges:
    """Return the differences between an earlier and a later snapshot of a hunt.

    The name of a project's folder does not count, because the same commit may be checked out at several places.

    Raises:
        BundleError: a manifest or an environment is missing or damaged.
    """
    if then.is_described != now.is_described:
        return CodeChanges((f"the code, which {'the earlier' if not then.is_described else 'this'} snapshot lacks",))
    before, after = _files(then), _files(now)
    changed, added, own, moves = [], [], 0, set()
    for name in sorted(before.keys() | after.keys()):
        was, is_now = before.get(name, set()), after.get(name, set())
        if was == is_now or is_page(name):
            continue
        if name.startswith(_OWN_CODE):
            own += 1
        elif not was and not name.startswith(f"{layout.SCENARIO_FILES}/") and not may_run(name):
            added.append(name)
        elif (move := (frozenset(was), frozenset(is_now))) not in moves:  # a file may be part of a project as well
            moves.add(move)
            changed.append(name if was and is_now else f"{name} ({'new' if is_now else 'removed'})")
    if own:
        changed.append(f"crashhunt itself ({own} {'file' if own == 1 else 'files'})")
    versions = differing_versions(then.environment, now.environment)
    changed += [f"{name} {was} (now {is_now})" for name, (was, is_now) in versions.items()]
    return CodeChanges(tuple(changed), tuple(added))


def _files(snapshot: Snapshot) -> Mapping[str, set[str]]:
    """Return the digests of each file, by a name that does not depend on the place of its project."""
    manifest = snapshot.manifest
    digests = {place: entry["blake2b"] for place, entry in manifest["files"].items()} | snapshot.conditions
    found: defaultdict[str, set[str]] = defaultdict(set)
    for value, place in manifest["argument_files"].items():
        if place in digests:
            found[value].add(digests.pop(place))
    for place, digest in digests.items():
        folder, _, name = place.partition("/")
        if folder == layout.CODE and not place.startswith(_OWN_CODE):
            project, _, inner = name.partition("/")
            found[inner if project.startswith("@") else name].add(digest)
        elif name:  # versions have no folder, and are compared with those of the environment
            found[place].add(digest)
    return found


def is_page(name: str) -> bool:
    """Return whether a file of a project is no condition of a trial, such as a README or a file of git."""
    path = PurePosixPath(name)
    is_text = path.stem.upper() in _PAGES and path.suffix.lower() in _PAGE_SUFFIXES
    return is_text or path.name in _FILES_OF_TOOLS or path.parts[0] == ".github"


def code_differences(snapshot: Snapshot, locators: Iterable[str]) -> list[str] | None:
    """Return the files of today's code that differ from their copies in a snapshot; None if none can be compared.

    Files are compared by content, not by time. A file that the snapshot lacks is reported only if it is a Python file
    of a work tree. The caller has verified the snapshot. Modules of agents are found as an import from the current
    folder finds them.
    """
    if not snapshot.has_code:
        return None
    files, folders = snapshot.manifest["files"], _folders_of_today(snapshot, locators)
    found, compared = [], False
    for base, folder in folders.items():
        below = {name: folder / name.removeprefix(f"{base}/") for name in files if name.startswith(f"{base}/")}
        below |= {base: folder} if base in files else {}
        below = {name: file for name, file in below.items() if not is_page(name.removeprefix(f"{base}/"))}
        changes = {name: why for name, file in below.items() if (why := changed_file(file, files[name]))}
        if folder == layout.PACKAGE:
            found += [f"crashhunt itself ({len(changes)} files)"] if changes else []
            continue
        compared = True
        found += [f"{shown_path(str(below[name]))} {why}" for name, why in changes.items()]
        if base.startswith(f"{layout.CODE}/@"):
            new = [name for name in code_of_tree(folder) if f"{base}/{name}" not in files]
            found += [f"{shown_path(str(folder / name))} is new" for name in new]
    programs = {word: path for locator in locators for word, path in _program_files(locator).items()}
    for value, place in snapshot.manifest["argument_files"].items():
        compared = compared or value in programs
        if place in files and (why := changed_file(str(programs.get(value, value)), files[place])):
            found.append(f"{value} {why}")
    return sorted(found) if compared else None


def program_warnings(snapshot: Snapshot, locators: Iterable[str]) -> list[str]:
    """Return the reasons why this machine cannot run the programs of a snapshot, each as a line of text.

    The caller has verified the snapshot.
    """
    files, here = snapshot.argument_files, platform.machine()
    found = []
    for locator in locators:
        if can_fork(locator):  # a library is refused where it is loaded
            continue
        word = words_of(locator)[0]
        facts = describe_binary(Path(files[word])) if word in files else None
        if facts is None:
            continue
        recorded = snapshot.environment.get("programs", {}).get(word, facts)
        then, now = recorded.get("packages", {}), facts.get("packages", {})
        found += [
            f"the library {name} was of {package} and is of {now[name]}"
            for name, package in then.items()
            if now.get(name, package) != package
        ]
        if facts["machine"] != here:
            found.append(f"the program {word} is for {facts['machine']}, and this machine is {here}, so it cannot run")
            continue
        own = {Path(file).name for file in files.values() if Path(file).parent.name == libraries_folder(locator)}
        lacking = [name for name in facts["missing"] if name not in own]
        found += [f"the program {word} needs the library {name}, which this machine lacks" for name in lacking]
    return found


def _program_files(locator: str) -> dict[str, Path]:
    """Return today's files of an agent's command line; none if the agent is no program, or the program is gone."""
    try:
        return files_of(locator) if is_program(locator) else {}
    except CrashhuntError:
        return {}


def _folders_of_today(snapshot: Snapshot, locators: Iterable[str]) -> dict[str, Path]:
    """Return for each folder or module in the snapshot the folder or file from which today's code is imported."""
    files = snapshot.manifest["files"]
    found = {f"{layout.CODE}/{layout.PACKAGE.name}": layout.PACKAGE}
    for place, original in snapshot.environment.get("origins", ()):
        if place != layout.CODE:
            if os.path.isdir(original):  # noqa: PTH112
                found.setdefault(place, Path(original))
            continue
        for file in Path(original).glob("*.py"):
            if f"{place}/{file.name}" in files:
                found[f"{place}/{file.name}"] = file
    points = registered("agents")
    for locator in locators:
        top = (points[locator].value if locator in points else locator).partition(":")[0].partition(".")[0]
        spec = PathFinder.find_spec(top, [os.getcwd(), *sys.path])  # noqa: PTH109 - sys.path holds strings
        if top == layout.PACKAGE.name or spec is None or spec.origin is None:
            continue
        for path in snapshot.manifest["paths"]:
            name = next((name for name in (f"{path}/{top}.py", f"{path}/{top}/__init__.py") if name in files), None)
            if name is None:
                continue
            parts = name.split("/")
            size = 2 if parts[1].startswith("@") or len(parts) > 2 else len(parts)
            today = Path(spec.origin).resolve()
            found["/".join(parts[:size])] = today.parents[len(parts) - size - 1] if len(parts) > size else today
            break
    return found
