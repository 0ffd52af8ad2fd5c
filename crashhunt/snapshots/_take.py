"""Taking of snapshots: code, scenario and files of a hunt are copied into a folder named by their digest."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import sysconfig
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.agent_locators import (
    can_fork,
    files_of,
    is_path,
    is_program,
    libraries_folder,
    libraries_of,
    neighbouring_modules,
    words_of,
)
from crashhunt.base.binaries import BinaryFacts, describe_binary
from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import BundleError, SnapshotError, UsageError, remedy
from crashhunt.base.exceptions import INSTALLED_FOLDERS
from crashhunt.base.files import put_in_place, sync_folder, sync_tree
from crashhunt.base.git import query, work_tree
from crashhunt.base.integrity import FileEntry, digest_of_content, digest_of_file
from crashhunt.base.opened_files import output_files
from crashhunt.base.process_owners import this_process
from crashhunt.base.temporary import remove_ended, temporary_beside
from crashhunt.plans import HuntSettings, SnapshotChoices, core_of, imported_by, write_settings
from crashhunt.scenario import Scenario, as_plain_data, load_order_of
from crashhunt.snapshots._environment import Environment, differing_versions, environment
from crashhunt.snapshots._snapshot import SCHEMA, Manifest, Snapshot, digest_of_manifest, write_manifest
from crashhunt.trial import Choice, Constant

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from crashhunt.base.plugins import ImportedModules


# The code that a hunt runs: the agents' own projects, found through the imported modules.

_GENERATED_FOLDERS = {"__pycache__", ".git", ".hg", ".venv", ".mypy_cache", ".ruff_cache", ".pytest_cache"}


@dataclass(slots=True)
class Sources:
    """Files of code, and their places in a snapshot."""

    files: dict[str, str] = field(default_factory=dict)  # the source file for each place in the snapshot (``code/…``)
    # the folders of the snapshot from which modules are imported, in the order of ``sys.path``
    paths: list[str] = field(default_factory=lambda: [layout.CODE])
    trees: list[Path] = field(default_factory=list)  # the git work trees that are part of the snapshot
    excluded: list[str] = field(default_factory=list)  # the files that were not taken, each with the reason
    # the original folder of each folder of the snapshot that is the copy of one; ``code`` may have several
    origins: list[tuple[str, str]] = field(default_factory=list)


def find_sources(imported: ImportedModules, *, roots: Sequence[Path] = (), without: Path | None = None) -> Sources:
    """Return crashhunt itself, the project of each agent, and all other imported modules that are not installed.

    An installed module that was imported by name is included, too, unless its wheel has libraries next to it
    (``NAME.libs``). A project is the git work tree that contains a module, with its tracked files in their current
    state and its untracked files that git does not ignore. A module outside of work trees is included with its package,
    or alone. Links that lead out of a work tree are not followed. The directories of hunts are excluded.

    Raises:
        SnapshotError: A root does not exist.
    """
    found = Sources()
    _real_folder.cache_clear()  # a link may lead elsewhere than at the snapshot before
    places = {name: _place_of(*place) for name, place in imported.places.items()}
    names = imported.named | _not_installed(places)
    _take_module("crashhunt", imported, found)
    # A replay never reads the pages of the guide.
    pages = f"{layout.CODE}/crashhunt/guide/"
    found.files = {at: file for at, file in found.files.items() if not (at.startswith(pages) and at.endswith(".md"))}
    work_tree_of = cache(work_tree)  # a project has many modules in one folder, and git takes milliseconds
    for name in sorted(names - {"crashhunt"}):
        place = places.get(name)
        if place is None:
            continue
        if (place / f"{name}.libs").is_dir():
            # Its compiled code loads libraries from there, and a copy would not find them. Its version identifies it.
            continue
        tree = None if _is_installed(place) else work_tree_of(place)
        listing = None if tree is None else _listing_that_has(tree, place / name, found)
        if listing is None:
            _take_module(name, imported, found)
        else:
            _take_tree(*listing, found, imports=[place, *map(Path, imported.path)], without=without)
    for root in roots:
        _take_root(root, imported, found, without)
    for odd in [name for name in found.files if "\\" in name]:
        found.excluded.append(f"{found.files.pop(odd)}: its name has a backslash, which elsewhere parts folders")
    return found


def _not_installed(places: Mapping[str, Path | None]) -> set[str]:
    return {name for name in places.keys() - {"__main__", "__mp_main__"} if not _is_installed(places[name])}


def _is_installed(place: Path | None) -> bool:
    """Return whether a module is installed, so that its version identifies it."""
    if place is None or not INSTALLED_FOLDERS.isdisjoint(place.parts):
        return True
    return f"{place}{os.sep}".startswith(_installed_places())


@cache
def _installed_places() -> tuple[str, ...]:
    return tuple({f"{Path(path).resolve()}{os.sep}" for path in sysconfig.get_paths().values()})


def _place_of(file: str | None, folders: Sequence[str]) -> Path | None:
    """Return the folder that contains a top-level module or package; None for a module built into Python."""
    if file is None:  # perhaps a package without __init__.py
        return Path(folders[0]).resolve().parent if len(folders) == 1 else None
    # Hundreds of modules lie in a few folders, so resolve each folder once.
    folder, own_name = os.path.split(file)
    path = Path(file).resolve() if os.path.islink(file) else _real_folder(folder) / own_name  # noqa: PTH114
    return path.parent.parent if path.stem == "__init__" else path.parent


@cache
def _real_folder(folder: str) -> Path:
    return Path(folder).resolve()


def _take_module(name: str, imported: ImportedModules, found: Sources) -> None:
    """Add a package, or a module that is a single file, to the sources."""
    file, folders = imported.places.get(name, (None, ()))
    archive = _archive_of(file or next(iter(folders), ""))
    if archive is not None:  # an entry of ``sys.path``, as it is in the snapshot
        place = f"{layout.CODE}/@{archive.parent.name}/{archive.name}"
        found.files[place] = str(archive)
        if place not in found.paths:
            found.paths.append(place)
        return
    for folder in map(Path, folders):
        found.origins.append((f"{layout.CODE}/{name}", str(folder)))
        for path in _walk(folder):
            found.files[f"{layout.CODE}/{name}/{path}"] = f"{folder}/{path}"
        return
    if file is not None:
        found.files[f"{layout.CODE}/{Path(file).name}"] = file
        found.origins.append((layout.CODE, str(Path(file).parent)))


def _archive_of(file: str) -> Path | None:
    """Return the zip file from which Python imported a module; None for a module in a folder."""
    if not file or os.path.exists(file):  # noqa: PTH110 - of hundreds of modules
        return None
    return next((path for path in Path(file).parents if path.is_file()), None)


def _walk(folder: Path | str, below: str = "") -> Iterator[str]:
    """Yield the names of all files below a folder, without following links to folders."""
    try:
        with os.scandir(folder) as entries:  # which knows the kinds of hundreds of files, so that none is asked for
            found = sorted(entries, key=lambda entry: entry.name)
    except OSError:  # not readable, or removed meanwhile
        return
    for entry in found:
        is_file = os.path.isfile(entry.path) if entry.is_symlink() else entry.is_file(follow_symlinks=False)  # noqa: PTH113
        if is_file and os.path.splitext(entry.name)[1] != ".pyc":  # noqa: PTH122
            yield f"{below}{entry.name}"
    for entry in found:
        if entry.is_dir(follow_symlinks=False) and entry.name not in _GENERATED_FOLDERS:
            yield from _walk(entry.path, f"{below}{entry.name}/")


def _listing_that_has(tree: Path, path: Path, found: Sources) -> tuple[Path, list[str]] | None:
    """Return a work tree and its files; None if git ignores the module at a path (without its suffix)."""
    if tree in found.trees:
        return tree, []
    files = list(_listed(tree))
    module = path.relative_to(tree).as_posix()
    if any(file.startswith((f"{module}.", f"{module}/")) for file in files):
        return tree, files
    return None


def _listed(tree: Path) -> Iterator[str]:
    """Yield tracked files and untracked, not ignored files, without generated files; also those of submodules."""
    output = query(tree, "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--deduplicate") or b""
    for entry in filter(None, output.split(b"\0")):
        name = os.fsdecode(entry).rstrip("/")
        path = tree / name
        if path.is_dir() and not path.is_symlink():
            yield from (f"{name}/{inner}" for inner in _listed(path) if path.resolve() != tree)
        elif _GENERATED_FOLDERS.isdisjoint(name.split("/")):
            yield name


def _take_tree(
    tree: Path, names: Sequence[str], found: Sources, *, imports: Iterable[Path], without: Path | None
) -> None:
    """Add the files of a work tree or a folder to the sources, under a name that no module can have."""
    if tree in found.trees:
        base = _base_of(tree, found)
    else:
        found.trees.append(tree)
        base = _base_of(tree, found)
        found.origins.append((base, str(tree)))
        hunts = _hunts_in(tree, names)
        if without is not None and without.resolve().is_relative_to(tree) and without.resolve() != tree:
            hunts.append(f"{without.resolve().relative_to(tree).as_posix()}/")
        outputs = output_files()
        listed = [n for n in names if not n.startswith(tuple(hunts)) and f"{tree.resolve()}/{n}" not in outputs]
        for name in listed:
            for place, path in _resolved(tree, name, listed, found):
                found.files[f"{base}/{place}"] = str(path)
    for entry in (place.resolve() for place in imports):
        if entry.is_relative_to(tree):
            below = entry.relative_to(tree).as_posix()
            place = base if below == "." else f"{base}/{below}"
            if place not in found.paths and any(file.startswith(f"{place}/") for file in found.files):
                found.paths.append(place)


def _hunts_in(tree: Path, names: Iterable[str]) -> list[str]:
    """Return the directories of hunts in a work tree, each with a slash at its end."""
    hunts = [str(Path(name).parent) for name in names if Path(name).name == layout.HUNT]
    return [f"{hunt}/" for hunt in hunts if (tree / hunt / layout.LEDGER).exists() and hunt != "."]


def code_of_tree(tree: Path) -> list[str]:
    """Return the names of the Python files that a snapshot of a work tree would contain, relative to its root."""
    names = list(_listed(tree))
    hunts = tuple(_hunts_in(tree, names))
    return [name for name in names if name.endswith(".py") and not name.startswith(hunts) and (tree / name).is_file()]


def _base_of(tree: Path, found: Sources) -> str:
    number = found.trees.index(tree)
    same = sum(other.name == tree.name for other in found.trees[:number])
    return f"{layout.CODE}/@{tree.name}" + (f"-{same + 1}" if same else "")


def _resolved(tree: Path, name: str, listed: Sequence[str], found: Sources) -> Iterator[tuple[str, Path]]:
    """Yield the files of an entry: the file itself, or the targets of a link inside the tree."""
    path = tree / name
    if not path.is_symlink():
        if path.is_file():  # skips deleted files, pipes and sockets
            yield name, path
        return
    target = path.resolve()
    if not target.is_relative_to(tree):
        found.excluded.append(f"{path}: a link that leads out of {tree}")
    elif target.is_file():
        yield name, target
    elif target.is_dir():
        inside = target.relative_to(tree).as_posix()
        prefix = "" if inside == "." else f"{inside}/"
        for other in listed:
            if other.startswith(prefix) and (tree / other).is_file() and not (tree / other).is_symlink():
                yield f"{name}/{other.removeprefix(prefix)}", tree / other


def _take_root(root: Path, imported: ImportedModules, found: Sources, without: Path | None) -> None:
    path = root.resolve()
    if not path.exists():
        raise SnapshotError(f"--snapshot-root {str(root)!r} does not exist", fix="correct the path")
    # The code finds a file at its place in the project, such as a library that git ignores.
    homes = [(origin, place) for place, origin in found.origins if path.is_relative_to(origin) and str(path) != origin]
    if homes and work_tree(path if path.is_dir() else path.parent) != path:
        for origin, place in [home for home in homes if home[1] != layout.CODE] or homes[:1]:  # a submodule has two
            base = f"{place}/{path.relative_to(origin).as_posix()}"
            names = [""] if path.is_file() else [f"/{name}" for name in _walk(path)]
            found.files |= {f"{base}{name}": f"{path}{name}" for name in names}
            if path.is_dir() and names and base not in found.paths:
                found.paths.append(base)
        return
    if path.is_file():
        found.files[f"{layout.CODE}/@{path.parent.name}/{path.name}"] = str(path)
        return
    names = list(_listed(path)) or list(_walk(path))
    _take_tree(path, names, found, imports=[path, *map(Path, imported.path)], without=without)


_MEGABYTE = 10**6
_SMALL_FILE_BYTES = 1 << 20  # bytes
_COPIED_PERMISSIONS = 0o755
_WHOLE_FILE_BYTES = 64 << 20  # bytes


@clear_constructor
@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotOptions:
    """Options of the snapshot of a hunt.

    Args:
        code: Whether the snapshot contains code; without code, a replay runs the current code.
        roots: Files and folders to include in addition to those found.
        limit_mb: Maximum size of the snapshot, in MB.
        new_code: Whether a resumed hunt continues although the snapshot differs from that of its trials.

    Raises:
        UsageError: The maximum size is not above 0.
    """

    code: bool = True
    roots: tuple[Path, ...] = ()
    limit_mb: float = 500.0
    new_code: bool = False

    def __post_init__(self) -> None:
        if not self.limit_mb > 0:  # also refuses NaN
            raise UsageError(f"--snapshot-limit is {self.limit_mb:g}", fix="give MB above 0, or --no-snapshot")

    @classmethod
    def of(cls, choices: SnapshotChoices) -> SnapshotOptions:
        """Return the options that a hunt's settings contain.

        Raises:
            UsageError: The maximum size is not above 0.
        """
        return cls(
            code=choices.snapshot_code,
            roots=tuple(map(Path, choices.snapshot_roots)),
            limit_mb=choices.snapshot_limit_mb,
            new_code=choices.continue_with_new_code,
        )


def take_snapshot(
    snapshots: Path,
    scenario: Scenario,
    settings: HuntSettings,
    options: SnapshotOptions | None = None,
    *,
    imported: ImportedModules | None = None,
) -> Snapshot:
    """Store the scenario, the agents' own projects, the files that their arguments name, and crashhunt itself.

    Equal contents are stored only once. By default, a separate process imports the modules of a trial now.

    Raises:
        SnapshotError: The snapshot is too large, or a file cannot be read or written.
    """
    options = options or SnapshotOptions()
    if imported is None:
        imported = imported_by(scenario, settings)
    found = find_sources(imported, roots=options.roots, without=snapshots.parent)
    argument_files = _argument_files(settings) | _program_files(settings, found, options.code, snapshots.parent)
    files = _with_arguments(found, argument_files)
    conditions: dict[str, str] = {}
    if not options.code:
        conditions = {place: digest for place, path in files.items() if (digest := _digest_of_original(path))}
        found, argument_files = Sources(paths=[]), {}
    argument_files |= _training_records(imported.agents, argument_files)
    files = _with_arguments(found, argument_files)
    _check_size(files, options.limit_mb)
    try:
        snapshots.mkdir(exist_ok=True)
        remove_ended(snapshots)
        with temporary_beside(snapshots / layout.MANIFEST, name=f"{layout.BUILDING}{this_process().token}") as building:
            around = environment(imported)
            if programs := _described_programs(settings, imported.revisions):
                around["programs"] = programs
            return _build(building, files, found, argument_files, scenario, settings, around, conditions)
    except OSError as error:
        raise _cannot_make(error, snapshots) from error


def _with_arguments(found: Sources, argument_files: Mapping[str, str]) -> dict[str, str]:
    """Return all files of a snapshot; a word of a command line is not always the path of its file."""
    return {place: path for path, place in argument_files.items()} | found.files


def _cannot_make(error: OSError, snapshots: Path) -> SnapshotError:
    """Return the error for a snapshot that cannot be made, with the fix for its cause."""
    is_limit = error.errno in (errno.EMFILE, errno.ENFILE, errno.EFBIG)
    return SnapshotError(
        f"the snapshot cannot be made: {error.strerror or error}",
        fix=remedy(error) if is_limit else "free some space, make the file readable, or give --no-snapshot",
        where=str(error.filename or snapshots),
    )


def _build(
    building: Path,
    files: dict[str, str],
    found: Sources,
    argument_files: dict[str, str],
    scenario: Scenario,
    settings: HuntSettings,
    around: Environment,
    conditions: dict[str, str],
) -> Snapshot:
    """Copy all files into a folder and rename it to its digest, unless a snapshot with this digest exists already."""
    building.mkdir()
    for folder in {name.rpartition("/")[0] for name in files}:
        (building / folder).mkdir(parents=True, exist_ok=True)
    entries = {name: _store(path, f"{building}/{name}") for name, path in files.items()}
    entries |= _store_scenario(scenario, building)
    stored = {name: entry for name, entry in entries.items() if entry is not None}
    manifest: Manifest = {
        "schema": SCHEMA,
        "paths": found.paths,
        "argument_files": argument_files,
        "left_out": found.excluded,
        "files": stored,
        "described": {},
    }
    final = _name(manifest, conditions, building)
    if _is_usable(final, stored):
        versions = differing_versions(Snapshot(final).environment, around)
        if not versions:
            return Snapshot(final)
        # The same files with another NumPy or SUMO are another condition of trials.
        final = _name(manifest, conditions | {name: now for name, (_, now) in versions.items()}, building)
        if _is_usable(final, stored):
            return Snapshot(final)
    write_settings(building / layout.HUNT, settings, ["crashhunt", "run", "as resolved"])
    facts: Environment = {
        **around, "git": _describe_trees(found.trees, building / layout.GIT_DIFF), "origins": found.origins,
    }  # fmt: skip
    if (core := core_of(scenario, settings.run)) is not None:
        facts["core"] = core
    if (load_order := load_order_of(scenario)) is not None:
        facts["load_order"] = load_order
    (building / layout.ENVIRONMENT).write_text(json.dumps(facts, indent=1), encoding="utf-8")
    write_manifest(building, manifest)
    sync_tree(building)
    put_in_place(building, final)  # an existing snapshot is equal, damaged, or taken by another user
    sync_folder(final.parent)
    return Snapshot(final)


def _name(manifest: Manifest, conditions: dict[str, str], building: Path) -> Path:
    """Add the conditions to a manifest; return the folder of its snapshot."""
    if conditions:
        manifest["conditions"] = conditions
    return building.with_name(digest_of_manifest(manifest))


def _is_usable(final: Path, stored: dict[str, FileEntry]) -> bool:
    """Return whether a snapshot of these files exists and is intact.

    The digest is too short to prove that two snapshots are the same, so only a snapshot of this user is usable.
    """
    if not final.exists() or _is_damaged(same := Snapshot(final)):
        return False
    return same.manifest["files"] == stored and same.is_made_here


def _is_damaged(snapshot: Snapshot) -> bool:
    try:
        return bool(snapshot.faults())
    except BundleError:
        return True


def _argument_files(settings: HuntSettings) -> dict[str, str]:
    """Return the files that agents' arguments name, such as the weights of a policy, and their places."""
    found: dict[str, str] = {}
    for agent in settings.agents.values():
        for spec in agent.arguments.values():
            distribution = spec.distribution
            values: Sequence[object] = ()
            if isinstance(distribution, Constant):
                values = (distribution.value,)
            elif isinstance(distribution, Choice):
                values = distribution.options
            for value in values:
                if not isinstance(value, str) or value in found or (is_program(agent.agent) and not is_path(value)):
                    continue
                if os.path.isfile(value):  # noqa: PTH113
                    found[value] = f"{layout.FILES}/{len(found)}-{Path(value).name}"
    return found


