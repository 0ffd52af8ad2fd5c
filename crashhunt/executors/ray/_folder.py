"""The folder of a cluster of the hunt's own, which goes with it, or with the next one where the hunt was killed."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

__all__ = ["Folder"]

_PREFIX, _LOCK = "chr-", "crashhunt.lock"
_LONGEST = 40  # characters of a folder in which Ray can make its sockets


class Folder:
    """A new folder with a short name; those whose owners are gone are removed first.

    Args:
        parent: of it; the folder for temporary files by default, where its name is not too long.
    """

    def __init__(self, parent: Path | None = None) -> None:
        usual = tempfile.gettempdir()
        parent = parent or Path(usual if len(usual) <= _LONGEST else "/tmp")
        for old in parent.glob(f"{_PREFIX}*"):
            _remove_if_left(old)
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        self._lock = (self.path / _LOCK).open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def fileno(self) -> int:
        """Return the descriptor of its lock: whoever inherits it owns the folder as well."""
        return self._lock.fileno()

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()


def _remove_if_left(folder: Path) -> None:
    with suppress(OSError):
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid():
            with (folder / _LOCK).open("r+") as lock:  # without one, it is not of ours, or a moment old
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
