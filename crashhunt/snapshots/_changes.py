"""Differences between two snapshots on which the results of trials may depend.

Every file of a project counts, because the files that a trial reads are not known. There are two exceptions:

- A page such as a README is no condition of a trial.
- A new file that Python cannot import is mostly an output, such as a report or a film. It is returned separately, so
  that the caller can name it.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.snapshots._environment import differing_versions
from crashhunt.snapshots._snapshot import may_run

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.snapshots._snapshot import Snapshot

_OWN_CODE = f"{layout.CODE}/crashhunt/"
_PAGES = frozenset((
    "AUTHORS", "CHANGELOG", "CHANGES", "CITATION", "CODE_OF_CONDUCT", "CONTRIBUTING", "COPYING", "LICENCE", "LICENSE",
    "NOTICE", "README", "SECURITY", "TODO",
))  # fmt: skip
_PAGE_SUFFIXES = ("", ".md", ".rst", ".txt", ".cff", ".adoc")
_FILES_OF_TOOLS = (".gitignore", ".gitattributes", ".gitmodules", ".editorconfig", ".mailmap")


@dataclass(frozen=True, slots=True)
class CodeChanges:
    """The differences between two snapshots.

    Args:
        changed: the files and versions on which the results of trials may depend, as texts.
        added: the new files that do not count as a change.
    """

    changed: tuple[str, ...] = ()
    added: tuple[str, ...] = ()


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
    versions = differing_versions(then.environment(), now.environment())
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
