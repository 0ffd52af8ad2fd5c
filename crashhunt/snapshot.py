"""Snapshots: the code and the scenario that a hunt ran, kept beside its crashes and addressed by content."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.errors import BundleError, HuntDirectoryError
from crashhunt.plugins import locate
from crashhunt.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

__all__ = ["Snapshot", "scenario_digest", "take_snapshot", "versions"]

_SKIPPED = {"__pycache__", ".git", ".venv", ".mypy_cache", ".ruff_cache", ".pytest_cache"}
_VERSIONED = ("crashhunt", "libsumo", "gymnasium", "numpy", "highway-env")


class Snapshot:
    """A snapshot on disk: ``code/``, ``scenario/``, ``manifest.json``, ``environment.json``, ``git.diff``.

    Args:
        path: of the folder, whose name is its digest.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.digest = path.name

    @property
    def code(self) -> Path:
        """The folder whose modules win over installed ones."""
        return self.path / "code"

    def scenario(self) -> Scenario:
        """Return the scenario as it was."""
        return load_scenario(self.path / "scenario" / "scenario.toml")

    def environment(self) -> dict[str, Any]:
        """Return what was installed."""
        try:
            found: dict[str, Any] = json.loads((self.path / "environment.json").read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise BundleError(f"cannot be read: {error}", where=str(self.path / "environment.json")) from None
        return found

    def verify(self) -> None:
        """Check that every file is as it was.

        Raises:
            BundleError: with the first file that is missing, changed or new.
        """
        fix = "get an undamaged copy of the hunt's directory"
        try:
            manifest = json.loads((self.path / "manifest.json").read_text(encoding="utf-8"))["files"]
        except (OSError, ValueError, KeyError) as error:
            raise BundleError(f"the snapshot has no manifest: {error}", fix=fix, where=str(self.path)) from None
        present = {path.relative_to(self.path).as_posix(): path for path in _files(self.path, ("code", "scenario"))}
        for name, entry in manifest.items():
            if name not in present:
                raise BundleError("missing from the snapshot", fix=fix, where=str(self.path / name))
            if _hash(present[name]) != entry["blake2b"]:
                raise BundleError("changed since the snapshot was taken", fix=fix, where=str(self.path / name))
        for name in present.keys() - manifest.keys():
            raise BundleError("not part of the snapshot", fix="remove it", where=str(self.path / name))


def take_snapshot(snapshots: Path, scenario: Scenario) -> Snapshot:
    """Store the scenario, the agents' own code and crashhunt itself, unless the very same is there already.

    The agents' own code is the top-level package or module of each, and whatever else they imported from the folder
    in which that lies.

    Args:
        snapshots: the folder of all snapshots.
        scenario: with its agents.

    Raises:
        HuntDirectoryError: the folder cannot be written.
    """
    building = snapshots / f".building-{os.getpid()}"
    try:
        snapshots.mkdir(exist_ok=True)
        shutil.rmtree(building, ignore_errors=True)
        roots = _copy_code((setup.agent for setup in scenario.agents.values()), building / "code")
        _copy_scenario(scenario, building / "scenario")
        files = {
            path.relative_to(building).as_posix(): {"size": path.stat().st_size, "blake2b": _hash(path)}
            for path in _files(building, ("code", "scenario"))
        }
        digest = _digest(files)
        (building / "manifest.json").write_text(json.dumps({"schema": 1, "files": files}, indent=1), encoding="utf-8")
        revision = {str(root): _git(root, building / "git.diff") for root in roots}
        environment = {**_environment(), "git": {root: found for root, found in revision.items() if found}}
        (building / "environment.json").write_text(json.dumps(environment, indent=1), encoding="utf-8")
        final = snapshots / digest
        if final.exists():
            shutil.rmtree(building)
        else:
            building.rename(final)
    except OSError as error:
        shutil.rmtree(building, ignore_errors=True)
        raise HuntDirectoryError(
            f"the snapshot cannot be written: {error.strerror or error}",
            fix="free some space or choose another directory",
            where=str(error.filename or snapshots),
        ) from error
    return Snapshot(final)


def scenario_digest(scenario: Scenario) -> str:
    """Return a digest of the scenario's files and of what it says, whoever drives in it."""
    files = {name: {"blake2b": _hash(scenario.folder / name)} for name in scenario.files()}
    says = _as_dict(scenario)
    del says["agents"]
    return _digest({**files, "": {"blake2b": json.dumps(says, sort_keys=True)}})


def _digest(files: dict[str, Any]) -> str:
    text = json.dumps({name: entry["blake2b"] for name, entry in files.items()}, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def _files(folder: Path, parts: Iterable[str]) -> Iterator[Path]:
    for part in parts:
        for path in sorted((folder / part).rglob("*")):
            if path.is_file() and not _SKIPPED.intersection(path.relative_to(folder).parts):
                yield path


def _copy_scenario(scenario: Scenario, target: Path) -> None:
    import tomli_w

    for name in scenario.files():
        copy = target / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(scenario.folder / name, copy)
    target.mkdir(parents=True, exist_ok=True)
    text = "# The scenario as it was resolved for this hunt.\n" + tomli_w.dumps(_as_dict(scenario))
    (target / "scenario.toml").write_text(text, encoding="utf-8")


def _as_dict(scenario: Scenario) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items() if item is not None}
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    data: dict[str, Any] = plain(asdict(replace(scenario, folder=Path())))
    return {key: value for key, value in data.items() if key not in ("folder", "notes")}


def _copy_code(locators: Iterable[str], target: Path) -> list[Path]:
    """Copy the code; return the folders that it came from."""
    target.mkdir(parents=True)
    roots: list[Path] = []
    names = {"crashhunt"}
    for locator in locators:
        names.add(locate("agents", locator).__module__.partition(".")[0])
    installed = {Path(path).resolve() for path in sysconfig.get_paths().values()}
    for name in sorted(names):
        root = _place_of(name)
        if root is None:
            continue
        if root not in roots:
            roots.append(root)
        if root not in installed and name != "crashhunt":
            # What the agent imported from beside itself; site-packages is everybody's, and recorded by version.
            names = names | {other for other in _top_level_modules() if _place_of(other) == root}
    for name in sorted(names):
        _copy_module(name, target)
    return roots


def _top_level_modules() -> set[str]:
    return {name.partition(".")[0] for name in list(sys.modules)}


def _place_of(name: str) -> Path | None:
    """The folder in which a top-level module or package lies."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if name == "__main__" or file is None:
        paths = list(getattr(module, "__path__", ()))  # a package without __init__.py
        return Path(paths[0]).resolve().parent if len(paths) == 1 else None
    path = Path(file).resolve()
    return path.parent.parent if path.stem == "__init__" else path.parent


def _copy_module(name: str, target: Path) -> None:
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    paths = list(getattr(module, "__path__", ()))
    if paths:
        shutil.copytree(paths[0], target / name, ignore=shutil.ignore_patterns(*_SKIPPED, "*.pyc"), dirs_exist_ok=True)
    elif file is not None:
        shutil.copyfile(file, target / Path(file).name)


def _environment() -> dict[str, Any]:
    distributions = {dist.metadata["Name"]: dist.version for dist in metadata.distributions() if dist.metadata["Name"]}
    relevant = ("PYTHONHASHSEED", "PYTHONPATH", "SUMO_HOME", "OMP_NUM_THREADS", "VIRTUAL_ENV")
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "versions": versions(),
        "distributions": dict(sorted(distributions.items(), key=lambda item: item[0].lower())),
        "variables": {name: os.environ[name] for name in relevant if name in os.environ},
    }


def versions() -> dict[str, str]:
    """Return the versions on which a result depends."""
    found = {"python": platform.python_version()}
    for name in _VERSIONED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _git(root: Path, diff: Path) -> str:
    """Append the work tree's changes to ``diff`` and return its revision; nothing where it is not one."""

    def git(*arguments: str) -> bytes:
        command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
        done = subprocess.run(command, capture_output=True, check=False, timeout=30)
        return done.stdout if done.returncode == 0 else b""

    try:
        revision = git("rev-parse", "HEAD").decode().strip()
        if revision:
            with diff.open("ab") as file:
                file.write(git("diff", "HEAD", "--no-ext-diff", "--binary", "--", "."))
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return revision
