"""The report of a hunt, including the reports on its audit, probes and branches."""

from __future__ import annotations

import statistics
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Literal

from crashhunt.base.codec import JsonObject, Serializable
from crashhunt.base.text import format_number, format_percent
from crashhunt.results import CrashTally
from crashhunt.statistics import TRIALS_PER_ROOT

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import Bundle, Group
    from crashhunt.ledger import KindData
    from crashhunt.plans import HuntSettings
    from crashhunt.results import BranchSums, ProbeSums, VersionCounts
    from crashhunt.statistics import CrashRate, RareEstimate
    from crashhunt.trial import Disturbance


@dataclass(frozen=True, slots=True)
class Difference(Serializable):
    """The first difference between a trial and its run in a new process."""

    trial: int  # number of the trial
    # the first step that differs; None if only the digests were compared, because no recording was kept
    step: int | None
    agent: str  # identifier of the agent or actor; empty if the difference concerns neither
    field: str  # name of the value that differs
    recorded: object  # the value in the hunt
    replayed: object  # the value in the new process

    def __str__(self) -> str:
        whose = f" of {self.agent}" if self.agent else ""
        where = "" if self.step is None else f"at step {self.step}, "
        return (
            f"trial {self.trial} differs when replayed in a new process: {where}{self.field}{whose} was "
            f"{self.recorded} and is {self.replayed}"
        )


@dataclass(frozen=True, slots=True)
class AuditReport(Serializable):
    """The result of an audit, which runs trials without a crash again in new processes."""

    trials: int = 0  # number of trials that were run again to their end
    differences: tuple[Difference, ...] = ()  # the first difference of each trial that differed
    not_finished: int = 0  # number of trials whose second run did not reach its end

    json_keys = ("trials", "not_finished", "differences")


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """The result of the robustness probes of a hunt."""

    sums: ProbeSums  # counts of all trials
    margins: tuple[float, ...]  # the robustness margin of each trial whose probes all have a result
    # why a probe has no result in the first trial in which not all probes have one; empty without such a trial
    why_unasked: str
    run_again: int  # number of crashes with the mildest disturbance that were run from the start
    # number of runs from the start that did not reach their end, for example because they were killed
    not_finished: int
    # runs from the start that crashed in the same way at the same step, and were confirmed bit-identically
    crashes: tuple[Bundle, ...]
    # the disturbance that the probe added in each trial of ``crashes``, with its actual values. The trial may have
    # drawn further disturbances.
    by: tuple[Disturbance, ...]

    def to_json(self) -> JsonObject:
        """Return the result in the form that ``run --json`` prints."""
        sums = self.sums
        return {
            "trials": sums["trials"],
            "not_fully_asked": sums["not_fully_asked"],
            "least": sums["least"],
            "median": statistics.median(self.margins) if self.margins else None,
            "probes": sums["probes"],
            "steps": sums["steps"],
            "left_out": sums["left_out"],
            **_verified(self),
        }


@dataclass(frozen=True, slots=True)
class BranchReport:
    """The result of the branches of a hunt."""

    sums: BranchSums  # counts of all trials
    # why a branch has no result in the first trial in which not all branches have one; empty without such a trial
    why_unanswered: str
    run_again: int  # number of crashed branches that were run from the start: the likeliest branch of each trial
    # number of runs from the start that did not reach their end, for example because they were killed
    not_finished: int
    # runs from the start that crashed in the same way at the same step, and were confirmed bit-identically
    crashes: tuple[Bundle, ...]

    def to_json(self) -> JsonObject:
        """Return the result in the form that ``run --json`` prints."""
        verified = _verified(self)
        return {**{name: count for name, count in self.sums.items() if name not in verified}, **verified}


