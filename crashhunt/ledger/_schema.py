"""The file of a ledger: its tables, and checks for damage."""

from __future__ import annotations

import errno
import json
import os
import sqlite3
import time
from contextlib import closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from crashhunt.base.errors import HuntDirectoryError, remedy
from crashhunt.base.files import FREE_SPACE, whole_file
from crashhunt.base.integrity import digest_of_row
from crashhunt.base.older_versions import HOW_TO_READ
from crashhunt.base.resources import error_of_next_files, limit_behind
from crashhunt.base.text import command_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from crashhunt.base.codec import JsonObject


VERSION = 1  # of the tables, as PRAGMA user_version
_MIN_READER_VERSION = 1  # the least version of a crashhunt that reads what this one writes
_APPLICATION_ID = 0x63726831  # "crh1", as PRAGMA application_id: ledgers from before format version 1 have none
_MAX_CELL_BYTES = 64 << 20  # of a ledger that may be a stranger's; the state of a sampler has some MB
_FILES_OF_LEDGER = 3  # that SQLite opens: the ledger, its write-ahead log and its shared memory
SEAL, _READER_FACT = "seal", "reader"
OWN_FACTS = (SEAL, _READER_FACT)  # on the ledger itself, in addition to the facts of the hunt

# Most trials have no traffic event, so that those that have some are counted without reading all the others.
WITH_EVENTS = """instr(result, '"events": {"') > 0"""
_EVENTS_INDEX = f"CREATE INDEX IF NOT EXISTS trials_with_events ON trials (number) WHERE {WITH_EVENTS};"
# What counts, ranks and compares trials reads this instead of the rows, which are fifty times as large.
_OUTCOME_INDEX = (
    "CREATE INDEX IF NOT EXISTS trials_by_outcome "
    "ON trials (outcome, time_to_collision_s, number, steps, seed, other_steps);"
)
_DANGER_INDEX = "CREATE INDEX IF NOT EXISTS trials_by_danger ON trials (outcome, danger, number);"
_SCHEMA = f"""
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
    digest INTEGER NOT NULL,
    danger REAL,
    other_steps INTEGER
) STRICT;
{_OUTCOME_INDEX}
{_EVENTS_INDEX}
{_DANGER_INDEX}
CREATE TABLE IF NOT EXISTS replaced (
    number INTEGER, replaced_at REAL, result TEXT NOT NULL, digest INTEGER NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS events (
    at REAL NOT NULL, state TEXT NOT NULL, detail TEXT NOT NULL, digest INTEGER NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS hunt (
    key TEXT PRIMARY KEY, value TEXT NOT NULL, digest INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS proposals (
    turn INTEGER PRIMARY KEY, number INTEGER NOT NULL UNIQUE, told TEXT NOT NULL, spec TEXT NOT NULL,
    digest INTEGER NOT NULL
) STRICT;
"""
# The columns of the tables in the order in which they are hashed. A later version adds columns at the end of a table,
# after the digest, and tables. It keeps the rest, so that every version checks the rows of all others.
COLUMNS = {
    "trials": (
        "number", "seed", "outcome", "steps", "time_to_collision_s", "gap_m", "required_deceleration",
        "wall_s", "ended_at", "snapshot", "result", "danger", "other_steps",
    ),
    "replaced": ("number", "replaced_at", "result"),
    "events": ("at", "state", "detail"),
    "hunt": ("key", "value"),
    "proposals": ("turn", "number", "told", "spec"),
}  # fmt: skip
_DIGEST_PLACES = {table: len(columns) for table, columns in COLUMNS.items()} | {"trials": 11}


@dataclass(frozen=True, slots=True)
class Shape:
    """The columns of the tables of a ledger."""

    version: int  # version of the table layout
    # columns of each table except the digest, in the order in which they are hashed. A table of a newer version may
    # have further columns at its end.
    columns: Mapping[str, tuple[str, ...]]

    def select(self, table: str) -> str:
        """Return the beginning of an SQL query for whole rows, with the digest as the last column."""
        return f"SELECT {', '.join((*self.columns[table], 'digest'))} FROM {table}"


def create(path: Path) -> None:
    """Create an empty ledger atomically, so that a visible file is always readable."""
    path.with_name(f"{path.name}-wal").unlink(missing_ok=True)  # SQLite would take that of an earlier one for its own
    with whole_file(path) as temporary, closing(sqlite3.connect(temporary, isolation_level=None)) as database:
        database.execute("PRAGMA synchronous = OFF")  # the whole file is synced at once
        database.executescript(
            f"BEGIN; {_SCHEMA} PRAGMA user_version = {VERSION}; PRAGMA application_id = {_APPLICATION_ID}; COMMIT;"
        )
        _note_reader(database)


def _note_reader(database: sqlite3.Connection) -> None:
    """Record the oldest version of crashhunt that can read the ledger."""
    row = (_READER_FACT, json.dumps(_MIN_READER_VERSION))
    database.execute("INSERT OR REPLACE INTO hunt VALUES (?, ?, ?)", (*row, digest_of_row(row)))


