"""Which code a hunt runs: the agents' own projects, found through what has been imported."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import SnapshotError
from crashhunt.base.git import environment_of_git
from crashhunt.base.plugins import import_module, locate

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

__all__ = ["Sources", "find_sources", "git"]

_GENERATED = {"__pycache__", ".git", ".hg", ".venv", ".mypy_cache", ".ruff_cache", ".pytest_cache"}


@dataclass(slots=True)
class Sources:
    """Code, and where in a snapshot it goes.

    Attributes:
        files: place in the snapshot (``code/…``) to the file.
        paths: the folders of the snapshot from which modules are imported, the first one first.
        trees: git work trees that are part of it.
        left_out: what was not taken, and why.
    """

    files: dict[str, Path] = field(default_factory=dict)
    paths: list[str] = field(default_factory=lambda: [layout.CODE])
    trees: list[Path] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def find_sources(
    locators: Iterable[str],
    modules: Iterable[str] = (),
    *,
    roots: Sequence[Path] = (),
    without: Path | None = None,
) -> Sources:
    """Find crashhunt itself, the whole project of each agent, and whatever else they imported that is not installed.

    A project is the git work tree that holds a module: what is tracked, as it is now, and what is untracked and not
    ignored. A module that is in none comes with its package, or alone. No link is followed out of a work tree, and
    the directories of hunts are left out.

    Args:
        locators: of the agents.
        modules: further modules that are part of it.
        roots: further files and folders.
        without: a folder to leave out.

    Raises:
        SnapshotError: a root does not exist.
    """
    found = Sources()
    names = {locate("agents", locator).__module__.partition(".")[0] for locator in locators}
    for module in modules:
        import_module(module)
        names.add(module.partition(".")[0])
    names |= {name for name in _top_level_modules() if not _is_installed(_place_of(name))}
    _take_module("crashhunt", found)
    # The pages of the guide are read by people and never by a replay.
    found.files = {place: file for place, file in found.files.items() if not _is_page(place)}
    for name in sorted(names - {"crashhunt"}):
        place = _place_of(name)
        if place is None:
            continue
        listing = None if _is_installed(place) else _listing_that_has(place, name, found)
        if listing is None:
            _take_module(name, found)
        else:
            _take_tree(*listing, found, imports=[place], without=without)
    for root in roots:
        _take_root(root, found, without)
    for odd in [name for name in found.files if "\\" in name]:
        found.left_out.append(f"{found.files.pop(odd)}: its name has a backslash, which elsewhere parts folders")
    return found


def git(folder: Path, *arguments: str) -> bytes | None:
    """Return what git prints, without any change to its index; None where there is no git or no repository."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=60, env=environment_of_git())
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _top_level_modules() -> set[str]:
    return {name.partition(".")[0] for name in list(sys.modules)} - {"__main__", "__mp_main__", "crashhunt"}


def _is_installed(place: Path | None) -> bool:
    """Whether a module lies with the installed ones, which are everybody's and recorded by their versions."""
    if place is None or not {"site-packages", "dist-packages"}.isdisjoint(place.parts):
        return True
    return any(map(place.is_relative_to, _installed_places()))


@cache
def _installed_places() -> tuple[Path, ...]:
    return tuple({Path(path).resolve() for path in sysconfig.get_paths().values()})


def _place_of(name: str) -> Path | None:
    """The folder in which a top-level module or package lies; None where it is part of Python itself."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if file is None:
        paths = list(getattr(module, "__path__", ()))  # a package without __init__.py
        return Path(paths[0]).resolve().parent if len(paths) == 1 else None
    path = Path(file).resolve()
    return path.parent.parent if path.stem == "__init__" else path.parent


def _take_module(name: str, found: Sources) -> None:
    """Take a package, or a module that is one file."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    for folder in map(Path, getattr(module, "__path__", ())):
        for path in _walk(folder):
            found.files[f"{layout.CODE}/{name}/{path}"] = folder / path
        return
    if file is not None:
        found.files[f"{layout.CODE}/{Path(file).name}"] = Path(file)


def _is_page(place: str) -> bool:
    return place.startswith(f"{layout.CODE}/crashhunt/guide/") and place.endswith(".md")


