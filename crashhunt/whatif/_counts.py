"""Counts of what-if runs: how many crashed, survived or do not count, in one shape for all callers."""

from __future__ import annotations

import statistics
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

from crashhunt.crashes import wilson

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial import Outcome


__all__ = ["Counts", "CountsData", "Run", "RunData"]


class RunData(TypedDict):
    """The plain data of a `Run`."""

    number: int
    outcome: str
    steps: int
    digest: str
    crashed: bool
    excluded: str


class CountsData(TypedDict):
    """What ``whatif --json`` prints."""

    crash: str
    interventions: Sequence[str]
    from_step: int | None
    code: str
    recorded_outcome: str
    recorded_steps: int
    asked: int
    runs: int
    crashed: int
    survived: int
    excluded: Mapping[str, int]
    share: float | None
    interval: Sequence[float] | None
    outcomes: Mapping[str, int]
    earliest_crash_step: int | None
    median_crash_step: float | None
    different: int
    interrupted: str
    warnings: Sequence[str]
    each: Sequence[RunData]


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
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

    def to_json(self) -> RunData:
        """Return plain data."""
        return {
            "number": self.number,
            "outcome": str(self.outcome),
            "steps": self.steps,
            "digest": self.digest,
            "crashed": self.crashed,
            "excluded": self.excluded,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """The counted runs of one question.

    Args:
        crash: the id of the crash.
        interventions: what was changed, in words.
        from_step: up to which step each counted run was bit-identical to the recording; None where the change holds
            from the start, so that no step has to be.
        code: whose code drove, ``snapshot`` or ``current``.
        recorded: the outcome of the recorded trial.
        recorded_steps: its length, in steps.
        asked: how many runs were asked for.
        each: the runs, by number.
        interrupted: why there are fewer than that; empty where there are not.
        warnings: what may make a difference, in words.
    """

    crash: str
    interventions: tuple[str, ...]
    from_step: int | None
    code: str
    recorded: Outcome
    recorded_steps: int
    asked: int
    each: tuple[Run, ...]
    interrupted: str = ""
    warnings: tuple[str, ...] = ()

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
    def different(self) -> int:
        """How many counted runs differ from each other."""
        return len({run.digest for run in self.counted})

    def to_json(self) -> CountsData:
        """Return the shape that ``whatif --json`` prints."""
        steps = self.crash_steps
        return {
            "crash": self.crash,
            "interventions": list(self.interventions),
            "from_step": self.from_step,
            "code": self.code,
            "recorded_outcome": str(self.recorded),
            "recorded_steps": self.recorded_steps,
            "asked": self.asked,
            "runs": self.runs,
            "crashed": self.crashed,
            "survived": self.survived,
            "excluded": self.excluded,
            "share": self.share,
            "interval": list(self.interval) if self.interval is not None else None,
            "outcomes": self.outcomes,
            "earliest_crash_step": steps[0] if steps else None,
            "median_crash_step": statistics.median(steps) if steps else None,
            "different": self.different,
            "interrupted": self.interrupted,
            "warnings": list(self.warnings),
            "each": [run.to_json() for run in self.each],
        }

    def lines(self) -> list[str]:
        """Return what people read: the answer first, then the evidence."""
        answer = f"{self.crash}: {self.crashed} of {self.runs} runs crashed"
        if self.interval is not None and self.share is not None:
            low, high = self.interval
            answer += f" ({self.share:.1%}; 95 % interval: {low:.1%} to {high:.1%})"
        found = [answer, f"  recorded: {self.recorded} at step {self.recorded_steps}"]
        found += [f"  changed: {what}" for what in self.interventions]
        if self.outcomes:
            found.append(f"  outcomes: {', '.join(f'{name} {count}' for name, count in self.outcomes.items())}")
        if steps := self.crash_steps:
            found.append(f"  crash steps: earliest {steps[0]}, median {statistics.median(steps):g}")
        if self.from_step is not None and self.runs:
            found.append(
                f"  verified: every run started at step 0 and matched the recording up to step {self.from_step}"
            )
        if self.runs > 1 and self.different == 1:
            found.append("  all runs are bit-identical")
        found += [f"  excluded: {count} runs, {reason}" for reason, count in self.excluded.items()]
        if self.interrupted:
            found.append(f"  interrupted: {self.interrupted}, after {len(self.each)} of {self.asked} runs")
        return [*found, *(f"  warning: {warning}" for warning in self.warnings)]