def shape_of(database: sqlite3.Connection, path: Path) -> Shape:
    """Return the columns of the tables of a ledger.

    Raises:
        HuntDirectoryError: the tables cannot be read, do not belong to their version, or are older than version 1.
        sqlite3.Error: the file is not a database.
    """
    version, application = (
        int(database.execute(f"PRAGMA {name}").fetchone()[0]) for name in ("user_version", "application_id")
    )
    names = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not names & COLUMNS.keys():
        raise HuntDirectoryError(
            "not a ledger of crashhunt: its tables are missing", fix="choose another directory", where=str(path)
        )
    if not application:
        raise HuntDirectoryError("the ledger is older than format version 1", fix=HOW_TO_READ, where=str(path))
    if version < 1 or application != _APPLICATION_ID:
        raise damaged(path, f"its version is {version} of {application:x}")
    if version > VERSION:
        _refuse_unreadable(database, path, version)
    return Shape(version, {table: _columns(database, path, version, table) for table in COLUMNS})


def _columns(database: sqlite3.Connection, path: Path, version: int, table: str) -> tuple[str, ...]:
    there = tuple(name for _, name, *_ in database.execute(f"PRAGMA table_info({table})"))
    known, place = COLUMNS[table], _DIGEST_PLACES[table]
    expected = (*known[:place], "digest", *known[place:])
    if version > VERSION and "digest" in there:
        columns = tuple(name for name in there if name != "digest")
        if columns[: len(known)] == known:
            return columns
    if there != expected:
        odd = sorted(set(expected) ^ set(there))
        if not there:
            raise damaged(path, f"the table {table} of version {version} is missing")
        what = f"the columns {', '.join(odd)}" if odd else "the order of the columns"
        raise damaged(path, f"the table {table} differs from that of version {version} in {what}")
    return known


def _refuse_unreadable(database: sqlite3.Connection, path: Path, version: int) -> None:
    """Refuse a ledger of a newer version, unless it records that this version can read it."""
    try:
        row = database.execute("SELECT key, value, digest FROM hunt WHERE key = ?", (_READER_FACT,)).fetchone()
        if row is not None and int(json.loads(checked(row, "the minimum version of its reader", path)[1])) <= VERSION:
            return
    except (sqlite3.Error, ValueError, TypeError):
        pass
    raise HuntDirectoryError(
        f"the ledger has version {version}, but this crashhunt reads versions up to {VERSION}",
        fix="use the crashhunt that made it, or run with --overwrite to begin again",
        where=str(path),
    )


# The file of a ledger, and what can be wrong with it.

Row: TypeAlias = tuple[Any, ...]
"""A row as SQLite returns it. The caller's query names its columns."""


def checked(row: Row, what: str, path: Path) -> Row:
    """Return a row after checking it against its digest, which is the last column.

    Raises:
        HuntDirectoryError: the row does not match its digest.
    """
    if digest_of_row(row[:-1]) != row[-1]:
        raise damaged(path, f"{what} has changed since it was written")
    return row


def plain_trial(row: Row, path: Path) -> JsonObject:
    """Return the trial that a checked row of all columns contains, as JSON data.

    Raises:
        HuntDirectoryError: the row contains no valid trial.
    """
    try:
        data: JsonObject = json.loads(row[10])
    except (ValueError, TypeError, RecursionError) as error:
        raise damaged(path, f"trial {row[0]} cannot be read: {error}") from None
    return data


