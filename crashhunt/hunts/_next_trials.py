"""The specification of each trial of a hunt: its seed, arguments and disturbances, and the order of the trials.

They follow from the seed of the hunt and the number of the trial. A trial that does not follow from the seed is in the
ledger before it starts.
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter, deque
from heapq import heappop, heappush
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.disturbances import FIRST_STEP
from crashhunt.ledger import Turn
from crashhunt.results import trials_of_running
from crashhunt.trial import KILLED, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.hunts._progress import Progress
    from crashhunt.ledger import Facts, Ledger
    from crashhunt.plans import HuntSettings, RunSettings
    from crashhunt.samplers import NamedSampler
    from crashhunt.statistics import Forcings
    from crashhunt.trial import Disturbance, Forcing, TrialResult, Value


_TRAFFIC_STREAM = 0x74726166  # apart from what else is drawn of the hunt's seed


def spec_of(
    number: int,
    settings: HuntSettings,
    sampler: NamedSampler,
    disturber: DisturbanceSampler | None = None,
    forcing: Forcing | None = None,
    *,
    digest_of_changes: bool = False,
) -> TrialSpec:
    """Return the trial that a sampler proposes, with the disturbances that follow from the trial's seed.

    With `--seeds`, trials use the given number of traffic seeds in turn. A traffic seed also determines the scenario's
    arguments if the sampler is independent. Samplers that are not independent propose the scenario's arguments
    themselves.

    With a forcing, the trial is a root. In a root, no disturbance is drawn from the first step on in which a
    disturbance may be forced.

    Raises:
        CrashhuntError: the sampler failed.
    """
    spec = _propose_trial(number, settings, sampler, disturber, forcing, digest_of_changes=digest_of_changes)
    assert spec is not None  # only a sampler that learns may propose no trial, and not its first
    return spec


def _propose_trial(
    number: int,
    settings: HuntSettings,
    sampler: NamedSampler,
    disturber: DisturbanceSampler | None = None,
    forcing: Forcing | None = None,
    *,
    digest_of_changes: bool,
) -> TrialSpec | None:
    """Return the trial as `spec_of`; None if the sampler proposes none before it receives further results."""
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
    seed = int(rng.integers(2**31))
    proposal = sampler.ask(number, rng)
    if proposal is None:
        return None
    values = dict(proposal.arguments)
    if settings.seeds:
        turn = number % settings.seeds
        rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(turn, _TRAFFIC_STREAM)))
        seed = int(rng.integers(2**31))
        if sampler.independent:
            traffic = sampler.ask(turn, rng)
            assert traffic is not None  # only a sampler that learns may propose no trial
            values |= {key: value for key, value in traffic.arguments.items() if not key[0]}
    arguments: dict[str, dict[str, Value]] = {agent: {} for agent in settings.agents}
    scenario_arguments: dict[str, Value] = {}
    for (agent, name), value in sorted(values.items()):
        (arguments[agent] if agent else scenario_arguments)[name] = value
    if proposal.seed is not None:
        seed = proposal.seed
    return TrialSpec(
        number=number,
        seed=seed,
        arguments=arguments,
        scenario_arguments=scenario_arguments,
        max_steps=settings.max_steps,
        parent=proposal.parent,
        origin=proposal.origin,
        disturbances=_drawn(disturber, seed, settings.max_steps, forcing) if disturber is not None else (),
        forcing=forcing,
        digest_of_changes=digest_of_changes,
    )


def _drawn(disturber: DisturbanceSampler, seed: int, steps: int, forcing: Forcing | None) -> tuple[Disturbance, ...]:
    """Return the disturbances of a trial; for a root, only those before the first step with a forced disturbance."""
    return disturber.draw(seed, steps if forcing is None else min(steps, FIRST_STEP - 1))


# The order of the trials, and the results that a sampler receives before each.

GREATEST_LAG = 32
"""Greatest delay of results for a sampler in a deterministic hunt, in trials. It does not depend on the workers, so
that 1 and 16 of them run the same trials."""
_QUEUED_PER_WORKER = 1  # trials handed over ahead of time, so that no worker waits for the hunt
_LOOK_EVERY_S = 0.1  # at the hunt on which another hunt waits
_FIRST_LAG, _TRIALS_PER_LAG = 4, 8  # delay of the first trials, and trials after which it is one more


def growing_lag(number: int, most: int) -> int:
    """Return the delay, in trials, with which a learning sampler receives results; it grows up to a maximum.

    A sampler learns most from its first results, and a delay costs it about as many trials as its length (Joulani,
    György and Szepesvári 2013, for stochastic bandits). With this growing delay, two workers are never idle, and 16
    workers are idle only before trial 96.
    """
    return min(most, _FIRST_LAG + number // _TRIALS_PER_LAG)


def trials_under_way(parallel: int) -> int:
    """Return the number of trials to submit so that ``parallel`` trials run and each worker has its next trial."""
    return parallel * (1 + _QUEUED_PER_WORKER)


def result_lag(before: Facts, run: RunSettings, parallel: int) -> int:
    """Return the maximum number of trials by which results reach the sampler late."""
    under_way = trials_under_way(parallel)
    if not run.deterministic:
        return under_way
    return before.get("lag") or max(GREATEST_LAG, under_way)


class Trials:
    """Provides the trials of a hunt that are still to run, in the order of their numbers.

    If the sampler does not learn, a trial follows from the hunt's seed and the number of the trial. If the sampler
    learns, the ledger contains each proposal before its trial starts, with the results that the sampler had received.
    `crashhunt.samplers.Sampler` defines when the sampler receives results.

    Args:
        settings: settings of the hunt.
        sampler: sampler that proposes the trials.
        ledger: ledger of the hunt.
        finished: the numbers of the finished trials.
        unanswered: the finished trials that run again, in the order of their numbers, because some of their results are
            missing for an external reason. The sampler receives the result in the ledger, not the result of the second
            run, so a resumed hunt proposes the same trials.
        lag: delay, in trials, with which a learning sampler receives results: the number of trials that run at a time.
            In a deterministic hunt, it is the maximum delay, which the first trials do not reach (`growing_lag`).
        disturber: object that draws the disturbances of trials; None if trials have no disturbances.
        forcings: object that returns the forcing of each root in rare mode; None in any other hunt.
        apart: the finished trials of other versions of the code, whose results a learning sampler does not receive.
        begun_with: version of the proposals that the hunt already contains; None if it contains none.
        digest_of_changes: whether the digests of the trials cover only the changes of observations.

    Raises:
        CrashhuntError: the sampler failed, or the ledger is damaged.
    """

    def __init__(
        self,
        settings: HuntSettings,
        sampler: NamedSampler,
        ledger: Ledger,
        finished: set[int],
        *,
        lag: int,
        begun_with: int | None = None,
        disturber: DisturbanceSampler | None = None,
        unanswered: Sequence[TrialSpec] = (),
        forcings: Forcings | None = None,
        apart: Collection[int] = frozenset(),
        digest_of_changes: bool = False,
    ) -> None:
        self._settings = settings
        self._sampler = sampler
        self._ledger = ledger
        self._lag = lag
        self._begun_with = sampler.version if begun_with is None else begun_with
        self._disturber = disturber
        self._waiting = iter(number for number in range(settings.most_trials) if number not in finished)
        self._next = next(self._waiting, None)
        self._unanswered = deque(unanswered)
        self._forcings = forcings
        self._digest_of_changes = digest_of_changes
        self._running_again: set[int] = set()
        self._proposed: dict[int, TrialSpec] = {}  # by a run before this one, and not ended
        self._open: set[int] = set()
        self._has_origins = False
        self._told: tuple[int, ...] = ()  # reported since the last proposal
        self._untold: list[int] = []  # a heap of the trials that have ended
        self._results: dict[int, TrialResult] = {}  # of those, what has ended in this run
        if sampler.learns:
            self._resume(finished, finished.difference(apart))

    @property
    def upcoming(self) -> int | None:
        """The number of the next trial; trials with lower numbers are running or have ended.

        The number is None if no trial is left.
        """
        upcoming = [one.number for one in list(self._unanswered)[:1]] + [
            one for one in (self._next,) if one is not None
        ]
        return min(upcoming, default=None)

    @property
    def exhausted(self) -> bool:
        """Whether all trials have been provided."""
        return self._next is None and not self._unanswered

    def take(self, room: int) -> list[TrialSpec]:
        """Return at most ``room`` next trials; fewer if no more exist, or if the sampler needs a result first.

        Raises:
            CrashhuntError: the sampler failed, or the ledger cannot be written.
        """
        found: list[TrialSpec] = []
        while self._unanswered and len(found) < room:
            found.append(self._unanswered.popleft())
            self._running_again.add(found[-1].number)
        turns: list[Turn] = []
        while self._next is not None and len(found) < room:
            spec = self._proposed.pop(self._next, None)
            if spec is None and self._sampler.learns:
                if self._must_wait(self._next):
                    break
                self._refuse_other_version()
                self._told += self._report_to_sampler(self._next - self._lag_of(self._next))
                spec = self._propose(self._next)
                if spec is None and self._open:
                    break
                if spec is None:
                    self._told += self._report_to_sampler(self._next)
                    spec = self._propose(self._next)
                if spec is None:
                    self._next = None
                    break
                turns.append(Turn(self._told, spec))
                self._told = ()
            elif spec is None:
                forcing = None
                if self._forcings is not None:
                    if min(self._open, default=self._next) < self._forcings.needed(self._next):
                        break
                    forcing = self._forcings.of(self._next)
                drawn = self._settings, self._sampler, self._disturber, forcing
                spec = spec_of(self._next, *drawn, digest_of_changes=self._digest_of_changes)
            found.append(spec)
            self._open.add(self._next)
            self._next = next(self._waiting, None)
        if turns:
            self._ledger.propose(turns)
        if not self._has_origins and any(spec.parent is not None or spec.origin for spec in found):
            self._has_origins = True
            self._ledger.note(origins=True)  # so that tables of trials have columns for them
        return found

    def require_same_version(self) -> None:
        """Refuse a hunt whose next trial would be proposed by another version of the sampler, before the hunt begins.

        Raises:
            HuntDirectoryError: the hunt began with another version.
        """
        if self._sampler.learns and self._next is not None and self._next not in self._proposed:
            self._refuse_other_version()

    def ended(self, result: TrialResult) -> None:
        """Register the result of a trial, which is already in the ledger or will be written next."""
        number = result.spec.number
        if number in self._running_again:
            return
        self._open.discard(number)
        if self._sampler.learns:
            self._results[number] = result
            heappush(self._untold, number)

    def _propose(self, number: int) -> TrialSpec | None:
        """Return a trial of a sampler that learns; None if it needs further results."""
        drawn = self._settings, self._sampler, self._disturber
        return _propose_trial(number, *drawn, digest_of_changes=self._digest_of_changes)

    def _refuse_other_version(self) -> None:
        """Refuse to mix proposals of two versions, because the hunt's seed could then no longer repeat the hunt."""
        name, version = self._settings.sampler, self._sampler.version
        if version != self._begun_with:
            raise HuntDirectoryError(
                f"the hunt began with version {self._begun_with} of the sampler {name!r}, and this crashhunt has "
                f"version {version}: trial {self._next} cannot be proposed as before",
                fix="begin a new hunt, or resume this one with the crashhunt that began it",
            )

    def _must_wait(self, number: int) -> bool:
        """Return whether a result that the sampler must receive before the next proposal is missing."""
        return self._settings.run.deterministic and min(self._open, default=number) <= number - self._lag_of(number)

    def _lag_of(self, number: int) -> int:
        return growing_lag(number, self._lag) if self._settings.run.deterministic else self._lag

    def _report_to_sampler(self, last: int) -> tuple[int, ...]:
        """Pass the results of finished trials up to a number to the sampler; return the numbers of these trials."""
        told = []
        while self._untold and self._untold[0] <= last:
            number = heappop(self._untold)
            result = self._results.pop(number, None) or self._ledger.result(number)
            assert result is not None
            self._sampler.tell(result)
            told.append(number)
        return tuple(told)

    def _resume(self, finished: set[int], known: set[int]) -> None:
        """Pass earlier results to the sampler in their original order, and find the proposals without a result.

        The sampler receives the results of the trials in ``known``.
        """
        told = set()
        for turn in self._ledger.turns():
            for number in turn.told:
                result = self._ledger.result(number) if number in known else None
                if result is not None:  # otherwise it runs again, and the sampler receives that result
                    self._sampler.tell(result)
                    told.add(number)
            if turn.spec.number not in finished:
                self._proposed[turn.spec.number] = turn.spec
        self._untold = sorted(known - told)


