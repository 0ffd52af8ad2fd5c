"""The conditions on this machine under which trials can run: folders that exist, and disks with free space.

If such a condition no longer holds, every agent may fail, so the failure of a trial is no evidence about the agent. A
process without foreign code therefore checks the conditions after each trial that fails. The hunt ends with the reason,
does not record the trial, and runs the trial again when it resumes.

Only a change since the beginning of the hunt counts. An agent that deletes its own temporary folder, or changes the
environment variable ``TMPDIR`` in its own process, changes none of these conditions.
"""

from __future__ import annotations

import os
import time
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, HostError
from crashhunt.base.temporary import folder_for_temporary_files
from crashhunt.base.text import command_line

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings

_MIN_FREE_BYTES: Final = 1 << 20
"""With less free space on a disk, it counts as full: no recording of a trial fits."""
_AGAIN: Final = "and run the same command again: the trials that failed because of it run again"
_REMOVAL_S: Final = 1.0
"""Time in which a removed folder disappears after its first file, in s."""
_CURRENT, _TEMPORARY = "the current folder of the command", "the folder for temporary files (TMPDIR)"


class _Folder(NamedTuple):
    """A folder that trials need, with its state when the hunt began."""

    name: str
    path: Path
    rights: int
    had_space: bool


class HostConditions:
    """The conditions under which the trials of a hunt run, as they are when this object is created."""

    def __init__(self, settings: WorkerSettings) -> None:
        hunt = next((path.parent for path in settings.scratch.parents if path.name.startswith(layout.SCRATCH)), None)
        if settings.scratch.name.startswith(layout.SCRATCH):
            hunt = settings.scratch.parent
        named = {
            _CURRENT: _current_folder(),
            _TEMPORARY: folder_for_temporary_files(),
            "the directory of the hunt" if hunt else "the folder for recordings": hunt or settings.scratch.parent,
        }
        self._folders = [_folder(name, path) for name, path in named.items() if path is not None]
        snapshot = Path(settings.scenario.folder).parent
        self._snapshot = snapshot if (snapshot / layout.MANIFEST).is_file() else None

    def check(self) -> None:
        """Check all conditions after a failure; this takes a few microseconds for each file of the snapshot.

        Raises:
            HostError: a condition no longer holds.
        """
        for folder in self._folders:
            _check_folder(folder)
        if _current_folder() is None:
            raise HostError(
                f"{_CURRENT} was deleted while trials ran, and another folder has its name now",
                fix=f"enter the new folder, {_AGAIN}",
                where=str(self._folders[0].path),
            )
        for path in self._files:
            self._check_file(path)

    def check_hunt(self) -> None:
        """Check that the directory of the hunt and its snapshot still exist, even if no trial fails.

        Raises:
            HostError: the directory or the manifest of the snapshot was deleted.
        """
        if not self._folders[-1].path.is_dir():
            _check_folder(self._folders[-1])
        if self._snapshot is not None:
            self._check_file(self._snapshot / layout.MANIFEST)

    def _check_file(self, path: Path) -> None:
        if not os.path.lexists(path):
            time.sleep(_REMOVAL_S)  # `rm -r` of a whole hunt deletes the files of its snapshot first
            for folder in self._folders:
                _check_folder(folder)
            fix = _AGAIN.removeprefix("and ")
            if self._snapshot is not None and self._snapshot.exists():
                fix = f"delete its folder with {command_line('rm', '-r', self._snapshot)}, {_AGAIN}"
            raise HostError("a file of the snapshot was deleted while trials ran", fix=fix, where=str(path))

    @cached_property
    def _files(self) -> list[Path]:
        """The files of the snapshot."""
        from crashhunt.snapshots import Snapshot

        if self._snapshot is None:
            return []
        try:
            return [self._snapshot / name for name in Snapshot(self._snapshot).manifest["files"]]
        except BundleError:
            return [self._snapshot / layout.MANIFEST]


def _folder(name: str, path: Path) -> _Folder:
    rights = sum(right for right in (os.R_OK, os.W_OK, os.X_OK) if os.access(path, right))
    return _Folder(name, path, rights, _has_space(path))


def _check_folder(folder: _Folder) -> None:
    if not folder.path.is_dir():
        raise _refusal(folder.name, "was deleted or moved", folder.path)
    if not os.access(folder.path, folder.rights):
        raise _refusal(folder.name, "was made inaccessible", folder.path)
    if folder.had_space and not _has_space(folder.path):
        raise HostError(f"the disk of {folder.name} is full", fix=f"free some space, {_AGAIN}", where=str(folder.path))


def _refusal(name: str, problem: str, path: Path) -> HostError:
    return HostError(f"{name} {problem} while trials ran", fix=f"restore it, {_AGAIN}", where=str(path))


def _current_folder() -> Path | None:
    """Return the current folder of this process; None if it was deleted."""
    try:
        return Path.cwd()
    except OSError:  # the kernel knows that the folder was deleted, even if there is another one with its name
        return None


def _has_space(path: Path) -> bool:
    """Return whether a disk has free space and can hold one more file."""
    try:
        found = os.statvfs(path)
    except OSError:
        return False
    has_inodes = found.f_favail > 0 or not found.f_files  # some file systems do not count files
    return found.f_bavail * found.f_frsize >= _MIN_FREE_BYTES and has_inodes
