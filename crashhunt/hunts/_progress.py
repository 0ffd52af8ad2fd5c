"""How a hunt is going: the figures of the status screen, of ``status`` and of the page."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base.capabilities import supports
from crashhunt.base.errors import BundleError
from crashhunt.crashes import (
    SIGNATURE_VERSION,
    Division,
    Group,
    cause_of,
    fault_of,
    features_of,
    groups_of,
    judgement_of,
    signature_of,
)
from crashhunt.executors import HasNodes
from crashhunt.hunts._phases import PhaseStatus, RemainingTime
from crashhunt.hunts._reports import kind_data
from crashhunt.hunts._tally import CrashTally

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.crashes import Bundle, Cause, Signature
    from crashhunt.executors import Executor, NodeFigures
    from crashhunt.hunts._rare import RareWatch
    from crashhunt.hunts._reports import AuditReport, StoppedBecause
    from crashhunt.ledger import Facts, Noted, RunningRate
    from crashhunt.plans import RunSettings
    from crashhunt.rates import BarWatch, RateWatch
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult


__all__ = [
    "HuntStatus",
    "Judged",
    "Kinds",
    "Progress",
    "SearchStatus",
    "Searching",
    "StrategyStatus",
]

_SHARE_OF_TIME = 0.05  # that grouping crashes for a screen may take

# Which kinds of crashes a hunt has found, while it runs.


@dataclass(frozen=True, slots=True)
class Judged:
    """A crash whose cause was searched for.

    Args:
        bundle: the crash, with its judgement.
        cause: the cause; None where the crash cannot be run again.
        is_stopped: whether the search was interrupted, so that nothing is known.
    """

    bundle: Bundle
    cause: Cause | None = None
    is_stopped: bool = False


class Kinds:
    """The kinds of the crashes that a hunt has saved.

    Args:
        wanted: how many kinds are enough; 0 for never.
        crashes: that were saved before.
        newest: when the last new kind came, in s since the epoch; None where that is unknown.
        only_at_fault: whether only crashes that are the agent's own fault count towards what is wanted.
        dropped: of each kind, in words, the trials whose bundles were given up before.
        dropped_at_fault: of these, the trials whose crashes are the agent's own fault.
        by_cause: how many crashes of each type to judge, so that each cause of a type counts; 0: types count.
    """

    def __init__(
        self,
        wanted: int,
        crashes: Sequence[Bundle] = (),
        newest: float | None = None,
        *,
        only_at_fault: bool = False,
        dropped: Mapping[str, Sequence[int]] | None = None,
        dropped_at_fault: Sequence[int] = (),
        by_cause: int = 0,
    ) -> None:
        self._by_cause = by_cause
        self._divisions: dict[Signature, Division] = {}
        self._only_at_fault = only_at_fault
        self._at_fault: set[int] = set()
        self._wanted = wanted
        self._signed: dict[int, tuple[Signature, Bundle]] = {}  # by the number of the trial
        self._seen: set[Signature] = set()
        self._first: dict[tuple[Signature, Cause | None], int] = {}  # of what counts, its trial of the least number
        self._groups: tuple[Group, ...] | None = None
        self._shown: tuple[Group, ...] = ()
        self._due = 0.0
        self.newest = newest
        self.newest_trial: int | None = None
        there = {bundle.result.spec.number for bundle in crashes}  # it was killed before it had removed them
        self.dropped = {
            words: [number for number in numbers if number not in there] for words, numbers in (dropped or {}).items()
        }
        self._dropped_at_fault = {number for number in dropped_at_fault if number not in there}
        for bundle in crashes:
            self._sign(bundle)

    def add(self, bundle: Bundle, ended: int) -> None:
        """Take in a crash that has been saved.

        Args:
            bundle: the crash.
            ended: how many trials have ended by now.
        """
        if self._sign(bundle):
            self.newest, self.newest_trial = time.time(), ended

    def groups(self, *, running: bool = False) -> tuple[Group, ...]:
        """Return what there is, the most frequent kind first, each with its crashes in the order of their trials.

        Args:
            running: for a screen, which asks ten times a second: those of some moments ago, where new ones would take
                too much of the time, as with 10,000 crashes.
        """
        began = time.monotonic()
        if running and self._groups is None and began < self._due:
            return self._shown
        if self._groups is None:
            dropped = {words: len(numbers) for words, numbers in self.dropped.items()}
            self._groups = groups_of((self._signed[number] for number in sorted(self._signed)), dropped)
            ended = time.monotonic()
            self._shown, self._due = self._groups, ended + (ended - began) / _SHARE_OF_TIME
        return self._groups

    def surplus(self, keep: int, *, final: bool = False) -> list[Bundle]:
        """Return the crashes beyond the `keep` shortest of each crash type, or of each cause, and forget them.

        They still count, but are no members any more. A type whose crashes are still being judged keeps all of them.

        Args:
            keep: how many stay.
            final: whether no more crashes are judged.
        """
        found = []
        for group in groups_of(self._signed.values()):
            for bundles in self._parts(group, final=final):
                ordered = sorted(bundles, key=self._worth)
                judged = self._divisions[group.signature].judged if group.signature in self._divisions else frozenset()
                # The runs that show the cause are in the bundle of a judged crash, so one of them stays.
                shown = next((place for place, one in enumerate(ordered) if one.result.spec.number in judged), 0)
                if keep <= shown:
                    ordered.insert(keep - 1, ordered.pop(shown))
                for bundle in ordered[keep:]:
                    number = bundle.result.spec.number
                    del self._signed[number]
                    if number in self._at_fault:
                        self._at_fault.discard(number)
                        self._dropped_at_fault.add(number)
                    self.dropped.setdefault(str(group.signature), []).append(number)
                    found.append(bundle)
        if found:
            self._groups = None
        return found

    def _parts(self, group: Group, *, final: bool) -> list[list[Bundle]]:
        """Return the crashes of a type by cause; none where that is not known yet."""
        division = self._divisions.get(group.signature)
        if division is None:
            return [list(group.bundles)]
        if not division.is_complete and not final:
            return []
        causes = division.causes()
        parts: dict[Cause, list[Bundle]] = {}
        for bundle in group.bundles:
            parts.setdefault(causes[bundle.result.spec.number], []).append(bundle)
        return list(parts.values())

    def next_to_judge(self) -> Bundle | None:
        """Return the next crash whose cause is wanted; None where there is none for now."""
        for division in self._divisions.values():
            if (number := division.choose()) is not None:
                return self._signed[number][1]
        return None

    def count_to_judge(self) -> int:
        """Return how many crashes are to be judged."""
        return sum(division.left for division in self._divisions.values())

    def settle(self, judged: Judged) -> None:
        """Take in the cause of a crash."""
        number = judged.bundle.result.spec.number
        if judged.is_stopped:
            self._divisions[self._signed[number][0]].postpone(number)
        else:
            self._settle(number, judged.cause)

    def _settle(self, number: int, cause: Cause | None) -> None:
        signature = self._signed[number][0]
        self._divisions[signature].settle(number, cause)
        self._count(number, signature, cause)

    @property
    def types_by_cause(self) -> int | None:
        """How many causes there are, each type on its own; None where types count."""
        return len(self._counted()) if self._by_cause else None

    def _count(self, number: int, signature: Signature, cause: Cause | None) -> None:
        if number in self._at_fault or not self._only_at_fault:
            known = None if cause is None or cause.kind == "unknown" else cause
            self._first[signature, known] = min(number, self._first.get((signature, known), number))

    def _counted(self) -> list[int]:
        """Return the first trials of what counts: a type without a known cause counts once."""
        caused = {signature for signature, cause in self._first if cause is not None}
        return sorted(
            number for (signature, cause), number in self._first.items() if cause is not None or signature not in caused
        )

    def _worth(self, bundle: Bundle) -> tuple[bool, int, int]:
        """What is kept first: what was hunted for, and of that the shortest."""
        result = bundle.result
        return self._only_at_fault and result.spec.number not in self._at_fault, result.steps, result.spec.number

    @property
    def until(self) -> int | None:
        """The least number of a trial up to which there are enough kinds; None where there are not."""
        firsts = self._counted()
        return firsts[self._wanted - 1] if 0 < self._wanted <= len(firsts) else None

    @property
    def at_fault(self) -> tuple[int, ...] | None:
        """The trials whose crashes are the agent's own fault, also without a bundle; None where that was not asked."""
        return tuple(sorted(self._at_fault | self._dropped_at_fault)) if self._only_at_fault else None

    @property
    def dropped_at_fault(self) -> list[int]:
        """Of the trials whose bundles were deleted, those whose crashes are the agent's own fault."""
        return sorted(self._dropped_at_fault)

    def refresh(self, crashes: Sequence[Bundle]) -> None:
        """Take the crashes as they are now: they have been confirmed."""
        for bundle in crashes:
            number = bundle.result.spec.number
            if number in self._signed:
                self._signed[number] = self._signed[number][0], bundle
        self._groups = None

    def _sign(self, bundle: Bundle) -> bool:
        """Take in a crash; return whether it is of a kind that has not been there."""
        number = bundle.result.spec.number
        collided = bundle.result.collision is not None
        try:
            # All look at it, and reading a log takes longer than looking.
            recording = bundle.recording() if collided and (self._only_at_fault or self._by_cause) else None
            signature = signature_of(bundle, recording)
            if self._only_at_fault and fault_of(bundle, recording).is_egos:
                self._at_fault.add(number)
            if self._by_cause and not bundle.result.outcome.is_software_fault:
                division = self._divisions.setdefault(signature, Division(self._by_cause))
                division.add(number, bundle.result.steps, features_of(bundle, recording))
        except BundleError:
            return False  # it has no crash type, and crashhunt check reports it
        is_new = signature not in self._seen
        self._seen.add(signature)
        self._signed[number] = signature, bundle
        self._groups = None
        self._count(number, signature, None)
        judgement = judgement_of(bundle) if signature in self._divisions else None
        if judgement is not None and not judgement.is_interrupted:
            cause = cause_of(bundle, judgement)
            if cause.kind != "unknown":
                self._settle(number, cause)
        return is_new