class Pace:
    """Limits how far a hunt runs ahead of another hunt whose trials are compared with its own, number by number.

    Without this limit, the faster of two hunts runs trials that are not needed if the comparison ends early. Only the
    hunt that is ahead waits, so the pairs come as fast as without the limit. If the other hunt is not running, there is
    no limit, because it may have ended or failed.
    """

    def __init__(self, other: Path) -> None:
        self._other = other
        self._finished: int | None = None  # trials of the other hunt
        self._looked = -math.inf

    def room(self, upcoming: int | None, lead: int) -> int:
        """Return how many trials may start now.

        ``lead`` is the number of trials that this hunt may be ahead of the other hunt.
        """
        if upcoming is None:
            return sys.maxsize
        now = time.monotonic()
        is_limited = self._finished is not None and upcoming < self._finished + lead
        if not is_limited and now - self._looked >= _LOOK_EVERY_S:
            self._looked, self._finished = now, trials_of_running(self._other)
        return sys.maxsize if self._finished is None else max(0, self._finished + lead - upcoming)


# Trials that a resumed hunt runs again: something outside of them, such as a kill, kept answers from it.

# Searching the text of a row takes a tenth of the time of parsing it. A few rows too many do no harm.
_WAS_KILLED_SQL = f"""(outcome = 'invalid' AND instr(result, '"kind": "{KILLED}"') > 0)"""
_UNANSWERED_SQL = """instr(result, '"may_be_asked_again": true') > 0"""


