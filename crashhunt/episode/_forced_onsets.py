"""Forced onsets: copies of a root trial that run to its end, each with a first disturbance that is forced to begin.

`crashhunt.disturbances.FirstOnsets` proposes the beginnings (onsets) of disturbances, with weights. After every step of
the root, this module forks a copy for each proposed onset, and records how the copy ended.

Invariant: the root itself is a plain trial without disturbances after step 1. Searching for target vehicles and making
copies changes no bit of the root.

If second onsets are forced as well, a copy runs without later disturbances, and is copied again for each second onset.
The copy makes these further copies itself, and returns all their results. A copy always runs to the end of its trial,
because a shorter run would miss later crashes and bias the estimate. If a copy has no result, its root counts as
incomplete, because this copy may have crashed.

Cost: the steps of the copies, and a fork of the process for each.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, cast

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.foreign_code import supports
from crashhunt.base.forks import NoAnswer
from crashhunt.disturbances import SECONDS_PER_COPY, FirstOnsets, disturber_of, parse_rates
from crashhunt.episode._forks import ForkRunner
from crashhunt.simulators import SupportsDisturbances
from crashhunt.trial import Disturbance, Forced, ForcedCopy, Outcome, in_turn

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import Plain
    from crashhunt.disturbances import DisturbanceSampler, Onset
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult

_WAIT_FACTOR_WITH_SECONDS: Final = 2 + SECONDS_PER_COPY  # such a copy waits for as many others, on average


class OnsetForcer:
    """Forks each root trial into copies in which a disturbance is forced.

    Args:
        words: the rates of disturbances, each as ``NAME=RATE``.
        crash_on: the outcomes that count as a crash.
        patience_s: time limit of a copy, in s of wall time.
        delay: function called with the wall time that copies have taken, in s.
        tell: function called with texts for the user.
    """

    def __init__(
        self,
        words: Sequence[str],
        crash_on: Sequence[Outcome],
        patience_s: float,
        delay: Callable[[float], None],
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._rates = parse_rates(words)
        self._crashes = frozenset(map(str, crash_on))
        self._patience_s = patience_s
        self._delay = delay
        self.fork_runner = ForkRunner("rare", tell)  # object that runs the forks, and counts those without a result
        self._sampler: DisturbanceSampler | None = None
        self._onsets: FirstOnsets | None = None
        self._copies: list[ForcedCopy] = []
        self._steps = 0

    def is_due(self, episode: Episode) -> bool:
        """Return whether the trial is a root trial; every step of a root trial is needed."""
        return episode.spec.forcing is not None

    def ask(self, episode: Episode) -> None:
        """Fork the copies that begin after the completed step; this method is also called before the first step."""
        if self._onsets is None:
            self._onsets = self._begin(episode)
        for onset in self._onsets.after(episode.steps, partial(_has_target, episode)):
            if self.fork_runner.unanswered:
                self.fork_runner.skip(self.fork_runner.why_unanswered)  # the root is incomplete anyway
                continue
            began = time.monotonic()
            try:
                self._follow(episode, onset)
            except CrashhuntError as error:
                self.fork_runner.stop(error.message)
                self.fork_runner.skip()
            finally:
                self._delay(time.monotonic() - began)

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the root trial with the results of its copies, and begin the next trial."""
        onsets, copies, steps, runner = self._onsets, tuple(self._copies), self._steps, self.fork_runner
        self._onsets, self._copies, self._steps = None, [], 0
        if onsets is None:
            return result
        forced = Forced(
            survival=onsets.survival,
            masses=dict(sorted(onsets.masses.items())),
            copies=copies,
            steps=steps,
            unanswered=runner.unanswered,
            why_unanswered=runner.why_unanswered,
            may_be_asked_again=runner.may_be_answered,
        )
        runner.begin_trial()
        return replace(result, forced=forced)

    def _begin(self, episode: Episode) -> FirstOnsets:
        names, dt, spec = episode.names, episode.simulator.step_length_s, episode.spec
        if self._sampler is None or (self._sampler.agents, self._sampler.step_length_s) != (names, dt):
            self._sampler = disturber_of(self._rates, agents=names, step_length_s=dt)
        assert spec.forcing is not None
        return FirstOnsets(self._sampler, spec.forcing, spec.seed, spec.max_steps)

    def _follow(self, episode: Episode, onset: Onset) -> None:
        """Run a copy to the end of its trial, with further copies for second disturbances; record how they ended."""
        assert self._onsets is not None
        seconds = self._onsets.following(onset)
        patience_s = self._patience_s * (1 if seconds is None else _WAIT_FACTOR_WITH_SECONDS)

        def run(copy: Episode) -> Plain:
            if seconds is None:
                copy.replan(onset.planned)
                return {"ends": [_run_to_end(copy, onset)]}
            copy.replan(onset.alone)
            return self._run_with_seconds(copy, onset, seconds)

        def attempt() -> tuple[Plain | None, NoAnswer | None]:
            copy = episode.fork(run, observed=False)
            return copy.answer(patience_s), copy.no_answer

        answer = self.fork_runner.run(attempt)
        if answer is None:
            return
        if lost := answer.get("lost"):
            self.fork_runner.skip(str(lost), is_from_outside=bool(answer["is_from_outside"]))
            return
        for end in cast("list[JsonObject]", answer["ends"]):
            self._note(onset, end)

    def _run_with_seconds(self, copy: Episode, onset: Onset, seconds: FirstOnsets) -> Plain:
        """Run a copy without later disturbances, and copies of it with second disturbances; return their results."""
        ends: list[Plain] = []
        branched = copy.steps
        while copy.result is None:
            for second in seconds.after(copy.steps, partial(_has_target, copy)):
                other = copy.fork(partial(_run_second, first=onset, onset=second), observed=False)
                end = other.answer(self._patience_s)
                if end is None:
                    why = other.no_answer or NoAnswer("did not answer")
                    return {"lost": f"a copy {why.why}", "is_from_outside": why.is_from_outside}
                ends.append(end)
            copy.step()
        alone = _end_of(copy, onset, branched, within=seconds.survival)
        return {"ends": [alone, *ends]}

    def _note(self, first: Onset, end: JsonObject) -> None:
        """Record how a copy ended."""
        outcome, step, within = str(end["outcome"]), cast(int, end["step"]), cast(float, end["within"])
        branched = cast(int, end["branched"])
        self._steps += step - branched
        if outcome in (Outcome.SIMULATOR_ERROR, Outcome.INVALID):
            self.fork_runner.skip(f"a copy ended by {outcome}")  # perhaps because it is a copy
            return
        crashed = outcome in self._crashes
        planned = cast("list[JsonObject]", end["planned"])
        self._copies.append(
            ForcedCopy(
                cell=first.cell,
                onset=cast(int, end["onset"]),
                weight=first.weight * within,
                branched=branched,
                crash=outcome if crashed else "",
                step=step,
                disturbed=bool(end["disturbed"]),
                disturbances=tuple(map(Disturbance.from_json, planned)) if crashed else (),
                within=within,
                second=str(end["second"]),
            )
        )


