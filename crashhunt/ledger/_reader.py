"""Reader of a ledger. Every row that is read is checked against its digest."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NotRequired, TypedDict, cast

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.ledger._schema import OWN_FACTS, SEAL, WITH_EVENTS, Row, checked, damaged, explained, plain_trial
from crashhunt.trial import KILLED, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import Plain
    from crashhunt.ledger._schema import Shape


__all__ = ["Facts", "HuntOwner", "KindData", "LedgerReader", "Noted", "Seal", "Turn", "UntilRate"]


# The shapes of what a ledger says besides trials.


class KindData(TypedDict):
    """A crash type as in the ledger and in ``--json``."""

    words: str
    count: int
    first: str
    shortest: str


class HuntOwner(TypedDict):
    """Identifies a process: ``started`` is in ticks since the start of its machine."""

    host: str
    pid: int
    started: int


class UntilRate(TypedDict):
    """The progress of a hunt with ``--until-rate``; ``decided_at`` is the number of a trial, or None."""

    bar: str
    decided_at: int | None
    verdict: str


class RateBounds(TypedDict):
    """An interval.

    Args:
        low: the least rate.
        high: the upper bound; None if there is none.
    """

    low: float
    high: float | None


class RunningRate(TypedDict):
    """The rate of a hunt so far, as ``status --json`` reports it.

    Args:
        method: ``plain``, counted trials; or ``rare``, copies with forced onsets, and plain trials.
        per: what the rate is per.
        confidence: confidence of all intervals, in percent.
        units: independent units that count: trials, traffics or roots.
        trials: plain trials that count.
        crashes: number of crashes in these trials.
        origin: the origin of the trials that count; empty if all do.
        certain: interval that is valid whenever you look; None if there is none.
        estimate: crash probability per trial by the copies; None if there is none.
        estimated: interval for it; None if the roots cannot carry one.
        why_not: why there is no certain interval, or no estimated one; empty if there is.
        bar: rate that the hunt is compared with; None for none.
        verdict: ``below``, ``above`` or ``undecided``; empty without a bar.
        trained_on: number of trials that do not count, because an agent was trained on their traffic; missing if all
            count.
    """

    method: Literal["plain", "rare"]
    per: Literal["trial", "hour", "1000km"]
    confidence: float
    units: int
    trials: int
    crashes: int
    origin: str
    certain: RateBounds | None
    estimate: float | None
    estimated: RateBounds | None
    why_not: str
    bar: float | None
    verdict: str
    trained_on: NotRequired[int]


class Noted(TypedDict, total=False):
    """The recorded facts about a hunt in addition to its state; None removes a fact.

    Args:
        owner: the process that runs it, while it runs.
        began: when it was begun or resumed, in s since the epoch.
        heartbeat: time of the last sign of life of the hunt, in s since the epoch.
        done_before: number of trials that had ended at the start of this run.
        planned: number of planned trials; 0 if only the time is limited.
        until: when its time is up, in s since the epoch; None if it has all the time.
        hunt_seed: what its trials are drawn from.
        independent: whether they were drawn independently of each other.
        plain_origin: origin of the independent trials, if its sampler keeps some apart that it does not guide;
            else None.
        lag: number of trials by which results for a sampler that learns are delayed at most.
        lag_grows: whether they are delayed by fewer at the beginning; None in hunts of before, where the lag is fixed.
        sampler_version: version of the proposals of a sampler that learns; None in hunts of before, which have
            version 1.
        origins: whether its sampler says where trials come from.
        core: whether the simulator's compiled core is used; None if it has none.
        disturb: disturbances of the trials with their rates; None without disturbances.
        copies: which copies of its trials there are to be, some of ``probes`` and ``branches``; None if there are
            none.
        confirmed: of the trials whose copies crashed, how many were run from the start of what they found, and how many
            crashed there.
        nodes: the machines on which it ran last, where there were several: fields of `NodeFigures`.
        kinds: kinds of crashes, the most frequent first, where it collects them all.
        kinds_version: version of the rules that say which crashes are of one kind.
        types_by_cause: number of causes, each type on its own, where the hunt counts causes.
        crash_on: the outcomes that count as a crash.
        dropped: for each crash type, in words, the trials whose crashes are in the ledger only, as shorter ones were
            kept.
        dropped_at_fault: of these trials, the ones whose crashes are the agent's own fault, where that is
            asked.
        newest_kind: when the last new one came, in s since the epoch; None if none or unknown.
        audits_left: the trials that were to be run again for the audit, and have not been; None if there is none.
        phase: what the hunt does after its last trial: fields of `PhaseStatus`; None before and at its end.
        ends_at: when its last trial is expected to end, in s since the epoch; None if that is unknown.
        failed_steps: number of steps of confirmations that failed.
        until_rate: ``bar``, as it was given, ``decided_at``, the number of the trial that decided, and ``verdict``;
            None if the hunt has no bar.
        running_rate: the crash rate so far: None if no rate is known.
    """

    owner: HuntOwner | None
    began: float
    heartbeat: float
    done_before: int
    planned: int
    until: float | None
    hunt_seed: int
    independent: bool
    plain_origin: str | None
    lag: int | None
    lag_grows: bool | None
    sampler_version: int | None
    origins: bool
    core: str | None
    disturb: list[str] | None
    copies: list[str] | None
    confirmed: Mapping[str, Sequence[int]] | None
    nodes: list[dict[str, Any]]
    kinds: list[KindData]
    kinds_version: int
    types_by_cause: int
    crash_on: list[str]
    newest_kind: float | None
    audits_left: list[int] | None
    phase: dict[str, Any] | None
    ends_at: float | None
    failed_steps: int
    dropped: dict[str, list[int]]
    dropped_at_fault: list[int]
    until_rate: UntilRate | None
    running_rate: RunningRate | None


class Facts(Noted, total=False):
    """All facts of a hunt.

    Args:
        state: as it was entered last, one of ``running``, ``error`` or why it stopped.
        detail: why.
    """

    state: str
    detail: str | None


class Seal(TypedDict):
    """The content of a ledger when it was closed; earlier versions recorded less."""

    outcomes: Mapping[str, int]
    steps: int
    table: str
    dangers: NotRequired[str]
    other_steps: NotRequired[int]
    events: int
    replaced: int
    proposals: NotRequired[int]
    facts: int


_CHUNK_ROWS = 4096
_BY_TIME = (
    "SELECT number, seed, outcome, steps, time_to_collision_s FROM trials INDEXED BY trials_by_outcome "
    "ORDER BY outcome, time_to_collision_s, number"
)
_BY_DANGER = "SELECT outcome, danger, number FROM trials INDEXED BY trials_by_danger ORDER BY outcome, danger, number"


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn with a sampler that learns.

    Args:
        told: the numbers of the trials whose results it received since its last turn, in that order.
        spec: the trial that it proposed then.
    """

    told: tuple[int, ...]
    spec: TrialSpec


