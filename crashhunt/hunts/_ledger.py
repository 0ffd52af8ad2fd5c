"""The ledger: facts about trials in one SQLite file; one writer, any number of readers, also while the hunt runs.

Every row has a digest of its content, which whoever reads the row checks. A writer that closes the file *seals* it: it
writes down how many trials ended how and a digest over what counts and ranks them, so that those who read no whole rows
see a change too, and that a row that is gone is missed. While a hunt runs, and after it was killed, there is no seal.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import time
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.integrity import digest_of_row
from crashhunt.hunts._ledger_file import (
    COLUMNS,
    PROTECTED,
    checked,
    create,
    damaged,
    explained,
    migrate,
    opened,
    plain_trial,
    removed,
    rewrite,
    version_of,
)
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

__all__ = ["Ledger", "has_begun"]

_SEAL = "seal"
_CHUNK = 4096


def has_begun(path: Path) -> bool:
    """Whether there is a ledger; an empty file, which whoever looks with SQLite leaves behind, is none."""
    return path.exists() and path.stat().st_size > 0


class Ledger:
    """What happened in a hunt.

    Args:
        path: of ``ledger.sqlite``.
        writable: the one writer; creates the file, and brings one of an earlier version to this one.

    Raises:
        HuntDirectoryError: the file cannot be opened, is not a ledger, or is damaged.
    """

    def __init__(self, path: Path, *, writable: bool = False) -> None:
        self._path = path
        self._writable = False
        if not writable and not path.exists():
            raise HuntDirectoryError(
                f"{str(path.parent)!r} is not the directory of a hunt: it has no ledger.sqlite",
                fix="give the directory that crashhunt run was given",
            )
        try:
            if writable and not has_begun(path):
                create(path)
            self._database = opened(path)
            with ExitStack() as failed:
                failed.callback(self._database.close)
                if writable:
                    self._prepare()
                self._version = version_of(self._database, path)
                if writable:
                    self._break_seal()
                    self._writable = True
                failed.pop_all()
        except sqlite3.Error as error:
            raise explained(path, error) from error

    @property
    def protected(self) -> bool:
        """Whether every row has a digest; the earliest ledgers had none."""
        return self._version >= PROTECTED

    @property
    def sealed(self) -> bool:
        """Whether whoever wrote last has closed it."""
        return self._seal() is not None

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
        )
        self._insert(row)

    def copy(self, row: tuple[Any, ...]) -> None:
        """Add a row that `intact_rows` of another ledger has yielded."""
        self._insert(row)

    def note(self, **facts: Any) -> None:
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

    def enter(self, state: str, detail: str = "", **facts: Any) -> None:
        """Set the state of the hunt, and write down when it got there and why."""
        self.note(state=state, detail=detail or None, **facts)
        self._event(state, detail)

    def remark(self, detail: str) -> None:
        """Write down something that happened on the way; the state of the hunt stays what it is."""
        self._event("remark", detail)

    def _event(self, state: str, detail: str) -> None:
        event = (time.time(), state, detail)
        try:
            with self._lasting():
                self._database.execute("INSERT INTO events VALUES (?, ?, ?, ?)", (*event, digest_of_row(event)))
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def events(self) -> list[tuple[float, str, str]]:
        """Return when the hunt got into which state, and why."""
        seal = self._seal()
        rows = list(self._select(f"SELECT at, state, detail{self._digest} FROM events ORDER BY rowid"))
        self._compare_seal(seal, "events", len(rows))
        return [self._checked(row, "what it says of its states")[:3] for row in rows]

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

    def replaced(self) -> list[TrialResult]:
        """Return the trials that ran again, as they were."""
        seal = self._seal()
        rows = list(self._select(f"SELECT number, replaced_at, result{self._digest} FROM replaced ORDER BY rowid"))
        self._compare_seal(seal, "replaced", len(rows))
        return [self._result(json.loads(self._checked(row, "a trial that ran again")[2])) for row in rows]

    def facts(self) -> dict[str, Any]:
        """Return the facts about the hunt itself."""
        seal = self._seal()
        rows = [self._checked(row, "a fact") for row in self._select(f"SELECT key, value{self._digest} FROM hunt")]
        self._compare_seal(seal, "facts", len(rows) - 1)
        try:
            return {row[0]: json.loads(row[1]) for row in rows if row[0] != _SEAL}
        except (ValueError, TypeError, RecursionError) as error:
            raise damaged(self._path, f"a fact cannot be read: {error}") from None

    def finished(self) -> set[int]:
        """Return the numbers of the trials that have ended."""
        return {number for (number,) in self._select("SELECT number FROM trials")}

    def outcomes(self) -> dict[str, int]:
        """Return how many trials ended how."""
        seal = self._seal()
        found = self._outcomes()
        self._compare_seal(seal, "outcomes", found)
        return found

    def traffic_events(self) -> dict[str, tuple[int, int]]:
        """Return how many traffic events of each kind there were, and in how many trials."""
        # Most rows have none, and looking for a text in them takes a tenth of the time of parsing them.
        has_some = """instr(trials.result, '"events": {"') AND json_valid(trials.result)"""
        rows = self._select(
            "SELECT event.key, sum(event.value), count(*) FROM trials, "
            f"json_each(iif({has_some}, trials.result, '{{}}'), '$.events') AS event GROUP BY event.key"
        )
        return {kind: (count, trials) for kind, count, trials in rows}

    def steps_total(self) -> int:
        """Return how many steps were run in all."""
        seal = self._seal()
        found = self._steps()
        self._compare_seal(seal, "steps", found)
        return found

    def results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[TrialResult]:
        """Yield trials in the order of their numbers, all or those that ended in one of some ways."""
        return map(self._result, self.plain_results(outcomes=outcomes))

    def plain_results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[dict[str, Any]]:
        """Yield the same as plain data, which takes a third of the time.

        Raises:
            HuntDirectoryError: a trial is not as it was written, or one is missing; those before were yielded.
        """
        where = f"WHERE outcome IN ({','.join('?' * len(outcomes))})" if outcomes else ""
        seal, count = self._seal(), 0
        for row in self._select(f"SELECT {COLUMNS}{self._digest} FROM trials {where} ORDER BY number", outcomes):
            count += 1
            yield self._plain(row)
        if seal is not None:
            said = {name: number for name, number in seal["outcomes"].items() if not outcomes or name in outcomes}
            if count != sum(said.values()) and self._seal() == seal:
                raise damaged(self._path, f"it has {count} such trials, and {sum(said.values())} were written")

    def intact_rows(self, numbers: Iterable[int]) -> Iterator[tuple[int, tuple[Any, ...] | None]]:
        """Yield the rows of trials, whatever has become of the others: None for one that is not as it was written."""
        for number in numbers:
            try:
                row = self._row(number)
                if row is not None:
                    self._plain(row)
                    yield number, row[:11]
            except HuntDirectoryError:
                yield number, None

    def check_pages(self) -> None:
        """Have SQLite look at the file.

        Raises:
            HuntDirectoryError: it is damaged.
        """
        for (found,) in self._select("PRAGMA integrity_check(1)"):
            if found != "ok":
                raise damaged(self._path, " ".join(str(found).split()))

    def result(self, number: int) -> TrialResult | None:
        """Return one trial, or None where it has not ended."""
        row = self._row(number)
        if row is None:
            self.outcomes()  # which finds out whether one is missing
            return None
        return self._result(self._plain(row))

    def result_text(self, number: int) -> str | None:
        """Return one trial as it is written, or None where it has not ended."""
        row = self._row(number)
        return None if row is None else str(self._plain(row) and row[10])

    def snapshot_of(self, number: int) -> str:
        """Return the digest of the snapshot that a trial ran from."""
        row = self._row(number)
        return str(self._plain(row) and row[9]) if row else ""

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
        """Yield number, seed, outcome, steps and least time to collision of every trial, in no particular order.

        Raises:
            HuntDirectoryError: they are not as they were written; they were yielded all the same.
        """
        seal = self._seal()
        if seal is None:  # without one, only the whole rows say whether they are as they were written
            for row in self._select(f"SELECT {COLUMNS}{self._digest} FROM trials ORDER BY number"):
                self._plain(row)
                yield row[:5]
            return
        said = hashlib.blake2b(digest_size=16)
        for rows in self._chunks():
            said.update(_as_text(rows))
            yield from rows
        self._compare_seal(seal, "table", said.hexdigest())

    def last_ended_at(self) -> float | None:
        """Return when the last trial ended, in s since the epoch; None where none has."""
        row = next(self._select(f"SELECT {COLUMNS}{self._digest} FROM trials ORDER BY number DESC LIMIT 1"), None)
        return float(row[8]) if row and self._plain(row) else None

    def restore(self) -> bool:
        """Write the file anew where somebody has removed it; its content is there as long as it is open.

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
                self._note(_SEAL, self._make_seal())
            self._writable = False
        self._database.close()

    @property
    def _digest(self) -> str:
        return ", digest" if self.protected else ""

    def _insert(self, row: tuple[Any, ...]) -> None:
        values = (*row, digest_of_row(row))
        try:
            self._database.execute("INSERT OR REPLACE INTO trials VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", values)
        except sqlite3.Error as error:
            raise explained(self._path, error) from error

    def _note(self, key: str, value: Any) -> None:
        if value is None:
            self._database.execute("DELETE FROM hunt WHERE key = ?", (key,))
        else:
            row = (key, json.dumps(value))
            self._database.execute("INSERT OR REPLACE INTO hunt VALUES (?, ?, ?)", (*row, digest_of_row(row)))

    @contextmanager
    def _lasting(self) -> Iterator[None]:
        """Have one commit wait for the disk, which takes along all those before that did not."""
        self._database.execute("PRAGMA synchronous = FULL")
        try:
            with self._database:
                self._database.execute("BEGIN")
                yield
        finally:
            self._database.execute("PRAGMA synchronous = NORMAL")

    def _select(self, query: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        try:
            for row in self._database.execute(query, values):  # noqa: UP028 - it would close the cursor, maybe too late
                yield row
        except sqlite3.Error as error:  # also in the middle of a file that is damaged
            raise explained(self._path, error) from error

    def _row(self, number: int) -> tuple[Any, ...] | None:
        return next(self._select(f"SELECT {COLUMNS}{self._digest} FROM trials WHERE number = ?", (number,)), None)

    def _checked(self, row: tuple[Any, ...], what: str) -> tuple[Any, ...]:
        return checked(row, what, self._path) if self.protected else row

    def _plain(self, row: tuple[Any, ...]) -> dict[str, Any]:
        return plain_trial(self._checked(row, f"trial {row[0]}"), self._path, trusted=self.protected)

    def _result(self, data: dict[str, Any]) -> TrialResult:
        try:
            return TrialResult.from_json(data)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise damaged(self._path, f"a trial cannot be read: {type(error).__name__}: {error}") from None

    def _seal(self) -> dict[str, Any] | None:
        if not self.protected:
            return None
        row = next(self._select("SELECT key, value, digest FROM hunt WHERE key = ?", (_SEAL,)), None)
        if row is None:
            return None
        found: dict[str, Any] = json.loads(self._checked(row, "its seal")[1])
        return found

    def _make_seal(self) -> dict[str, Any]:
        said = hashlib.blake2b(digest_size=16)
        for rows in self._chunks():
            said.update(_as_text(rows))
        return {
            "outcomes": self._outcomes(),
            "steps": self._steps(),
            "table": said.hexdigest(),
            "events": self._count("events"),
            "replaced": self._count("replaced"),
            "facts": self._count(f"hunt WHERE key <> '{_SEAL}'"),
        }

    def _break_seal(self) -> None:
        """See that what is there is as it was written before anything is added to it."""
        if not self.protected or not self.sealed:
            for _ in self.plain_results():
                pass
        elif self._seal() != self._make_seal():
            raise damaged(self._path, "trials are missing or have changed")
        if not self.protected:
            migrate(self._database)
            self._version = version_of(self._database, self._path)
        if self.sealed:
            self._note(_SEAL, None)

    def _prepare(self) -> None:
        """Make what follows last: a reader never blocks the writer, and a kill leaves a file that opens."""
        self._database.execute("PRAGMA journal_mode = WAL")
        self._database.execute("PRAGMA synchronous = NORMAL")
        self._file = self._path.stat()

    def _compare_seal(self, seal: dict[str, Any] | None, name: str, found: object) -> None:
        # A writer may have come meanwhile; then it is another seal, or none.
        if seal is not None and found != seal.get(name) and self._seal() == seal:
            raise damaged(self._path, f"{name} are not those that were written")

    def _outcomes(self) -> dict[str, int]:
        return dict(self._select("SELECT outcome, count(*) FROM trials GROUP BY outcome ORDER BY outcome"))

    def _count(self, table: str) -> int:
        return int(next(self._select(f"SELECT count(*) FROM {table}"))[0])

    def _steps(self) -> int:
        return int(next(self._select("SELECT coalesce(sum(steps), 0) FROM trials"))[0])

    def _chunks(self) -> Iterator[list[tuple[Any, ...]]]:
        try:
            cursor = self._database.execute(
                "SELECT number, seed, outcome, steps, time_to_collision_s FROM trials INDEXED BY trials_by_outcome "
                "ORDER BY outcome, time_to_collision_s, number"
            )
            while rows := cursor.fetchmany(_CHUNK):
                yield rows
        except sqlite3.Error as error:
            raise explained(self._path, error) from error


def _real(value: float | None) -> float | None:
    return None if value is None else float(value)  # as SQLite gives it back


def _as_text(rows: list[tuple[Any, ...]]) -> bytes:
    return "".join(map(repr, rows)).encode()
