"""The file of a ledger, and what can be wrong with it."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing, contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TypeAlias

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import digest_of_row
from crashhunt.trial import check_plain

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.base.codec import JsonObject


__all__ = [
    "Row",
    "checked",
    "damaged",
    "explained",
    "has_content",
    "is_untouched",
    "leave_untouched",
    "opened",
    "plain_trial",
    "removed",
    "rewrite",
]


Row: TypeAlias = tuple[Any, ...]
"""A row as SQLite returns it. The caller's query names its columns."""

_CHECK = "crashhunt check {} says what can be saved"


def checked(row: Row, what: str, path: Path) -> Row:
    """Return a row, once it is sure that it is what its digest, in the last column, was made of.

    Raises:
        HuntDirectoryError: it is not.
    """
    if digest_of_row(row[:-1]) != row[-1]:
        raise damaged(path, f"{what} is not as it was written")
    return row


def plain_trial(row: Row, path: Path, *, trusted: bool) -> JsonObject:
    """Return the trial of a whole row as plain data.

    Raises:
        HuntDirectoryError: it is none; where the row had no digest, also where two places contradict each other.
    """
    try:
        data: JsonObject = json.loads(row[10])
        if not trusted:
            check_plain(data)
            spec, closest = data["spec"], data["closest"]
            said = (spec["number"], spec["seed"], data["outcome"], data["steps"], *closest.values(), data["wall_s"])
            if row[:8] != said:
                raise ValueError("its columns say something else than its text")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise damaged(path, f"trial {row[0]} cannot be read: {error}") from None
    return data


def damaged(path: Path, message: str) -> HuntDirectoryError:
    """Return the error for a ledger that is not as it was written."""
    return HuntDirectoryError(f"the ledger is damaged: {message}", fix=_CHECK.format(path.parent), where=str(path))


def explained(path: Path, error: sqlite3.Error) -> HuntDirectoryError:
    """Return the error that says in our words what SQLite says."""
    where, text = str(path), " ".join(str(error).split())  # which may quote what is damaged
    if "full" in text or "disk I/O" in text:
        return HuntDirectoryError(
            f"the disk is full ({text})", fix="free some space and run the same command again", where=where
        )
    if "locked" in text:
        return HuntDirectoryError(
            f"another program keeps it busy ({text})", fix="close what has it open, and try again", where=where
        )
    if "unable to open" in text or "readonly" in text:
        if os.path.isdir(path):  # noqa: PTH112
            return damaged(path, "a folder is where the file should be")
        there = os.path.exists(path.parent)  # noqa: PTH110
        if there and os.path.exists(path) and not os.access(path, os.R_OK):  # noqa: PTH110
            return HuntDirectoryError(f"it may not be read ({text})", fix="make it readable", where=where)
        reason = "is not writable" if there else "does not exist"
        return HuntDirectoryError(f"the folder {reason} ({text})", fix="choose another", where=where)
    if "not a database" in text:
        return HuntDirectoryError(
            f"not a ledger of crashhunt ({text})",
            fix=f"choose another directory, or see with crashhunt check {path.parent} what is left",
            where=where,
        )
    return damaged(path, text)


_untouched: ContextVar[bool] = ContextVar("untouched", default=False)


@contextmanager
def leave_untouched() -> Iterator[None]:
    """Open every ledger that is only read as `opened` does with `read_only`, in whatever is called meanwhile."""
    before = _untouched.set(True)
    try:
        yield
    finally:
        _untouched.reset(before)


def is_untouched() -> bool:
    """Whether the caller is within `leave_untouched`."""
    return _untouched.get()


def opened(path: Path, *, read_only: bool = False) -> sqlite3.Connection:
    """Open a ledger.

    Args:
        path: of the file.
        read_only: leave the folder as it is. SQLite makes two files next to a ledger that is read, and the last reader
            of a killed hunt moves one of them into the ledger.
    """
    if not read_only:
        return sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
    log = path.with_name(f"{path.name}-wal")
    # Without a write-ahead log, nothing writes to the file. With one, readers need the shared memory next to it.
    mode = "mode=ro" if has_content(log) else "mode=ro&immutable=1"
    uri = f"{path.absolute().as_uri()}?{mode}"
    return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False, timeout=10.0)


def has_content(path: Path) -> bool:
    """Whether a file is there, and not empty."""
    try:
        return path.stat().st_size > 0
    except OSError:
        return False


def removed(path: Path, was: os.stat_result) -> bool:
    """Whether the file of a ledger that is open was removed.

    Raises:
        HuntDirectoryError: another file is in its place.
    """
    try:
        if os.path.samestat(path.stat(), was):
            return False
    except FileNotFoundError:
        return True
    raise HuntDirectoryError(
        "another file was put in the place of the ledger while the hunt ran",
        fix="run the hunt again, in a directory that no other process writes to",
        where=str(path),
    )


def rewrite(database: sqlite3.Connection, path: Path) -> None:
    """Write a ledger that is open, and whose file was removed, to a new one; it is closed.

    Raises:
        HuntDirectoryError: the folder is gone or not writable.
    """
    try:
        with whole_file(path) as temporary:
            with closing(sqlite3.connect(temporary)) as copy:
                database.backup(copy)
            database.close()  # which removes what belongs to the old file
    except sqlite3.Error as error:
        raise explained(path, error) from error
    except OSError as error:
        message = f"the ledger was removed while the hunt ran, and cannot be written again: {error.strerror}"
        fix = "run the hunt again, in a directory that no other process writes to"
        raise HuntDirectoryError(message, fix=fix, where=str(path)) from error
