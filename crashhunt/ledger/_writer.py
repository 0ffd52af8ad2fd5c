"""The ledger: facts about trials in one SQLite file; one writer, any number of readers, also while the hunt runs.

Every row has a digest of its content, and every reader checks it. A writer that closes the file *seals* it. The seal
has the number of trials of each outcome and a digest over the columns that count and rank them. So readers of single
columns detect a change, too, and a missing row is detected. During a hunt, and after a kill, there is no seal.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Unpack

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.integrity import digest_of_row
from crashhunt.ledger._reader import LedgerReader, Turn
from crashhunt.ledger._schema import (
    SEAL,
    VERSION,
    columns_of_trials,
    create,
    damaged,
    explained,
    is_untouched,
    migrate,
    opened,
    removed,
    rewrite,
    shape_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from crashhunt.ledger._reader import Facts, Noted
    from crashhunt.ledger._schema import Row
    from crashhunt.trial import TrialResult


__all__ = ["Ledger", "Turn", "has_begun"]


_COLUMNS = columns_of_trials()
_PLACEHOLDERS = ", ".join("?" * (len(_COLUMNS) + 1))
_INSERT = f"INSERT OR REPLACE INTO trials ({', '.join(_COLUMNS)}, digest) VALUES ({_PLACEHOLDERS})"
_TOGETHER_S = 0.5  # a kill loses no more than this of what was recorded together


def has_begun(path: Path) -> bool:
    """Return whether a ledger exists; an empty file, which SQLite creates on opening, does not count."""
    return path.exists() and path.stat().st_size > 0


class Ledger(LedgerReader):
    """Writes the trials and the facts of a hunt.

    Args:
        path: path of ``ledger.sqlite``.
        writable: the one writer; creates the file, and brings one of an earlier version to this one.
        read_only: leave even SQLite's own files next to it as they are; for a reader of foreign hunts.

    Raises:
        HuntDirectoryError: the file cannot be opened, is not a ledger, or is damaged.
    """

    def __init__(self, path: Path, *, writable: bool = False, read_only: bool = False) -> None:
        self._writable = False
        self._together_since = math.inf
        if not writable and not path.exists():
            raise HuntDirectoryError(
                f"{str(path.parent)!r} is not the directory of a hunt: it has no ledger.sqlite",
                fix="give the directory of a hunt",
            )
        try:
            if writable and not has_begun(path):
                create(path)
            database = opened(path, read_only=read_only or (not writable and is_untouched()))
            with ExitStack() as failed:
                failed.callback(database.close)
                super().__init__(database, path, shape_of(database, path))
                if writable:
                    self._begin_to_write()
                failed.pop_all()
        except sqlite3.Error as error:
            raise explained(path, error) from error

    def record(self, result: TrialResult, *, snapshot: str) -> None:
        """Add a trial that has ended; one that ran again replaces its row.

        Raises:
            HuntDirectoryError: the disk is full.
        """
        closest = result.closest.to_json()
        row = (
            result.spec.number,
            result.spec.seed,
            str(result.outcome),
            result.steps,
            _real(closest["time_to_collision_s"]),
            _real(closest["gap_m"]),
            _real(closest["required_deceleration"]),
            float(result.wall_s),
            time.time(),
            snapshot,
            json.dumps(result.to_json()),
            _real(result.danger),
            result.other_steps,
        )
        self._insert(row)

    @contextmanager
    def together(self) -> Iterator[None]:
        """Write all records inside the context together, so that thousands of trials can be recorded per second.

        What was recorded is written half a second later at the latest, with the next trial: the caller may wait
        for trials in between. Other processes do not see it before, and a kill loses it: those trials run again.

        Raises:
            HuntDirectoryError: the disk is full.
        """
        try:
            self._database.execute("BEGIN")  # which locks nothing until the first of them
            self._together_since = time.monotonic()
            try:
                yield
            finally:  # what has been recorded has happened, whatever keeps the rest from it
                self._together_since = math.inf
                if self._database.in_transaction:  # which an error of the disk may have ended
                    self._database.execute("COMMIT")
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def copy(self, row: Row) -> None:
        """Add a row that `intact_rows` of another ledger has yielded, of any version."""
        count = len(_COLUMNS)
        self._insert((*row, *(None,) * count)[:count])

    def propose(self, turns: Sequence[Turn]) -> None:
        """Add the proposals of a sampler that learns, all or nothing, and the results that it received before.

        When this returns, a kill changes nothing about it any more. If the power goes, the last second may be
        lost; then what depended on it, the trials and their results, is lost with it.

        Raises:
            HuntDirectoryError: the disk is full, or one of the trials was proposed before.
        """
        try:
            with self._database:
                self._database.execute("BEGIN")
                for turn in turns:
                    self._turns += 1
                    row = (self._turns, turn.spec.number, json.dumps(turn.told), json.dumps(turn.spec.to_json()))
                    values = (*row, digest_of_row(row))
                    self._database.execute("INSERT INTO proposals VALUES (?, ?, ?, ?, ?)", values)
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def note(self, **facts: Unpack[Facts]) -> None:
        """Set facts about the hunt itself, such as its state; None removes one.

        When this returns, everything that was recorded so far is on the disk, and stays there if the power goes. It is
        called about once a second; after every trial it would cost more than the trials.
        """
        try:
            with self._lasting():
                for key, value in facts.items():
                    self._note(key, value)
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def enter(self, state: str, detail: str = "", **facts: Unpack[Noted]) -> None:
        """Set the state of the hunt, and write down when it got there and why."""
        self.note(state=state, detail=detail or None, **facts)
        self._event(state, detail)

    def remark(self, detail: str) -> None:
        """Record an event; the state of the hunt does not change."""
        self._event("remark", detail)

    def _event(self, state: str, detail: str) -> None:
        event = (time.time(), state, detail)
        try:
            with self._lasting():
                self._database.execute("INSERT INTO events VALUES (?, ?, ?, ?)", (*event, digest_of_row(event)))
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def replace(self, numbers: Iterable[int]) -> int:
        """Move trials out of the way so that they run again; return how many there were."""
        gone = 0
        try:
            with self._database:
                self._database.execute("BEGIN")
                for number in numbers:
                    found = self.result_text(number)
                    if found is not None:
                        row = (number, time.time(), found)
                        self._database.execute("INSERT INTO replaced VALUES (?, ?, ?, ?)", (*row, digest_of_row(row)))
                        self._database.execute("DELETE FROM trials WHERE number = ?", (number,))
                        gone += 1
        except sqlite3.Error as error:
            raise explained(self._path, error) from error
        return gone

    def restore(self) -> bool:
        """Write the file again if it was removed; its content exists as long as it is open.

        Returns:
            Whether it was gone.

        Raises:
            HuntDirectoryError: another file is in its place, or the folder is gone, or not writable.
        """
        if not removed(self._path, self._file):
            return False
        rewrite(self._database, self._path)
        self._database = opened(self._path)
        self._prepare()
        return True

    def close(self) -> None:
        """Close the file; a writer seals it before."""
        if self._writable:
            with suppress(sqlite3.Error, HuntDirectoryError):  # on a full disk it stays without
                self._note(SEAL, self._make_seal())
            self._writable = False
        self._database.close()

    def _insert(self, row: Row) -> None:
        values = (*row, digest_of_row(row))
        try:
            self._database.execute(_INSERT, values)
            if time.monotonic() - self._together_since > _TOGETHER_S:
                self._database.execute("COMMIT")
                self._database.execute("BEGIN")
                self._together_since = time.monotonic()
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def _note(self, key: str, value: object) -> None:
        if value is None:
            self._database.execute("DELETE FROM hunt WHERE key = ?", (key,))
        else:
            row = (key, json.dumps(value))
            self._database.execute("INSERT OR REPLACE INTO hunt VALUES (?, ?, ?)", (*row, digest_of_row(row)))

    @contextmanager
    def _lasting(self) -> Iterator[None]:
        """Make one commit wait for the disk; this also makes all earlier commits durable."""
        self._database.execute("PRAGMA synchronous = FULL")
        try:
            with self._database:
                self._database.execute("BEGIN")
                yield
        finally:
            self._database.execute("PRAGMA synchronous = NORMAL")

    def _begin_to_write(self) -> None:
        """Check that the existing content is intact before anything is added, and migrate it to this version.

        Raises:
            HuntDirectoryError: it is not, or it is of a newer version.
        """
        if self._shape.version > VERSION:  # its columns are unknown here
            raise HuntDirectoryError(
                f"the ledger has version {self._shape.version}, but this crashhunt writes version {VERSION}: the "
                "ledger can be read, but not extended",
                fix="resume with the crashhunt that made it, or run with --overwrite to begin again",
                where=str(self._path),
            )
        self._prepare()
        seal = self._seal()
        if seal is None:
            for rows in (self.plain_results(), self.turns()):
                for _ in rows:
                    pass
        elif not self._fits(seal):
            raise damaged(self._path, "trials are missing or have changed")
        if self._shape.version < VERSION:
            migrate(self._database, self._shape.version)
            self._shape = shape_of(self._database, self._path)
        self._turns = int(next(self._select("SELECT coalesce(max(turn), 0) FROM proposals"))[0])
        if seal is not None:
            self._note(SEAL, None)
        self._writable = True

    def _prepare(self) -> None:
        """Make what follows last: a reader never blocks the writer, and a kill leaves a file that opens."""
        self._database.execute("PRAGMA journal_mode = WAL")
        self._database.execute("PRAGMA synchronous = NORMAL")
        self._file = self._path.stat()


def _real(value: float | None) -> float | None:
    return None if value is None else float(value)  # as SQLite gives it back
