"""The directory of a hunt: its owner, and the lock against a second hunt in it."""

from __future__ import annotations

import fcntl
import os
import shutil
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BusyError, CrashhuntError, HuntDirectoryError
from crashhunt.base.files import cannot_write, whole_file
from crashhunt.base.process_owners import this_process
from crashhunt.base.temporary import remove_ended, remove_scratch, temporary_beside
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import HuntSettings, read_settings, write_settings
from crashhunt.results._hunt_state import is_hunt

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


_DIFFERENCES_SHOWN = 4
# What a hunt writes, `hunt.toml` last: without it the folder is not a hunt's.
_OWN_FILES = (
    "snapshots",
    "crashes",
    *layout.BESIDE,
    "trials",
    layout.LEDGER,
    "ledger.sqlite-wal",
    "ledger.sqlite-shm",
    layout.NOTES,
    layout.HUNT,
)
_PERMITTED_FILES = (".lock", layout.SCRATCH, ".hunt.")  # what may be there before: of a hunt that could not begin


class HuntDirectory:
    """The directory of a hunt, with its lock and scratch folder.

    The directory is created if it does not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._absolute = path.absolute()  # now, because the current folder may be deleted while the hunt runs
        # whether the hunt has begun. Before that, an error deletes a directory that was created for the hunt, and
        # restores the settings of a hunt that was to resume.
        self.has_begun = False
        # settings of a hunt that was to resume; None before `claim`, and for a new hunt
        self.settings_before: HuntSettings | None = None
        self._file_before: bytes | None = None

    @property
    def scratch(self) -> Path:
        """The folder into which running trials write.

        A resumed hunt has another folder, because processes of a killed hunt may still write for a moment.
        """
        return self._absolute / f"{layout.SCRATCH}-{this_process().token}"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the directory against other hunts; the lock ends with this process.

        Raises:
            HuntDirectoryError: the directory is in use, belongs to something else, or cannot be written.
        """
        try:
            is_new = self._make()
            if not (self.path / ".lock").exists():  # leave no file in a foreign folder
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
                    f"another hunt is running in this directory (process {lock.read().strip() or '?'})",
                    fix="wait for it, stop it, or choose another directory",
                    where=str(self.path),
                ) from None
            self._refuse_foreign()
            try:
                lock.truncate(0)
                try:  # without a buffer, which would be written again when the file is closed
                    os.write(lock.fileno(), b"%d" % os.getpid())
                except OSError as error:
                    raise cannot_write(self.path, error) from error
                with temporary_beside(self.path / layout.LEDGER, name=self.scratch.name):
                    yield
            except BaseException:
                if is_new and not self.has_begun:
                    self._remove_own(".lock")
                    with suppress(OSError):
                        self.path.rmdir()
                elif self._file_before is not None and not self.has_begun:
                    with suppress(CrashhuntError, OSError), whole_file(self.path / layout.HUNT) as temporary:
                        temporary.write_bytes(self._file_before)
                raise

    def _make(self) -> bool:
        """Create the directory; return whether it is new."""
        try:
            self.path.mkdir()
        except FileExistsError:
            self.path.mkdir(exist_ok=True)  # raises for a file
            return False
        return True

    def _remove_own(self, *more: str) -> None:
        for name in (*_OWN_FILES, *more):
            if (self.path / name).is_dir():
                shutil.rmtree(self.path / name, ignore_errors=True)
                with suppress(OSError):
                    (self.path / name).rmdir()  # because rmtree opens the folder, which ``ulimit -n`` may refuse
            else:
                (self.path / name).unlink(missing_ok=True)

    def claim(self, settings: HuntSettings, command: list[str], *, overwrite: bool, seed_given: bool) -> HuntSettings:
        """Claim the directory for this hunt, or check that it already has this hunt; return the valid settings.

        A hunt without the result of a trial is replaced. The command line is written to ``hunt.toml`` as a comment.
        Unless the user chose the seed, a resumed hunt keeps its own.

        Raises:
            HuntDirectoryError: the existing hunt has other trials, or the directory cannot be written.
        """
        if overwrite:
            self._remove_own()
        file = self.path / layout.HUNT
        if file.exists():
            before = read_settings(file)
            resumed = settings if seed_given else replace(settings, seed=before.seed)
            # The snapshots show which files of the scenario differ, if there are trials.
            differences = before.differences(replace(resumed, scenario_digest=before.scenario_digest))
            if not differences:
                settings, self.settings_before = resumed, before
            elif not self._has_results():  # the hunt ended before its first trial, often by a mistake in the scenario
                self._remove_own()
            else:
                more = len(differences) - _DIFFERENCES_SHOWN
                shown = "; ".join(differences[:_DIFFERENCES_SHOWN]) + (f"; and {more} more" if more > 0 else "")
                raise HuntDirectoryError(
                    f"the directory contains another hunt: {shown}",
                    fix="give the same settings to resume it, another directory, or --overwrite to begin again",
                    where=str(self.path),
                )
        for left in self.path.glob(f"{layout.SCRATCH}*"):  # with the lock of the hunt, no other hunt uses it
            remove_scratch(left)
        for folder in (self.path, *(self.path / name for name in (layout.CRASHES, *layout.BESIDE))):
            remove_ended(folder)
        try:
            self._file_before = file.read_bytes() if file.exists() else None
            self.scratch.mkdir()
            write_settings(file, settings, command)
        except OSError as error:
            raise self._unusable(error) from error
        return settings

    def _has_results(self) -> bool:
        """Return whether the hunt in the directory has the result of a trial; a damaged ledger counts as results."""
        folders = (layout.CRASHES, layout.TRIALS, *layout.BESIDE)
        if any(path for folder in folders for path in (self.path / folder).glob(layout.SHOWN)):
            return True
        if not has_begun(self.path / layout.LEDGER):
            return any((self.path / layout.SNAPSHOTS).glob(layout.SHOWN))  # which is taken after the ledger exists
        try:
            with closing(Ledger(self.path / layout.LEDGER)) as ledger:
                return bool(ledger.outcomes())
        except HuntDirectoryError:
            return True

    def _refuse_foreign(self) -> None:
        try:
            foreign = sorted(path.name for path in self.path.iterdir() if not path.name.startswith(_PERMITTED_FILES))
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
