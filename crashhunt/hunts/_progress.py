"""How a hunt is going: the figures of the status screen, of ``status`` and of the page."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base.faculties import offers
from crashhunt.executors import HasNodes
from crashhunt.hunts._kinds import Kinds, kind_data
from crashhunt.hunts._searching import Searching, SearchStatus

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle
    from crashhunt.executors import Executor, NodeFigures
    from crashhunt.hunts._audit import AuditReport
    from crashhunt.hunts._data import Facts, Noted
    from crashhunt.plans import RunSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.triage import Group
    from crashhunt.trial import TrialResult

__all__ = ["HuntStatus", "Progress"]


@dataclass(frozen=True, slots=True)
class HuntStatus:
    """How a hunt is going, for people who watch.

    Args:
        phase: ``hunting``, ``saving``, ``auditing``, ``confirming`` or ``done``.
        planned: trials in all; 0 where only the time is limited.
        done: trials that have ended, in earlier runs of the hunt too.
        outcomes: how they ended.
        rate_per_s: trials a second in this run.
        elapsed_s: wall time of this run.
        nearest: the trial that came nearest to a crash without one.
        workers: trial number to where it is.
        crashes: found so far; all but the last are saved.
        nodes: the machines that take part now; None where there is this one only.
        kinds: of crashes, the most frequent first; None where the first crash ends the hunt.
        newest_kind_s: how long ago the last new one came, in s; None where nobody knows.
        newest_kind_trials: how many trials have ended since; None where it came in an earlier run of the hunt.
        time_left_s: until no more trials begin, in s of wall time; infinite where nobody has limited it.
        disturbed: how many of the crashes had disturbances; None where the hunt has none.
        stressed: the trial of this run for whose crash it would have taken the least, as far as copies were asked;
            None where no copy was asked, or nothing plausible made one crash.
        branched: how many branches of trials of this run have crashed.
        not_fully_asked: of how many trials of this run a question to their copies has no answer.
        search: which strategies have had trials in this run, and when the greatest danger grew.
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

    @property
    def seconds_left(self) -> float:
        """When the hunt will be at its end, by trials or by the clock, whichever comes first; infinite if never."""
        left = (self.planned - self.done) / self.rate_per_s if self.planned and self.rate_per_s else math.inf
        return min(left, self.time_left_s)

    @property
    def share_done(self) -> float:
        """Which share of the hunt is done, from 0 to 1, by trials or by the clock, whichever is nearer to its end."""
        by_count = self.done / self.planned if self.planned else 0.0
        whole_s = self.elapsed_s + self.time_left_s
        return max(by_count, self.elapsed_s / whole_s if whole_s > 0 else 1.0)


@dataclass(slots=True)
class Progress:
    """What this run of the hunt has seen."""

    began: float = field(default_factory=time.monotonic)
    until: float = math.inf  # no trial begins
    ended_here: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    crashes: list[Bundle] = field(default_factory=list)
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

    def resume(self, crashes: list[Bundle], run: RunSettings, before: Facts) -> None:
        """Take in what was saved before."""
        self.crashes = crashes
        self.failed_steps = before.get("failed_steps", 0)
        if run.keep_going or run.only_at_fault:
            wanted = run.distinct if run.keep_going else 1
            newest = before.get("newest_kind")
            dropped = before.get("dropped")
            self.kinds = Kinds(wanted, crashes, newest, only_at_fault=run.only_at_fault, dropped=dropped)

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
        if self.kinds is not None:
            self.kinds.add(bundle, self.ended_here)

    def replace(self, crashes: list[Bundle]) -> None:
        """Take the crashes as they are now: they have been confirmed."""
        self.crashes = crashes
        if self.kinds is not None:
            self.kinds.refresh(crashes)

    @property
    def last_wanted(self) -> int | None:
        """The number of the trial with which the hunt has found what it is after; None where it goes on."""
        found = self.found.keys() | self.copied.keys()
        return min(found) if found else self.kinds.until if self.kinds is not None else None

    @property
    def ended_by_copy(self) -> Bundle | None:
        """What a copy has found that ends the hunt; None where it is a trial that does, or nothing."""
        return self.copied.get(self.last_wanted) if self.last_wanted is not None else None

    @property
    def is_done(self) -> bool:
        """Whether the hunt had found what it is after before it began."""
        return bool(self.crashes or self.copied) if self.kinds is None else self.kinds.until is not None

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
        return sum(one.result.disturbed for one in self.crashes) + (unsaved is not None and unsaved.disturbed)

    @property
    def time_left_s(self) -> float:
        """Until no more trials begin; infinite where nobody has limited it."""
        return max(0.0, self.until - time.monotonic())

    def look_at(self, executor: Executor) -> None:
        """Take note of where trials run."""
        self.nodes = tuple(executor.nodes()) if offers(executor, HasNodes) else None

    def noted(self) -> Noted:
        """Return what the ledger is to say about now."""
        nodes: Noted = {} if self.nodes is None else {"nodes": [asdict(node) for node in self.nodes]}
        kinds: Noted = {}
        if self.kinds is not None:
            kinds = {"kinds": list(map(kind_data, self.kinds.groups())), "newest_kind": self.kinds.newest}
        failed = self.failed_steps + sum(result.steps + result.other_steps for result in self.failed)
        in_vain: Noted = {"failed_steps": failed} if failed else {}
        audits: Noted = {} if self.audit is None else {"audits_left": self.audits_left or None}
        return {"heartbeat": time.time(), **audits, **nodes, **kinds, **in_vain}

    def about_kinds(self) -> tuple[tuple[Group, ...] | None, float | None, int | None]:
        """Return the last three of `HuntStatus`."""
        if self.kinds is None:
            return None, None, None
        newest, trial = self.kinds.newest, self.kinds.newest_trial
        since = None if newest is None else max(0.0, time.time() - newest)
        return self.kinds.groups(), since, None if trial is None else self.ended_here - trial