def damaged(path: Path, message: str) -> HuntDirectoryError:
    """Return the error for a ledger that has changed since it was written."""
    fix = f"run {command_line('crashhunt', 'check', path.parent)} to see what can be recovered"
    return HuntDirectoryError(f"the ledger is damaged: {message}", fix=fix, where=str(path))


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Return a context in which an error of SQLite becomes an error of crashhunt."""
    try:
        yield
    except sqlite3.Error as error:
        raise _explanation(path, error) from error


def _explanation(path: Path, error: sqlite3.Error) -> HuntDirectoryError:
    where, text = str(path), " ".join(str(error).split())  # which may quote what is damaged
    # SQLite reports a file that would exceed ``ulimit -f`` as an I/O error.
    if "disk I/O" in text and (limit := limit_behind(OSError(errno.EFBIG, text))):
        what, _, fix = limit.partition(": ")
        return HuntDirectoryError(f"cannot be written ({text}), because {what}", fix=fix, where=where)
    if "full" in text or "disk I/O" in text:
        return HuntDirectoryError(f"the disk is full ({text})", fix=FREE_SPACE, where=where)
    if "locked" in text:
        return HuntDirectoryError(
            f"another program keeps it busy ({text})", fix="close what has it open, and try again", where=where
        )
    if "unable to open" in text or "readonly" in text:
        if no_file := error_of_next_files(_FILES_OF_LEDGER):
            message = f"cannot be opened ({no_file.strerror})"
            return HuntDirectoryError(message, fix=limit_behind(no_file) or remedy(no_file), where=where)
        if os.path.isdir(path):  # noqa: PTH112
            return damaged(path, "a folder is where the file should be")
        there = os.path.exists(path.parent)  # noqa: PTH110
        if there and os.path.exists(path) and not os.access(path, os.R_OK):  # noqa: PTH110
            return HuntDirectoryError(f"it may not be read ({text})", fix="make it readable", where=where)
        reason = "is not writable" if there else "does not exist"
        return HuntDirectoryError(f"the folder {reason} ({text})", fix="choose another folder", where=where)
    if "not a database" in text:
        return HuntDirectoryError(
            f"not a ledger of crashhunt ({text})",
            fix=f"choose another directory, or see with {command_line('crashhunt', 'check', path.parent)} what is left",
            where=where,
        )
    return damaged(path, text)


_untouched: ContextVar[bool] = ContextVar("untouched", default=False)


@contextmanager
def leave_untouched() -> Iterator[None]:
    """Return a context in which every ledger is opened read-only, as `opened` does with `read_only`."""
    before = _untouched.set(True)
    try:
        yield
    finally:
        _untouched.reset(before)


def is_untouched() -> bool:
    """Return whether the caller is inside the context of `leave_untouched`."""
    return _untouched.get()


def may_write(path: Path) -> bool:
    """Return whether a reader can write SQLite's files next to a ledger.

    It cannot in another user's folder, on a read-only file system, or on a full disk.
    """
    disk = os.statvfs(path.parent)
    return os.access(path.parent, os.W_OK) and (disk.f_blocks == 0 or disk.f_bavail > 0)


_BUSY_S = 10.0  # for another process to release its lock on the file
_RETRY_S = 0.05
_LOOK_EVERY_S = 1.0  # how late a request to stop waiting may be


class PatientConnection(sqlite3.Connection):
    """A connection that can wait for minutes while another process, such as a backup, locks the file."""

    # function called about once a second with the time that a statement has waited, in s. It may raise an error to stop
    # waiting. The default waits for ten seconds.
    wait: Callable[[float], None] | None = None

    def execute(self, statement: str, *given: Any) -> sqlite3.Cursor:
        """Run a statement; a statement that could not begin, because the file is locked, is run again."""
        began = time.monotonic()
        while True:
            try:
                return super().execute(statement, *given)
            except sqlite3.OperationalError as error:
                waited_s = time.monotonic() - began
                # A transaction whose snapshot is too old has another code: it cannot be run again.
                if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or (self.wait is None and waited_s > _BUSY_S):
                    raise
                if self.wait is not None:
                    self.wait(waited_s)
                time.sleep(_RETRY_S)  # SQLite itself does not wait in every case


def opened(path: Path, *, read_only: bool = False) -> PatientConnection:
    """Open a ledger.

    Args:
        path: path of the ledger file.
        read_only: whether to leave the folder unchanged. Otherwise SQLite creates two files next to a ledger that is
            read, and the last reader of a killed hunt merges one of them into the ledger.
    """
    if not read_only:
        return _connect(path)
    log = path.with_name(f"{path.name}-wal")
    # Without a write-ahead log, nothing writes to the file. With one, readers need the shared memory next to it.
    mode = "mode=ro" if has_content(log) else "mode=ro&immutable=1"
    uri = f"{path.absolute().as_uri()}?{mode}"
    database = _connect(uri, uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_CELL_BYTES)
    return database


def _connect(database: Path | str, *, uri: bool = False) -> PatientConnection:
    return sqlite3.connect(
        database, uri=uri, isolation_level=None, check_same_thread=False, timeout=_LOOK_EVERY_S,
        factory=PatientConnection,
    )  # fmt: skip


def has_content(path: Path) -> bool:
    """Return whether a file exists and is not empty."""
    try:
        return path.stat().st_size > 0
    except OSError:
        return False


def removed(path: Path, was: os.stat_result) -> bool:
    """Return whether the file of an open ledger was removed.

    Raises:
        HuntDirectoryError: another file has replaced it.
    """
    try:
        if os.path.samestat(path.stat(), was):
            return False
    except FileNotFoundError:
        return True
    raise HuntDirectoryError(
        "another file replaced the ledger while the hunt ran",
        fix="run the hunt again, in a directory that no other process writes to",
        where=str(path),
    )


def rewrite(database: sqlite3.Connection, path: Path) -> None:
    """Write an open ledger whose file was removed to a new file, and close the ledger.

    Raises:
        HuntDirectoryError: the folder was removed or is not writable.
    """
    try:
        with explained(path), whole_file(path) as temporary:
            with closing(sqlite3.connect(temporary)) as copy:
                database.backup(copy)
            database.close()  # which removes what belongs to the old file
    except OSError as error:
        message = f"the ledger was removed while the hunt ran, and cannot be written again: {error.strerror}"
        fix = "run the hunt again, in a directory that no other process writes to"
        raise HuntDirectoryError(message, fix=fix, where=str(path)) from error
