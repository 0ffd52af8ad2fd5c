"""Snapshots: code, scenario and environment of a hunt, stored in its directory under the digest of their content."""

from __future__ import annotations

import hashlib
import importlib.machinery
import json
import os
import shutil
from contextlib import suppress
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NotRequired, TypedDict

from crashhunt.base import layout
from crashhunt.base.codec import typed_where_there
from crashhunt.base.errors import BundleError
from crashhunt.base.integrity import (
    FILES,
    FileEntry,
    authentication_code,
    changed_file,
    describe_files,
    digest_of_data,
    is_authentic,
    parse_object,
    read_bounded,
    read_object,
    typed,
)
from crashhunt.base.older_versions import HOW_TO_READ
from crashhunt.plans import HuntSettings, read_settings
from crashhunt.scenario import Scenario, digest_of_described, load_scenario
from crashhunt.snapshots._environment import Environment, environment_of_simulation


class Manifest(TypedDict):
    """The contents of ``manifest.json``: the files of a snapshot, and the folders from which modules are imported.

    ``described`` lists the files that describe the snapshot and do not belong to its digest. ``conditions`` are
    further facts on which trials depend. With ``--no-snapshot``, they are the digests of the files of the code. They
    may also be the versions that distinguish the snapshot from another snapshot of the same files.
    ``authentication_code`` proves to the user who took the snapshot that it is unchanged.
    """

    schema: int
    paths: list[str]
    argument_files: dict[str, str]
    left_out: list[str]
    files: dict[str, FileEntry]
    described: dict[str, FileEntry]
    authentication_code: NotRequired[str]
    integrity: NotRequired[str]
    conditions: NotRequired[dict[str, str]]


SCHEMA = 1
_VERSION_FIX = "use the version of crashhunt that wrote the trial"
_MAX_OLDER_SCHEMA = 3  # from before format version 1, as schema 1 without ``integrity``
_DESCRIPTION_FILES = (layout.HUNT, layout.ENVIRONMENT, layout.GIT_DIFF)
_SNAPSHOT_FOLDERS = (layout.CODE, layout.FILES, layout.SCENARIO_FILES)
# Suffixes of files that Python may import, or run at its start.
_IMPORTABLE_SUFFIXES = {".py", ".pyc", ".pyo", ".so", ".pth", *importlib.machinery.all_suffixes()}