def _program_files(settings: HuntSettings, found: Sources, takes_code: bool, hunt: Path) -> dict[str, str]:
    """Return the files of the agents' command lines, and their places; add the projects of programs to the sources.

    A program of a git work tree keeps its place among the files of its project, even if git ignores it, as it does
    most binaries.
    """
    places: dict[str, str] = {}
    locators = sorted({agent.agent for agent in settings.agents.values() if is_program(agent.agent)})
    for number, (word, path) in enumerate(pair for locator in locators for pair in files_of(locator).items()):
        tree = work_tree(path.parent) if takes_code else None
        if tree is not None and path.resolve().is_relative_to(tree):
            if tree not in found.trees:
                _take_tree(tree, list(_listed(tree)), found, imports=(), without=hunt)
            base = next(place for place, origin in found.origins if origin == str(tree))
            places[word] = f"{base}/{path.resolve().relative_to(tree).as_posix()}"
        else:
            folder = f"{layout.FILES}/program-{number}"
            places[word] = f"{folder}/{path.name}"
            places |= {str(module): f"{folder}/{name}" for name, module in neighbouring_modules(path).items()}
        found.files[places[word]] = str(path)
    for locator in (one for one in locators if not can_fork(one)):
        libraries, fixed = libraries_of(locator)
        folder = f"{layout.FILES}/{libraries_folder(locator)}"
        places |= {str(path): f"{folder}/{name}" for name, path in libraries.items() if name not in fixed}
        found.excluded += [f"{libraries[name]}: the program has its path (DT_RPATH), and uses it" for name in fixed]
    return places


