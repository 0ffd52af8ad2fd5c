"""Temporary files and folders of a process, which are removed however the process ends.

Each process has one folder for temporary files, ``crashhunt-temporary-UID/TOKEN`` in the system's folder for temporary
files (``TMPDIR``, else ``/tmp``). `OwnerProcess` defines the token. The folder contains

* folders that only this process needs (`temporary_folder`), and
* a symbolic link for each temporary file or folder in another place (`temporary_beside`). Such files become permanent
by a rename, or the user has chosen their disk. The link is made before the file, and removed after it.

`remove_leftovers` removes files that killed processes left. Each command calls this function at its start, and each
process calls it before the first temporary file. A leftover is removed only if three conditions hold
(`has_ended` checks a part of the first):

* its process has certainly ended (`has_ended`), and no process holds the lock of its folder,
* the leftover belongs to this user, and its name contains the token of that process,
* the leftover is a folder or a regular file. A symbolic link that looks like a leftover is not removed, nor is its
  target.

After a crash of the machine, no process can distinguish its temporary files from those of other hosts. The next hunt in
a directory removes the scratch folder of this directory, and the system clears its folder for temporary files.

The page `reference/files.md` of the guide lists every temporary file.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import stat
import threading
import weakref
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.process_owners import has_ended, owner_in, this_process
from crashhunt.base.shared_memory import release_shared_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


_WRITTEN_MEANWHILE = "another process has written there in the meantime"
_LINK_NAME = "elsewhere"
_GIT_WORK_TREES_FOLDER = "worktrees"  # in the folder of a Git repository
_MAX_NAME_BYTES = 255  # bytes, on every usual file system
_MAX_MKDIR_ATTEMPTS = 5  # to make a folder that another process removes at the same moment, because it is empty


class TemporaryFolder:
    """A new folder that only this process and its children use.

    Args:
        purpose: first part of the folder's name, such as ``replay``.

    Raises:
        OSError: the disk is full, or no folder for temporary files can be written.
    """

    def __init__(self, purpose: str) -> None:
        self.path = _things.make(lambda folder: _new_folder(folder, purpose))
        # Python calls it at its end too, and when the caller loses the object.
        self._remove = weakref.finalize(self, _remove_of_owner, self.path, os.getpid())

    def remove(self) -> None:
        """Remove the folder and all its contents. A second call does nothing."""
        self._remove()


@contextmanager
def temporary_folder(purpose: str) -> Iterator[Path]:
    """Yield a new folder that only this process and its children use, and remove it at the end.

    The name of the folder begins with ``purpose``, such as ``replay``.

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
    """Yield a temporary path in the same folder, and remove it at the end.

    The caller creates a file or a folder under this path, and renames it to its final path.

    Args:
        path: the final path; the temporary path has a similar name in the same folder.
        name: another name for the temporary file; it must contain the token of this process.
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
                _things.end(link, removed=not _exists(target))


@contextmanager
def new_folder(path: Path, *, mode: int = 0o777) -> Iterator[Path]:
    """Yield a temporary folder, which becomes the given folder at the end.

    An existing folder receives the contents and stays the same folder, because it may be the current folder of the
    user, a mount point, or the target of a link. A folder that exists must be empty. ``mode`` has the permissions of a
    new folder.

    Raises:
        OSError: the folder cannot be written, or another process has written into it in the meantime.
    """
    target = path.absolute()
    is_there = target.is_dir()
    with temporary_beside(target / "new" if is_there else target) as building:
        building.mkdir(mode=mode)
        yield building
        if is_there:
            if any(entry.suffix != building.suffix for entry in target.iterdir()):
                raise FileExistsError(errno.EEXIST, _WRITTEN_MEANWHILE, str(path))
            for entry in sorted(building.iterdir()):
                entry.rename(target / entry.name)
            return
        try:
            building.rename(target)
        except OSError as error:
            if target.exists():
                raise FileExistsError(errno.EEXIST, _WRITTEN_MEANWHILE, str(path)) from error
            raise


def temporary_name(path: Path, suffix: str = "") -> str:
    """Return a hidden name with the token of this process, for a temporary file in the folder of a path.

    Each thread has another name, because a program may, for example, minimize the same crash in two threads.

    Args:
        path: final path of the file or folder.
        suffix: end of the name; by default the ending of the path, because some libraries choose the format by it.
    """
    stem, suffix = (path.name, suffix) if suffix else (path.stem, path.suffix)
    thread = "" if threading.current_thread() is threading.main_thread() else f"-{threading.get_native_id()}"
    rest = f".{this_process().token}{thread}{suffix}"
    room = _MAX_NAME_BYTES - 1 - len(os.fsencode(rest))
    while len(os.fsencode(stem)) > room:
        stem = stem[:-1]
    return f".{stem}{rest}"


def remove_leftovers() -> None:
    """Remove the temporary files of processes that have ended, from the folder that contains all of them."""
    _things.swept = True
    place, prefix = _base_folder()
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
    """Remove the files in one folder whose hidden names contain the token of a process that has ended."""
    with suppress(OSError):
        for path in list(folder.iterdir()):
            owner = owner_in(path.name) if path.name.startswith(".") else None
            if owner is not None and has_ended(owner):
                _remove_if_ours(path, owner.token)


def remove_at_once(path: Path) -> None:
    """Remove a folder so that no other process ever sees a part of its contents; errors are ignored."""
    with temporary_beside(path) as hidden, suppress(OSError):
        path.rename(hidden)


def remove_scratch(path: Path) -> None:
    """Remove a folder in which trials ran, and the shared memory of these trials."""
    release_shared_memory(path)
    remove_tree(path)


def remove_tree(path: Path) -> None:
    """Remove a file or a folder with all its contents, even if their permissions forbid it.

    Errors are ignored. For a symbolic link, the link is removed and not its target.
    """
    with suppress(OSError):
        if not stat.S_ISDIR(path.lstat().st_mode):
            path.unlink()
            return
        shutil.rmtree(path, ignore_errors=True)
        if _exists(path):  # an agent may have taken permissions away
            path.chmod(0o700)
            for parent, names, _ in os.walk(path):
                for folder in (Path(parent, name) for name in names):
                    if not folder.is_symlink():
                        folder.chmod(0o700)
            shutil.rmtree(path, ignore_errors=True)


class _TemporaryFiles:
    """The temporary files of this process. The folder for temporary files exists only while it has contents."""

    def __init__(self) -> None:
        self.swept = False
        self._forget()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        """Ignore the temporary files of the parent process, because a fork does not own them."""
        # A finalizer may run anywhere, such as when `make` allocates memory, and then calls `end` in the same thread.
        self._lock = threading.RLock()
        self._folder: Path | None = None
        self._is_shared = False
        self._opened = -1
        self._count = self._serial = 0

    def make(self, made: Callable[[Path], Path]) -> Path:
        """Create a file or folder in the temporary folder of this process, and return it.

        Raises:
            OSError: the file or folder cannot be created.
        """
        if not self.swept:
            remove_leftovers()
        with self._lock:
            self._count += 1  # first, so that the folder stays if a finalizer ends the last other thing meanwhile
            for left in reversed(range(_MAX_MKDIR_ATTEMPTS)):
                try:
                    return made(self._create_folder())
                except FileNotFoundError:  # another process removed it or its parent, which were empty or old
                    self._close()
                    if not left:
                        self._count -= 1
                        raise
                except BaseException:
                    self._count -= 1
                    self._remove_folder()
                    raise
        raise AssertionError

    def end(self, path: Path, *, removed: bool = True) -> None:
        """Remove a temporary file; with the last file, also remove the folder.

        Args:
            path: path of the temporary file.
            removed: whether the file or folder is gone; otherwise it stays, and the next command tries again.
        """
        with self._lock:
            if removed:
                remove_tree(path)
            self._count -= 1
            self._remove_folder()

    def next_name(self, purpose: str) -> str:
        """Return a name that is not yet used in the folder."""
        self._serial += 1
        return f"{purpose}-{self._serial}"

    def _create_folder(self) -> Path:
        if self._folder is not None:
            return self._folder
        place, prefix = _base_folder()
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

    def _remove_folder(self) -> None:
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
    made = folder / _things.next_name(_LINK_NAME)
    made.symlink_to(target)
    return made


def _remove_of_owner(path: Path, pid: int) -> None:
    if os.getpid() == pid:  # not in a fork of this process
        remove_scratch(path)
        _things.end(path, removed=not _exists(path))


def _base_folder() -> tuple[Path, str]:
    """Return the folder that contains the temporary folders of all processes of this user, and their name prefix."""
    usual = folder_for_temporary_files()
    place = usual / f"crashhunt-temporary-{os.getuid()}"
    try:
        found = place.lstat()
        ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    except FileNotFoundError:
        ours = True
    except OSError:
        ours = False
    return (place, "") if ours else (usual, "crashhunt-temporary-")  # another user made one with this name


def folder_for_temporary_files() -> Path:
    """Return the folder for temporary files that `tempfile` would choose, without the slow import of `tempfile`."""
    named = (os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    for path in (*named, "/tmp", "/var/tmp", "/usr/tmp"):
        if path and os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK):  # noqa: PTH112
            return Path(path).absolute()
    return Path.cwd()


def _remove_left(folder: Path, token: str) -> None:
    """Remove all temporary files of a process that has ended."""
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
                if left.parent.name == _GIT_WORK_TREES_FOLDER:
                    with suppress(OSError):  # Git removes it with the last work tree too
                        left.parent.rmdir()
        folder.rmdir()
    finally:
        os.close(opened)


def _remove_if_ours(path: Path, token: str) -> bool:
    """Remove a path if its name contains a token; return whether the path is gone."""
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
    return not _exists(path)


def _exists(path: Path) -> bool:
    """Return whether a path exists; a broken symbolic link counts as existing."""
    try:
        path.lstat()
    except OSError:
        return False
    return True


_things = _TemporaryFiles()