def _run_second(copy: Episode, first: Onset, onset: Onset) -> Plain:
    # A new plan begins after the next step, so it includes a first onset that has to begin later.
    copy.replan(in_turn([*(one for one in first.alone if one.step > copy.steps + 1), *onset.planned]))
    return _run_to_end(copy, onset, within=onset.weight, second=onset.cell)


def _run_to_end(copy: Episode, onset: Onset, *, within: float = 1.0, second: str = "") -> Plain:
    branched = copy.steps
    while copy.result is None:
        copy.step()
    return _end_of(copy, onset, branched, within=within, second=second)


def _end_of(copy: Episode, onset: Onset, branched: int, *, within: float, second: str = "") -> Plain:
    """Return the result of a copy as a dict with the names of `ForcedCopy`."""
    result = copy.result
    assert result is not None
    return {
        "outcome": str(result.outcome),
        "step": result.steps,
        "disturbed": result.disturbed,
        "planned": [one.to_json() for one in copy.spec.disturbances],
        "onset": onset.step,
        "branched": branched,
        "within": within,
        "second": second,
    }


def _has_target(episode: Episode, planned: Disturbance) -> bool:
    """Return whether a disturbance that begins in the next step has a target vehicle, as in `DisturbanceInjector`."""
    simulator = episode.simulator
    if planned.agent not in simulator.agents or not supports(simulator, SupportsDisturbances):
        return False
    return bool(simulator.resolve_target(planned))