def _described_programs(settings: HuntSettings, revisions: Mapping[str, str]) -> dict[str, BinaryFacts]:
    """Return what identifies the programs of agents, by the words that name them."""
    locators = {agent.agent for agent in settings.agents.values() if is_program(agent.agent)}
    files = {word: path for locator in sorted(locators) for word, path in files_of(locator).items()}
    described = {word: found for word, path in files.items() if (found := describe_binary(path)) is not None}
    for locator, revision in revisions.items():
        if is_program(locator) and not can_fork(locator):
            word = words_of(locator)[0]
            without: BinaryFacts = {"machine": "", "build_id": "", "system": [], "missing": []}
            described[word] = {**described.get(word, without), "revision": revision}
    return described


def _training_records(modules: Sequence[str], argument_files: dict[str, str]) -> dict[str, str]:
    """Return the training records next to policies and next to the files of agents' modules, and their places.

    A comparison of hunts needs these records to know on which traffic an agent was trained.
    """
    records = dict.fromkeys(str(Path(policy).parent / layout.TRAINED_ON) for policy in (*argument_files, *modules))
    there = [record for record in records if os.path.isfile(record)]  # noqa: PTH113
    first = len(argument_files)
    return {record: f"{layout.FILES}/{place}-{layout.TRAINED_ON}" for place, record in enumerate(there, first)}


