"""Files that are complete or absent, even after a power failure."""

from __future__ import annotations

import errno
import fcntl
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crashhunt.base import layout
from crashhunt.base.errors import FULL, HuntDirectoryError
from crashhunt.base.temporary import remove_tree, temporary_beside, temporary_name

if TYPE_CHECKING:
    from collections.abc import Iterator

_PARALLEL_SYNCS = 8  # fsync calls that overlap; more threads are not faster
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of <fcntl.h> and <linux/fs.h>


@contextmanager
def whole_file(path: Path, *, lasting: bool = True, noted: bool = True) -> Iterator[Path]:
    """Yield a temporary name in a file's folder. At the end, this file replaces the original; on error, it is deleted.

    Args:
        path: path of the final file.
        lasting: whether content and name are synced to the disk at the end. Set this argument to False for files that
            are useless after a crash of the process or a power failure.
        noted: whether the next command removes the temporary file if this process is killed. Set this argument
            to False inside a folder that is itself temporary.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    _refuse_device(path)
    if not path.name:  # the current folder, or that of the system
        raise cannot_write(path, IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR)))
    name = temporary_name(path)
    with temporary_beside(path, name=name) if noted else nullcontext(path.with_name(name)) as temporary:
        try:
            yield temporary
            if lasting:
                _sync(temporary)  # else the name may reach the disk before the content does
            temporary.replace(path)
            if lasting:
                sync_folder(path.parent)
        except OSError as error:
            raise cannot_write(path, error) from error
        finally:
            remove_tree(temporary)


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name as `whole_file` does, for a file that the user names.

    Raises:
        HuntDirectoryError: the file cannot be written, or would change a file of a hunt, a crash or a scenario.
    """
    refuse_kept(path)
    with whole_file(path) as temporary:
        yield temporary


def refuse_kept(path: Path) -> None:
    """Raise an error if an output would replace, or be added to, a file of a hunt, a crash or a scenario."""
    if path.name in layout.KEPT and path.is_file():
        raise HuntDirectoryError(
            "would change a file of a hunt, a crash or a scenario", fix="give another file", where=str(path)
        )


def _refuse_device(path: Path) -> None:
    """Raise an error if a file would replace a device, a pipe or a link to these; root could replace /dev/null."""
    try:
        is_special = path.exists() and not (path.is_file() or path.is_dir())
    except OSError as error:  # such as a name that is too long
        raise cannot_write(path, error) from error
    if is_special:
        raise HuntDirectoryError("is a device or a pipe, and cannot be replaced", fix="give a file", where=str(path))
    if path.absolute().parent == Path("/dev"):  # such as /dev/stdout, a link to what is a file now
        raise HuntDirectoryError(
            "is in the folder of device files", fix="give a file in another folder", where=str(path)
        )


def put_in_place(made: Path, final: Path) -> None:
    """Rename a folder to its final name; an existing folder with this name is replaced.

    Both folders are renamed at once if the system supports that. Otherwise, the old folder is removed first.

    Raises:
        OSError: the folder cannot be renamed.
    """
    if not final.exists() or not exchange(made, final):
        remove_tree(final)
        made.rename(final)


def exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two files or folders atomically; return whether the system supports that."""
    import ctypes  # which no other command needs

    try:
        exchange = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):  # an old or another C library
        return False
    return bool(exchange(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE) == 0)


def sync_tree(folder: Path) -> None:
    """Sync a folder and all its contents to the disk, so that its final name implies complete contents.

    Raises:
        OSError: the disk is full, or broken.
    """
    folders, files = [], []
    for parent, _, names in os.walk(folder):
        folders.append(parent)
        files += [path for name in names if os.path.isfile(path := os.path.join(parent, name))]  # noqa: PTH113, PTH118
    # A file system with a journal commits once for several concurrent syncs.
    with ThreadPoolExecutor(_PARALLEL_SYNCS) as threads:
        for _ in threads.map(_sync_all, [files[share::_PARALLEL_SYNCS] for share in range(_PARALLEL_SYNCS)]):
            pass  # iterating raises the errors of the threads
        for _ in threads.map(sync_folder, folders):
            pass


def is_empty_folder(path: Path) -> bool:
    """Return whether a path is an empty folder.

    Raises:
        OSError: the folder may not be read.
    """
    return path.is_dir() and not any(path.iterdir())


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Return a context that holds the lock of a folder, after other processes have released it.

    Raises:
        OSError: the folder does not exist, or the file system has no locks.
    """
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX)
        yield
    finally:
        os.close(opened)


def sync_folder(*folders: str | Path) -> None:
    """Sync the directory entries of folders to the disk, if the file system supports that."""
    with suppress(OSError):  # some network file systems cannot
        for folder in folders:
            _sync(folder)


def _sync_all(paths: list[str]) -> None:
    for path in paths:
        _sync(path)


def _sync(path: str | Path) -> None:
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


FREE_SPACE: Final = "free some space and run the same command again"


def cannot_write(path: Path, error: OSError) -> HuntDirectoryError:
    """Return the error for a file or folder that cannot be written."""
    fix = FREE_SPACE if error.errno in FULL else "choose another place"
    return HuntDirectoryError(f"cannot be written: {error.strerror or error}", fix=fix, where=str(path))
