"""The writer of a ledger: records facts about trials in one SQLite file. Any number of readers may read meanwhile.

Every row has a digest of its content, and every reader checks it. A writer that closes the file *seals* it. The seal
contains the number of trials of each outcome, and a digest over the columns for counts and rankings. Readers of single
columns can therefore detect changed and missing rows as well. During a hunt, and after a kill, there is no seal.
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
from crashhunt.ledger._reader import LedgerReader, Turn as Turn
from crashhunt.ledger._schema import (
    COLUMNS,
    SEAL,
    VERSION,
    Row,
    create,
    damaged,
    explained,
    is_untouched,
    may_write,
    opened,
    removed,
    rewrite,
    shape_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from crashhunt.ledger._facts import Facts, Noted
    from crashhunt.trial import TrialResult


_COLUMNS = COLUMNS["trials"]
_PLACEHOLDERS = ", ".join("?" * (len(_COLUMNS) + 1))
_INSERT = f"INSERT OR REPLACE INTO trials ({', '.join(_COLUMNS)}, digest) VALUES ({_PLACEHOLDERS})"
_TOGETHER_S = 0.5  # a kill loses no more than this of what was recorded together


def has_begun(path: Path) -> bool:
    """Return whether a ledger exists. An empty file, which SQLite creates on opening, does not count."""
    return path.exists() and path.stat().st_size > 0


class Ledger(LedgerReader):
    """Writes the trials and the facts of a hunt.

    Args:
        path: path of ``ledger.sqlite``.
        writable: whether to write. The only writer creates the file.
        read_only: whether to leave SQLite's auxiliary files next to the ledger unchanged; for readers of other users'
            hunts.
        wait: function called while another process locks the file, as for `wait_while_locked`, from the beginning on.

    Raises:
        HuntDirectoryError: the file cannot be opened, is not a ledger, or is damaged.
    """

    def __init__(
        self,
        path: Path,
        *,
        writable: bool = False,
        read_only: bool = False,
        wait: Callable[[float], None] | None = None,
    ) -> None:
        self._writable = False
        self._together_since = math.inf
        if not writable and not path.exists():
            raise HuntDirectoryError(
                f"{str(path.parent)!r} is not the directory of a hunt: it has no ledger.sqlite",
                fix="give the directory of a hunt",
            )
        with explained(path):
            if writable and not has_begun(path):
                create(path)
            database = opened(path, read_only=read_only or (not writable and (is_untouched() or not may_write(path))))
            database.wait = wait
            with ExitStack() as failed:
                failed.callback(database.close)
                super().__init__(database, path, shape_of(database, path))
                if writable:
                    self._begin_to_write()
                failed.pop_all()

    def wait_while_locked(self, wait: Callable[[float], None]) -> None:
        """Wait without a limit from now on while another process, such as a backup, locks the file.

        Args:
            wait: function called about once a second with the time that a statement has waited, in s. It may raise an
                error to stop waiting.
        """
        self._database.wait = wait

    def record(self, result: TrialResult, *, snapshot: str) -> None:
        """Add a finished trial. If the trial was run again, the new row replaces the old row.

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
        """Return a context whose records are written together, so that thousands of trials can be recorded per second.

        A record is written with the first trial that follows at least half a second later, so the caller may wait
        between trials. Until then, other processes do not see the record, and a kill loses it; the trial then runs
        again.

        Raises:
            HuntDirectoryError: the disk is full.
        """
        with explained(self._path):
            self._database.execute("BEGIN")  # which locks nothing until the first of them
            self._together_since = time.monotonic()
            try:
                yield
            finally:  # what has been recorded has happened, whatever keeps the rest from it
                self._together_since = math.inf
                if self._database.in_transaction:  # which an error of the disk may have ended
                    self._database.execute("COMMIT")

    def copy(self, row: Row) -> None:
        """Add a row that `intact_rows` of another ledger has yielded, without the columns of a later version."""
        self._insert(row[: len(_COLUMNS)])

    def propose(self, turns: Sequence[Turn]) -> None:
        """Add proposals of a learning sampler and the results that it received before, all or nothing.

        After the method has returned, a kill loses no proposal. A power failure may lose the last second. In that case,
        the trials that depend on it, and their results, are lost as well.

        Raises:
            HuntDirectoryError: the disk is full, or a trial was proposed twice.
        """
        with explained(self._path), self._database:
            self._database.execute("BEGIN")
            for turn in turns:
                self._turns += 1
                row = (self._turns, turn.spec.number, json.dumps(turn.told), json.dumps(turn.spec.to_json()))
                self._database.execute("INSERT INTO proposals VALUES (?, ?, ?, ?, ?)", (*row, digest_of_row(row)))

    def note(self, **facts: Unpack[Facts]) -> None:
        """Set facts about the hunt as a whole, such as its state; the value None removes a fact.

        After the method has returned, all earlier records are on the disk and survive a power failure. This method is
        called about once a second. A call after every trial would cost more than the trials.
        """
        with self._lasting():
            for key, value in facts.items():
                self._note(key, value)

    def enter(self, state: str, detail: str = "", **facts: Unpack[Noted]) -> None:
        """Set the state of the hunt, and record the time and the reason."""
        self.note(state=state, detail=detail or None, **facts)
        self._event(state, detail)

    def remark(self, detail: str) -> None:
        """Record an event without a change of the hunt's state."""
        self._event("remark", detail)

    def _event(self, state: str, detail: str) -> None:
        event = (time.time(), state, detail)
        with self._lasting():
            self._database.execute("INSERT INTO events VALUES (?, ?, ?, ?)", (*event, digest_of_row(event)))

    def replace(self, numbers: Iterable[int]) -> int:
        """Remove trials from the results so that they run again, and return the number of removed trials."""
        gone = 0
        with explained(self._path), self._database:
            self._database.execute("BEGIN")
            for number in numbers:
                found = self.result_text(number)
                if found is not None:
                    row = (number, time.time(), found)
                    self._database.execute("INSERT INTO replaced VALUES (?, ?, ?, ?)", (*row, digest_of_row(row)))
                    self._database.execute("DELETE FROM trials WHERE number = ?", (number,))
                    gone += 1
        return gone

    def restore(self) -> bool:
        """Write the file again if it was removed; its contents exist as long as the ledger is open.

        Returns:
            Whether the file had been removed.

        Raises:
            HuntDirectoryError: another file has replaced it, or the folder was removed or is not writable.
        """
        if not removed(self._path, self._file):
            return False
        wait = self._database.wait
        rewrite(self._database, self._path)
        self._database = opened(self._path)
        self._database.wait = wait
        self._prepare()
        return True

    def close(self) -> None:
        """Close the file; a writer seals the ledger first."""
        if self._writable:
            with suppress(sqlite3.Error, HuntDirectoryError):  # on a full disk it stays without
                self._note(SEAL, self._make_seal())
        self._database.close()

    def _insert(self, row: Row) -> None:
        with explained(self._path):
            self._database.execute(_INSERT, (*row, digest_of_row(row)))
            if time.monotonic() - self._together_since > _TOGETHER_S:
                self._database.execute("COMMIT")
                self._database.execute("BEGIN")
                self._together_since = time.monotonic()

    def _note(self, key: str, value: object) -> None:
        if value is None:
            self._database.execute("DELETE FROM hunt WHERE key = ?", (key,))
        else:
            row = (key, json.dumps(value))
            self._database.execute("INSERT OR REPLACE INTO hunt VALUES (?, ?, ?)", (*row, digest_of_row(row)))

    @contextmanager
    def _lasting(self) -> Iterator[None]:
        """Return a context whose commit waits for the disk, which also makes all earlier commits durable.

        Inside `together`, its records are committed first, because SQLite refuses a transaction within a transaction.
        """
        with explained(self._path):
            is_together = self._database.in_transaction
            if is_together:
                self._database.execute("COMMIT")
            self._database.execute("PRAGMA synchronous = FULL")
            try:
                with self._database:
                    self._database.execute("BEGIN")
                    yield
            finally:
                self._database.execute("PRAGMA synchronous = NORMAL")
                if is_together:
                    self._database.execute("BEGIN")
                    self._together_since = time.monotonic()

    def _begin_to_write(self) -> None:
        """Check that the existing contents are intact before the first write.

        Raises:
            HuntDirectoryError: the contents are damaged, or are of a newer version.
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
        self._turns = int(next(self._select("SELECT coalesce(max(turn), 0) FROM proposals"))[0])
        if seal is not None:
            self._note(SEAL, None)
        self._writable = True

    def _prepare(self) -> None:
        """Configure SQLite so that readers never block the writer, and a killed writer leaves a readable file."""
        self._database.execute("PRAGMA journal_mode = WAL")
        self._database.execute("PRAGMA synchronous = NORMAL")
        self._file = self._path.stat()


def _real(value: float | None) -> float | None:
    return None if value is None else float(value)  # as SQLite gives it back