def _check_size(files: dict[str, str], limit_mb: float) -> None:
    sizes = {path: _size(path) for path in files.values()}
    total = sum(sizes.values())
    if total > limit_mb * _MEGABYTE:
        largest = sorted(sizes, key=lambda path: -sizes[path])[:3]
        names = ", ".join(f"{path} ({sizes[path] / _MEGABYTE:.3g} MB)" for path in largest)
        raise SnapshotError(
            f"the snapshot would have {total / _MEGABYTE:.3g} MB, above the limit of {limit_mb:g} MB; largest: {names}",
            fix="list unneeded files in .gitignore, raise --snapshot-limit, or give --no-snapshot",
        )


def _digest_of_original(path: str) -> str:
    """Return the digest of a file that is not copied; empty if it cannot be read.

    Of a large file, such as a data set, only the size and both ends count, because a hunt would begin minutes later.
    """
    try:
        size = _size(path)
        if size <= _WHOLE_FILE_BYTES:
            return digest_of_file(path)
        with open(path, "rb") as file:
            ends = file.read(_SMALL_FILE_BYTES)
            file.seek(-_SMALL_FILE_BYTES, os.SEEK_END)
            return digest_of_content(b"%d %b%b" % (size, ends, file.read()))
    except OSError:
        return ""


