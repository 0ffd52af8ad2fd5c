"""Snapshots: the code and the scenario that a hunt ran, kept beside its crashes and addressed by content."""

from __future__ import annotations

import importlib.machinery
import json
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import BundleError, SnapshotError, UsageError
from crashhunt.base.files import sync_folder, sync_tree
from crashhunt.base.integrity import (
    FILES,
    changed_file,
    describe_files,
    digest_of_data,
    digest_of_file,
    read_object,
    typed,
)
from crashhunt.oracles import modules_of
from crashhunt.plans import HuntSettings, SnapshotChoices, read_settings, write_settings
from crashhunt.scenario import Scenario, as_plain_data, digest_of_described, load_scenario
from crashhunt.snapshots._environment import environment
from crashhunt.snapshots._sources import Sources, find_sources, git
from crashhunt.trial import Choice, Constant

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Snapshot", "SnapshotOptions", "latest_snapshot", "take_snapshot"]

SCHEMA = 2
_PROTECTED = 2  # the first version with a digest of its manifest and of what describes the rest
_MEGABYTE = 10**6
_DESCRIBING = (layout.HUNT, layout.ENVIRONMENT, layout.GIT_DIFF)
_PARTS = (layout.CODE, layout.FILES, layout.SCENARIO_FILES)
# What Python might import, or run when it starts.
_IMPORTABLE = {".py", ".pyc", ".pyo", ".so", ".pth", *importlib.machinery.all_suffixes()}


@clear_constructor
@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotOptions:
    """What a snapshot takes in.

    Args:
        code: whether it has code at all; without, a replay runs what is current.
        roots: files and folders besides what is found.
        limit_mb: how large it may be, in MB.

    Raises:
        UsageError: the limit is none.
    """

    code: bool = True
    roots: tuple[Path, ...] = ()
    limit_mb: float = 500.0

    def __post_init__(self) -> None:
        if not self.limit_mb > 0:  # nor what is not a number
            raise UsageError(f"--snapshot-limit is {self.limit_mb:g}", fix="give MB above 0, or --no-snapshot")

    @classmethod
    def of(cls, choices: SnapshotChoices) -> SnapshotOptions:
        """Return what the options of a hunt say.

        Raises:
            UsageError: the limit is none.
        """
        limit_mb = choices.snapshot_limit_mb
        return cls(code=choices.snapshot_code, roots=tuple(map(Path, choices.snapshot_roots)), limit_mb=limit_mb)


