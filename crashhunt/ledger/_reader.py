"""The reader of a ledger, which checks every row against the digest of the row."""

from __future__ import annotations

import hashlib
import json
import re
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.ledger._schema import OWN_FACTS, SEAL, WITH_EVENTS, Row, checked, damaged, explained, plain_trial
from crashhunt.trial import KILLED, Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import Plain
    from crashhunt.ledger._facts import Facts, Seal
    from crashhunt.ledger._schema import PatientConnection, Shape


_CHUNK_ROWS = 4096
_BY_TIME = (
    "SELECT number, seed, outcome, steps, time_to_collision_s FROM trials INDEXED BY trials_by_outcome "
    "ORDER BY outcome, time_to_collision_s, number"
)
_BY_DANGER = "SELECT outcome, danger, number FROM trials INDEXED BY trials_by_danger ORDER BY outcome, danger, number"


@dataclass(frozen=True, slots=True)
class Turn:
    """One exchange with a learning sampler: results that it received, then its proposal."""

    # numbers of the trials whose results the sampler received since its last proposal, in the order of receipt
    told: tuple[int, ...]
    spec: TrialSpec  # the trial that the sampler then proposed


class LedgerReader:
    """Reads the trials and facts of a ledger."""

    def __init__(self, database: PatientConnection, path: Path, shape: Shape) -> None:
        self._database = database
        self._path = path
        self._shape = shape

    @property
    def sealed(self) -> bool:
        """Whether the last writer sealed the ledger when it closed the file."""
        return self._seal() is not None

    def events(self) -> list[tuple[float, str, str]]:
        """Return the changes of the hunt's state, each with its time and reason."""
        seal = self._seal()
        rows = list(self._select(f"{self._shape.select('events')} ORDER BY rowid"))
        self._compare_seal(seal, "events", len(rows))
        return [self._checked(row, "an entry on the state of the hunt")[:3] for row in rows]

    def replaced(self) -> list[TrialResult]:
        """Return the trials that were run again, with their former results."""
        seal = self._seal()
        rows = list(self._select(f"{self._shape.select('replaced')} ORDER BY rowid"))
        self._compare_seal(seal, "replaced", len(rows))
        return [self._result(json.loads(self._checked(row, "a trial that ran again")[2])) for row in rows]

    def turns(self) -> Iterator[Turn]:
        """Yield the proposals of a learning sampler, in order; other samplers have none.

        Raises:
            HuntDirectoryError: a proposal is damaged or missing; the proposals before it have been yielded.
        """
        seal, count = self._seal(), 0
        for row in self._select(f"{self._shape.select('proposals')} ORDER BY turn"):
            count += 1
            yield self._turn(row)
        self._compare_seal(seal, "proposals", count)

    def intact_turns(self) -> list[Turn]:
        """Return the intact proposals, even if other proposals are damaged."""
        found: list[Turn] = []
        with suppress(HuntDirectoryError):  # the table cannot be read on
            for row in self._select(f"{self._shape.select('proposals')} ORDER BY turn"):
                with suppress(HuntDirectoryError):
                    found.append(self._turn(row))
        return found

    def facts(self) -> Facts:
        """Return the facts about the hunt as a whole."""
        seal = self._seal()
        rows = [self._checked(row, "a fact") for row in self._select(self._shape.select("hunt"))]
        self._compare_seal(seal, "facts", sum(row[0] != SEAL for row in rows))
        try:
            return cast("Facts", {row[0]: json.loads(row[1]) for row in rows if row[0] not in OWN_FACTS})
        except (ValueError, TypeError, RecursionError) as error:
            raise damaged(self._path, f"an entry of the table hunt cannot be read: {error}") from None

    def finished(self) -> set[int]:
        """Return the numbers of the finished trials."""
        return {number for (number,) in self._select("SELECT number FROM trials")}

    def outcomes(self) -> dict[str, int]:
        """Return the number of trials with each outcome."""
        seal = self._seal()
        found = self._outcomes()
        self._compare_seal(seal, "outcomes", found)
        return found

    def snapshots(self) -> dict[str, dict[str, int]]:
        """Return the number of trials with each outcome for each snapshot, the snapshot that was used first first."""
        found: dict[str, dict[str, int]] = {}
        for digest, outcome, count, _ in self._select(
            "SELECT snapshot, outcome, count(*), min(ended_at) AS since FROM trials GROUP BY snapshot, outcome "
            "ORDER BY since"
        ):
            found.setdefault(digest, {})[outcome] = count
        return found

    def numbers_from(self, snapshots: Sequence[str]) -> set[int]:
        """Return the numbers of the trials that ran from the given snapshots."""
        rows = self._select(f"SELECT number FROM trials WHERE {_among('snapshot', snapshots)}", tuple(snapshots))
        return {number for (number,) in rows}

    def count_longer(self, wall_s: float) -> int:
        """Return the number of trials that took longer than a time and did not hang."""
        return self._count(f"trials WHERE wall_s > {float(wall_s)!r} AND outcome <> '{Outcome.HANG}'")

    def traffic_events(self) -> dict[str, tuple[int, int]]:
        """Return for each type of traffic event the number of events, and the number of trials with such events."""
        rows = self._select(
            "SELECT event.key, sum(event.value), count(*) FROM trials, "
            f"json_each(iif(json_valid(result), result, '{{}}'), '$.events') AS event "
            f"WHERE {WITH_EVENTS} GROUP BY event.key"
        )
        return {kind: (count, trials) for kind, count, trials in rows}

    def summed(self, what: str, of: str) -> list[Row]:
        """Return SQL sums over all trials; rows whose data cannot be read are skipped.

        Args:
            what: SQL expressions to select, such as sums.
            of: SQL query for one trial. In it, ``{stress.margin}`` is replaced by this value of the trial's JSON data,
                and ``data`` is the JSON data.
        """
        each = re.sub(r"{([\w.]+)}", r"json_extract(data, '$.\1')", of)
        trials = "(SELECT number, iif(json_valid(result), result, '{}') AS data FROM trials)"
        return list(self._select(f"SELECT {what} FROM ({each} FROM {trials})"))

    def disturbed_crashes(
        self, outcomes: tuple[str, ...], snapshots: Sequence[str] = ()
    ) -> tuple[int, tuple[int, str, float] | None]:
        """Return the number of disturbed crashes, and number, outcome and log-likelihood of the likeliest crash.

        Without ``snapshots``, all trials count.
        """
        where = _among("outcome", outcomes) + (f" AND {_among('snapshot', snapshots)}" if snapshots else "")
        (row,) = self._select(
            # Of a query with one max(), SQLite takes what stands bare from the row that has it.
            "SELECT total(disturbed), max(iif(disturbed, likely, NULL)), number, outcome FROM (SELECT number, outcome, "
            "json_extract(data, '$.log_likelihood') AS likely, "
            "coalesce(json_array_length(data, '$.disturbances'), 0) > 0 AS disturbed FROM ("
            "SELECT number, outcome, iif(json_valid(result), result, '{}') AS data FROM trials "
            f"WHERE {where}))",
            (*outcomes, *snapshots),
        )
        count, likely, number, outcome = row
        return int(count), None if likely is None else (number, outcome, float(likely))

    def tried_by_origin(self, outcomes: tuple[str, ...]) -> list[tuple[str, int, int, float, int]]:
        """Return for each trial origin: name, trials, trials with criticality, sum of the criticality, and crashes.

        A trial with one of the outcomes has criticality 1.
        """
        marks = ",".join("?" * len(outcomes))
        rows = self._select(
            "SELECT origin, count(*), count(danger), total(danger), total(crashed) FROM (SELECT "
            "json_extract(data, '$.spec.origin') AS origin, crashed, iif(crashed, 1.0, json_extract(data, '$.danger')) "
            f"AS danger FROM (SELECT outcome IN ({marks}) AS crashed, iif(json_valid(result), result, '{{}}') AS data "
            "FROM trials)) WHERE origin > '' GROUP BY origin",
            outcomes,
        )
        return [(name, count, measured, danger, int(crashes)) for name, count, measured, danger, crashes in rows]

    def trial_steps(self) -> int:
        """Return the total number of steps of the trials, without warm-ups and forks."""
        seal = self._seal()
        found = self._steps()
        self._compare_seal(seal, "steps", found)
        return found

    def steps_total(self) -> int:
        """Return the number of simulated steps.

        The number includes the steps of trials, of their warm-ups, of their forks, and of confirmations that ended
        differently.
        """
        seal = self._seal()
        other = self._other_steps()
        self._compare_seal(seal, "other_steps", other)
        return self.trial_steps() + other + (self.facts().get("failed_steps") or 0)

    def results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[TrialResult]:
        """Yield trials in the order of their numbers: all trials, or only trials with certain outcomes."""
        return map(self._result, self.plain_results(outcomes=outcomes))

    def plain_results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[JsonObject]:
        """Yield the trials that `results` yields, but as JSON data, which takes a third of the time.

        Raises:
            HuntDirectoryError: a trial is damaged or missing; the trials before it have been yielded.
        """
        where = f"WHERE outcome IN ({','.join('?' * len(outcomes))})" if outcomes else ""
        seal, count = self._seal(), 0
        for row in self._select(f"{self._shape.select('trials')} {where} ORDER BY number", outcomes):
            count += 1
            yield self._plain(row)
        if seal is not None:
            said = {name: number for name, number in seal["outcomes"].items() if not outcomes or name in outcomes}
            if count != sum(said.values()) and self._seal() == seal:
                raise damaged(
                    self._path, f"it has {count} trials with these outcomes, but {sum(said.values())} were written"
                )

    def endings(self) -> Iterator[tuple[int, int, str, str, bool]]:
        """Yield the endings of trials in the order of their numbers, without decoding whole rows.

        An ending consists of number, seed, outcome, origin, and whether the process was killed from outside.
        """
        of = "iif(json_valid(result), result, '{}')"
        rows = self._select(
            f"SELECT number, seed, outcome, json_extract({of}, '$.spec.origin'), "
            f"json_extract({of}, '$.failure.kind') = ? FROM trials ORDER BY number",
            (KILLED,),
        )
        return (
            (number, seed, outcome, origin or "", bool(was_killed))
            for number, seed, outcome, origin, was_killed in rows
        )

    def intact_rows(self, numbers: Iterable[int]) -> Iterator[tuple[int, Row | None]]:
        """Yield the rows of some trials, even if other rows are damaged; None for a row that is not intact."""
        for number in numbers:
            try:
                row = self._row(number)
                if row is not None:
                    self._plain(row)
                    yield number, row[:-1]
            except HuntDirectoryError:
                yield number, None

    def check_pages(self) -> None:
        """Run SQLite's integrity check on the file.

        Raises:
            HuntDirectoryError: the file is damaged.
        """
        for (found,) in self._select("PRAGMA integrity_check(1)"):
            if found != "ok":
                raise damaged(self._path, " ".join(str(found).split()))

    def result(self, number: int) -> TrialResult | None:
        """Return the result of one trial, or None if the trial has not ended."""
        row = self._row(number)
        if row is None:
            self.outcomes()  # which finds out whether one is missing
            return None
        return self._result(self._plain(row))

    def results_where(self, condition: str, *values: float) -> Iterator[TrialResult]:
        """Yield the trials whose rows satisfy an SQL condition, in the order of their numbers."""
        return map(self._result, self.plain_results_where(condition, *values))

    def plain_results_where(self, condition: str, *values: float | str) -> Iterator[JsonObject]:
        """Yield the trials whose rows satisfy an SQL condition, as JSON data."""
        rows = self._select(f"{self._shape.select('trials')} WHERE {condition} ORDER BY number", values)
        return map(self._plain, rows)

    def result_text(self, number: int) -> str | None:
        """Return the JSON text of one trial as it was written, or None if the trial has not ended."""
        row = self._row(number)
        return None if row is None else str(self._plain(row) and row[10])

    def snapshot_of(self, number: int) -> str:
        """Return the digest of the snapshot from which a trial ran."""
        row = self._row(number)
        return str(self._plain(row) and row[9]) if row else ""

    def nearest_miss(self) -> TrialResult | None:
        """Return the trial that came nearest to a crash without crashing: the trial with the greatest criticality.

        For a ledger without criticality, return the trial with the least time to collision.
        """
        most = self.most_dangerous(1)
        if most:
            return self.result(most[0])
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

    def most_dangerous(self, count: int, snapshots: Sequence[str] = ()) -> list[int]:
        """Return the numbers of the trials with the greatest criticality but no crash, the greatest criticality first.

        Of trials with equal criticality, the trial with the lowest number comes first. Trials without a criticality are
        skipped. Without ``snapshots``, all trials count.
        """
        which = f"AND {_among('snapshot', snapshots)} " if snapshots else ""
        found = [
            row
            for outcome in ("survived", "finished")
            for row in self._select(
                f"SELECT -danger, number FROM trials WHERE outcome = ? AND danger > 0 {which}"
                "ORDER BY danger DESC, number LIMIT ?",
                (outcome, *snapshots, count),
            )
        ]
        return [number for _, number in sorted(found)[:count]]

    def table(self) -> Iterator[tuple[int, int, str, int, float | None]]:
        """Yield number, seed, outcome, steps and least time to collision of every trial, in no particular order.

        Raises:
            HuntDirectoryError: the rows have changed since they were written; they have been yielded nevertheless.
        """
        seal = self._seal()
        if seal is None:  # without one, only the whole rows say whether they are as they were written
            for row in self._select(f"{self._shape.select('trials')} ORDER BY number"):
                self._plain(row)
                yield row[:5]
            return
        said = hashlib.blake2b(digest_size=16)
        for rows in self._chunks():
            said.update(_as_text(rows))
            yield from rows
        self._compare_seal(seal, "table", said.hexdigest())

    # What a reader that follows a hunt asks again and again: what has come, and not all of it.

    @contextmanager
    def one_moment(self) -> Iterator[None]:
        """Return a context in which all reads show one state of the ledger, although the hunt continues to write."""
        next(self._select("BEGIN"), None)
        try:
            yield
        finally:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")

    def last_number(self) -> int:
        """Return the greatest number of a finished trial; -1 if no trial has finished."""
        return int(next(self._select("SELECT coalesce(max(number), -1) FROM trials"))[0])

    def replaced_count(self) -> int:
        """Return the number of trials that were replaced because they were to run again."""
        return self._count("replaced")

    def steps_by_outcome(self) -> dict[str, tuple[int, int, int]]:
        """Return for each outcome the number of trials, and their least and greatest number of steps."""
        rows = self._select("SELECT outcome, count(*), min(steps), max(steps) FROM trials GROUP BY outcome")
        return {outcome: (trials, least, most) for outcome, trials, least, most in rows}

    def parts_of(self, width: int, outcome: str) -> Iterator[tuple[int, int, int]]:
        """Count the trials with an outcome in each part of the hunt; yield the part, their number and their steps.

        Part i begins with trial i * width.
        """
        yield from self._select(
            "SELECT number / ?, count(*), sum(steps) FROM trials WHERE outcome = ? GROUP BY number / ?",
            (width, outcome, width),
        )

    def ended_between(self, first: int, last: int) -> Iterator[tuple[int, str, int]]:
        """Yield number, outcome and steps of the trials with numbers in a range, including both ends."""
        yield from self._select(
            "SELECT number, outcome, steps FROM trials WHERE number BETWEEN ? AND ? ORDER BY number", (first, last)
        )

    def numbers_of(self, outcomes: Iterable[str]) -> list[int]:
        """Return the numbers of the trials with certain outcomes in order, using only an index."""
        found: list[int] = []
        for outcome in outcomes:
            found += (number for (number,) in self._select("SELECT number FROM trials WHERE outcome = ?", (outcome,)))
        return sorted(found)

    def killed_numbers(self, first: int = 0) -> list[int]:
        """Return in order the numbers, from `first` on, of trials killed from outside, which run again."""
        sign = f'"kind": "{KILLED}"'
        query = "SELECT number FROM trials WHERE outcome = 'invalid' AND number >= ? AND instr(result, ?) > 0"
        return sorted(number for (number,) in self._select(query, (first, sign)))

    def plain_trial(self, number: int) -> JsonObject | None:
        """Return one trial as JSON data; None if the trial has not ended.

        Raises:
            HuntDirectoryError: the row has changed since it was written.
        """
        row = self._row(number)
        return None if row is None else self._plain(row)

    def last_ended_at(self) -> float | None:
        """Return the time at which the last trial ended, in s since the epoch; None if no trial has ended."""
        row = next(self._select(f"{self._shape.select('trials')} ORDER BY number DESC LIMIT 1"), None)
        return float(row[8]) if row and self._plain(row) else None

    def _select(self, query: str, values: Row = ()) -> Iterator[Row]:
        with explained(self._path):  # also in the middle of a file that is damaged
            for row in self._database.execute(query, values):  # noqa: UP028 - it would close the cursor, maybe too late
                yield row

    def _row(self, number: int) -> Row | None:
        return next(self._select(f"{self._shape.select('trials')} WHERE number = ?", (number,)), None)

    def _checked(self, row: Row, what: str) -> Row:
        return checked(row, what, self._path)

    def _plain(self, row: Row) -> JsonObject:
        return plain_trial(self._checked(row, f"trial {row[0]}"), self._path)

    def _result(self, data: JsonObject) -> TrialResult:
        try:
            return TrialResult.from_json(data)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise damaged(self._path, f"a trial cannot be read: {type(error).__name__}: {error}") from None

    def _turn(self, row: Row) -> Turn:
        try:
            _, _, told, spec, *_ = self._checked(row, f"the proposal of trial {row[1]}")
            return Turn(tuple(json.loads(told)), TrialSpec.from_json(json.loads(spec)))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise damaged(self._path, f"a proposal cannot be read: {type(error).__name__}: {error}") from None

    def _seal(self) -> Seal | None:
        row = next(self._select(f"{self._shape.select('hunt')} WHERE key = ?", (SEAL,)), None)
        if row is None:
            return None
        found: Seal = json.loads(self._checked(row, "its seal")[1])
        return found

    def _make_seal(self) -> Seal:
        table, ranked = hashlib.blake2b(digest_size=16), hashlib.blake2b(digest_size=16)
        for digest, query in ((table, _BY_TIME), (ranked, _BY_DANGER)):
            for rows in self._chunks(query):
                digest.update(_as_text(rows))
        return {
            "outcomes": self._outcomes(),
            "steps": self._steps(),
            "table": table.hexdigest(),
            "events": self._count("events"),
            "replaced": self._count("replaced"),
            "proposals": self._count("proposals"),
            "facts": self._count(f"hunt WHERE key <> '{SEAL}'"),
            "dangers": ranked.hexdigest(),
            "other_steps": self._other_steps(),
        }

    def _fits(self, seal: Seal) -> bool:
        """Return whether the contents match the seal, in which a later version may have recorded more."""
        found: Plain = self._make_seal()
        said: Plain = seal
        return all(found[name] == said.get(name) for name in found)

    def _compare_seal(self, seal: Seal | None, name: str, found: object) -> None:
        # A writer may have come meanwhile. Then the ledger has another seal, or none.
        if seal is not None and found != seal.get(name) and self._seal() == seal:
            raise damaged(self._path, f"its {name} differ from those that were written")

    def _outcomes(self) -> dict[str, int]:
        return dict(self._select("SELECT outcome, count(*) FROM trials GROUP BY outcome ORDER BY outcome"))

    def _count(self, table: str) -> int:
        return int(next(self._select(f"SELECT count(*) FROM {table}"))[0])

    def _steps(self) -> int:
        return int(next(self._select("SELECT coalesce(sum(steps), 0) FROM trials"))[0])

    def _other_steps(self) -> int:
        return int(next(self._select("SELECT coalesce(sum(other_steps), 0) FROM trials"))[0])

    def _chunks(self, query: str = _BY_TIME) -> Iterator[list[Row]]:
        with explained(self._path):
            cursor = self._database.execute(query)
            while rows := cursor.fetchmany(_CHUNK_ROWS):
                yield rows


def _among(column: str, values: Sequence[str]) -> str:
    """Return the SQL condition that a column has one of the values, which the query has to bind."""
    return f"{column} IN ({','.join('?' * len(values))})"


def _as_text(rows: list[Row]) -> bytes:
    return "".join(map(repr, rows)).encode()