def _size(path: str) -> int:
    try:
        return os.stat(path).st_size  # noqa: PTH116 - a Path takes several times as long
    except OSError:
        return 0


def _store(path: str, copy: str) -> FileEntry | None:
    """Copy a file, executable if it is; return None if the file has been deleted in the meantime.

    A copy is never a program with the rights of its owner (set-user-ID), and only its owner can write to it.
    """
    try:
        with open(path, "rb", buffering=0) as file:
            status = os.fstat(file.fileno())
            content = file.readall() if status.st_size < _SMALL_FILE_BYTES else None
        if content is None:
            shutil.copyfile(path, copy)
    except FileNotFoundError:
        return None
    # A hunt copies hundreds of modules, so write the content that was read, without shutil and Path.
    with open(copy, "r+b" if content is None else "wb") as file:
        if content is not None:
            file.write(content)
        os.fchmod(file.fileno(), status.st_mode & _COPIED_PERMISSIONS | stat.S_IRUSR | stat.S_IWUSR)
    entry: FileEntry = {"size": _size(copy), "blake2b": digest_of_file(copy)} if content is None else {
        "size": len(content), "blake2b": digest_of_content(content)
    }  # fmt: skip
    return {**entry, "executable": 1} if status.st_mode & stat.S_IXUSR else entry