class Snapshot:
    """A snapshot on disk.

    ``code/`` and ``scenario/``, ``files/`` that arguments name, the ``manifest.json`` with the size and hash of each,
    the resolved ``hunt.toml``, ``environment.json`` and ``git.diff``.

    Args:
        path: of the folder, whose name is its digest.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.digest = path.name

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Return the manifest.

        Raises:
            BundleError: it is missing, damaged or of another version.
        """
        file = self.path / layout.MANIFEST
        try:
            found = read_object(file)
            typed(found, {"schema": int, "paths": list[str], "files": FILES})
            if not 1 <= found["schema"] <= SCHEMA:
                raise BundleError(
                    f"schema {found['schema']} is above {SCHEMA}", fix="use the version that wrote it", where=str(file)
                )
            if found["schema"] >= _PROTECTED or "integrity" in found:
                typed(found, {"integrity": str, "described": FILES})
                said = found.pop("integrity")
                if digest_of_data(found) != said:
                    raise ValueError("it has changed since it was written")
            found.setdefault("argument_files", {})
            typed(found, {"argument_files": dict[str, str]})
            _see_that_all_is_inside(found)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise BundleError(f"the snapshot has no manifest: {reason}", fix=_UNDAMAGED, where=str(self.path)) from None
        return found

    @property
    def has_code(self) -> bool:
        """Whether it holds the code."""
        return bool(self.manifest["paths"])

    @property
    def code(self) -> tuple[str, ...]:
        """The folders whose modules win over installed ones, the first one first."""
        return tuple(str((self.path / place).resolve()) for place in self.manifest["paths"])

    @property
    def argument_files(self) -> dict[str, str]:
        """The files that arguments name: the value of the argument to the file in the snapshot."""
        found = self.manifest["argument_files"]
        return {value: str((self.path / place).resolve()) for value, place in found.items()}

    def scenario(self) -> Scenario:
        """Return the scenario as it was; it is read once."""
        return self._scenario

    @cached_property
    def _scenario(self) -> Scenario:
        return load_scenario(self.path / layout.SCENARIO_FILES / layout.SCENARIO, kept=True)

    def settings(self) -> HuntSettings:
        """Return the settings of the hunt as they were; they are read once."""
        return self._settings

    @cached_property
    def _settings(self) -> HuntSettings:
        return read_settings(self.path / layout.HUNT)

    def environment(self) -> dict[str, Any]:
        """Return what was installed; it is read once.

        Raises:
            BundleError: the file is missing or damaged.
        """
        return self._environment

    @cached_property
    def _environment(self) -> dict[str, Any]:
        file = self.path / layout.ENVIRONMENT
        try:
            found = read_object(file)
            known = {"distributions": dict[str, str], "loaded": list[str]}
            known |= dict.fromkeys(("python", "implementation", "machine", "cpu"), str)
            typed(found, {key: kind for key, kind in known.items() if key in found})
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise BundleError(f"cannot be read: {reason}", fix=_UNDAMAGED, where=str(file)) from None
        return found

    def faults(self) -> list[str]:
        """Return what is not as it was: files that are missing or changed, and modules that were not there.

        What Python compiled by itself is removed first: nobody can tell whether it was made from the code beside it.
        """
        manifest = self.manifest
        found = []
        for name, entry in {**manifest["files"], **manifest.get("described", {})}.items():
            wrong = changed_file(self.path / name, entry)
            if wrong:
                found.append(f"{name} {wrong}")
        digest = digest_of_described(manifest["files"], says=[manifest["paths"], manifest["argument_files"]])
        if digest != self.digest:
            found.append(f"its manifest is that of the snapshot {digest}")
        self.discard_compiled()
        return found + [f"{name} was not there" for name in self._added() if self._may_run(name)]

    def additions(self) -> list[str]:
        """Return the files that were not there and are no modules: an agent may write data beside its code."""
        return [name for name in self._added() if not self._may_run(name)]

    def discard_compiled(self) -> None:
        """Remove what Python compiled, which it would take for the code beside it, whatever is in there."""
        for path in (self.path / layout.CODE).rglob("__pycache__/*.pyc"):
            if path.relative_to(self.path).as_posix() not in self.manifest["files"]:
                with suppress(OSError):  # what cannot be removed is told as added
                    path.unlink()

    def _may_run(self, name: str) -> bool:
        return (self.path / name).is_symlink() or any(name.endswith(suffix) for suffix in _IMPORTABLE)

    def _added(self) -> list[str]:
        there = (
            path.relative_to(self.path).as_posix()
            for part in _PARTS
            for path in (self.path / part).rglob("*")
            if path.is_symlink() or not path.is_dir()
        )
        return sorted(name for name in there if name not in self.manifest["files"])

    def verify(self) -> None:
        """Check that everything is as it was.

        Raises:
            BundleError: with what is not.
        """
        faults = self.faults()
        if faults:
            more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
            raise BundleError(
                f"the snapshot is damaged: {faults[0]}{more}",
                fix="get an undamaged copy of the hunt's directory, or give --force",
                where=str(self.path),
            )


_UNDAMAGED = "get an undamaged copy of the hunt's directory"


def _see_that_all_is_inside(manifest: dict[str, Any]) -> None:
    """See that no name in a manifest leads out of the snapshot."""
    names = [*manifest["files"], *manifest["paths"], *manifest["argument_files"].values()]
    for name in names:
        parts = name.split("/")
        if parts[0] not in _PARTS or not {"", ".", ".."}.isdisjoint(parts) or "\\" in name or "\0" in name:
            raise ValueError(f"the name {name!r} leads out of the snapshot")
    for name in manifest.get("described", {}):
        if name not in _DESCRIBING:
            raise ValueError(f"the name {name!r} is none of its files")
    for entry in (*manifest["files"].values(), *manifest.get("described", {}).values()):
        typed(entry, {"size": int, "blake2b": str})


def latest_snapshot(hunt: Path) -> Snapshot | None:
    """Return the snapshot that a hunt took last; None where it has none."""
    found = sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN), key=lambda path: path.stat().st_mtime)
    return Snapshot(found[-1]) if found else None


