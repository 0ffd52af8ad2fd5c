"""Counts of what-if runs: how many crashed, survived or do not count, in one shape for all callers."""

from __future__ import annotations

import statistics
from collections import Counter
from dataclasses import dataclass

from crashhunt.base.codec import Serializable
from crashhunt.crashes import wilson
from crashhunt.trial import Outcome

__all__ = ["Counts", "Run"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(Serializable):
    """One run.

    Args:
        number: its place among those that were asked for, from 0.
        outcome: how it ended.
        steps: how many steps it completed.
        digest: of its recording; equal digests are equal runs.
        crashed: whether the hunt counts its outcome as a crash.
        excluded: why it does not count; empty where it counts.
    """

    number: int
    outcome: Outcome
    steps: int
    digest: str
    crashed: bool
    excluded: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts(Serializable):
    """The counted runs of one question.

    Args:
        crash: the id of the crash.
        interventions: what was changed, in words.
        from_step: up to which step each counted run was bit-identical to the recording; None where the change holds
            from the start, so that no step has to be.
        code: whose code drove, ``snapshot`` or ``current``.
        recorded_outcome: the outcome of the recorded trial.
        recorded_steps: its length, in steps.
        asked: how many runs were asked for.
        each: the runs, by number.
        interrupted: why there are fewer than that; empty where there are not. Then `each` ends before the first run
            that had not finished: short runs finish first, so counting all finished runs would favour early crashes.
        warnings: what may make a difference, in words.
    """

    crash: str
    interventions: tuple[str, ...]
    from_step: int | None
    code: str
    recorded_outcome: Outcome
    recorded_steps: int
    asked: int
    each: tuple[Run, ...]
    interrupted: str = ""
    warnings: tuple[str, ...] = ()

    json_keys = (
        "crash", "interventions", "from_step", "code", "recorded_outcome", "recorded_steps", "asked", "runs",
        "crashed", "survived", "excluded", "share", "interval", "outcomes", "earliest_crash_step",
        "median_crash_step", "different", "interrupted", "warnings", "each",
    )  # fmt: skip

    @property
    def counted(self) -> tuple[Run, ...]:
        """The runs that count."""
        return tuple(run for run in self.each if not run.excluded)

    @property
    def runs(self) -> int:
        """How many runs count."""
        return len(self.counted)

    @property
    def crashed(self) -> int:
        """How many of them crashed."""
        return sum(run.crashed for run in self.counted)

    @property
    def survived(self) -> int:
        """How many of them did not crash."""
        return self.runs - self.crashed

    @property
    def excluded(self) -> dict[str, int]:
        """How many runs do not count, by reason."""
        return dict(Counter(run.excluded for run in self.each if run.excluded))

    @property
    def share(self) -> float | None:
        """The share of counted runs that crashed; None without one."""
        return self.crashed / self.runs if self.runs else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The Wilson interval of the share, with 95 % confidence.

        None where it says nothing: without runs, and where all runs are equal, as they then are one run.
        """
        return wilson(self.crashed, self.runs) if self.different > 1 else None

    @property
    def outcomes(self) -> dict[str, int]:
        """How many counted runs ended in which outcome, the most frequent first."""
        return dict(Counter(str(run.outcome) for run in self.counted).most_common())

    @property
    def crash_steps(self) -> list[int]:
        """The steps of the crashes, in order."""
        return sorted(run.steps for run in self.counted if run.crashed)

    @property
    def earliest_crash_step(self) -> int | None:
        """The step of the earliest crash; None without a crash."""
        return min(self.crash_steps, default=None)

    @property
    def median_crash_step(self) -> float | None:
        """The median step of the crashes; None without a crash."""
        return statistics.median(self.crash_steps) if self.crash_steps else None

    @property
    def different(self) -> int:
        """How many counted runs differ from each other."""
        return len({run.digest for run in self.counted})

    def lines(self) -> list[str]:
        """Return what people read: the answer first, then the evidence."""
        answer = f"{self.crash}: {self.crashed} of {self.runs} runs crashed"
        if self.interval is not None and self.share is not None:
            low, high = self.interval
            answer += f" ({self.share:.1%}; 95 % interval: {low:.1%} to {high:.1%})"
        found = [answer, f"  recorded: {self.recorded_outcome} at step {self.recorded_steps}"]
        found += [f"  changed: {what}" for what in self.interventions]
        if self.outcomes:
            found.append(f"  outcomes: {', '.join(f'{name} {count}' for name, count in self.outcomes.items())}")
        if self.median_crash_step is not None:
            found.append(f"  crash steps: earliest {self.earliest_crash_step}, median {self.median_crash_step:g}")
        if self.from_step is not None and self.runs:
            found.append(
                f"  verified: every run started at step 0 and matched the recording up to step {self.from_step}"
            )
        if self.runs > 1 and self.different == 1:
            found.append("  all runs are bit-identical")
        found += [f"  excluded: {count} runs, {reason}" for reason, count in self.excluded.items()]
        if self.interrupted:
            counted = f"{len(self.each)} of {self.asked} runs (those before the first run that had not finished)"
            found.append(f"  interrupted: {self.interrupted}, after {counted}")
        return [*found, *(f"  warning: {warning}" for warning in self.warnings)]
