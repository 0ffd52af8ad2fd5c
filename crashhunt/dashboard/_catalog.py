"""Finds the hunts below the folders that the user named, and assigns each hunt an identifier for links.

No path in a request reaches the file system, because a request contains an identifier, and the catalog maps it to a
folder. A hunt is listed only if its files lie inside one of the named folders after all symbolic links are resolved.
"""

from __future__ import annotations

import hashlib
import os
import stat
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.integrity import too_large
from crashhunt.results import is_case, is_hunt

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

_MAX_DEPTH = 4  # of hunts below a named folder: a folder of suites has DIR/SUITE/ID/RUN
_MAX_FOLDERS = 20_000  # looked into; a home folder may have millions
_SCAN_EVERY_S = 1.0
_MAX_SHARE_OF_TIME = 0.05  # that looking for hunts may take
_SKIPPED_FOLDERS = frozenset(
    {"__pycache__", "node_modules", "site-packages", layout.CRASHES, layout.SNAPSHOTS, *layout.BESIDE}
)
_OWN_FILES = (
    layout.HUNT, layout.LEDGER, f"{layout.LEDGER}-wal", f"{layout.LEDGER}-shm", layout.REQUEST, layout.CRASHES,
    *layout.BESIDE, layout.SNAPSHOTS, layout.RUN_LOG, layout.ERROR_LOG,
    layout.NOTES,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FoundHunt:
    """A hunt that the catalog has found."""

    id: str  # identifier in links: 16 hexadecimal digits that depend only on the path of the hunt
    path: Path  # path of the hunt's folder, with symbolic links resolved
    root: Path  # the folder named by the user that contains the hunt
    name: str  # path of the hunt relative to `root`, or the name of its folder
    suite: str  # folder that contains this and other hunts, relative to `root`; empty if there is none
    exported: bool = False  # whether the hunt was unpacked from a file that ``crashhunt export`` wrote


class Catalog:
    """The hunts in some folders and their subfolders, which are scanned for new hunts while requests arrive."""

    def __init__(self, roots: Sequence[Path], exported: dict[str, Path] | None = None) -> None:
        self.roots = tuple(dict.fromkeys(root.resolve() for root in roots))
        self._exported = dict(exported or {})
        self._found: dict[str, FoundHunt] = {}
        self._due = 0.0
        self._lock = threading.Lock()
        self.is_cut = False

    def hunts(self) -> dict[str, FoundHunt]:
        """Return the hunts by identifier, in the order of the folders named by the user."""
        with self._lock:
            began = time.monotonic()
            if began >= self._due:
                self._found = {found.id: found for found in self._scan()}
                ended = time.monotonic()
                self._due = ended + max(_SCAN_EVERY_S, (ended - began) / _MAX_SHARE_OF_TIME)
            return self._found

    def find(self, identifier: str) -> FoundHunt | None:
        """Return a hunt by its identifier; None if the identifier is unknown, or if the hunt's folder was deleted."""
        found = self._found.get(identifier) or self.hunts().get(identifier)
        return found if found is not None and found.path.is_dir() else None

    def _scan(self) -> Iterator[FoundHunt]:
        for name, path in self._exported.items():
            place = path.resolve()
            yield FoundHunt(id=_identifier(path, name), path=place, root=place, name=name, suite="", exported=True)
        self.is_cut = False
        seen: set[Path] = set()
        for root in self.roots:
            for path in self._below(root):
                if path not in seen:
                    seen.add(path)
                    below = path.relative_to(root)
                    suite = below.parent.as_posix()
                    name = below.as_posix() if path != root else root.name or str(root)
                    suite = "" if suite == "." else suite
                    yield FoundHunt(id=_identifier(path), path=path, root=root, name=name, suite=suite)

    def _below(self, root: Path) -> Iterator[Path]:
        """Yield the folders of hunts below a folder, parents before children; hunts themselves are not searched."""
        folders, looked = [(root, 0)], 0
        while folders:
            folder, depth = folders.pop(0)
            looked += 1
            if looked > _MAX_FOLDERS:
                self.is_cut = True
                return
            if is_case(folder):
                continue
            if is_hunt(folder):
                yield folder
                continue
            if depth < _MAX_DEPTH:
                folders += [(path, depth + 1) for path in self._folders_in(folder)]

    def _folders_in(self, folder: Path) -> list[Path]:
        try:
            with os.scandir(folder) as entries:
                names = sorted(entry.name for entry in entries if entry.is_dir())
        except OSError:
            return []
        wanted = (
            name for name in names if name[0] != "." and layout.REPLACED not in name and name not in _SKIPPED_FOLDERS
        )
        found = [(folder / name).resolve() for name in wanted]
        return [path for path in found if is_inside(path, self.roots)]


def is_inside(path: Path, roots: Sequence[Path]) -> bool:
    """Return whether a resolved path equals one of some folders, or lies inside one of them."""
    return any(path == root or root in path.parents for root in roots)


def unreadable(folder: Path, root: Path, names: Iterable[str] = _OWN_FILES) -> str:
    """Return the reason why a file of a folder must not be opened; empty if all files may be opened.

    A folder of another user may contain links that lead out of it, pipes at which a reader waits for ever, and files
    that fill the memory. The files must lie inside ``root``. By default, the files of a hunt are checked.
    """
    for name in names:
        path = folder / name
        try:
            found = path.lstat()
            if stat.S_ISLNK(found.st_mode):
                if not is_inside(path.resolve(), [root]):
                    return f"{name} is a symbolic link to a place outside {root}"
                found = path.stat()
        except (OSError, RuntimeError):  # a reader reports a missing file, or a link to itself
            continue
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
            return f"{name} is neither a file nor a folder"
        if why := too_large(name, found.st_size):
            return why
    return ""


def unreadable_below(folder: Path, root: Path) -> str:
    """Return the reason why a file in a folder or its subfolders must not be opened; empty if all may be opened.

    The files must lie inside ``root``. The folder may be missing.
    """
    folders = [str(folder)]  # texts: a snapshot has 50 folders, and making a path takes longer than listing its folder
    while folders:
        inside, odd = folders.pop(), []
        try:
            with os.scandir(inside) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    elif not entry.is_file(follow_symlinks=False):
                        odd.append(entry.name)
        except OSError:
            continue
        if odd and (why := unreadable(Path(inside), root, odd)):
            return f"in {Path(inside).relative_to(root)}, {why}"
    return ""


def _identifier(path: Path, salt: str = "") -> str:
    text = os.fsencode(str(path)) if not salt else b"export:" + os.fsencode(salt)
    return hashlib.blake2b(text, digest_size=8).hexdigest()
