"""The folder of a cluster of the hunt's own, which goes with it, or with the next one where the hunt was killed."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import IO

__all__ = ["Folder", "owned", "remove_if_left"]

_PREFIX, _LOCK = "chr-", "crashhunt.lock"
_LONGEST = 40  # characters of a folder in which Ray can make its sockets


class Folder:
    """A new folder with a short name, of letters that Ray knows; those whose owners are gone are removed first.

    Args:
        parent: of it; the folder for temporary files by default, where its name is such.
    """

    def __init__(self, parent: Path | None = None) -> None:
        usual = tempfile.gettempdir()
        parent = parent or Path(usual if len(usual) <= _LONGEST and usual.isascii() else "/tmp")
        for old in parent.glob(f"{_PREFIX}*"):
            remove_if_left(old / _LOCK)
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        self._lock = owned(self.path / _LOCK)

    def fileno(self) -> int:
        """Return the descriptor of its lock: whoever inherits it owns the folder as well."""
        return self._lock.fileno()

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()


def owned(lock: Path) -> IO[str]:
    """Make the lock of a folder, which nobody sees before it is held, and hold it for as long as it is open."""
    part = lock.with_name(f".{lock.name}")
    file = part.open("w")
    fcntl.flock(file, fcntl.LOCK_EX)
    part.rename(lock)
    return file


def remove_if_left(lock: Path) -> None:
    """Remove the folder of a lock that nobody holds; without one, it is not of ours, or a moment old."""
    with suppress(OSError):
        found = lock.parent.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid():
            with lock.open("r+") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.parent, ignore_errors=True)