def find_unanswered(ledger: Ledger) -> list[TrialResult]:
    """Return the trials that are to run again, from the ledger of a hunt.

    Raises:
        HuntDirectoryError: a row of the ledger has changed since it was written.
    """
    where = (
        _WAS_KILLED_SQL if not ledger.facts().get("copies") else f"{_WAS_KILLED_SQL} OR {_UNANSWERED_SQL}"
    )  # the latter reads every row
    return [result for result in ledger.results_where(where) if result.is_to_be_run_again]


class Unanswered:
    """The trials of a hunt that run again. Their rows stay in the ledger until new results replace them."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._before = {result.spec.number: result for result in find_unanswered(ledger)}
        self._open: set[int] = set()  # of this run of the hunt

    def __len__(self) -> int:
        """Return the number of trials that are still to be run again."""
        return len(self._open | self._before.keys())

    @property
    def specs(self) -> list[TrialSpec]:
        """Return the trials to run again, in the order of their numbers."""
        return [result.spec for result in self._before.values()]

    def account(self, result: TrialResult, progress: Progress) -> bool:
        """Register a finished trial; return whether its result is to be recorded.

        The progress has already counted the trial once if it runs again.
        """
        if result.is_to_be_run_again:
            self._open.add(result.spec.number)
        before = self._before.pop(result.spec.number, None)
        if before is None:
            return True
        if result.was_killed_from_outside:
            return False  # the ledger has an answer that is as good, or better
        progress.outcomes -= Counter([str(before.outcome)])
        if not before.was_killed_from_outside:  # otherwise its outcome was unknown
            progress.counted_before.add(result.spec.number)
        if before.digest and before.digest != result.digest:
            again = f"trial {result.spec.number} was run again for the answers of its copies"
            note = f"{again}, and differs: it is not determined by its specification"
            self._ledger.remark(note)
            progress.notes.append(note)
        return True
