"""Files that are there as a whole or not at all, also after the power went."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from crashhunt.base.errors import FULL, HuntDirectoryError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["cannot_write", "sync_folder", "sync_tree", "whole_file"]

_AT_ONCE = 8  # more are not faster


@contextmanager
def whole_file(path: Path, *, lasting: bool = True) -> Iterator[Path]:
    """Yield a name beside a file to write to, which becomes the file in the end, and is gone after an error.

    Args:
        path: of the file.
        lasting: whether it is on the disk, its name too, before this returns. What nobody needs after the process that
            reads it has ended, or after the power went, does without.

    Raises:
        HuntDirectoryError: it cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
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
        with suppress(OSError):
            temporary.unlink()


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