# What a hunt's sampler has tried in this run, strategy by strategy, and what came of it.


@dataclass(frozen=True, slots=True)
class StrategyStatus:
    """One of the origins of trials.

    Args:
        name: of the strategy.
        trials: that it proposed and that have ended.
        share: of all that have ended, 0 to 1.
        danger: mean of its trials, 0 to 1, a crash counting as 1; None where none of them has one.
        crashes: among its trials.
    """

    name: str
    trials: int
    share: float
    danger: float | None
    crashes: int


@dataclass(frozen=True, slots=True)
class SearchStatus:
    """How a search is going, for people who watch.

    Args:
        strategies: those that have had trials, the most frequent first; empty where a sampler names none.
        grown_trials: how many trials have ended since the greatest danger grew; None where it has not in this run.
        grown_s: how long ago that was, in s of wall time; None likewise.
    """

    strategies: tuple[StrategyStatus, ...] = ()
    grown_trials: int | None = None
    grown_s: float | None = None


@dataclass(slots=True)
class _Tally:
    trials: int = 0
    measured: int = 0
    danger: float = 0.0
    crashes: int = 0


@dataclass(slots=True)
class Searching:
    """Keeps account of the trials of a hunt, also those of its earlier runs."""

    ended: int = 0
    _tallies: dict[str, _Tally] = field(default_factory=dict)
    _grown: tuple[int, float] | None = None  # after how many trials, and when

    def resume(self, ended: int, tried: Iterable[tuple[str, int, int, float, int]]) -> None:
        """Count the trials of earlier runs.

        Args:
            ended: how many there were.
            tried: of each origin its name, trials, trials with a danger, their sum of danger, and crashes.
        """
        self.ended = ended
        for name, trials, measured, danger, crashes in tried:
            self._tallies[name] = _Tally(trials=trials, measured=measured, danger=danger, crashes=crashes)

    def take(self, result: TrialResult, *, crashed: bool) -> None:
        """Count a trial that has ended."""
        self.ended += 1
        if not result.spec.origin:
            return
        tally = self._tallies.setdefault(result.spec.origin, _Tally())
        tally.trials += 1
        tally.crashes += crashed
        danger = 1.0 if crashed else result.danger
        if danger is not None:
            tally.measured += 1
            tally.danger += danger

    def grow(self) -> None:
        """Take note that the trial which was counted last is the most dangerous one without a crash."""
        self._grown = self.ended, time.monotonic()

    def status(self) -> SearchStatus:
        """Return how it is going."""
        strategies = [
            StrategyStatus(
                name=name,
                trials=tally.trials,
                share=tally.trials / self.ended,
                danger=tally.danger / tally.measured if tally.measured else None,
                crashes=tally.crashes,
            )
            for name, tally in sorted(self._tallies.items(), key=lambda entry: (-entry[1].trials, entry[0]))
        ]
        if self._grown is None:
            return SearchStatus(tuple(strategies))
        trials, moment = self._grown
        return SearchStatus(tuple(strategies), self.ended - trials, time.monotonic() - moment)