class LedgerReader:
    """Reads a ledger.

    Args:
        database: that is open.
        path: path of its file.
        shape: what its tables have.
    """

    def __init__(self, database: sqlite3.Connection, path: Path, shape: Shape) -> None:
        self._database = database
        self._path = path
        self._shape = shape

    @property
    def protected(self) -> bool:
        """Whether every row has a digest; the earliest ledgers had none."""
        return self._shape.protected

    @property
    def sealed(self) -> bool:
        """Whether the last writer has closed it."""
        return self._seal() is not None

    def events(self) -> list[tuple[float, str, str]]:
        """Return when the hunt got into which state, and why."""
        seal = self._seal()
        rows = list(self._select(f"{self._shape.select('events')} ORDER BY rowid"))
        self._compare_seal(seal, "events", len(rows))
        return [self._checked(row, "what it says of its states")[:3] for row in rows]

    def replaced(self) -> list[TrialResult]:
        """Return the trials that ran again, as they were."""
        seal = self._seal()
        rows = list(self._select(f"{self._shape.select('replaced')} ORDER BY rowid"))
        self._compare_seal(seal, "replaced", len(rows))
        return [self._result(json.loads(self._checked(row, "a trial that ran again")[2])) for row in rows]

    def turns(self) -> Iterator[Turn]:
        """Yield the proposals of a sampler that learns, in order; nothing for other samplers.

        Raises:
            HuntDirectoryError: a proposal is damaged or missing; earlier ones have been yielded.
        """
        if not self._proposing:
            return
        seal, count = self._seal(), 0
        for row in self._select(f"{self._shape.select('proposals')} ORDER BY turn"):
            count += 1
            yield self._turn(row)
        self._compare_seal(seal, "proposals", count)

    def intact_turns(self) -> list[Turn]:
        """Return the intact proposals, also if others are damaged."""
        found: list[Turn] = []
        try:
            for row in self._select(f"{self._shape.select('proposals')} ORDER BY turn") if self._proposing else ():
                try:
                    found.append(self._turn(row))
                except HuntDirectoryError:
                    continue
        except HuntDirectoryError:  # the table cannot be read on
            pass
        return found

    def facts(self) -> Facts:
        """Return the facts about the hunt itself."""
        seal = self._seal()
        rows = [self._checked(row, "a fact") for row in self._select(self._shape.select("hunt"))]
        self._compare_seal(seal, "facts", sum(row[0] != SEAL for row in rows))
        try:
            return cast(Facts, {row[0]: json.loads(row[1]) for row in rows if row[0] not in OWN_FACTS})
        except (ValueError, TypeError, RecursionError) as error:
            raise damaged(self._path, f"a fact cannot be read: {error}") from None

    def finished(self) -> set[int]:
        """Return the numbers of the trials that have ended."""
        return {number for (number,) in self._select("SELECT number FROM trials")}

    def outcomes(self) -> dict[str, int]:
        """Return the number of trials with each outcome."""
        seal = self._seal()
        found = self._outcomes()
        self._compare_seal(seal, "outcomes", found)
        return found

    def traffic_events(self) -> dict[str, tuple[int, int]]:
        """Return how many traffic events of each kind there were, and in how many trials."""
        rows = self._select(
            "SELECT event.key, sum(event.value), count(*) FROM trials, "
            f"json_each(iif(json_valid(result), result, '{{}}'), '$.events') AS event "
            f"WHERE {WITH_EVENTS} GROUP BY event.key"
        )
        return {kind: (count, trials) for kind, count, trials in rows}

    def summed(self, what: str, of: str) -> list[Row]:
        """Return sums over all trials, without rows whose data cannot be read.

        Args:
            what: is selected of them.
            of: the query for each, in which ``{stress.margin}`` is a value of its plain data and ``data`` all of it.
        """
        each = re.sub(r"{([\w.]+)}", r"json_extract(data, '$.\1')", of)
        trials = "(SELECT number, iif(json_valid(result), result, '{}') AS data FROM trials)"
        return list(self._select(f"SELECT {what} FROM ({each} FROM {trials})"))

    def disturbed_crashes(self, outcomes: tuple[str, ...]) -> tuple[int, tuple[int, str, float] | None]:
        """Return how many crashes had disturbances, and of the likeliest its number, outcome and log-likelihood.

        Args:
            outcomes: that count as a crash.
        """
        marks = ",".join("?" * len(outcomes))
        (row,) = self._select(
            # Of a query with one max(), SQLite takes what stands bare from the row that has it.
            "SELECT total(disturbed), max(iif(disturbed, likely, NULL)), number, outcome FROM (SELECT number, outcome, "
            "json_extract(data, '$.log_likelihood') AS likely, "
            "coalesce(json_array_length(data, '$.disturbances'), 0) > 0 AS disturbed FROM ("
            "SELECT number, outcome, iif(json_valid(result), result, '{}') AS data FROM trials "
            f"WHERE outcome IN ({marks})))",
            outcomes,
        )
        count, likely, number, outcome = row
        return int(count), None if likely is None else (number, outcome, float(likely))

    def tried_by_origin(self, outcomes: tuple[str, ...]) -> list[tuple[str, int, int, float, int]]:
        """Return of each origin of trials its name, trials, trials with a danger, their sum of danger, and crashes.

        Args:
            outcomes: that count as a crash, of which each has a danger of 1.
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
        """Return the number of steps of the trials."""
        seal = self._seal()
        found = self._steps()
        self._compare_seal(seal, "steps", found)
        return found

    def steps_total(self) -> int:
        """Return the number of simulated steps.

        They include the steps of trials, of their warm-up and of their copies, and those of confirmations that ended
        differently. Steps that an older ledger does not record are missing.
        """
        seal = self._seal()
        other = self._other_steps()
        self._compare_seal(seal, "other_steps", other)
        return self.trial_steps() + other + (self.facts().get("failed_steps") or 0)

    def results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[TrialResult]:
        """Yield trials in the order of their numbers, all or those that ended in one of some ways."""
        return map(self._result, self.plain_results(outcomes=outcomes))

    def plain_results(self, *, outcomes: tuple[str, ...] = ()) -> Iterator[JsonObject]:
        """Yield the same as plain data, which takes a third of the time.

        Raises:
            HuntDirectoryError: a trial is damaged or missing; earlier ones have been yielded.
        """
        where = f"WHERE outcome IN ({','.join('?' * len(outcomes))})" if outcomes else ""
        seal, count = self._seal(), 0
        for row in self._select(f"{self._shape.select('trials')} {where} ORDER BY number", outcomes):
            count += 1
            yield self._plain(row)
        if seal is not None:
            said = {name: number for name, number in seal["outcomes"].items() if not outcomes or name in outcomes}
            if count != sum(said.values()) and self._seal() == seal:
                raise damaged(self._path, f"it has {count} such trials, and {sum(said.values())} were written")

    def endings(self) -> Iterator[tuple[int, int, str, str, bool]]:
        """Yield how trials ended, in the order of their numbers, without reading their rows as a whole.

        Each is number, seed, outcome, origin, and whether its process was killed from outside.
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
        """Yield the rows of trials, whatever has become of the others: None for one that is not as it was written."""
        for number in numbers:
            try:
                row = self._row(number)
                if row is not None:
                    self._plain(row)
                    yield number, row[:-1] if self.protected else row
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
        """Return one trial, or None if it has not ended."""
        row = self._row(number)
        if row is None:
            self.outcomes()  # which finds out whether one is missing
            return None
        return self._result(self._plain(row))

    def results_where(self, condition: str, *values: float) -> Iterator[TrialResult]:
        """Yield the trials whose rows fulfil a condition in SQL, in the order of their numbers."""
        return map(self._result, self.plain_results_where(condition, *values))

    def plain_results_where(self, condition: str, *values: float) -> Iterator[JsonObject]:
        """Yield the same as plain data."""
        rows = self._select(f"{self._shape.select('trials')} WHERE {condition} ORDER BY number", values)
        return map(self._plain, rows)

    def result_text(self, number: int) -> str | None:
        """Return one trial as it is written, or None if it has not ended."""
        row = self._row(number)
        return None if row is None else str(self._plain(row) and row[10])

    def snapshot_of(self, number: int) -> str:
        """Return the digest of the snapshot that a trial ran from."""
        row = self._row(number)
        return str(self._plain(row) and row[9]) if row else ""

    def nearest_miss(self) -> TrialResult | None:
        """Return the trial that did not crash and came nearest to it: the most dangerous one.

        In a ledger of before danger was measured, that with the least time to collision.
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

    def most_dangerous(self, count: int) -> list[int]:
        """Return the numbers of the trials without a crash that were the most dangerous, the greatest danger first.

        Of several that are equal, the first. Trials without this value are skipped.
        """
        if "danger" not in self._shape.columns["trials"]:
            return []
        found = [
            row
            for outcome in ("survived", "finished")
            for row in self._select(
                "SELECT -danger, number FROM trials WHERE outcome = ? AND danger > 0 "
                "ORDER BY danger DESC, number LIMIT ?",
                (outcome, count),
            )
        ]
        return [number for _, number in sorted(found)[:count]]

    def table(self) -> Iterator[tuple[int, int, str, int, float | None]]:
        """Yield number, seed, outcome, steps and least time to collision of every trial, in no particular order.

        Raises:
            HuntDirectoryError: they are not as they were written; they were yielded nevertheless.
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
        """Read everything as of one moment, although the hunt writes on."""
        next(self._select("BEGIN"), None)
        try:
            yield
        finally:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")

    def last_number(self) -> int:
        """Return the greatest number of a trial that has ended; -1 where none has."""
        return int(next(self._select("SELECT coalesce(max(number), -1) FROM trials"))[0])

    def replaced_count(self) -> int:
        """Return the number of trials that were moved away to run again."""
        return self._count("replaced")

    def steps_by_outcome(self) -> dict[str, tuple[int, int, int]]:
        """Return for each outcome how many trials had it, and the least and the most steps of one; from an index."""
        rows = self._select("SELECT outcome, count(*), min(steps), max(steps) FROM trials GROUP BY outcome")
        return {outcome: (trials, least, most) for outcome, trials, least, most in rows}

    def parts_of(self, width: int, outcome: str) -> Iterator[tuple[int, int, int]]:
        """Yield part, trials and steps of all trials that ended in one way, from an index only.

        Args:
            width: numbers of trials in a part; part i begins with trial i * width.
            outcome: how they ended.
        """
        yield from self._select(
            "SELECT number / ?, count(*), sum(steps) FROM trials WHERE outcome = ? GROUP BY number / ?",
            (width, outcome, width),
        )

    def ended_between(self, first: int, last: int) -> Iterator[tuple[int, str, int]]:
        """Yield number, outcome and steps of the trials whose numbers are in a range, both ends included."""
        yield from self._select(
            "SELECT number, outcome, steps FROM trials WHERE number BETWEEN ? AND ? ORDER BY number", (first, last)
        )

    def numbers_of(self, outcomes: Iterable[str]) -> list[int]:
        """Return the numbers of the trials that ended in one of some ways, in order; from an index only."""
        found: list[int] = []
        for outcome in outcomes:
            found += (number for (number,) in self._select("SELECT number FROM trials WHERE outcome = ?", (outcome,)))
        return sorted(found)

    def killed_numbers(self, first: int = 0) -> list[int]:
        """Return the numbers, from one on, of trials that were killed from outside, in order: they run again."""
        sign = f'"kind": "{KILLED}"'
        query = "SELECT number FROM trials WHERE outcome = 'invalid' AND number >= ? AND instr(result, ?) > 0"
        return sorted(number for (number,) in self._select(query, (first, sign)))

    def plain_trial(self, number: int) -> JsonObject | None:
        """Return one trial as plain data; None if it has not ended.

        Raises:
            HuntDirectoryError: it is not as it was written.
        """
        row = self._row(number)
        return None if row is None else self._plain(row)

    def last_ended_at(self) -> float | None:
        """Return when the last trial ended, in s since the epoch; None if none has."""
        row = next(self._select(f"{self._shape.select('trials')} ORDER BY number DESC LIMIT 1"), None)
        return float(row[8]) if row and self._plain(row) else None

    def _select(self, query: str, values: Row = ()) -> Iterator[Row]:
        try:
            for row in self._database.execute(query, values):  # noqa: UP028 - it would close the cursor, maybe too late
                yield row
        except sqlite3.Error as error:  # also in the middle of a file that is damaged
            raise explained(self._path, error) from error

    def _row(self, number: int) -> Row | None:
        return next(self._select(f"{self._shape.select('trials')} WHERE number = ?", (number,)), None)

    def _checked(self, row: Row, what: str) -> Row:
        return checked(row, what, self._path) if self.protected else row

    def _plain(self, row: Row) -> JsonObject:
        return plain_trial(self._checked(row, f"trial {row[0]}"), self._path, trusted=self.protected)

    def _result(self, data: JsonObject) -> TrialResult:
        try:
            return TrialResult.from_json(data)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise damaged(self._path, f"a trial cannot be read: {type(error).__name__}: {error}") from None

    @property
    def _proposing(self) -> bool:
        return "proposals" in self._shape.columns

    def _turn(self, row: Row) -> Turn:
        try:
            _, _, told, spec, *_ = self._checked(row, f"the proposal of trial {row[1]}")
            return Turn(tuple(json.loads(told)), TrialSpec.from_json(json.loads(spec)))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise damaged(self._path, f"a proposal cannot be read: {type(error).__name__}: {error}") from None

    def _seal(self) -> Seal | None:
        if not self.protected:
            return None
        row = next(self._select(f"{self._shape.select('hunt')} WHERE key = ?", (SEAL,)), None)
        if row is None:
            return None
        found: Seal = json.loads(self._checked(row, "its seal")[1])
        return found

    def _make_seal(self) -> Seal:
        said = hashlib.blake2b(digest_size=16)
        for rows in self._chunks():
            said.update(_as_text(rows))
        seal: Seal = {
            "outcomes": self._outcomes(),
            "steps": self._steps(),
            "table": said.hexdigest(),
            "events": self._count("events"),
            "replaced": self._count("replaced"),
            "proposals": self._count("proposals") if self._proposing else 0,
            "facts": self._count(f"hunt WHERE key <> '{SEAL}'"),
        }
        if "danger" in self._shape.columns["trials"]:
            ranked = hashlib.blake2b(digest_size=16)
            for rows in self._chunks(_BY_DANGER):
                ranked.update(_as_text(rows))
            seal["dangers"] = ranked.hexdigest()
        if "other_steps" in self._shape.columns["trials"]:
            seal["other_steps"] = self._other_steps()
        return seal

    def _fits(self, seal: Seal) -> bool:
        """Return whether the content equals the sealed content, also if another version has sealed it."""
        found: Plain = self._make_seal()
        said: Plain = seal
        return all(found[name] == said[name] for name in found.keys() & said.keys())

    def _compare_seal(self, seal: Seal | None, name: str, found: object) -> None:
        # A writer may have come meanwhile; then it is another seal, or none. One of before may say less.
        if seal is not None and found != seal.get(name, found) and self._seal() == seal:
            raise damaged(self._path, f"{name} are not those that were written")

    def _outcomes(self) -> dict[str, int]:
        return dict(self._select("SELECT outcome, count(*) FROM trials GROUP BY outcome ORDER BY outcome"))

    def _count(self, table: str) -> int:
        return int(next(self._select(f"SELECT count(*) FROM {table}"))[0])

    def _steps(self) -> int:
        return int(next(self._select("SELECT coalesce(sum(steps), 0) FROM trials"))[0])

    def _other_steps(self) -> int:
        if "other_steps" not in self._shape.columns["trials"]:
            return 0
        return int(next(self._select("SELECT coalesce(sum(other_steps), 0) FROM trials"))[0])

    def _chunks(self, query: str = _BY_TIME) -> Iterator[list[Row]]:
        try:
            cursor = self._database.execute(query)
            while rows := cursor.fetchmany(_CHUNK_ROWS):
                yield rows
        except sqlite3.Error as error:
            raise explained(self._path, error) from error


def _as_text(rows: list[Row]) -> bytes:
    return "".join(map(repr, rows)).encode()
