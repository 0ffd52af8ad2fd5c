"""The specification of each trial of a hunt, which is in the ledger before it starts where nothing else tells it."""

from __future__ import annotations

from collections import deque
from heapq import heappop, heappush
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.hunts._ledger_reader import Turn
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.disturbances import Disturber
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.samplers import NamedSampler
    from crashhunt.trial import TrialResult, Value

__all__ = ["LAG", "Trials", "spec_of"]

_TRAFFIC = 0x74726166  # apart from what else is drawn of the hunt's seed
LAG = 32
"""By how many trials a deterministic hunt tells late: a constant, so that 1 and 16 workers run the same trials."""


class Trials:
    """Hands out the trials of a hunt that are still to run, in order of their numbers.

    Of a sampler that does not learn, a trial follows from the hunt's seed and its number. What one that learns proposes
    is in the ledger, with the results that it was told before, when it is handed out; `crashhunt.samplers.Sampler` has
    the rule by which they are told.

    Args:
        settings: of the hunt.
        sampler: who proposes.
        ledger: of the hunt.
        finished: the numbers of the trials that have ended.
        unanswered: those of them that run again, in order of their numbers: something outside of them kept answers from
            it. The sampler has been or is told what the ledger has, and not what comes of the second run, so that a
            resumed hunt proposes the same trials.
        lag: how many trials the hunt has under way at once; where it is deterministic, how many it may.
        disturber: what draws their disturbances; None where they have none.

    Raises:
        CrashhuntError: the sampler fails, or the ledger is damaged.
    """

    def __init__(
        self,
        settings: HuntSettings,
        sampler: NamedSampler,
        ledger: Ledger,
        finished: set[int],
        *,
        lag: int,
        disturber: Disturber | None = None,
        unanswered: Sequence[TrialSpec] = (),
    ) -> None:
        self._settings = settings
        self._sampler = sampler
        self._ledger = ledger
        self._lag = lag
        self._disturber = disturber
        self._waiting = iter(number for number in range(settings.most_trials) if number not in finished)
        self._next = next(self._waiting, None)
        self._unanswered = deque(unanswered)
        self._running_again: set[int] = set()
        self._proposed: dict[int, TrialSpec] = {}  # by a run before this one, and not ended
        self._open: set[int] = set()
        self._has_origins = False
        self._untold: list[int] = []  # a heap of the trials that have ended
        self._results: dict[int, TrialResult] = {}  # of those, what has ended in this run
        if sampler.learns:
            self._resume(finished)

    @property
    def upcoming(self) -> int | None:
        """The number of the next one; all of lower numbers have ended or are under way. None where there is none."""
        upcoming = [one.number for one in list(self._unanswered)[:1]] + [
            one for one in (self._next,) if one is not None
        ]
        return min(upcoming, default=None)

    @property
    def exhausted(self) -> bool:
        """Whether there are no more."""
        return self._next is None and not self._unanswered

    def take(self, room: int) -> list[TrialSpec]:
        """Return the next trials, at most so many; fewer where there are no more, or a result is waited for first.

        Raises:
            CrashhuntError: the sampler fails, or the ledger cannot be written.
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
                told = self._tell(self._next - self._lag)
                spec = spec_of(self._next, self._settings, self._sampler, self._disturber)
                turns.append(Turn(told, spec))
            elif spec is None:
                spec = spec_of(self._next, self._settings, self._sampler, self._disturber)
            found.append(spec)
            self._open.add(self._next)
            self._next = next(self._waiting, None)
        if turns:
            self._ledger.propose(turns)
        if not self._has_origins and any(spec.parent is not None or spec.origin for spec in found):
            self._has_origins = True
            self._ledger.note(origins=True)  # so that tables of trials have columns for them
        return found

    def ended(self, result: TrialResult) -> None:
        """Take note of how a trial ended, which is in the ledger already, or will be before anything else happens."""
        number = result.spec.number
        if number in self._running_again:
            self._running_again.discard(number)
            return
        self._open.discard(number)
        if self._sampler.learns:
            self._results[number] = result
            heappush(self._untold, number)

    def _must_wait(self, number: int) -> bool:
        """Whether a result that is to be told before this proposal is not there yet."""
        return self._settings.run.deterministic and min(self._open, default=number) <= number - self._lag

    def _tell(self, last: int) -> tuple[int, ...]:
        """Tell what has ended, up to some number; return the numbers."""
        told = []
        while self._untold and self._untold[0] <= last:
            number = heappop(self._untold)
            result = self._results.pop(number, None) or self._ledger.result(number)
            assert result is not None
            self._sampler.tell(result)
            told.append(number)
        return tuple(told)

    def _resume(self, finished: set[int]) -> None:
        """Tell what was told before, in the same order, and find what was proposed and has not ended."""
        told = set()
        for turn in self._ledger.turns():
            for number in turn.told:
                result = self._ledger.result(number) if number in finished else None
                if result is not None:  # else it is to run again, and is told then
                    self._sampler.tell(result)
                    told.add(number)
            if turn.spec.number not in finished:
                self._proposed[turn.spec.number] = turn.spec
        self._untold = sorted(finished - told)


def spec_of(
    number: int, settings: HuntSettings, sampler: NamedSampler, disturber: Disturber | None = None
) -> TrialSpec:
    """Return a trial as a sampler proposes it, with the disturbances that follow from its seed.

    Where the hunt has so many traffics and no more, trials have them in turns: the seed, and what an independent
    sampler draws for the scenario; what another one proposes for that stays.

    Raises:
        CrashhuntError: the sampler fails.
    """
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
    seed = int(rng.integers(2**31))
    proposal = sampler.ask(number, rng)
    values = dict(proposal.arguments)
    if settings.seeds:
        turn = number % settings.seeds
        rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(turn, _TRAFFIC)))
        seed = int(rng.integers(2**31))
        if sampler.independent:
            values |= {key: value for key, value in sampler.ask(turn, rng).arguments.items() if not key[0]}
    arguments: dict[str, dict[str, Value]] = {agent: {} for agent in settings.agents}
    scenario_arguments: dict[str, Value] = {}
    for (agent, name), value in sorted(values.items()):
        (arguments[agent] if agent else scenario_arguments)[name] = value
    if proposal.seed is not None:
        seed = proposal.seed
    return TrialSpec(
        number,
        seed,
        arguments,
        scenario_arguments,
        max_steps=settings.max_steps,
        parent=proposal.parent,
        origin=proposal.origin,
        disturbances=disturber.draw(seed, settings.max_steps) if disturber is not None else (),
    )