def take_snapshot(
    snapshots: Path, scenario: Scenario, settings: HuntSettings, options: SnapshotOptions | None = None
) -> Snapshot:
    """Store the scenario, the agents' own projects, what their arguments name, and crashhunt itself.

    The very same content is stored once.

    Args:
        snapshots: the folder of all snapshots of a hunt.
        scenario: with its agents.
        settings: of the hunt.
        options: what to take in.

    Raises:
        SnapshotError: it is too large, or cannot be read or written.
    """
    options = options or SnapshotOptions()
    building = snapshots / f"{layout.BUILDING}{os.getpid()}"
    found = Sources(paths=[])
    if options.code:
        locators = [setup.agent for setup in scenario.agents.values()]
        modules = [*scenario.modules(), *modules_of(settings.oracles)]
        found = find_sources(locators, modules, roots=options.roots, without=snapshots.parent)
    argument_files = _argument_files(settings) if options.code else {}
    files = found.files | {argument_files[value]: Path(value) for value in argument_files}
    _check_size(files, options.limit_mb)
    try:
        snapshots.mkdir(exist_ok=True)
        shutil.rmtree(building, ignore_errors=True)
        building.mkdir()
        entries = {name: _store(path, building / name) for name, path in files.items()}
        entries |= _store_scenario(scenario, building)
        stored = {name: entry for name, entry in entries.items() if entry is not None}
        manifest = {
            "schema": SCHEMA,
            "paths": found.paths,
            "argument_files": argument_files,
            "left_out": found.left_out,
            "files": stored,
        }
        digest = digest_of_described(stored, says=[found.paths, argument_files])
        final = snapshots / digest
        if final.exists() and not _is_damaged(Snapshot(final)):
            shutil.rmtree(building)
            return Snapshot(final)
        write_settings(building / layout.HUNT, settings, ["crashhunt", "run", "as resolved"])
        facts = {**environment(), "git": _describe_trees(found.trees, building / layout.GIT_DIFF)}
        (building / layout.ENVIRONMENT).write_text(json.dumps(facts, indent=1), encoding="utf-8")
        manifest["described"] = describe_files(building)
        manifest["integrity"] = digest_of_data(manifest)
        (building / layout.MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        sync_tree(building)
        if final.exists():  # what is in it is the same, but for the damage
            shutil.rmtree(final)
        building.rename(final)
        sync_folder(snapshots)
    except OSError as error:
        shutil.rmtree(building, ignore_errors=True)
        raise SnapshotError(
            f"the snapshot cannot be made: {error.strerror or error}",
            fix="free some space, make the file readable, or give --no-snapshot",
            where=str(error.filename or snapshots),
        ) from error
    return Snapshot(final)


def _is_damaged(snapshot: Snapshot) -> bool:
    try:
        return bool(snapshot.faults())
    except BundleError:
        return True


def _argument_files(settings: HuntSettings) -> dict[str, str]:
    """The files that arguments of agents name, such as the weights of a policy, and their place in the snapshot."""
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
                if isinstance(value, str) and value not in found and os.path.isfile(value):  # noqa: PTH113
                    found[value] = f"{layout.FILES}/{len(found)}-{Path(value).name}"
    return found


def _check_size(files: dict[str, Path], limit_mb: float) -> None:
    sizes = {path: _size(path) for path in files.values()}
    total = sum(sizes.values())
    if total > limit_mb * _MEGABYTE:
        largest = sorted(sizes, key=lambda path: -sizes[path])[:3]
        names = ", ".join(f"{path} ({sizes[path] / _MEGABYTE:.3g} MB)" for path in largest)
        raise SnapshotError(
            f"the snapshot would have {total / _MEGABYTE:.3g} MB, above the limit of {limit_mb:g} MB; largest: {names}",
            fix="have git ignore what the agent does not need, raise --snapshot-limit, or give --no-snapshot",
        )


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _store(path: Path, copy: Path) -> dict[str, Any] | None:
    copy.parent.mkdir(parents=True, exist_ok=True)
    try:
        shutil.copy(path, copy)
    except FileNotFoundError:
        return None  # deleted since it was listed
    return {"size": copy.stat().st_size, "blake2b": digest_of_file(copy)}


def _store_scenario(scenario: Scenario, building: Path) -> dict[str, Any]:
    import tomli_w

    entries: dict[str, Any] = {}
    texts = set(scenario.texts())
    relocated = scenario.backend.relocated
    for name in scenario.files():
        place = f"{layout.SCENARIO_FILES}/{name}"
        entries[place] = _store(scenario.folder / name, building / place)
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
    """Write the uncommitted changes of work trees down; return their revisions."""
    revisions = {}
    for tree in trees:
        revision = git(tree, "rev-parse", "HEAD")
        if revision is not None:
            revisions[str(tree)] = revision.decode().strip()
            with diff.open("ab") as file:
                file.write(git(tree, "diff", "HEAD", "--no-ext-diff", "--no-textconv", "--binary") or b"")
    return revisions
