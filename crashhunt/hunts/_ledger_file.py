"""The file of a ledger: its tables, those of earlier versions, and what can be wrong with it."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import digest_of_row
from crashhunt.trial import check_plain

if TYPE_CHECKING:
    from pathlib import Path

__all__ = [
    "COLUMNS",
    "PROTECTED",
    "VERSION",
    "checked",
    "create",
    "damaged",
    "explained",
    "migrate",
    "opened",
    "plain_trial",
    "removed",
    "rewrite",
    "version_of",
]

VERSION = 2  # of the tables, as PRAGMA user_version
PROTECTED = 2  # the first version in which every row has a digest of its content
_SCHEMA = """
CREATE TABLE IF NOT EXISTS trials (
    number INTEGER PRIMARY KEY,
    seed INTEGER NOT NULL,
    outcome TEXT NOT NULL,
    steps INTEGER NOT NULL,
    time_to_collision_s REAL,
    gap_m REAL,
    required_deceleration REAL,
    wall_s REAL NOT NULL,
    ended_at REAL NOT NULL,
    snapshot TEXT NOT NULL,
    result TEXT NOT NULL,
    digest INTEGER NOT NULL
) STRICT;
-- What counts, ranks and compares trials reads this instead of the rows, which are fifty times as large.
CREATE INDEX IF NOT EXISTS trials_by_outcome ON trials (outcome, time_to_collision_s, number, steps, seed);
CREATE TABLE IF NOT EXISTS replaced (
    number INTEGER, replaced_at REAL, result TEXT NOT NULL, digest INTEGER NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS events (
    at REAL NOT NULL, state TEXT NOT NULL, detail TEXT NOT NULL, digest INTEGER NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS hunt (
    key TEXT PRIMARY KEY, value TEXT NOT NULL, digest INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
"""
COLUMNS = (
    "number, seed, outcome, steps, time_to_collision_s, gap_m, required_deceleration, "
    "wall_s, ended_at, snapshot, result"
)
_TABLES = {
    "trials": tuple(COLUMNS.split(", ")),
    "replaced": ("number", "replaced_at", "result"),
    "events": ("at", "state", "detail"),
    "hunt": ("key", "value"),
}
_CHECK = "crashhunt check {} says what can be saved"


def create(path: Path) -> None:
    """Make an empty ledger, as a whole: whoever sees the file can read it."""
    path.with_name(f"{path.name}-wal").unlink(missing_ok=True)  # SQLite would take that of an earlier one for its own
    with whole_file(path) as temporary, closing(sqlite3.connect(temporary, isolation_level=None)) as database:
        database.execute("PRAGMA synchronous = OFF")  # the whole file is synced at once
        database.executescript(f"BEGIN; {_SCHEMA} PRAGMA user_version = {VERSION}; COMMIT;")


def version_of(database: sqlite3.Connection, path: Path) -> int:
    """Return the version of the tables.

    Raises:
        HuntDirectoryError: it is none that can be read, or the tables are not those of that version.
        sqlite3.Error: it is no database.
    """
    found = int(database.execute("PRAGMA user_version").fetchone()[0])
    names = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not names & _TABLES.keys():
        raise HuntDirectoryError(
            "not a ledger of crashhunt: it has none of its tables", fix="choose another directory", where=str(path)
        )
    if found < 1:
        raise damaged(path, f"its version is {found}")
    if found > VERSION:
        raise HuntDirectoryError(
            f"a ledger of version {found}, and this crashhunt reads the versions up to {VERSION}",
            fix="use the crashhunt that made it, or run with --overwrite to begin anew",
            where=str(path),
        )
    for table, columns in _TABLES.items():
        there = tuple(name for _, name, *_ in database.execute(f"PRAGMA table_info({table})"))
        expected = columns if found < PROTECTED else (*columns, "digest")
        if there != expected:
            odd = sorted(set(expected) ^ set(there))
            what = f"{', '.join(odd)} of" if there and odd else "the columns of" if there else "without"
            raise damaged(path, f"it is not as version {found} is: {what} the table {table}")
    return found


def migrate(database: sqlite3.Connection) -> None:
    """Bring the tables of an earlier version to this one: what is there now is what digests will vouch for."""
    database.create_function("digest_of_row", -1, lambda *values: digest_of_row(values), deterministic=True)
    try:
        database.execute("BEGIN IMMEDIATE")
        for table, columns in _TABLES.items():
            database.execute(f"ALTER TABLE {table} ADD COLUMN digest INTEGER NOT NULL DEFAULT 0")
            database.execute(f"UPDATE {table} SET digest = digest_of_row({', '.join(columns)})")
        database.execute(f"PRAGMA user_version = {VERSION}")
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:
            database.execute("ROLLBACK")
        raise


def checked(row: tuple[Any, ...], what: str, path: Path) -> tuple[Any, ...]:
    """Return a row, once it is sure that it is what its digest, in the last column, was made of.

    Raises:
        HuntDirectoryError: it is not.
    """
    if digest_of_row(row[:-1]) != row[-1]:
        raise damaged(path, f"{what} is not as it was written")
    return row


def plain_trial(row: tuple[Any, ...], path: Path, *, trusted: bool) -> dict[str, Any]:
    """Return the trial of a row of `COLUMNS` as plain data.

    Raises:
        HuntDirectoryError: it is none; where the row had no digest, also where two places contradict each other.
    """
    try:
        data: dict[str, Any] = json.loads(row[10])
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


def opened(path: Path) -> sqlite3.Connection:
    """Open a ledger."""
    return sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)


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
        fix="run the hunt again, in a directory that nobody else writes to",
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
        message = f"the ledger was removed while the hunt ran, and cannot be written anew: {error.strerror}"
        fix = "run the hunt again, in a directory that nobody else writes to"
        raise HuntDirectoryError(message, fix=fix, where=str(path)) from error