class Snapshot:
    """A snapshot that is stored on disk.

    A snapshot has the folders ``code/``, ``scenario/`` and ``files/``, which contains the files that arguments name.
    The file ``manifest.json`` contains the size and hash of each file. The files ``hunt.toml``, ``environment.json``
    and ``git.diff`` describe the snapshot.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.digest = path.name

    @cached_property
    def manifest(self) -> Manifest:
        """Return the contents of the manifest.

        Raises:
            BundleError: the manifest is missing, damaged or of another version.
        """
        file = self.path / layout.MANIFEST
        try:
            return _parse_manifest(read_bounded(file))
        except _UnsupportedError as error:
            message, fix = error.args
            raise BundleError(message, fix=fix, where=str(file)) from None
        except (OSError, ValueError) as error:
            if not self.path.exists():  # such as for a crash that was copied outside its hunt
                fix = "copy the whole directory of the hunt, or write the crash into a file with crashhunt export"
                raise BundleError("the snapshot is missing", fix=fix, where=str(self.path)) from None
            reason = error.strerror if isinstance(error, OSError) else error
            raise BundleError(
                f"the snapshot has no manifest: {reason}", fix=_DAMAGE_FIX, where=str(self.path)
            ) from None

    @property
    def has_code(self) -> bool:
        """Whether the snapshot contains the code."""
        return bool(self.manifest["paths"])

    @property
    def conditions(self) -> dict[str, str]:
        """The facts besides the files on which trials depend, see `Manifest`."""
        return self.manifest.get("conditions", {})

    @property
    def is_described(self) -> bool:
        """Whether the snapshot contains the code, or at least its digests."""
        return self.has_code or any("/" in name for name in self.conditions)

    @property
    def code(self) -> tuple[str, ...]:
        """The folders whose modules take precedence over installed modules, the first folder first."""
        return tuple(str((self.path / place).resolve()) for place in self.manifest["paths"])

    @property
    def argument_files(self) -> dict[str, str]:
        """The files that arguments name: path in the snapshot by value of the argument."""
        found = self.manifest["argument_files"]
        return {value: str((self.path / place).resolve()) for value, place in found.items()}

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario that the snapshot contains."""
        return load_scenario(self.path / layout.SCENARIO_FILES / layout.SCENARIO, kept=True)

    @cached_property
    def settings(self) -> HuntSettings:
        """The settings of the hunt that the snapshot contains."""
        return read_settings(self.path / layout.HUNT)

    @cached_property
    def environment(self) -> Environment:
        """The recorded environment.

        Raises:
            BundleError: the file is missing or damaged.
        """
        file = self.path / layout.ENVIRONMENT
        try:
            found = read_object(file, Environment)
            known: dict[str, object] = {"distributions": dict[str, str], "loaded": list[str]}
            known |= dict.fromkeys(("python", "implementation", "machine", "cpu", "simd"), str)
            typed_where_there(found, known)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise BundleError(f"cannot be read: {reason}", fix=_DAMAGE_FIX, where=str(file)) from None
        return found

    @property
    def is_made_here(self) -> bool:
        """Return whether this user took the snapshot on this machine; `faults` returns later changes of its files.

        Raises:
            BundleError: the manifest is missing or damaged.
        """
        manifest = self.manifest
        return is_authentic("snapshot", _authenticated(manifest), manifest.get("authentication_code"))

    def fingerprint(self) -> str:
        """Return the SHA-256 of everything that would run, in hexadecimal; it is equal for all users.

        Raises:
            BundleError: the manifest is missing or damaged.
        """
        found = hashlib.sha256(json.dumps(_authenticated(self.manifest), sort_keys=True).encode())
        for name in (layout.HUNT, layout.ENVIRONMENT):  # the manifests of the earliest versions do not list these files
            content = b""
            with suppress(OSError, ValueError):
                content = read_bounded(self.path / name)
            found.update(len(content).to_bytes(8, "little") + content)
        return found.hexdigest()

    def changes(self) -> list[str]:
        """Return the faults of the files that the manifest lists: missing and changed files. Nothing is written."""
        manifest = self.manifest
        found = []
        for name, entry in {**manifest["files"], **manifest["described"]}.items():
            wrong = changed_file(f"{self.path}/{name}", entry)  # hundreds of files, and a Path takes as long again
            if wrong:
                found.append(f"{name} {wrong}")
        digest = digest_of_manifest(manifest)
        if digest != self.digest:
            found.append(f"its manifest is that of the snapshot {digest}")
        return found

    def faults(self) -> list[str]:
        """Return the faults of the snapshot: missing files, changed files, and added modules.

        The method first removes compiled files, because they may not match the source files next to them.
        """
        found = self.changes()
        self.discard_compiled()
        return found + [f"{name} was not there" for name in self._added() if self._is_module(name)]

    def additions(self) -> list[str]:
        """Return the added files that are not modules; an agent may write data into its folder."""
        return [name for name in self._added() if not self._is_module(name)]

    def discard_compiled(self) -> None:
        """Delete compiled files, which Python would run instead of the source files next to them."""
        for parent, _, files in os.walk(self.path / layout.CODE):
            if os.path.basename(parent) == "__pycache__":  # noqa: PTH119 - hundreds of folders
                for path in (Path(parent, name) for name in files if name.endswith(".pyc")):
                    if path.relative_to(self.path).as_posix() not in self.manifest["files"]:
                        with suppress(OSError):  # `faults` then reports the file as added
                            path.unlink()

    def _is_module(self, name: str) -> bool:
        return (self.path / name).is_symlink() or may_run(name)

    def _added(self) -> list[str]:
        found = []
        for part in _SNAPSHOT_FOLDERS:
            for parent, folders, files in os.walk(self.path / part):
                below = Path(parent).relative_to(self.path).as_posix()
                links = [name for name in folders if os.path.islink(os.path.join(parent, name))]  # noqa: PTH114, PTH118
                found += [f"{below}/{name}" for name in (*files, *links)]
        return sorted(name for name in found if name not in self.manifest["files"])

    def verify(self, *, to_run: bool = True) -> None:
        """Check that the snapshot is unchanged.

        If the code is to run, added modules are faults, and compiled files are deleted.

        Raises:
            BundleError: The snapshot has changed; the message names the first fault.
        """
        faults = self.faults() if to_run else self.changes()
        if faults:
            more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
            raise BundleError(
                f"the snapshot is damaged: {faults[0]}{more}",
                fix="get an undamaged copy of the hunt's directory; or run crashhunt replay --force --trust",
                where=str(self.path),
            )


def may_run(name: str) -> bool:
    """Return whether Python may import a file, or run it at its start, by the file's name."""
    return name.endswith(tuple(_IMPORTABLE_SUFFIXES))


class _UnsupportedError(Exception):
    """The manifest is of another version. The arguments are the message and the fix."""


