"""Progress of a hunt: the figures for the status screen, ``status`` and the dashboard; phases and the time left."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter, deque
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Literal, TypeVar

from crashhunt.base.codec import Serializable
from crashhunt.base.foreign_code import supports
from crashhunt.crashes import (
    SIGNATURE_VERSION,
    Group,
)
from crashhunt.executors import HasNodes
from crashhunt.hunts._reports import AuditReport, StoppedBecause, kind_data
from crashhunt.results import CrashTally, Kinds, sums_of_branches, sums_of_probes
from crashhunt.trial import Outcome
from crashhunt.trial_reruns import call_in_threads

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.executors import Executor, NodeFigures
    from crashhunt.ledger import Facts, Ledger, Noted, RunningRate
    from crashhunt.plans import RunSettings
    from crashhunt.recording import BlackBoxHeader, Recording
    from crashhunt.statistics import BarWatch, RareWatch, RateWatch
    from crashhunt.trial import TrialResult


# What a hunt's sampler has tried in this run, strategy by strategy, and the result.


@dataclass(frozen=True, slots=True)
class StrategyStatus:
    """The trials of one strategy of the sampler."""

    name: str  # name of the strategy
    trials: int  # number of finished trials that the strategy proposed
    share: float  # share of all finished trials, from 0 to 1
    # mean criticality of the strategy's trials, from 0 to 1, in which a crash counts as 1; None if it is unknown
    danger: float | None
    crashes: int  # number of crashes among the strategy's trials


@dataclass(frozen=True, slots=True)
class SearchStatus:
    """Progress of the search, for the status screen."""

    # strategies that have proposed trials, the most frequent first; empty if the sampler reports no strategies
    strategies: tuple[StrategyStatus, ...] = ()
    # number of trials since the greatest criticality last rose; None if it did not rise in this run
    grown_trials: int | None = None
    # time since the greatest criticality last rose, in s of wall time; None if it did not rise in this run
    grown_s: float | None = None


@dataclass(slots=True)
class _Tally:
    trials: int = 0
    measured: int = 0
    danger: float = 0.0
    crashes: int = 0


@dataclass(slots=True)
class StrategyTally:
    """Counts the trials of each strategy, including those of earlier runs of the hunt."""

    ended: int = 0
    _tallies: dict[str, _Tally] = field(default_factory=dict)
    _grown: tuple[int, float] | None = None  # after how many trials, and when

    def resume(self, ended: int, tried: Iterable[tuple[str, int, int, float, int]]) -> None:
        """Add the counts of trials of earlier runs.

        Args:
            ended: number of finished trials.
            tried: for each origin: name, number of trials, number of trials with criticality, sum of their criticality,
                and number of crashes.
        """
        self.ended = ended
        for name, trials, measured, danger, crashes in tried:
            self._tallies[name] = _Tally(trials=trials, measured=measured, danger=danger, crashes=crashes)

    def take(self, result: TrialResult, *, crashed: bool) -> None:
        """Count a finished trial."""
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
        """Record that the last counted trial is the most critical trial without a crash."""
        self._grown = self.ended, time.monotonic()

    def status(self) -> SearchStatus:
        """Return the present progress of the search."""
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
    """The progress of a hunt, for the status screen."""

    # the current phase: ``hunting``, ``saving``, ``auditing``, ``done``, or a name of `PhaseStatus`. During
    # ``waiting``, another program locks the ledger.
    phase: str
    planned: int  # total number of trials; 0 if only the time is limited
    done: int  # number of finished trials, including those of earlier runs of the hunt
    outcomes: dict[str, int]  # number of trials with each outcome
    rate_per_s: float  # trials per second in this run of the hunt
    elapsed_s: float  # wall time of this run of the hunt, in s
    nearest: TrialResult | None  # the trial without a crash that came nearest to a crash
    workers: dict[int, BlackBoxHeader]  # progress of each running trial, by number
    crashes: int  # number of crashes, with or without a bundle
    # the machines that currently run trials; None if only this machine does
    nodes: tuple[NodeFigures, ...] | None = None
    # crash types, the most frequent first; None if the hunt ends at its first crash
    kinds: tuple[Group, ...] | None = None
    newest_kind_s: float | None = None  # time since the last new crash type, in s; None if unknown
    # number of trials since the last new crash type; None if an earlier run of the hunt found it
    newest_kind_trials: int | None = None
    types_by_cause: int | None = None  # number of crash types by cause; None if the hunt counts types
    time_left_s: float = math.inf  # time until no more trials begin, in s of wall time; infinite without a limit
    disturbed: int | None = None  # number of crashes with disturbances; None if the hunt has no disturbances
    # the trial with the smallest robustness margin; None if there were no probes, or if no probe crashed
    stressed: TrialResult | None = None
    branched: int = 0  # number of branches that have crashed
    not_fully_asked: int = 0  # number of trials in which a probe or branch has no result
    # trials of each strategy, and the last rise of the greatest criticality in this run
    search: SearchStatus = field(default_factory=SearchStatus)
    rate: RunningRate | None = None  # the current crash rate; None if there is none
    # time until the last trial ends, in s of wall time; None to estimate it from the mean rate
    trials_left_s: float | None = None
    progress: PhaseStatus | None = None  # progress of the work after the last trial; None before that
    steps: int = 0  # number of steps that the trials of this run of the hunt have simulated, without warm-up

    @property
    def seconds_left(self) -> float:
        """Time until the last trial or the time limit, whichever is first; infinite if both are unknown."""
        if not self.planned:
            return self.time_left_s
        if self.trials_left_s is not None:
            return min(self.trials_left_s, self.time_left_s)
        left = max(0, self.planned - self.done) / self.rate_per_s if self.rate_per_s else math.inf
        return min(left, self.time_left_s)

    @property
    def share_done(self) -> float:
        """The completed share of the hunt, from 0 to 1: the larger of the shares of trials and of time."""
        by_count = self.done / self.planned if self.planned else 0.0
        whole_s = self.elapsed_s + self.time_left_s
        return max(by_count, self.elapsed_s / whole_s if whole_s > 0 else 1.0)


@dataclass(slots=True)
class Progress:
    """The progress of a hunt in this run and in earlier runs."""

    began: float = field(default_factory=time.monotonic)
    until: float = math.inf  # no trial begins
    remaining: RemainingTime = field(default_factory=lambda: RemainingTime(time.monotonic()))
    phase: PhaseStatus | None = None  # after the last trial
    parallel: int = 1  # trials that run at a time
    ends_at: float | None = None  # of the trials, in s since the epoch
    ended_here: int = 0
    steps_here: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    crashes: list[Bundle] = field(default_factory=list)
    earlier: list[Bundle] = field(default_factory=list)  # crashes of other versions of the code, which end no hunt
    under_way: int = 0  # the greatest number of trials at a time
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
    searching: StrategyTally = field(default_factory=StrategyTally)
    rate: BarWatch | None = None
    counted: RateWatch | None = None  # the same where there is a bar
    counted_before: set[int] = field(default_factory=set)  # trials that run again, and that the rate has already
    rare: RareWatch | None = None

    def resume(
        self, crashes: list[Bundle], run: RunSettings, before: Facts, apart: Collection[int] = frozenset()
    ) -> None:
        """Add the crashes that earlier runs have saved."""
        self.crashes = crashes
        self.under_way = before.get("under_way", 0)
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
                dropped_judged=before.get("dropped_judged"),
                by_cause=run.by_cause,
                apart=apart,
            )

    def resume_counts(self, ledger: Ledger, before: Facts, crash_on: tuple[Outcome, ...]) -> None:
        """Add the trials of earlier runs of the hunt to the counts on the screen."""
        self.outcomes.update(ledger.outcomes())
        self.nearest = ledger.nearest_miss()
        if before.get("origins"):
            self.searching.resume(sum(self.outcomes.values()), ledger.tried_by_origin(crash_on))
        branches, probes = sums_of_branches(ledger, before), sums_of_probes(ledger, before)
        self.branched = branches["crashed"] if branches is not None else 0
        self.not_fully_asked = sum(sums["not_fully_asked"] for sums in (branches, probes) if sums is not None)
        if probes is not None and probes["crashed_trials"] and probes["trial"] is not None:
            self.stressed = ledger.result(probes["trial"])

    def count(self, result: TrialResult, *, crashed: bool, planned: int) -> None:
        """Count a finished trial.

        A crash has already been saved, or ends the hunt and is then saved.
        """
        self.ended_here += 1
        self.steps_here += result.steps
        self.outcomes[str(result.outcome)] += 1
        self.searching.take(result, crashed=crashed)
        self.remaining.ended(time.monotonic(), max(0, planned - sum(self.outcomes.values())), self.parallel)
        if self.counted is not None and result.spec.number not in self.counted_before:
            self.counted.add(result)
        if result.outcome is Outcome.INVALID and not crashed:
            self.last_invalid = result
        elif not crashed:
            self._compare(result)
        elif self.kinds is None:
            self.found[result.spec.number] = result

    def _compare(self, result: TrialResult) -> None:
        """Compare a trial without a crash with the nearest miss and the least robustness margin of the hunt."""
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

    def save(self, bundle: Bundle, recording: Recording | None = None) -> None:
        """Add a crash that has been saved; its recording is read from the log if it is not given."""
        self.crashes.append(bundle)
        self.tally.add(bundle.result)
        if self.kinds is not None:
            self.kinds.add(bundle, self.ended_here + 1, recording)  # counted after its row is written

    def replace(self, crashes: list[Bundle]) -> None:
        """Replace the crashes by their confirmed versions."""
        self.crashes = crashes
        if self.kinds is not None:
            self.kinds.refresh(crashes)

    @property
    def last_wanted(self) -> int | None:
        """The number of the trial whose crash ends the hunt; None if the hunt continues."""
        if self.rate is not None and self.rate.decided_at is not None:
            return self.rate.decided_at
        found = self.found.keys() | self.copied.keys()
        return min(found) if found else self.kinds.until if self.kinds is not None else None

    @property
    def ended_by_copy(self) -> Bundle | None:
        """The crash of a fork that ends the hunt; None if there is none, or if a trial ends the hunt."""
        return self.copied.get(self.last_wanted) if self.last_wanted is not None else None

    @property
    def is_done(self) -> bool:
        """Whether earlier runs of the hunt have already found the wanted crashes."""
        if self.rate is not None:
            return self.rate.decided_at is not None
        return bool(self.crashes or self.copied) if self.kinds is None else self.kinds.until is not None

    def why_stopped(self, *, keep_going: bool) -> StoppedBecause:
        """Return the reason why a hunt ends after it has found the wanted crashes."""
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
        """The number of crashes with disturbances."""
        unsaved = self.unsaved
        return self.tally.disturbed + (unsaved is not None and unsaved.disturbed)

    @property
    def crash_count(self) -> int:
        """The number of crashes, with or without a bundle."""
        return self.tally.found + (self.unsaved is not None)

    @property
    def time_left_s(self) -> float:
        """Time until no more trials begin, in s; infinite without a limit."""
        return max(0.0, self.until - time.monotonic())

    def expect_end(self, planned: int, parallel: int) -> None:
        """Estimate the time at which the last trial ends.

        The number of planned trials is 0 if only the time is limited.
        """
        left = planned - sum(self.outcomes.values())
        found = self.remaining.seconds_left(time.monotonic(), left, parallel) if left > 0 else 0.0
        found = min(found, self.time_left_s)
        self.parallel = parallel
        self.ends_at = time.time() + found if planned and math.isfinite(found) else None

    def status(
        self, phase: str, planned: int, workers: Mapping[int, BlackBoxHeader] | None = None, *, has_disturbances: bool
    ) -> HuntStatus:
        """Return the present progress for the status screen.

        The phase is one of `HuntStatus`. The number of planned trials is 0 if only the time is limited.
        """
        elapsed = time.monotonic() - self.began
        kinds, newest_s, newest_trials = self.about_kinds(running=phase != "done")
        return HuntStatus(
            phase=phase,
            planned=planned,
            done=sum(self.outcomes.values()),
            outcomes=dict(self.outcomes),
            rate_per_s=self.ended_here / elapsed if elapsed > 0 else 0.0,
            elapsed_s=elapsed,
            nearest=self.nearest,
            workers=dict(workers or {}),
            crashes=self.crash_count,
            nodes=self.nodes,
            kinds=kinds,
            newest_kind_s=newest_s,
            newest_kind_trials=newest_trials,
            types_by_cause=self.kinds.types_by_cause if self.kinds is not None else None,
            time_left_s=self.time_left_s,
            disturbed=self.disturbed if has_disturbances else None,
            stressed=self.stressed,
            branched=self.branched,
            not_fully_asked=self.not_fully_asked,
            search=self.searching.status(),
            rate=self.running_rate(now=phase == "done"),
            trials_left_s=None if self.ends_at is None else max(0.0, self.ends_at - time.time()),
            progress=self.phase,
            steps=self.steps_here,
        )

    def look_at(self, executor: Executor) -> None:
        """Update the progress of the running trials."""
        self.nodes = tuple(executor.nodes()) if supports(executor, HasNodes) else None

    def running_rate(self, *, now: bool = False) -> RunningRate | None:
        """Return the current crash rate; None if the trials give no bound.

        Unless ``now``, the rate may be some moments old.
        """
        watch = self.rare or self.counted
        return None if watch is None else watch.running(now=now)

    def noted(self, *, now: bool = False) -> Noted:
        """Return the present progress in the form that the ledger stores.

        Unless ``now``, the rate may be some moments old.
        """
        nodes: Noted = {} if self.nodes is None else {"nodes": [asdict(node) for node in self.nodes]}
        kinds: Noted = {}
        if self.kinds is not None:
            groups = list(map(kind_data, self.kinds.groups()))
            kinds = {"kinds": groups, "kinds_version": SIGNATURE_VERSION, "newest_kind": self.kinds.newest}
            if (by_cause := self.kinds.types_by_cause) is not None:
                kinds["types_by_cause"] = by_cause
        failed = self.failed_steps + sum(result.steps + result.other_steps for result in self.failed)
        in_vain: Noted = {"failed_steps": failed} if failed else {}
        audits: Noted = {} if self.audit is None else {"audits_left": self.audits_left or None}
        bar: Noted = {} if self.rate is None else {"until_rate": self.rate.noted()}
        rate: Noted = {"running_rate": self.running_rate(now=now)}
        phase: Noted = {"phase": None if self.phase is None else self.phase.to_json(), "ends_at": self.ends_at}
        beat: Noted = {"heartbeat": time.time(), "elapsed_s": time.monotonic() - self.began}
        beat["under_way"] = self.under_way
        return {**beat, **audits, **nodes, **kinds, **in_vain, **bar, **phase, **rate}

    def about_kinds(self, *, running: bool = False) -> tuple[tuple[Group, ...] | None, float | None, int | None]:
        """Return the fields of `HuntStatus` about crash types; `running` has the same meaning as for `Kinds.groups`."""
        if self.kinds is None:
            return None, None, None
        newest, trial = self.kinds.newest, self.kinds.newest_trial
        since = None if newest is None else max(0.0, time.time() - newest)
        return self.kinds.groups(running=running), since, None if trial is None else self.ended_here - trial


# Phases of a hunt, their progress and the time left.
#
# The time left is robust against trials that end in batches. The mean rate so far falls while a batch runs. The time
# left by that rate rises for as long as a trial takes. Therefore a new estimate is made only when a trial ends, over
# the time of whole batches, and the mean of the estimates of the last batch counts. Between two trials, the time left
# falls with the clock.

T = TypeVar("T")
R = TypeVar("R")

PhaseName = Literal["causes", "confirming", "auditing", "near misses", "probes", "branches", "rare crashes"]
"""What a hunt does after its last trial."""

_TICK_S = 0.1  # how late the screen may be
_MIN_SPAN = 8  # trials whose mean rate is an estimate
_MAX_SPAN = 10_000  # trials whose times are kept
_STALL_BATCHES = 2  # durations of a batch without an end of a trial, after which the time left stands still


class RemainingTime:
    """Estimates when the last of several trials ends, from the times at which trials end.

    Cost: constant time for each trial and each estimate, and O(`_MAX_SPAN`) memory.

    Args:
        began: time at which the first trial began, in s of a monotonic clock.
    """

    def __init__(self, began: float) -> None:
        self._began = began
        self._times: deque[float] = deque(maxlen=_MAX_SPAN)
        self._count = 0
        self._ends: deque[float] = deque()
        self._rate = 0.0

    def ended(self, now: float, left: int, parallel: int) -> None:
        """Count a finished trial.

        The times are in s of a monotonic clock.
        """
        self._count += 1
        self._times.append(now)
        span = min(max(_MIN_SPAN, 4 * parallel, self._count // 2), self._count, _MAX_SPAN - 1)
        span = max(span // parallel * parallel, min(span, parallel))  # whole batches
        first = self._began if span == self._count else self._times[-span - 1]
        self._rate = span / max(now - first, 1e-6)
        if self._count <= parallel:  # the first batch is not complete before
            self._ends.clear()
        self._ends.append(now + left / self._rate)
        while len(self._ends) > parallel:
            self._ends.popleft()

    def seconds_left(self, now: float, left: int, parallel: int) -> float:
        """Return the time until the last trial ends, in s; infinite before the first trial has ended.

        The times are in s of a monotonic clock.
        """
        if not left:
            return 0.0
        if not self._ends:
            return math.inf
        stalls = self._times[-1] + _STALL_BATCHES * max(1, parallel) / self._rate
        return max(1.0, statistics.fmean(self._ends) - min(now, stalls))


@dataclass(frozen=True, slots=True)
class PhaseStatus(Serializable):
    """Progress of a phase of a hunt."""

    name: PhaseName
    done: int  # number of finished runs
    total: int  # total number of runs
    seconds_left: float | None  # time until the phase ends, in s; None if it is unknown


class PhaseClock:
    """Reports the progress of the work after the last trial of a hunt.

    Args:
        show: function that receives the progress about ten times a second, in the thread of the hunt.
        parallel: number of runs at a time.
    """

    def __init__(self, show: Callable[[PhaseStatus], None], parallel: int) -> None:
        self._show, self._parallel = show, max(1, parallel)
        self._name: PhaseName | None = None
        self._done = self._total = 0
        self._left = RemainingTime(0.0)
        self._shown = -math.inf

    def begin(self, name: PhaseName, total: int, done: int = 0) -> None:
        """Begin a phase."""
        self._name, self._total, self._done = name, total, done
        self._left = RemainingTime(time.monotonic())
        self.tick(force=True)

    def advance(self) -> None:
        """Count a finished run."""
        self._done += 1
        self._left.ended(time.monotonic(), self._total - self._done, self._parallel)
        self.tick(force=True)

    def tick(self, *, force: bool = False) -> None:
        """Show the progress, unless it was shown in the last 0.1 s, or the first phase has not begun."""
        now = time.monotonic()
        if self._name is None or (now - self._shown < _TICK_S and not force):
            return
        self._shown = now
        left = self._left.seconds_left(now, self._total - self._done, self._parallel)
        self._show(
            PhaseStatus(
                name=self._name,
                done=self._done,
                total=self._total,
                seconds_left=left if math.isfinite(left) else None,
            )
        )

    def run(
        self, function: Callable[[T], R], items: Sequence[T], *, counts: Callable[[R], bool] = lambda _: True
    ) -> list[R]:
        """Call a function for each item in threads that wait for processes; return the results in item order.

        ``counts`` returns whether a result counts as a finished run.
        """

        def ended(result: R) -> None:
            if counts(result):
                self.advance()

        return call_in_threads(function, items, self._parallel, ended=ended, tick=self.tick)
