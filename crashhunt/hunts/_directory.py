"""The directory of a hunt: whose it is, and that nobody else hunts in it meanwhile."""

from __future__ import annotations

import fcntl
import os
import shutil
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BusyError, HuntDirectoryError
from crashhunt.base.owners import this_process
from crashhunt.base.temporary import remove_ended, remove_scratch, temporary_beside
from crashhunt.hunts._state import is_hunt
from crashhunt.plans import HuntSettings, read_settings, write_settings

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["HuntDirectory"]

_DIFFERENCES_SHOWN = 4
# What a hunt writes, `hunt.toml` last: without it the folder is not a hunt's.
_OWN = (
    "snapshots",
    "crashes",
    *layout.BESIDE,
    "trials",
    layout.LEDGER,
    "ledger.sqlite-wal",
    "ledger.sqlite-shm",
    layout.HUNT,
)
_SCRATCH = ".scratch"
_BEFORE = (".lock", _SCRATCH, ".hunt.")  # what may be there before: of a hunt that could not begin


class HuntDirectory:
    """A directory to hunt in.

    Args:
        path: of it; it is made where it does not exist, its parents are not.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def scratch(self) -> Path:
        """Where running trials write, wherever their process goes meanwhile.

        A hunt that resumes has another folder: processes of one that was killed may still be writing for a moment.
        """
        return self.path.absolute() / f"{_SCRATCH}-{this_process().token}"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other hunts out, by a lock that dies with this process.

        Raises:
            HuntDirectoryError: the directory is busy, foreign or unwritable.
        """
        try:
            self.path.mkdir(exist_ok=True)
            if not (self.path / ".lock").exists():  # nothing is left behind in a folder of somebody else's
                self._refuse_foreign()
            lock = (self.path / ".lock").open("a+")
        except OSError as error:
            raise self._unusable(error) from error
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.seek(0)
                raise BusyError(
                    f"another hunt is running there (process {lock.read().strip() or '?'})",
                    fix="wait for it, stop it, or choose another directory",
                    where=str(self.path),
                ) from None
            self._refuse_foreign()
            lock.truncate(0)
            lock.write(str(os.getpid()))
            lock.flush()
            with temporary_beside(self.path / layout.LEDGER, name=self.scratch.name):
                yield

    def claim(self, settings: HuntSettings, command: list[str], *, overwrite: bool, seed_given: bool) -> HuntSettings:
        """Make the directory this hunt's, or see that it is already; return the settings that hold.

        Args:
            settings: what was asked.
            command: the command line, as a comment in ``hunt.toml``.
            overwrite: begin anew, whatever is there.
            seed_given: whether the seed was asked for; if not, a resumed hunt keeps its own.

        Raises:
            HuntDirectoryError: the hunt that is there makes other trials, or the directory is unwritable.
        """
        if overwrite:
            for name in _OWN:
                if (self.path / name).is_dir():
                    shutil.rmtree(self.path / name, ignore_errors=True)
                else:
                    (self.path / name).unlink(missing_ok=True)
        file = self.path / layout.HUNT
        if file.exists():
            before = read_settings(file)
            if not seed_given:
                settings = replace(settings, seed=before.seed)
            differences = before.differences(settings)
            if differences:
                more = len(differences) - _DIFFERENCES_SHOWN
                shown = "; ".join(differences[:_DIFFERENCES_SHOWN]) + (f"; and {more} more" if more > 0 else "")
                raise HuntDirectoryError(
                    f"another hunt is there: {shown}",
                    fix="give the same settings to go on with it, another directory, or --overwrite to begin anew",
                    where=str(self.path),
                )
        for left in self.path.glob(f"{_SCRATCH}*"):  # with the lock of the hunt, no other hunt uses it
            remove_scratch(left)
        for folder in (self.path, *(self.path / name for name in (layout.CRASHES, *layout.BESIDE))):
            remove_ended(folder)
        try:
            self.scratch.mkdir()
            write_settings(file, settings, command)
        except OSError as error:
            raise self._unusable(error) from error
        return settings

    def _refuse_foreign(self) -> None:
        try:
            foreign = sorted(path.name for path in self.path.iterdir() if not path.name.startswith(_BEFORE))
        except OSError as error:
            raise self._unusable(error) from error
        if foreign and not is_hunt(self.path):
            raise HuntDirectoryError(
                f"the folder is not empty and not a hunt: it has {foreign[0]!r}",
                fix="give an empty or a new folder",
                where=str(self.path),
            )

    def _unusable(self, error: OSError) -> HuntDirectoryError:
        if isinstance(error, FileExistsError):
            return HuntDirectoryError(f"{str(self.path)!r} is a file", fix="give a new or an empty folder")
        return HuntDirectoryError(
            f"the directory cannot be used: {error.strerror}",
            fix="choose one below a folder that exists and is writable",
            where=str(error.filename or self.path),
        )
