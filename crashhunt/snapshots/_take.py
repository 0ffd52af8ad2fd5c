"""Taking a snapshot: the code, the scenario and the files of a hunt, copied and addressed by content."""

from __future__ import annotations

import json
import os
import shutil
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import BundleError, SnapshotError, UsageError
from crashhunt.base.files import put_in_place, sync_folder, sync_tree
from crashhunt.base.integrity import (
    describe_files,
    digest_of_content,
    digest_of_data,
    digest_of_file,
)
from crashhunt.base.owners import this_process
from crashhunt.base.temporary import remove_ended, temporary_beside
from crashhunt.oracles import modules_of
from crashhunt.plans import HuntSettings, SnapshotChoices, core_of, load_order_of, write_settings
from crashhunt.scenario import Scenario, as_plain_data, digest_of_described
from crashhunt.snapshots._environment import environment
from crashhunt.snapshots._sources import Sources, find_sources, git
from crashhunt.trial import Choice, Constant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.integrity import FileEntry
    from crashhunt.snapshots._data import Environment, Manifest

from crashhunt.snapshots._snapshot import SCHEMA, Snapshot, code_of_manifest

__all__ = ["SnapshotOptions", "take_snapshot"]

_MEGABYTE = 10**6
_SMALL = 1 << 20  # bytes


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
        remove_ended(snapshots)
        with temporary_beside(snapshots / layout.MANIFEST, name=f"{layout.BUILDING}{this_process().token}") as building:
            return _build(building, files, found, argument_files, scenario, settings)
    except OSError as error:
        raise SnapshotError(
            f"the snapshot cannot be made: {error.strerror or error}",
            fix="free some space, make the file readable, or give --no-snapshot",
            where=str(error.filename or snapshots),
        ) from error


def _build(
    building: Path,
    files: dict[str, Path],
    found: Sources,
    argument_files: dict[str, str],
    scenario: Scenario,
    settings: HuntSettings,
) -> Snapshot:
    """Copy everything into a folder, and give that the name of its digest; nothing where it is there already."""
    building.mkdir()
    for folder in {name.rpartition("/")[0] for name in files}:
        (building / folder).mkdir(parents=True, exist_ok=True)
    entries = {name: _store(path, building / name) for name, path in files.items()}
    entries |= _store_scenario(scenario, building)
    stored = {name: entry for name, entry in entries.items() if entry is not None}
    manifest: Manifest = {
        "schema": SCHEMA,
        "paths": found.paths,
        "argument_files": argument_files,
        "left_out": found.left_out,
        "files": stored,
    }
    digest = digest_of_described(stored, says=[found.paths, argument_files])
    final = building.with_name(digest)
    # The digest is too short to prove that two snapshots are the same, so use only a snapshot of this user.
    if final.exists() and not _is_damaged(Snapshot(final)) and Snapshot(final).is_made_here:
        return Snapshot(final)
    write_settings(building / layout.HUNT, settings, ["crashhunt", "run", "as resolved"])
    facts: Environment = {**environment(), "git": _describe_trees(found.trees, building / layout.GIT_DIFF)}
    if (core := core_of(scenario, settings.run)) is not None:
        facts["core"] = core
    if (load_order := load_order_of(scenario)) is not None:
        facts["load_order"] = load_order
    (building / layout.ENVIRONMENT).write_text(json.dumps(facts, indent=1), encoding="utf-8")
    manifest["described"] = describe_files(building)
    manifest["authentication_code"] = code_of_manifest(manifest)
    manifest["integrity"] = digest_of_data(manifest)
    (building / layout.MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    sync_tree(building)
    put_in_place(building, final)  # what is there already is the same, but for damage and the user who took it
    sync_folder(final.parent)
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


def _store(path: Path, copy: Path) -> FileEntry | None:
    """Copy a file, and whether it can be run; None where it has been deleted since it was listed."""
    try:
        with open(path, "rb", buffering=0) as file:
            status = os.fstat(file.fileno())
            content = file.readall() if status.st_size < _SMALL else None
        if content is None:
            shutil.copy(path, copy)
            return {"size": copy.stat().st_size, "blake2b": digest_of_file(copy)}
    except FileNotFoundError:
        return None
    # There are hundreds of modules: to copy each and to read it again would take most of a hunt's start.
    with open(copy, "wb") as file:  # and a Path takes twice as long
        file.write(content)
        os.fchmod(file.fileno(), stat.S_IMODE(status.st_mode))
    return {"size": len(content), "blake2b": digest_of_content(content)}


def _store_scenario(scenario: Scenario, building: Path) -> dict[str, FileEntry | None]:
    import tomli_w

    entries: dict[str, FileEntry | None] = {}
    texts = set(scenario.texts())
    relocated = scenario.backend.relocated
    for name in scenario.files():
        place = f"{layout.SCENARIO_FILES}/{name}"
        (building / place).parent.mkdir(parents=True, exist_ok=True)
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