@dataclass(frozen=True, slots=True)
class RareReport:
    """The result of a hunt in rare mode."""

    estimate: RareEstimate  # estimate of the crash probability per trial
    # number of crashes found by forks that were run again from the start. The crashes with the greatest weights are
    # chosen.
    run_again: int
    not_finished: int  # number of runs from the start, requested for ``run_again``, that did not finish
    # runs from the start that crashed in the same way at the same step, and were confirmed bit-identically
    crashes: tuple[Bundle, ...]

    def to_json(self) -> JsonObject:
        """Return the result in the form that ``run --json`` prints."""
        return {**self.estimate.to_json(), **_verified(self)}

    @property
    def lines(self) -> list[str]:
        """Return the estimate, its evidence and its limits, as lines for the user."""
        found = self.estimate
        if found.estimate is None:
            certain = [] if found.roots else self._certain_lines  # bounds that rest on plain trials alone
            return [f"rare: no estimate: {found.why_not or 'no root has ended'}", *certain]
        answer = f"rare: {format_number(found.estimate)} per trial" if found.estimate else "rare: no crash yet"
        if found.estimated is not None:
            one = found.estimated
            answer += f" ({_between(one.low, one.high)}, estimated from {found.roots} roots; "
            answer += f"effective sample size {one.effective:.0f})"
        lines = [answer]
        if found.estimated is None:
            more = ""
            if found.more_roots is not None:
                more = f"; about {found.more_roots * TRIALS_PER_ROOT} more trials are needed"
            lines.append(f"  no interval ({found.roots} roots with their copies): {found.why_not}{more}")
        shares = [
            f"{cell} {format_number(part)} ({format_percent(part / found.disturbed)})"
            for cell, part in found.parts.items()
            if found.disturbed
        ]
        undisturbed = f"undisturbed {found.undisturbed_crashes} of {found.roots + found.plain} trials"
        lines.append("  " + "; ".join([undisturbed, *shares[:_MAX_SHOWN_CELLS]]))
        if len(shares) > _MAX_SHOWN_CELLS:
            lines.append(f"  {_MAX_SHOWN_CELLS} of {len(shares)} parts shown; run --json has all of them")
        if found.undisturbed_crashes and (part := found.estimated_disturbed) is not None:
            between = _between(part.low, part.high)
            lines.append(f"  with a disturbance: {format_number(found.disturbed)} per trial ({between})")
        if found.plain_equivalent_steps is not None:
            spent = f"{found.steps} steps, {found.plain_steps} of them in plain trials"
            lines.append(
                f"  {spent}; plain trials alone need about {format_number(found.plain_equivalent_steps)} steps"
            )
        if self.run_again:
            lines.append(f"  of the {self.run_again} weightiest crashes, {len(self.crashes)} came again from the start")
        lines += self._certain_lines
        lines.append("  the estimate omits failures that no copy has met; the certain bounds include them")
        return lines

    @property
    def _certain_lines(self) -> list[str]:
        found = self.estimate
        if found.certain is None:
            return []
        low, high = found.certain
        crashed = f"{found.plain_crashes} of {found.plain} plain trials crashed"
        bounds = f"at least {format_number(low)}, at most {format_number(high)}"
        return [f"  certain: {bounds} ({format_percent(found.confidence)}; {crashed})"]


def _verified(report: ProbeReport | BranchReport | RareReport) -> JsonObject:
    """Return the runs of crashes of forks from the start, in the form that ``run --json`` prints."""
    return {
        "run_again": report.run_again,
        "not_finished": report.not_finished,
        "confirmed": len(report.crashes),
        "crashes": [bundle.summary() for bundle in report.crashes],
    }


def _between(low: float, high: float) -> str:
    return f"{format_number(low)} to {format_number(high)}"


_MAX_SHOWN_CELLS = 5  # parts of the estimate of rare mode


def kind_data(group: Group) -> KindData:
    """Return a crash type as a short description, with the identifiers of its crashes."""
    return {
        "words": str(group.signature),
        "count": group.count,
        "first": group.first.id,
        "shortest": group.shortest.id,
    }


StoppedBecause = Literal["crash", "distinct", "rate", "all_trials", "interrupted", "no_valid_trial", "time", "precise"]