@dataclass(frozen=True, slots=True)
class HuntStatus:
    """How a hunt is going, for people who watch.

    Args:
        phase: ``hunting``, ``saving``, ``auditing``, ``done``, or a name of `PhaseStatus`.
        planned: trials in all; 0 where only the time is limited.
        done: trials that have ended, in earlier runs of the hunt too.
        outcomes: how they ended.
        rate_per_s: trials a second in this run.
        elapsed_s: wall time of this run.
        nearest: the trial that came nearest to a crash without one.
        workers: trial number to where it is.
        crashes: found so far, with or without a bundle.
        nodes: the machines that take part now; None where there is this one only.
        kinds: of crashes, the most frequent first; None where the first crash ends the hunt.
        newest_kind_s: how long ago the last new one came, in s; None where that is unknown.
        newest_kind_trials: how many trials have ended since; None where it came in an earlier run of the hunt.
        time_left_s: until no more trials begin, in s of wall time; infinite without a limit.
        disturbed: how many of the crashes had disturbances; None where the hunt has none.
        stressed: the trial with the least stress margin; None if no copy was asked, or if no copy crashed.
        branched: how many branches have crashed.
        not_fully_asked: of how many trials a question to their copies has no answer.
        search: which strategies have had trials, and when the greatest danger grew in this run.
        rate: the crash rate so far; None where the trials bound none.
        trials_left_s: until the last trial ends, in s of wall time; None for an estimate by the mean rate.
        progress: of what is done after the last trial; None before.
    """

    phase: str
    planned: int
    done: int
    outcomes: dict[str, int]
    rate_per_s: float
    elapsed_s: float
    nearest: TrialResult | None
    workers: dict[int, BlackBoxHeader]
    crashes: int
    nodes: tuple[NodeFigures, ...] | None = None
    kinds: tuple[Group, ...] | None = None
    newest_kind_s: float | None = None
    newest_kind_trials: int | None = None
    time_left_s: float = math.inf
    disturbed: int | None = None
    stressed: TrialResult | None = None
    branched: int = 0
    not_fully_asked: int = 0
    search: SearchStatus = field(default_factory=SearchStatus)
    rate: RunningRate | None = None
    trials_left_s: float | None = None
    progress: PhaseStatus | None = None

    @property
    def seconds_left(self) -> float:
        """Time until the last trial, or until the limit, whichever comes first; infinite if neither is known."""
        if not self.planned:
            return self.time_left_s
        if self.trials_left_s is not None:
            return min(self.trials_left_s, self.time_left_s)
        left = (self.planned - self.done) / self.rate_per_s if self.rate_per_s else math.inf
        return min(left, self.time_left_s)

    @property
    def share_done(self) -> float:
        """Which share of the hunt is done, from 0 to 1, by trials or by the clock, whichever is nearer to its end."""
        by_count = self.done / self.planned if self.planned else 0.0
        whole_s = self.elapsed_s + self.time_left_s
        return max(by_count, self.elapsed_s / whole_s if whole_s > 0 else 1.0)