def _walk(folder: Path) -> Iterator[str]:
    """The names of all files below a folder; links to folders are not followed."""
    for parent, folders, files in os.walk(folder):
        folders[:] = sorted(set(folders) - _GENERATED)
        below = Path(parent).relative_to(folder).as_posix()
        for name in sorted(files):
            if os.path.splitext(name)[1] != ".pyc" and os.path.isfile(os.path.join(parent, name)):  # noqa: PTH113, PTH118, PTH122
                yield name if below == "." else f"{below}/{name}"


def _listing_that_has(place: Path, name: str, found: Sources) -> tuple[Path, list[str]] | None:
    """The work tree that holds a module, and its files; None where none does, or where it is ignored there."""
    top = git(place, "rev-parse", "--show-toplevel")
    if top is None:
        return None
    tree = Path(os.fsdecode(top.rstrip(b"\n"))).resolve()
    if tree in found.trees:
        return tree, []
    files = list(_listed(tree))
    module = (place / name).relative_to(tree).as_posix()
    if any(file.startswith((f"{module}.", f"{module}/")) for file in files):
        return tree, files
    return None


def _listed(tree: Path) -> Iterator[str]:
    """What is tracked, and what is untracked and not ignored, but nothing generated; inside submodules too."""
    output = git(tree, "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--deduplicate") or b""
    for entry in filter(None, output.split(b"\0")):
        name = os.fsdecode(entry).rstrip("/")
        path = tree / name
        if path.is_dir() and not path.is_symlink():
            yield from (f"{name}/{inner}" for inner in _listed(path) if path.resolve() != tree)
        elif _GENERATED.isdisjoint(name.split("/")):
            yield name


def _take_tree(
    tree: Path, names: Sequence[str], found: Sources, *, imports: Iterable[Path], without: Path | None
) -> None:
    """Take the files of a work tree, or of a folder, under a name that no module can have."""
    if tree in found.trees:
        base = _base_of(tree, found)
    else:
        found.trees.append(tree)
        base = _base_of(tree, found)
        hunts = [str(Path(name).parent) for name in names if Path(name).name == layout.HUNT]
        hunts = [f"{hunt}/" for hunt in hunts if (tree / hunt / layout.LEDGER).exists() and hunt != "."]
        if without is not None and without.resolve().is_relative_to(tree) and without.resolve() != tree:
            hunts.append(f"{without.resolve().relative_to(tree).as_posix()}/")
        listed = [name for name in names if not name.startswith(tuple(hunts))]
        for name in listed:
            for place, path in _resolved(tree, name, listed, found):
                found.files[f"{base}/{place}"] = path
    entries = [*map(Path, imports), *(Path(entry or ".").resolve() for entry in sys.path)]
    for entry in entries:
        if entry.is_relative_to(tree):
            below = entry.relative_to(tree).as_posix()
            place = base if below == "." else f"{base}/{below}"
            if place not in found.paths and any(file.startswith(f"{place}/") for file in found.files):
                found.paths.append(place)


def _base_of(tree: Path, found: Sources) -> str:
    number = found.trees.index(tree)
    same = sum(other.name == tree.name for other in found.trees[:number])
    return f"{layout.CODE}/@{tree.name}" + (f"-{same + 1}" if same else "")


def _resolved(tree: Path, name: str, listed: Sequence[str], found: Sources) -> Iterator[tuple[str, Path]]:
    """The files that an entry stands for: itself, or what a link inside the tree leads to."""
    path = tree / name
    if not path.is_symlink():
        if path.is_file():  # not deleted meanwhile, no pipe and no socket
            yield name, path
        return
    target = path.resolve()
    if not target.is_relative_to(tree):
        found.left_out.append(f"{path}: a link that leads out of {tree}")
    elif target.is_file():
        yield name, target
    elif target.is_dir():
        inside = target.relative_to(tree).as_posix()
        prefix = "" if inside == "." else f"{inside}/"
        for other in listed:
            if other.startswith(prefix) and (tree / other).is_file() and not (tree / other).is_symlink():
                yield f"{name}/{other.removeprefix(prefix)}", tree / other


def _take_root(root: Path, found: Sources, without: Path | None) -> None:
    path = root.resolve()
    if path.is_file():
        found.files[f"{layout.CODE}/@{path.parent.name}/{path.name}"] = path
        return
    if not path.is_dir():
        raise SnapshotError(f"--snapshot-root {str(root)!r} does not exist", fix="mend the path")
    names = list(_listed(path)) or list(_walk(path))
    _take_tree(path, names, found, imports=[path], without=without)
