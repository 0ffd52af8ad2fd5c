"""The cache of scenarios of maps that hunts name: a scenario is made once, and stored by the contents of the map."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import HuntDirectoryError, ScenarioError
from crashhunt.base.integrity import changed_file, describe_files, digest_of_file
from crashhunt.base.temporary import remove_tree, temporary_beside
from crashhunt.base.version import __version__
from crashhunt.scenario import load_scenario
from crashhunt.sumo.maps._make import MapOptions, make_scenario
from crashhunt.sumo.maps._source import MapSource, check_source, kind_of_file
from crashhunt.sumo.maps._tools import find_tools

if TYPE_CHECKING:
    from crashhunt.scenario import Scenario


_FORMAT = 1
"""Raised where the same map becomes another scenario."""
_COMPLETION_MARK = "made.json"
_MAX_KEPT = 20
"""Maps; a town takes up to 20 MB."""


def load_map(path: Path, ego: str) -> Scenario:
    """Return the scenario of a map. The scenario is made once, and then kept in the user's cache.

    Raises:
        ScenarioError: the map cannot be used, or ``ego`` names a vehicle.
    """
    if ego:
        fix = "omit the option, or make the scenario yourself: crashhunt init DIR"
        raise ScenarioError(f"--ego {ego!r} cannot be used with a map", fix=fix, where=str(path))
    folder = cached_scenario(path)
    scenario = load_scenario(folder)
    note = f"the scenario of {path.name} is {folder}; crashhunt init makes one that you can edit"
    return replace(scenario, name=path.name.partition(".")[0] or path.name, notes=(note, *scenario.notes))


def cached_scenario(path: Path) -> Path:
    """Return the folder of the scenario of a map; the scenario is made if the cache does not contain it.

    Raises:
        ScenarioError: the map cannot be used; the message gives the fix.
        HuntDirectoryError: the cache folder cannot be used.
    """
    kind = kind_of_file(path)
    assert kind is not None
    source = MapSource(kind=kind, path=path)
    check_source(source)
    what = [digest_of_file(path), kind, path.name, find_tools().version, __version__, _FORMAT]
    digest = hashlib.blake2b(json.dumps(what).encode("utf-8", "backslashreplace"), digest_size=16).hexdigest()
    cache = _cache_folder()
    folder = cache / digest
    if _is_whole(folder):
        with suppress(OSError):
            os.utime(folder)
        return folder
    with temporary_beside(folder) as building:
        make_scenario(source, MapOptions(picture=False), building)
        (building / _COMPLETION_MARK).write_text(json.dumps(describe_files(building)), encoding="utf-8")
        _keep(building, folder)
    _remove_old(cache, folder)
    return folder


def _cache_folder() -> Path:
    """Return the cache folder, to which only this user has access.

    Raises:
        HuntDirectoryError: the folder belongs to another user, other users may write into it, or it cannot be created.
    """
    home = os.environ.get("XDG_CACHE_HOME", "")
    fix = "set XDG_CACHE_HOME to a folder of your own, or make the scenario yourself: crashhunt init DIR"
    try:
        base = Path(home) if Path(home).is_absolute() else Path.home() / ".cache"
        folder = base / "crashhunt" / "maps"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.lstat()
    except (OSError, RuntimeError) as error:
        raise HuntDirectoryError(f"the cache of maps cannot be made: {error}", fix=fix) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise HuntDirectoryError("the cache of maps can be written by other users", fix=fix, where=str(folder))
    return folder


def _is_whole(folder: Path) -> bool:
    """Return whether a cached scenario is complete and unchanged."""
    try:
        proof = json.loads((folder / _COMPLETION_MARK).read_text(encoding="utf-8"))
        return bool(proof) and not any(changed_file(folder / name, entry) for name, entry in proof.items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ScenarioError):
        return False


def _keep(building: Path, folder: Path) -> None:
    """Move the new scenario to its final path; if another process was faster, that process's scenario is kept."""
    for _ in range(2):
        try:
            building.rename(folder)
        except OSError:
            if _is_whole(folder):
                return
            remove_tree(folder)  # damaged
        else:
            return
    raise HuntDirectoryError("the cache of maps cannot be written", fix="remove this folder", where=str(folder))


def _remove_old(cache: Path, newest: Path) -> None:
    with suppress(OSError):
        kept = sorted(
            (one for one in cache.iterdir() if not one.name.startswith(".")), key=lambda one: -one.stat().st_mtime
        )
        for old in kept[_MAX_KEPT:]:
            if old != newest:
                remove_tree(old)