@dataclass(slots=True)
class Progress:
    """What the hunt has seen, in this run of it and before."""

    began: float = field(default_factory=time.monotonic)
    until: float = math.inf  # no trial begins
    remaining: RemainingTime = field(default_factory=lambda: RemainingTime(time.monotonic()))
    phase: PhaseStatus | None = None  # after the last trial
    parallel: int = 1  # trials that run at a time
    ends_at: float | None = None  # of the trials, in s since the epoch
    ended_here: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    crashes: list[Bundle] = field(default_factory=list)
    tally: CrashTally = field(default_factory=CrashTally)
    found: dict[int, TrialResult] = field(default_factory=dict)  # crashes that are not saved yet
    copied: dict[int, Bundle] = field(default_factory=dict)  # what copies of trials have found, run from the start
    nearest: TrialResult | None = None
    stressed: TrialResult | None = None
    branched: int = 0
    not_fully_asked: int = 0
    last_invalid: TrialResult | None = None
    notes: list[str] = field(default_factory=list)
    failed: list[TrialResult] = field(default_factory=list)  # what was to confirm something, and ended otherwise
    failed_steps: int = 0  # of such runs, before this run of the hunt
    audit: AuditReport | None = None
    audits_left: list[int] = field(default_factory=list)
    nodes: tuple[NodeFigures, ...] | None = None
    kinds: Kinds | None = None
    searching: Searching = field(default_factory=Searching)
    rate: BarWatch | None = None
    counted: RateWatch | None = None  # the same where there is a bar
    rare: RareWatch | None = None

    def resume(self, crashes: list[Bundle], run: RunSettings, before: Facts) -> None:
        """Take in what was saved before."""
        self.crashes = crashes
        self.failed_steps = before.get("failed_steps", 0)
        if run.keep_going or run.only_at_fault:
            wanted = run.distinct if run.keep_going else 1
            newest = before.get("newest_kind")
            self.kinds = Kinds(
                wanted,
                crashes,
                newest,
                only_at_fault=run.only_at_fault,
                dropped=before.get("dropped"),
                dropped_at_fault=before.get("dropped_at_fault") or (),
                by_cause=run.by_cause,
            )

    def count(self, result: TrialResult, *, crashed: bool) -> None:
        """Count a trial that has ended."""
        self.ended_here += 1
        self.outcomes[str(result.outcome)] += 1
        self.searching.take(result, crashed=crashed)

    def take(self, result: TrialResult) -> None:
        """Take note of a trial without a crash, which has been counted."""
        if result.collision is None and result.failure is None:
            before = self.nearest
            self.nearest = max(before or result, result, key=lambda one: one.nearness)
            if self.nearest is not before:
                self.searching.grow()
        if result.branches is not None:
            self.branched += len(result.branches.crashes)
        if result.stress is not None and result.stress.disturbance is not None:
            least = self.stressed.stress.least if self.stressed is not None and self.stressed.stress else 1.0
            self.stressed = result if result.stress.least < least else self.stressed
        self.not_fully_asked += not result.is_fully_asked

    def save(self, bundle: Bundle) -> None:
        """Take in a crash that has been saved."""
        self.crashes.append(bundle)
        self.tally.add(bundle.result)
        if self.kinds is not None:
            self.kinds.add(bundle, self.ended_here)

    def replace(self, crashes: list[Bundle]) -> None:
        """Take the crashes as they are now: they have been confirmed."""
        self.crashes = crashes
        if self.kinds is not None:
            self.kinds.refresh(crashes)

    @property
    def last_wanted(self) -> int | None:
        """The number of the trial with which the hunt has found what it is after; None where the hunt continues."""
        if self.rate is not None and self.rate.decided_at is not None:
            return self.rate.decided_at
        found = self.found.keys() | self.copied.keys()
        return min(found) if found else self.kinds.until if self.kinds is not None else None

    @property
    def ended_by_copy(self) -> Bundle | None:
        """What a copy has found that ends the hunt; None where it is a trial that does, or nothing."""
        return self.copied.get(self.last_wanted) if self.last_wanted is not None else None

    @property
    def is_done(self) -> bool:
        """Whether the hunt had found what it is after before it began."""
        if self.rate is not None:
            return self.rate.decided_at is not None
        return bool(self.crashes or self.copied) if self.kinds is None else self.kinds.until is not None

    def why_stopped(self, *, keep_going: bool) -> StoppedBecause:
        """Why a hunt stops that has found what it is after."""
        if self.rate is not None:
            return "rate"
        return "distinct" if keep_going else "crash"

    @property
    def unsaved(self) -> TrialResult | None:
        """The crash that ends the hunt, until it is saved."""
        lowest = self.last_wanted
        if lowest is None or lowest not in self.found:
            return None
        return None if any(lowest == one.result.spec.number for one in self.crashes) else self.found[lowest]

    @property
    def disturbed(self) -> int:
        """How many of the crashes had disturbances."""
        unsaved = self.unsaved
        return self.tally.disturbed + (unsaved is not None and unsaved.disturbed)

    @property
    def crash_count(self) -> int:
        """How many crashes there are, with or without a bundle."""
        return self.tally.found + (self.unsaved is not None)

    @property
    def time_left_s(self) -> float:
        """Until no more trials begin; infinite without a limit."""
        return max(0.0, self.until - time.monotonic())

    def look_at(self, executor: Executor) -> None:
        """Take note of where trials run."""
        self.nodes = tuple(executor.nodes()) if supports(executor, HasNodes) else None

    def running_rate(self, *, now: bool = False) -> RunningRate | None:
        """Return the crash rate so far; None where the trials bound none.

        Args:
            now: whether that of some moments ago will not do.
        """
        watch = self.rare or self.counted
        return None if watch is None else watch.running(now=now)

    def noted(self, *, now: bool = False) -> Noted:
        """Return what the ledger is to say about now.

        Args:
            now: whether a rate of some moments ago will not do.
        """
        nodes: Noted = {} if self.nodes is None else {"nodes": [asdict(node) for node in self.nodes]}
        kinds: Noted = {}
        if self.kinds is not None:
            groups = list(map(kind_data, self.kinds.groups()))
            kinds = {"kinds": groups, "kinds_version": SIGNATURE_VERSION, "newest_kind": self.kinds.newest}
        failed = self.failed_steps + sum(result.steps + result.other_steps for result in self.failed)
        in_vain: Noted = {"failed_steps": failed} if failed else {}
        audits: Noted = {} if self.audit is None else {"audits_left": self.audits_left or None}
        bar: Noted = {} if self.rate is None else {"until_rate": self.rate.noted()}
        rate: Noted = {"running_rate": self.running_rate(now=now)}
        phase: Noted = {"phase": None if self.phase is None else self.phase.to_json(), "ends_at": self.ends_at}
        return {"heartbeat": time.time(), **audits, **nodes, **kinds, **in_vain, **bar, **phase, **rate}

    def about_kinds(self, *, running: bool = False) -> tuple[tuple[Group, ...] | None, float | None, int | None]:
        """Return the last three of `HuntStatus`; `running` as of `Kinds.groups`."""
        if self.kinds is None:
            return None, None, None
        newest, trial = self.kinds.newest, self.kinds.newest_trial
        since = None if newest is None else max(0.0, time.time() - newest)
        return self.kinds.groups(running=running), since, None if trial is None else self.ended_here - trial
