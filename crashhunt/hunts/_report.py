"""What came of a hunt: what `Hunt.run` returns, and ``run --json`` prints."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict

from crashhunt.hunts._kinds import KindData, kind_data

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import Bundle, CrashSummary
    from crashhunt.hunts._audit import AuditData, AuditReport
    from crashhunt.hunts._branched import BranchReport, BranchReportData
    from crashhunt.hunts._probed import ProbeData, ProbeReport
    from crashhunt.plans import HuntSettings
    from crashhunt.triage import Group

__all__ = ["EventCount", "HuntReport", "HuntReportData", "StoppedBecause"]

StoppedBecause = Literal["crash", "distinct", "all_trials", "interrupted", "no_valid_trial", "time"]


class EventCount(TypedDict):
    """How many traffic events of a kind there were, and in how many trials."""

    count: int
    trials: int


class HuntReportData(TypedDict):
    """What ``run --json`` prints of a hunt."""

    dir: str
    hunt_seed: int
    trials_planned: int
    trials_run: int
    outcomes: dict[str, int]
    stopped_because: StoppedBecause
    wall_s: float
    steps_total: int
    events: dict[str, EventCount]
    crashes: list[CrashSummary]
    notes: list[str]
    audit: AuditData | None
    unanswered: int
    kinds: NotRequired[list[KindData]]
    near_misses: NotRequired[list[CrashSummary]]
    probes: NotRequired[ProbeData]
    branches: NotRequired[BranchReportData]
    at_fault: NotRequired[list[int]]
    copied: NotRequired[str]


@dataclass(frozen=True, slots=True)
class HuntReport:
    """What came of a hunt.

    Args:
        directory: of the hunt.
        settings: what was asked.
        stopped_because: why it ended.
        outcomes: how the trials ended.
        trial_steps: how many steps trials have taken.
        steps_total: how many were simulated in all: theirs, those before their first, such as of traffic that warms up,
            those of their copies, and those of runs that were to confirm something and ended otherwise.
        wall_s: wall time of this run.
        crashes: what was found, the one with the fewest steps first.
        reason: in words, where not one trial was valid.
        notes: what people should know about how it went, such as trials that were run again.
        events: traffic events of all trials: kind to how many, and in how many trials.
        audit: what came of running trials without a crash again; None where nobody asked for it.
        kinds: of crashes, the most frequent first; None where the first crash ended the hunt.
        near_misses: that were kept, the most dangerous first.
        probes: what came of asking copies of trials; None where nobody did.
        at_fault: the trials whose crashes are the agent's own fault; None where that was not asked.
        branches: what came of copies that went on with other disturbances; None where there were to be none.
        copied: what a copy found, where that ended the hunt: it came again from the start.
        unanswered: how many trials the same command runs again, as they or copies of them were killed from outside.
    """

    directory: Path
    settings: HuntSettings
    stopped_because: StoppedBecause
    outcomes: dict[str, int]
    trial_steps: int
    steps_total: int
    wall_s: float
    crashes: tuple[Bundle, ...]
    reason: str = ""
    notes: tuple[str, ...] = ()
    events: dict[str, tuple[int, int]] = field(default_factory=dict)
    audit: AuditReport | None = None
    kinds: tuple[Group, ...] | None = None
    near_misses: tuple[Bundle, ...] = ()
    probes: ProbeReport | None = None
    at_fault: tuple[int, ...] | None = None
    branches: BranchReport | None = None
    copied: Bundle | None = None
    unanswered: int = 0

    def to_json(self) -> HuntReportData:
        """Return the shape that ``run --json`` prints."""
        found: HuntReportData = {
            "dir": str(self.directory),
            "hunt_seed": self.settings.seed,
            "trials_planned": self.settings.trials,
            "trials_run": sum(self.outcomes.values()),
            "outcomes": self.outcomes,
            "stopped_because": self.stopped_because,
            "wall_s": round(self.wall_s, 3),
            "steps_total": self.steps_total,
            "events": {kind: {"count": count, "trials": trials} for kind, (count, trials) in self.events.items()},
            "crashes": [bundle.summary() for bundle in self.crashes],
            "notes": list(self.notes),
            "audit": self.audit.to_json() if self.audit is not None else None,
            "unanswered": self.unanswered,
        }
        if self.probes is not None:
            found["probes"] = self.probes.to_json()
        if self.branches is not None:
            found["branches"] = self.branches.to_json()
        if self.kinds is not None:
            found["kinds"] = list(map(kind_data, self.kinds))
        if self.settings.run.near_misses:
            found["near_misses"] = [bundle.summary() for bundle in self.near_misses]
        if self.at_fault is not None:
            found["at_fault"] = list(self.at_fault)
        if self.copied is not None:
            found["copied"] = str(self.copied.path)
        return found
