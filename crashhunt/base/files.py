"""Files that are there as a whole or not at all, also after the power went."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING

from crashhunt.base.errors import FULL, HuntDirectoryError
from crashhunt.base.temporary import remove_tree, temporary_beside, temporary_name

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["cannot_write", "exchange", "is_empty_folder", "put_in_place", "sync_folder", "sync_tree", "whole_file"]

_AT_ONCE = 8  # more are not faster
_HERE, _RENAME_EXCHANGE = -100, 2  # AT_FDCWD of <fcntl.h>, and of <linux/fs.h>


@contextmanager
def whole_file(path: Path, *, lasting: bool = True, noted: bool = True) -> Iterator[Path]:
    """Yield a name beside a file to write to, which becomes the file in the end, and is gone after an error.

    Args:
        path: of the file.
        lasting: whether it is on the disk, its name too, before this returns. What nobody needs after the process that
            reads it has ended, or after the power went, does without.
        noted: whether the next command removes what is left of it if this process is killed. A file inside of a folder
            that is temporary itself does without.

    Raises:
        HuntDirectoryError: it cannot be written.
    """
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


def put_in_place(made: Path, final: Path) -> None:
    """Rename a folder to where it is to stay; one that is there already gets the name of the new one.

    Both are renamed at once where the system can do that. Elsewhere the old folder is removed first.

    Raises:
        OSError: the folder cannot be renamed.
    """
    if not final.exists() or not exchange(made, final):
        remove_tree(final)
        made.rename(final)


def exchange(first: Path, second: Path) -> bool:
    """Let two files or folders have each other's name, at once; return whether the system can."""
    import ctypes  # which no other command needs

    try:
        exchange = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):  # an old or another C library
        return False
    return bool(exchange(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _RENAME_EXCHANGE) == 0)


def sync_tree(folder: Path) -> None:
    """Have a folder with everything in it on the disk before its name says that it is whole.

    Raises:
        OSError: the disk is full, or broken.
    """
    folders, files = [], []
    for parent, _, names in os.walk(folder):
        folders.append(parent)
        files += [path for name in names if os.path.isfile(path := os.path.join(parent, name))]  # noqa: PTH113, PTH118
    # Several take a disk as long as one: a file system with a journal writes it once for all of them.
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        for _ in threads.map(_sync_all, [files[share::_AT_ONCE] for share in range(_AT_ONCE)]):
            pass  # which raises what it has raised
        for _ in threads.map(sync_folder, folders):
            pass


def is_empty_folder(path: Path) -> bool:
    """Return whether a path is a folder that has nothing in it.

    Raises:
        OSError: it may not be read.
    """
    return path.is_dir() and not any(path.iterdir())


def sync_folder(*folders: str | Path) -> None:
    """Have the names in folders on the disk, where the file system can do that."""
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


def cannot_write(path: Path, error: OSError) -> HuntDirectoryError:
    """Return the error for a file or folder that cannot be written."""
    fix = "free some space and run the same command again" if error.errno in FULL else "choose another place"
    return HuntDirectoryError(f"cannot be written: {error.strerror or error}", fix=fix, where=str(path))
