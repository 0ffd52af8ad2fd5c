"""Everything temporary that a process makes, so that nothing of it outlives the process, however the process ends.

Each process has one folder for temporary things, ``crashhunt-temporary-UID/TOKEN`` in the system's folder for temporary
files (``TMPDIR``, else ``/tmp``). `Owner` says what the token is. The folder holds

* the folders that only this process needs (`temporary_folder`), and
* a symbolic link for each temporary thing that has to lie elsewhere (`temporary_beside`), because a rename makes it
  permanent, or because the disk is chosen by the user. The link is made before the thing, and removed after it.

`remove_leftovers` removes what killed processes left. Each command calls it when it starts, and each process calls it
before it makes its first temporary thing. It removes a leftover only if all of this holds:

* its process has certainly ended (`has_ended`), and no process holds the lock of its folder,
* it belongs to this user, and its name has the token of that process,
* it is a folder or a regular file. A symbolic link that looks like a leftover stays, and so does its target.

A crash of the machine leaves things that no later process can tell from those of other hosts. The next hunt in a
directory removes the scratch there, and the system clears its folder for temporary files.

The page `reference/files.md` of the guide lists every temporary thing.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import threading
import weakref
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.owners import has_ended, owner_in, this_process
from crashhunt.base.shared_memory import release_shared_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = [
    "TemporaryFolder",
    "remove_at_once",
    "remove_ended",
    "remove_leftovers",
    "remove_scratch",
    "remove_tree",
    "temporary_beside",
    "temporary_folder",
    "temporary_name",
]

_LINK = "elsewhere"
_WORK_TREES = "worktrees"  # in the folder of a Git repository
_LONGEST_NAME = 255  # bytes, on every usual file system
_TRIES = 5  # to make a folder that another process removes at the same moment, because it is empty


class TemporaryFolder:
    """A new folder that only this process and its children use.

    Args:
        purpose: first part of its name, such as ``replay``.

    Raises:
        OSError: the disk is full, or no folder for temporary files can be written.
    """

    def __init__(self, purpose: str) -> None:
        self.path = _things.make(lambda folder: _new_folder(folder, purpose))
        # Python calls it at its end too, and when the caller loses the object.
        self._remove = weakref.finalize(self, _end, self.path, os.getpid())

    def remove(self) -> None:
        """Remove the folder and everything in it. A second call does nothing."""
        self._remove()


@contextmanager
def temporary_folder(purpose: str) -> Iterator[Path]:
    """Yield a new folder that only this process and its children use, and remove it at the end.

    Args:
        purpose: first part of its name, such as ``replay``.

    Raises:
        OSError: the disk is full, or no folder for temporary files can be written.
    """
    folder = TemporaryFolder(purpose)
    try:
        yield folder.path
    finally:
        folder.remove()


@contextmanager
def temporary_beside(path: Path, *, name: str = "") -> Iterator[Path]:
    """Yield a path in the same folder for something temporary, and remove what is there at the end.

    The caller makes a file or a folder there, and renames it where it is to stay.

    Args:
        path: what is being made; its name and its folder give those of the temporary thing.
        name: name of the temporary thing, where it is another one; has to have the token of this process.
    """
    there = path.with_name(name or temporary_name(path, ".part"))
    target = there.absolute()  # wherever this process goes meanwhile
    link = None
    with suppress(OSError):  # then the thing is not found by other commands; the disk may be full
        link = _things.make(lambda folder: _new_link(folder, target))
    pid = os.getpid()
    try:
        yield there
    finally:
        if os.getpid() == pid:  # not in a fork of this process
            remove_scratch(target)
            if link is not None:
                _things.end(link, removed=not _is_there(target))


def temporary_name(path: Path, suffix: str = "") -> str:
    """Return a hidden name with the token of this process for something temporary beside a file or folder.

    Args:
        path: of what is being made.
        suffix: end of the name; by default that of the path, because some libraries choose the format by it.
    """
    stem, suffix = (path.name, suffix) if suffix else (path.stem, path.suffix)
    rest = f".{this_process().token}{suffix}"
    room = _LONGEST_NAME - 1 - len(os.fsencode(rest))
    while len(os.fsencode(stem)) > room:
        stem = stem[:-1]
    return f".{stem}{rest}"


def remove_leftovers() -> None:
    """Remove what processes left that have ended without removing it; costs one look into a folder."""
    _things.swept = True
    place, prefix = _place()
    try:
        names = [entry.name for entry in os.scandir(place) if entry.name.startswith(prefix)]
    except OSError:
        return  # no process has made anything
    for name in names:
        owner = owner_in(name)
        if owner is not None and name == f"{prefix}{owner.token}" and has_ended(owner):
            with suppress(OSError):
                _remove_left(place / name, owner.token)
    if not prefix:
        with suppress(OSError):  # other processes use it
            place.rmdir()


def remove_ended(folder: Path) -> None:
    """Remove what in one folder has a hidden name with the token of a process that has ended."""
    with suppress(OSError):
        for path in list(folder.iterdir()):
            owner = owner_in(path.name) if path.name.startswith(".") else None
            if owner is not None and has_ended(owner):
                _remove_if_ours(path, owner.token)


def remove_at_once(path: Path) -> None:
    """Remove a folder so that no other process ever sees a part of it; errors are ignored."""
    with temporary_beside(path) as hidden, suppress(OSError):
        path.rename(hidden)


def remove_scratch(path: Path) -> None:
    """Remove a folder in which trials ran, and the shared memory that they left."""
    release_shared_memory(path)
    remove_tree(path)


def remove_tree(path: Path) -> None:
    """Remove a file or a folder with everything in it, also where its permissions are in the way.

    Errors are ignored. A symbolic link is removed, and not what it points to.
    """
    with suppress(OSError):
        if not stat.S_ISDIR(path.lstat().st_mode):
            path.unlink()
            return
        shutil.rmtree(path, ignore_errors=True)
        if _is_there(path):  # an agent may have taken permissions away
            path.chmod(0o700)
            for parent, names, _ in os.walk(path):
                for folder in (Path(parent, name) for name in names):
                    if not folder.is_symlink():
                        folder.chmod(0o700)
            shutil.rmtree(path, ignore_errors=True)


class _Things:
    """What this process has that is temporary: its folder, which is there as long as anything is in it."""

    def __init__(self) -> None:
        self.swept = False
        self._forget()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        """Begin with nothing: in a new process, and in a fork, which owns nothing of what its parent has."""
        self._lock = threading.Lock()
        self._folder: Path | None = None
        self._is_shared = False
        self._opened = -1
        self._count = self._serial = 0

    def make(self, made: Callable[[Path], Path]) -> Path:
        """Have something made in the folder of this process, and return it.

        Raises:
            OSError: it cannot be made.
        """
        if not self.swept:
            remove_leftovers()
        with self._lock:
            for left in reversed(range(_TRIES)):
                try:
                    found = made(self._begun())
                    self._count += 1
                    return found
                except FileNotFoundError:  # another process removed it or its parent, which were empty or old
                    self._close()
                    if not left:
                        raise
                except BaseException:
                    self._leave()
                    raise
        raise AssertionError

    def end(self, path: Path, *, removed: bool = True) -> None:
        """Remove something that was made, and the folder with the last.

        Args:
            path: of it.
            removed: whether what it stands for is gone; otherwise it stays, and the next command tries again.
        """
        with self._lock:
            if removed:
                remove_tree(path)
            self._count -= 1
            self._leave()

    def next_name(self, purpose: str) -> str:
        """Return a name that nothing in the folder has."""
        self._serial += 1
        return f"{purpose}-{self._serial}"

    def _begun(self) -> Path:
        if self._folder is not None:
            return self._folder
        place, prefix = _place()
        if not prefix:
            with suppress(FileExistsError):
                place.mkdir(mode=0o700)
        folder = place / f"{prefix}{this_process().token}"
        with suppress(FileExistsError):  # what this process could not remove is still there
            folder.mkdir(mode=0o700)
        self._opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        with suppress(OSError):  # some file systems have no locks; then the start time alone decides
            fcntl.flock(self._opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._folder, self._is_shared = folder, bool(prefix)
        return folder

    def _leave(self) -> None:
        if self._folder is not None and not self._count:
            with suppress(OSError):
                self._folder.rmdir()
                if not self._is_shared:
                    self._folder.parent.rmdir()
            self._close()

    def _close(self) -> None:
        if self._opened >= 0:
            os.close(self._opened)
        self._folder, self._opened = None, -1


def _new_folder(folder: Path, purpose: str) -> Path:
    made = folder / _things.next_name(purpose)
    made.mkdir(mode=0o700)
    return made


def _new_link(folder: Path, target: Path) -> Path:
    made = folder / _things.next_name(_LINK)
    made.symlink_to(target)
    return made


def _end(path: Path, pid: int) -> None:
    if os.getpid() == pid:  # not in a fork of this process
        remove_scratch(path)
        _things.end(path, removed=not _is_there(path))


def _place() -> tuple[Path, str]:
    """Return the folder for the folders of all processes of this user, and what their names begin with there."""
    usual = _temporary_files()
    place = usual / f"crashhunt-temporary-{os.getuid()}"
    try:
        found = place.lstat()
        ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    except FileNotFoundError:
        ours = True
    except OSError:
        ours = False
    return (place, "") if ours else (usual, "crashhunt-temporary-")  # another user made one with this name


def _temporary_files() -> Path:
    """Return the folder that `tempfile` chooses too; to import that takes longer than a look into the folder."""
    named = (os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    for path in (*named, "/tmp", "/var/tmp", "/usr/tmp"):
        if path and os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK):  # noqa: PTH112
            return Path(path).absolute()
    return Path.cwd()


def _remove_left(folder: Path, token: str) -> None:
    """Remove everything of a process that has ended."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(opened).st_uid != os.getuid():
            return
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where it is in use, or being removed by another one
        for path in list(folder.iterdir()):
            if not path.is_symlink():
                remove_scratch(path)
            elif _remove_if_ours(left := path.readlink(), token):
                path.unlink()
                if left.parent.name == _WORK_TREES:
                    with suppress(OSError):  # Git removes it with the last work tree too
                        left.parent.rmdir()
        folder.rmdir()
    finally:
        os.close(opened)


def _remove_if_ours(path: Path, token: str) -> bool:
    """Remove something if it is what a token stands for; return whether it is not there, or no longer."""
    owner = owner_in(path.name)
    try:
        found = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    kind = stat.S_ISDIR(found.st_mode) or stat.S_ISREG(found.st_mode)
    if owner is None or owner.token != token or not kind or found.st_uid != os.getuid():
        return True  # it is something else, and stays
    remove_scratch(path)
    return not _is_there(path)


def _is_there(path: Path) -> bool:
    """Return whether there is anything of that name, a broken symbolic link too."""
    try:
        path.lstat()
    except OSError:
        return False
    return True


_things = _Things()