@lru_cache(maxsize=4)
def _parse_manifest(text: bytes) -> Manifest:
    """Return the contents of a manifest, which callers must not change.

    A command makes many `Snapshot` objects of one snapshot, and each checks hundreds of entries.
    """
    found = parse_object(text, Manifest)
    typed(found, {"schema": int, "paths": list[str], "files": FILES})
    if 1 < found["schema"] <= _MAX_OLDER_SCHEMA or (found["schema"] == SCHEMA and "integrity" not in found):
        raise _UnsupportedError("the snapshot is older than format version 1", HOW_TO_READ)
    if found["schema"] != SCHEMA:
        raise _UnsupportedError(
            f"schema version {found['schema']} is not supported (supported: {SCHEMA})", _VERSION_FIX
        )
    typed(found, {"integrity": str, "described": FILES})
    said = found.pop("integrity")
    if digest_of_data(found) != said:
        raise ValueError("the file has changed since it was written")
    found.setdefault("argument_files", {})
    typed(
        found, {"argument_files": dict[str, str], **({"conditions": dict[str, str]} if "conditions" in found else {})}
    )
    _check_names(found)
    return found


def digest_of_manifest(manifest: Manifest) -> str:
    """Return the digest of a snapshot, which is the name of its folder."""
    conditions = manifest.get("conditions")
    more = [conditions] if conditions else []
    return digest_of_described(manifest["files"], plain_data=[manifest["paths"], manifest["argument_files"], *more])


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a snapshot, with its descriptions and an authentication code that covers all files."""
    manifest["described"] = describe_files(folder)
    manifest["authentication_code"] = authentication_code("snapshot", _authenticated(manifest))
    manifest["integrity"] = digest_of_data(manifest)
    (folder / layout.MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")


def _authenticated(manifest: Manifest) -> dict[str, object]:
    return {name: value for name, value in manifest.items() if name not in ("authentication_code", "integrity")}


_DAMAGE_FIX = "get an undamaged copy of the hunt's directory"


def _check_names(manifest: Manifest) -> None:
    """Raise ValueError if a name in a manifest leads out of the snapshot's folder."""
    names = [*manifest["files"], *manifest["paths"], *manifest["argument_files"].values()]
    for name in names:
        parts = name.split("/")
        if parts[0] not in _SNAPSHOT_FOLDERS or not {"", ".", ".."}.isdisjoint(parts) or "\\" in name or "\0" in name:
            raise ValueError(f"the path {name!r} leads out of the snapshot")
    for name in manifest["described"]:
        if name not in _DESCRIPTION_FILES:
            raise ValueError(f"the snapshot has no file {name!r}")
    for entry in (*manifest["files"].values(), *manifest["described"].values()):
        typed(entry, {"size": int, "blake2b": str})


def latest_snapshot(hunt: Path) -> Snapshot | None:
    """Return the latest snapshot of a hunt; None if the hunt has none."""
    found = sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN), key=lambda path: path.stat().st_mtime)
    return Snapshot(found[-1]) if found else None


# A snapshot without code: the scenario alone, to be run with the current code.


def without_code(snapshot: Snapshot, snapshots: Path) -> Snapshot:
    """Copy a snapshot without its code: the scenario with its files, the settings and the environment.

    The caller need not verify the snapshot.

    Raises:
        BundleError: A file of the snapshot is missing or has changed.
        OSError: The copy cannot be written.
    """
    kept = {
        name: entry
        for name, entry in snapshot.manifest["files"].items()
        if name.startswith(f"{layout.SCENARIO_FILES}/")
    }
    digest = digest_of_described(kept, plain_data=[[], {}])
    final = snapshots / digest
    (final / layout.SCENARIO_FILES).mkdir(parents=True)
    for name, entry in kept.items():
        wrong = changed_file(snapshot.path / name, entry)
        if wrong:
            fix = "get an undamaged copy of the hunt's directory"
            raise BundleError(f"the snapshot is damaged: {name} {wrong}", fix=fix, where=str(snapshot.path))
        (final / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(snapshot.path / name, final / name)
    shutil.copyfile(snapshot.path / layout.HUNT, final / layout.HUNT)
    environment = json.dumps(environment_of_simulation(snapshot.environment), indent=1)
    (final / layout.ENVIRONMENT).write_text(environment, encoding="utf-8")
    manifest: Manifest = {
        "schema": SCHEMA,
        "paths": [],
        "argument_files": {},
        "left_out": [],
        "files": kept,
        "described": {},
    }
    write_manifest(final, manifest)
    return Snapshot(final)
