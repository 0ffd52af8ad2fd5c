"""The ledger: facts about trials in one SQLite file; one writer, any number of readers, also while the hunt runs."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

from crashhunt.errors import HuntDirectoryError
from crashhunt.trial import TrialResult
from crashhunt.whole_file import whole_file

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

__all__ = ["Ledger", "has_begun"]

_VERSION = 1  # of the tables, as PRAGMA user_version
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
    result TEXT NOT NULL
) STRICT;
-- What counts, ranks and compares trials reads this instead of the rows, which are fifty times as large.
CREATE INDEX IF NOT EXISTS trials_by_outcome ON trials (outcome, time_to_collision_s, number, steps, seed);
CREATE TABLE IF NOT EXISTS replaced (number INTEGER, replaced_at REAL, result TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS events (at REAL NOT NULL, state TEXT NOT NULL, detail TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS hunt (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT, WITHOUT ROWID;
"""


def has_begun(path: Path) -> bool:
    """Whether there is a ledger; an empty file, which whoever looks with SQLite leaves behind, is none."""
    return path.exists() and path.stat().st_size > 0


class Ledger:
    """What happened in a hunt.

    Args:
        path: of ``ledger.sqlite``.
        writable: the one writer; creates the file.

    Raises:
        HuntDirectoryError: the file cannot be opened, or is not a ledger.
    """

    def __init__(self, path: Path, *, writable: bool = False) -> None:
        self._path = path
        if not writable and not path.exists():
            raise HuntDirectoryError(
                f"{str(path.parent)!r} is not the directory of a hunt: it has no ledger.sqlite",
                fix="give the directory that crashhunt run was given",
            )
        try:
            if writable and not has_begun(path):
                _create(path)
            self._database = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
            with ExitStack() as failed:
                failed.callback(self._database.close)
                if writable:
                    # A reader never blocks the writer, and a kill or a power cut leaves a file that opens.
                    self._database.execute("PRAGMA journal_mode = WAL")
                    self._database.execute("PRAGMA synchronous = NORMAL")
                self._check()
                failed.pop_all()
        except sqlite3.Error as error:
            raise self._explained(error) from error

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
            closest["time_to_collision_s"],
            closest["gap_m"],
            closest["required_deceleration"],
            result.wall_s,
            time.time(),
            snapshot,
            json.dumps(result.to_json()),
        )
        try:
            self._database.execute("INSERT OR REPLACE INTO trials VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
        except sqlite3.Error as error:
            raise self._explained(error) from error

    def note(self, **facts: Any) -> None:
        """Set facts about the hunt itself, such as its state; None removes one."""
        try:
            for key, value in facts.items():
                if value is None:
                    self._database.execute("DELETE FROM hunt WHERE key = ?", (key,))
                else:
                    self._database.execute("INSERT OR REPLACE INTO hunt VALUES (?, ?)", (key, json.dumps(value)))
        except sqlite3.Error as error:
            raise self._explained(error) from error

    def enter(self, state: str, detail: str = "", **facts: Any) -> None:
        """Set the state of the hunt, and write down when it got there and why."""
        self.note(state=state, detail=detail or None, **facts)
        try:
            self._database.execute("INSERT INTO events VALUES (?, ?, ?)", (time.time(), state, detail))
        except sqlite3.Error as error:
            raise self._explained(error) from error

    def events(self) -> list[tuple[float, str, str]]:
        """Return when the hunt got into which state, and why."""
        return list(self._select("SELECT at, state, detail FROM events ORDER BY rowid"))

    def replace(self, numbers: Iterable[int]) -> int:
        """Move trials out of the way so that they run again; return how many there were."""
        rows = [(number, time.time(), number) for number in numbers]
        try:
            with self._database:
                self._database.execute("BEGIN")
                self._database.executemany(
                    "INSERT INTO replaced SELECT ?, ?, result FROM trials WHERE number = ?", rows
                )
                gone = self._database.executemany("DELETE FROM trials WHERE number = ?", [row[:1] for row in rows])
        except sqlite3.Error as error:
            raise self._explained(error) from error
        return gone.rowcount

    def replaced(self) -> list[TrialResult]:
        """Return the trials that ran again, as they were."""
        rows = self._select("SELECT result FROM replaced ORDER BY rowid")
        return [TrialResult.from_json(json.loads(text)) for (text,) in rows]

    def facts(self) -> dict[str, Any]:
        """Return the facts about the hunt itself."""
        return {key: json.loads(value) for key, value in self._select("SELECT key, value FROM hunt")}

    def finished(self) -> set[int]:
        """Return the numbers of the trials that have ended."""
        return {number for (number,) in self._select("SELECT number FROM trials")}

    def outcomes(self) -> dict[str, int]:
        """Return how many trials ended how."""
        return dict(self._select("SELECT outcome, count(*) FROM trials GROUP BY outcome ORDER BY outcome"))

    def steps_total(self) -> int:
        """Return how many steps were run in all."""
        return int(next(self._select("SELECT coalesce(sum(steps), 0) FROM trials"))[0])

    def results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[TrialResult]:
        """Yield trials in the order of their numbers, all or those that ended in one of some ways."""
        return map(TrialResult.from_json, self.plain_results(outcomes=outcomes))

    def plain_results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[dict[str, Any]]:
        """Yield the same as plain data, which takes a third of the time."""
        where = f"WHERE outcome IN ({','.join('?' * len(outcomes))})" if outcomes else ""
        for (text,) in self._select(f"SELECT result FROM trials {where} ORDER BY number", outcomes):
            yield json.loads(text)

    def result(self, number: int) -> TrialResult | None:
        """Return one trial, or None where it has not ended."""
        row = next(self._select("SELECT result FROM trials WHERE number = ?", (number,)), None)
        return TrialResult.from_json(json.loads(row[0])) if row else None

    def snapshot_of(self, number: int) -> str:
        """Return the digest of the snapshot that a trial ran from."""
        row = next(self._select("SELECT snapshot FROM trials WHERE number = ?", (number,)), None)
        return str(row[0]) if row else ""

    def nearest_miss(self) -> TrialResult | None:
        """Return the trial that did not crash and came nearest to it, by time to collision."""
        least = [
            row
            for outcome in ("survived", "finished")
            for row in self._select(
                "SELECT time_to_collision_s, number FROM trials WHERE outcome = ? AND time_to_collision_s IS NOT NULL "
                "ORDER BY time_to_collision_s, number LIMIT 1",
                (outcome,),
            )
        ]
        return self.result(min(least)[1]) if least else None

    def table(self) -> Iterator[tuple[int, int, str, int, float | None]]:
        """Yield number, seed, outcome, steps and least time to collision of every trial, in no particular order."""
        yield from self._select(
            "SELECT number, seed, outcome, steps, time_to_collision_s FROM trials INDEXED BY trials_by_outcome"
        )

    def last_ended_at(self) -> float | None:
        """Return when the last trial ended, in s since the epoch; None where none has."""
        row = next(self._select("SELECT ended_at FROM trials ORDER BY number DESC LIMIT 1"), None)
        return float(row[0]) if row else None

    def _select(self, query: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        try:
            yield from self._database.execute(query, values)
        except sqlite3.Error as error:  # also in the middle of a file that is damaged
            raise self._explained(error) from error

    def _check(self) -> None:
        found = int(self._database.execute("PRAGMA user_version").fetchone()[0])
        self._database.execute("SELECT count(*) FROM hunt").fetchone()
        if found != _VERSION:
            raise HuntDirectoryError(
                f"a ledger of version {found}, and this crashhunt reads version {_VERSION}",
                fix="use the crashhunt that made it, or run with --overwrite to begin anew",
                where=str(self._path),
            )

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _explained(self, error: sqlite3.Error) -> HuntDirectoryError:
        where = str(self._path)
        text = str(error)
        if "full" in text or "disk I/O" in text:
            return HuntDirectoryError(
                f"the disk is full ({text})", fix="free some space and run the same command again", where=where
            )
        if "unable to open" in text or "readonly" in text:
            reason = "is not writable" if os.path.exists(self._path.parent) else "does not exist"  # noqa: PTH110
            return HuntDirectoryError(f"the folder {reason} ({text})", fix="choose another", where=where)
        return HuntDirectoryError(f"not a ledger of crashhunt ({text})", fix="choose another directory", where=where)


def _create(path: Path) -> None:
    """Make an empty ledger, as a whole: whoever sees the file can read it."""
    path.with_name(f"{path.name}-wal").unlink(missing_ok=True)  # SQLite would take that of an earlier one for its own
    with whole_file(path) as temporary, closing(sqlite3.connect(temporary, isolation_level=None)) as database:
        database.executescript(f"BEGIN; {_SCHEMA} PRAGMA user_version = {_VERSION}; COMMIT;")
