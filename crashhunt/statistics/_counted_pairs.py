"""The pairs of trials of two agents that count, and which trials are failures.

A pair is one trial of each agent with the same number, seed and traffic. Pairs count in the order of their numbers, up
to the first number whose trials have not both ended. A crash ends a trial early, so the finished pairs are not a fair
sample, but the first k pairs are. With `--seeds`, a pair consists of all trials of a traffic seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.statistics._counted_trials import has_too_many_invalid, why_too_many_invalid

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from crashhunt.statistics._counted_trials import CountingRule, TrialFacts


Pair = tuple[tuple["TrialFacts", "TrialFacts"], ...]
"""The trials of a pair that count, each as first and second: one, or those of a traffic."""


class PairSequence:
    """Combines trials of two agents, which end in any order, to pairs in the order of their numbers.

    A trial that is invalid for both agents is excluded, and so is a trial that was not drawn at random. A trial that is
    invalid for one agent only counts: it has failed if the agent's own code prevents its start. Otherwise, and if its
    process was killed from outside, its result is unknown. ``is_same`` returns whether two trials of the same number
    have the same seed and traffic; by default, all have.

    Attributes:
        rounds: number of trials in each pair.
        invalid: number of pairs of trials that are invalid for both agents.
    """

    def __init__(
        self,
        rules: tuple[CountingRule, CountingRule],
        is_same: Callable[[TrialFacts, TrialFacts], bool] = lambda _first, _second: True,
    ) -> None:
        self._rules, self._is_same = rules, is_same
        self._waiting: tuple[dict[int, TrialFacts], dict[int, TrialFacts]] = ({}, {})
        self._next = max(rule.first for rule in rules)  # trial, or traffic
        self._traffics = rules[0].traffics
        self.rounds = min(rule.trials_per_unit for rule in rules) if self._traffics else 1
        self.valid = self.invalid = self.not_random = self.not_same = 0  # pairs of trials

    def add(self, side: int, trial: TrialFacts) -> Iterator[Pair]:
        """Add a trial, and yield the newly complete pairs, including pairs without a trial that counts.

        ``side`` is 0 for the first agent and 1 for the second. A trial that was added before is ignored.
        """
        if self._has(trial.number) or not self._is_wanted(trial.number):
            return
        self._waiting[side][trial.number] = trial
        while (numbers := self._numbers(self._next)) and all(
            number in waiting for number in numbers for waiting in self._waiting
        ):
            self._next += 1
            yield self._counted(numbers)

    def _has(self, number: int) -> bool:
        return (number % self._traffics if self._traffics else number) < self._next

    def _is_wanted(self, number: int) -> bool:
        return not self._traffics or number < self._traffics * self.rounds

    def _numbers(self, place: int) -> list[int]:
        """Return the numbers of the trials of a pair; empty if the hunt has no such traffic seed."""
        if not self._traffics:
            return [place]
        if place >= self._traffics:
            return []
        return [place + turn * self._traffics for turn in range(self.rounds)]

    def _counted(self, numbers: list[int]) -> Pair:
        found = []
        for number in numbers:
            both = self._waiting[0].pop(number), self._waiting[1].pop(number)
            if any(
                rule.plain_origin and one.origin != rule.plain_origin
                for rule, one in zip(self._rules, both, strict=True)
            ):
                self.not_random += 1
            elif not self._is_same(*both):
                self.not_same += 1
            elif all(one.has_ended and not one.valid for one in both):
                self.invalid += 1
            else:
                self.valid += 1
                found.append(both)
        return tuple(found)

    @property
    def position(self) -> int:
        """The number of the first trial, or traffic seed, that has not ended for both agents."""
        return self._next

    @property
    def excluded(self) -> int:
        """The number of trials that have ended, but do not belong to a complete pair yet."""
        return sum(map(len, self._waiting))

    def waiting(self, side: int) -> bool:
        """Return whether trials of an agent have ended for which the same trials of the other agent have not."""
        return any(number not in self._waiting[1 - side] for number in self._waiting[side])

    @property
    def is_hopeless(self) -> bool:
        """Whether too many pairs certainly have an invalid trial."""
        return has_too_many_invalid(self.invalid, self.valid)

    @property
    def why_not(self) -> str:
        """The reason why the pairs allow no verdict; empty if they allow one."""
        return why_too_many_invalid(self.invalid, self.valid, "pairs have an invalid trial")


@dataclass(frozen=True, slots=True, kw_only=True)
class SideCounts:
    """The trials of one agent that are invalid, although the same trials of the other agent are not."""

    not_started: int = 0  # number of trials that count as failures, because the user's code prevented their start
    killed: int = 0  # number of trials whose processes were killed from outside
    unknown: int = 0  # number of trials that are invalid for any other reason
    example: str = ""  # number of one of these trials, and the reason why it is invalid; empty if there is none

    @property
    def lost(self) -> int:
        """The number of trials whose result is unknown."""
        return self.killed + self.unknown

    def __add__(self, other: SideCounts) -> SideCounts:
        return SideCounts(
            not_started=self.not_started + other.not_started, killed=self.killed + other.killed,
            unknown=self.unknown + other.unknown, example=self.example or other.example,
        )  # fmt: skip


def failures_of(trial: TrialFacts) -> tuple[bool, bool]:
    """Return whether a trial has certainly failed, and whether it may have failed."""
    if trial.valid:
        return trial.crashed, trial.crashed
    return trial.has_ended and trial.failure is not None and trial.failure.is_of_users_code, True


def reason_of(trial: TrialFacts) -> str:
    """Return the reason why a trial is invalid, in one line."""
    failure = trial.failure
    if failure is None:
        return "invalid"
    if failure.exit_code is not None or failure.kind == "timeout" or not failure.traceback:
        return failure.message
    place = f" ({failure.agent or failure.party}, {failure.place})" if failure.place else ""
    return f"{failure.line}{place}"