def _store_scenario(scenario: Scenario, building: Path) -> dict[str, FileEntry | None]:
    import tomli_w

    entries: dict[str, FileEntry | None] = {}
    texts = set(scenario.texts())
    relocated = scenario.backend.relocated
    for name in scenario.files():
        place = f"{layout.SCENARIO_FILES}/{name}"
        (building / place).parent.mkdir(parents=True, exist_ok=True)
        entries[place] = _store(f"{scenario.folder}/{name}", f"{building}/{place}")
        moved = relocated(scenario.folder / name) if relocated is not None and name in texts else None
        if moved is not None:
            (building / place).write_bytes(moved)
            entries[place] = {"size": len(moved), "blake2b": digest_of_file(building / place)}
    (building / layout.SCENARIO_FILES).mkdir(exist_ok=True)
    resolved = building / layout.SCENARIO_FILES / layout.SCENARIO
    text = "# The scenario as it was resolved for this hunt.\n" + tomli_w.dumps(as_plain_data(scenario))
    resolved.write_text(text, encoding="utf-8")
    entries[f"{layout.SCENARIO_FILES}/{layout.SCENARIO}"] = {
        "size": resolved.stat().st_size,
        "blake2b": digest_of_file(resolved),
    }
    return entries


def _describe_trees(trees: Sequence[Path], diff: Path) -> dict[str, str]:
    """Write the uncommitted changes of work trees to a file; return the revisions of the work trees."""
    revisions = {}
    for tree in trees:
        revision = query(tree, "rev-parse", "HEAD")
        if revision is not None:
            revisions[str(tree)] = revision.decode().strip()
            with diff.open("ab") as file:
                file.write(query(tree, "diff", "HEAD", "--no-ext-diff", "--no-textconv", "--binary") or b"")
    return revisions