@dataclass(frozen=True, slots=True)
class HuntReport:
    """The result of a hunt.

    Args:
        directory: directory of the hunt.
        settings: the settings of the hunt.
        stopped_because: the reason why the hunt ended.
        outcomes: number of trials with each outcome.
        trial_steps: number of steps of the trials.
        steps_total: number of simulated steps. The number includes warm-ups, forks, and confirmations that failed.
        wall_s: wall time of this run of the hunt, in s.
        crashes: the crashes that have a bundle, the crash with the fewest steps first.
        reason: the reason why no trial was valid, as text.
        notes: facts about the run that users should know, such as trials that were run again.
        events: traffic events of all trials: for each type, the number of events, and the number of trials with such
            events.
        audit: the result of the audit; None without ``--audit``.
        kinds: crash types, the most frequent first; None if the first crash ended the hunt.
        types_by_cause: number of crash types by cause; None without ``--by-cause``.
        near_misses: the near misses that were kept, the most critical first.
        probes: the result of the probes; None without ``--probe``.
        at_fault: numbers of the trials whose crash is the agent's fault; None without ``--only-at-fault``.
        branches: the result of the branches; None without ``--branch``.
        copied: the crash of a fork that ended the hunt, after it was confirmed by a run from the start.
        rare: the result of rare mode; None without ``--rare``.
        tally: counts of the crashes of all trials, with or without a bundle.
        unconfirmed: number of crashes that the same command confirms when it runs again, because Ctrl-C came before
            their confirmation.
        unanswered: number of trials that the same command runs again, because they or their forks were killed.
        rate: the rate, compared with the threshold in ``until_rate``; None if there is no threshold.
        code_versions: the trials of each version of the code; empty if all trials ran with the same code. Crashes,
            types and rate are those of the newest version.
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
    types_by_cause: int | None = None
    near_misses: tuple[Bundle, ...] = ()
    probes: ProbeReport | None = None
    at_fault: tuple[int, ...] | None = None
    branches: BranchReport | None = None
    copied: Bundle | None = None
    unanswered: int = 0
    unconfirmed: int = 0
    rate: CrashRate | None = None
    rare: RareReport | None = None
    tally: CrashTally = field(default_factory=CrashTally)
    code_versions: tuple[VersionCounts, ...] = ()

    def to_json(self) -> JsonObject:
        """Return the report in the form that ``run --json`` prints."""
        found: JsonObject = {
            "dir": str(self.directory),
            "hunt_seed": self.settings.seed,
            "trials_planned": self.settings.trials,
            "trials_run": sum(self.outcomes.values()),
            "outcomes": self.outcomes,
            "stopped_because": self.stopped_because,
            "wall_s": round(self.wall_s, 3),
            "steps_total": self.steps_total,
            "events": {kind: {"count": count, "trials": trials} for kind, (count, trials) in self.events.items()},
            "crashes_found": self.tally.found,
            "crashes": [bundle.summary() for bundle in self.crashes],
            "notes": list(self.notes),
            "audit": self.audit.to_json() if self.audit is not None else None,
            "unanswered": self.unanswered,
            "unconfirmed": self.unconfirmed,
        }
        if self.probes is not None:
            found["probes"] = self.probes.to_json()
        if self.branches is not None:
            found["branches"] = self.branches.to_json()
        if self.kinds is not None:
            found["kinds"] = list(map(kind_data, self.kinds))
        if self.types_by_cause is not None:
            found["types_by_cause"] = self.types_by_cause
        if self.settings.run.near_misses:
            found["near_misses"] = [bundle.summary() for bundle in self.near_misses]
        if self.at_fault is not None:
            found["at_fault"] = list(self.at_fault)
        if self.copied is not None:
            found["copied"] = str(self.copied.path)
        if self.rare is not None:
            found["rare"] = self.rare.to_json()
        if self.rate is not None:
            found["rate"] = self.rate.to_json()
        if self.code_versions:
            found["code_versions"] = list(map(asdict, self.code_versions))
        return found
