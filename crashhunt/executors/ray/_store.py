"""What a node keeps on its disk: parcels that it was sent, for hunts to come, and a folder for each hunt that runs."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from crashhunt.base.errors import BundleError
from crashhunt.executors.ray._folder import owned, remove_if_left
from crashhunt.executors.ray._parcel import unpack

__all__ = ["Place", "Store"]

_KEPT_BYTES = 10**9  # of parcels
_KEPT = 32
_LOCK = "lock"


class Store:
    """The folder of this user on this machine, which all its nodes share.

    Args:
        folder: of it; one below the folder for temporary files by default.
        kept_bytes: how much of parcels is kept; the ones that were used last.
    """

    def __init__(self, folder: Path | None = None, *, kept_bytes: int = _KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._folder = folder or Path(tempfile.gettempdir()) / f"crashhunt-{os.getuid()}"
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = self._folder.lstat()
            mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
        except OSError:
            mine = False
        if not mine:  # somebody else's; what is in there would be run
            self._folder = Path(tempfile.mkdtemp(prefix="crashhunt-"))

    def find(self, digest: str) -> bytes | None:
        """Return a parcel, or None where it is not there; whoever unpacks it sees whether it is damaged."""
        file = self._file(digest)
        try:
            packed = file.read_bytes()
            os.utime(file)
        except OSError:
            return None
        return packed

    def keep(self, digest: str, packed: bytes) -> None:
        """Keep a parcel, and let go of those that were not used for longest."""
        file = self._file(digest)
        part = file.with_name(f".{digest}.{os.getpid()}")
        with suppress(OSError):  # it is sent again, then
            part.write_bytes(packed)
            part.replace(file)
        with suppress(OSError):
            part.unlink()
        self._forget()

    def drop(self, digest: str) -> None:
        """Remove a parcel that is damaged."""
        with suppress(OSError):
            self._file(digest).unlink()

    def place(self) -> Place:
        """Make a folder for one hunt, and remove those whose process is gone.

        Raises:
            OSError: the disk is full.
        """
        for old in self._folder.glob("hunt-*"):
            remove_if_left(old / _LOCK)
        return Place(Path(tempfile.mkdtemp(prefix="hunt-", dir=self._folder)))

    def _file(self, digest: str) -> Path:
        return self._folder / f"{digest}.zip"

    def _forget(self) -> None:
        found = []
        for file in self._folder.glob("*.zip"):
            with suppress(OSError):
                found.append((file.stat().st_mtime, file.stat().st_size, file))
        total = 0
        for count, (_, size, file) in enumerate(sorted(found, reverse=True)):
            total += size
            if count and (total > self._kept_bytes or count >= _KEPT):
                with suppress(OSError):
                    file.unlink()


class Place:
    """The folder of one hunt on a node, which is its own as long as this process lives.

    Args:
        path: of it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.code = path / "parcel"
        self.scratch = path / "scratch"
        self._lock = owned(path / _LOCK)
        self.scratch.mkdir()

    def unpack(self, packed: bytes, digest: str) -> bool:
        """Unpack a parcel, which is verified; return whether it is as it should be."""
        try:
            unpack(packed, digest, self.code)
        except BundleError:
            shutil.rmtree(self.code, ignore_errors=True)
            return False
        return True

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()
