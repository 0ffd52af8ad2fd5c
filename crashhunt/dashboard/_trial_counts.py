"""Counts the trials of a hunt in each part of the hunt.

A hunt may have a million trials and write a thousand each second. The memory therefore does not grow with the number of
trials. A refresh reads only new trials, namely those with numbers above the greatest known number, and those in gaps
below this number. Trials end in any order, so their numbers do not show the order in which they ended.

Invariants: `outcomes`, the parts and the counts up to the first gap are exact.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from crashhunt.ledger import Ledger

PARTS = 256
"""Parts that the trials of a hunt are counted in, at most."""

_TAIL = 4_000  # numbers among which workers leave gaps
_MAX_GAPS = 1_000  # that are read one by one; of more, the range over all of them is read


class Prefix(NamedTuple):
    """The first trials of a hunt, up to the first trial that has not ended."""

    valid: int  # number of trials that count
    invalid: int  # number of trials that do not count
    crashes: int  # number of valid trials that crashed
    steps: int  # number of simulated steps of the valid trials
    excluded: int  # number of trials that have ended although an earlier trial has not


class _Part:
    """The results of the trials in one part of the hunt."""

    __slots__ = ("outcomes", "steps")

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.steps = 0


class TrialCounts:
    """Counts the trials of a hunt, with a sample for plots."""

    def __init__(self, crash_on: Collection[str]) -> None:
        self.crash_on = frozenset(map(str, crash_on))
        self.last = -1
        self.outcomes: Counter[str] = Counter()
        self._width = 1
        self._parts: dict[int, _Part] = {}
        self._prefix = 0  # the first number that has not ended
        self._prefix_outcomes: Counter[str] = Counter()
        self._prefix_steps = 0  # of valid trials
        self._waiting: dict[int, tuple[str, int]] = {}  # that have ended beyond it
        self._killed: set[int] = set()

    def refresh(self, ledger: Ledger) -> list[tuple[int, str]]:
        """Read new trials and count them.

        Returns:
            Number and outcome of each new trial; empty at the first call, because all trials are new.
        """
        if self.last < 0:
            self._begin(ledger)
            return []
        new = [row for first, last in self._gaps(ledger.last_number()) for row in ledger.ended_between(first, last)]
        rows = [row for row in new if row[0] >= self._prefix and row[0] not in self._waiting]
        if any(outcome == Outcome.INVALID for _, outcome, _ in rows):
            self._killed.update(ledger.killed_numbers(rows[0][0]))
        for number, outcome, steps in rows:
            self._count(number // self._width, outcome, 1, steps)
            self._waiting[number] = outcome, steps
            self.last = max(self.last, number)
        self._advance()
        while self.last // self._width >= PARTS:
            self._halve()
        return [(number, outcome) for number, outcome, _ in rows]

    def _begin(self, ledger: Ledger) -> None:
        self.last = ledger.last_number()
        if self.last < 0:
            return
        self._width = 1 << max(0, (self.last // PARTS).bit_length())
        invalid_steps: Counter[int] = Counter()
        known = ledger.steps_by_outcome()
        usual = self._usual(ledger, known)
        for outcome in known:
            if outcome == usual:
                continue
            for part, trials, steps in ledger.parts_of(self._width, outcome):
                self._count(part, outcome, trials, steps)
                if outcome == Outcome.INVALID:
                    invalid_steps[part] += steps
        if usual:
            self._fill(usual, known[usual][1], self._tail_gaps(ledger))
        self._killed.update(ledger.killed_numbers())
        # All parts before the first incomplete one are without gaps; only the rest is read trial by trial.
        whole = 0
        while whole in self._parts and self._parts[whole].outcomes.total() == self._width:
            whole += 1
        if self._killed:
            whole = min(whole, min(self._killed) // self._width)
        for part in range(whole):
            self._prefix_outcomes += self._parts[part].outcomes
            self._prefix_steps += self._parts[part].steps - invalid_steps[part]
        self._prefix = whole * self._width
        for number, outcome, steps in ledger.ended_between(self._prefix, self.last):
            self._waiting[number] = outcome, steps
        self._advance()

    def _usual(self, ledger: Ledger, known: Mapping[str, tuple[int, int, int]]) -> str:
        """Return the most frequent outcome if its trials in each part follow from those of other outcomes; else empty.

        The method can derive the parts if all trials with this outcome took the same number of steps, as with
        ``survived``, and numbers are missing only near the end. The derivation avoids sorting a million numbers by
        part.
        """
        # Steps of invalid trials are counted apart from those of others.
        usual = max(known.keys() - {Outcome.INVALID}, key=lambda outcome: known[outcome][0], default="")
        if not usual:
            return ""
        _, least, most = known[usual]
        missing = self.last + 1 - sum(trials for trials, _, _ in known.values())
        return usual if least == most and missing == len(self._tail_gaps(ledger)) else ""

    def _tail_gaps(self, ledger: Ledger) -> set[int]:
        """Return those of the last trial numbers that are missing in the ledger."""
        first = max(0, self.last - _TAIL)
        return set(range(first, self.last)) - {number for number, _, _ in ledger.ended_between(first, self.last)}

    def _fill(self, outcome: str, steps: int, gaps: set[int]) -> None:
        """Count all trials that are neither counted nor missing under one outcome."""
        missing = Counter(number // self._width for number in gaps)
        for part in range(self.last // self._width + 1):
            there = min(self._width, self.last + 1 - part * self._width) - missing[part]
            others = self._parts[part].outcomes.total() if part in self._parts else 0
            if there > others:
                self._count(part, outcome, there - others, (there - others) * steps)

    def _count(self, part: int, outcome: str, trials: int, steps: int) -> None:
        found = self._parts.setdefault(part, _Part())
        found.outcomes[outcome] += trials
        found.steps += steps
        self.outcomes[outcome] += trials

    def _gaps(self, last: int) -> list[tuple[int, int]]:
        """Return the ranges of numbers that may belong to new trials, up to the last number in the ledger."""
        found, first = [], self._prefix
        for number in sorted(self._waiting):
            if number > first:
                found.append((first, number - 1))
            first = max(first, number + 1)
        if len(found) > _MAX_GAPS:
            return [(self._prefix, last)]
        return [*found, (max(first, self._prefix), last)] if last >= first else found

    def _advance(self) -> None:
        """Move trials after the first gap to the counts of the trials before it, if the gap is closed."""
        while self._prefix in self._waiting and self._prefix not in self._killed:
            outcome, steps = self._waiting.pop(self._prefix)
            self._prefix_outcomes[outcome] += 1
            self._prefix_steps += steps if outcome != Outcome.INVALID else 0
            self._prefix += 1

    def _halve(self) -> None:
        before, self._parts, self._width = self._parts, {}, 2 * self._width
        for part, found in before.items():
            into = self._parts.setdefault(part // 2, _Part())
            into.outcomes += found.outcomes
            into.steps += found.steps

    @property
    def prefix(self) -> Prefix:
        """The counts of trials on which a rate is based."""
        invalid = self._prefix_outcomes[Outcome.INVALID]
        return Prefix(
            valid=self._prefix_outcomes.total() - invalid,
            invalid=invalid,
            crashes=sum(count for outcome, count in self._prefix_outcomes.items() if outcome in self.crash_on),
            steps=self._prefix_steps,
            excluded=len(self._waiting) - len(self._killed),
        )

    @property
    def trials(self) -> int:
        """The number of finished trials."""
        return self.outcomes.total()

    @property
    def crashes(self) -> int:
        """The number of trials with an outcome that counts as a crash."""
        return sum(count for outcome, count in self.outcomes.items() if outcome in self.crash_on)

    def curve(self, most: int = PARTS) -> list[list[int]]:
        """Return cumulative trials, steps and crashes after each part of the hunt; all are 0 in the first entry.

        ``most`` is the maximum number of points, at least 2.
        """
        found, trials, steps, crashes = [[0, 0, 0]], 0, 0, 0
        for number in sorted(self._parts):
            part = self._parts[number]
            trials += part.outcomes.total()
            steps += part.steps
            crashes += sum(count for outcome, count in part.outcomes.items() if outcome in self.crash_on)
            found.append([trials, steps, crashes])
        if len(found) <= most:
            return found
        return [found[round(place * (len(found) - 1) / (most - 1))] for place in range(most)]

    def parts(self) -> list[dict[str, object]]:
        """Return the parts of the hunt: first and last trial number, and the number of trials with each outcome."""
        return [
            {
                "first": number * self._width,
                "last": min(self.last, (number + 1) * self._width - 1),
                "steps": self._parts[number].steps,
                "outcomes": dict(self._parts[number].outcomes),
            }
            for number in sorted(self._parts)
        ]
