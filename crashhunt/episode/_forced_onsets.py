"""Forced onsets: copies of a root run to the end of its trial, each with a first disturbance that is forced on it.

`crashhunt.disturbances.FirstOnsets` proposes the onsets with their weights. This module asks it after every step of the
root, makes a copy for each onset, and notes how the copy ended.

Invariant: the root itself is a plain trial without disturbances after step 1. Looking for vehicles and making copies
changes no bit of it.

A copy always runs to the end of its trial: a horizon would bias the estimate, because crashes after it would be lost.
A root with a copy that has no answer counts as incomplete, since a lost copy may have been the one that crashed.

Cost: the steps of the copies, and a fork of the process for each.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, cast

from crashhunt.base.capabilities import supports
from crashhunt.base.errors import CrashhuntError
from crashhunt.disturbances import FirstOnsets, disturber_of, parse_rates
from crashhunt.episode._questions import Questions
from crashhunt.simulators import SupportsDisturbances
from crashhunt.trial import Disturbance, Forced, ForcedCopy, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.base.forks import NoAnswer
    from crashhunt.base.json_types import Plain
    from crashhunt.disturbances import DisturbanceSampler, Onset
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult

__all__ = ["OnsetForcer"]


class OnsetForcer:
    """Makes the copies of one root after another.

    Args:
        words: the rates of disturbances, ``NAME=RATE`` each.
        crash_on: the outcomes that count as a crash.
        patience_s: time limit of a copy, in s of wall time.
        delay: called with the wall time that copies have taken, in s.
        tell: called with what the user should know.
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
        self._questions = Questions("rare", tell)
        self._sampler: DisturbanceSampler | None = None
        self._onsets: FirstOnsets | None = None
        self._copies: list[ForcedCopy] = []
        self._steps = 0

    @property
    def why_not(self) -> str:
        """Why no copies can be made any more, in words; empty where they can."""
        return self._questions.why_not

    def stop(self, why_not: str) -> None:
        """Make no copies any more."""
        self._questions.stop(why_not)

    def is_due(self, episode: Episode) -> bool:
        """Whether the trial is a root: the law needs every step of it."""
        return episode.spec.forcing is not None

    def ask(self, episode: Episode) -> None:
        """Make the copies that leave the root after the step that is complete; also called before the first step."""
        if self._onsets is None:
            self._onsets = self._begin(episode)
        for onset in self._onsets.after(episode.steps, partial(_has_target, episode)):
            if self._questions.unanswered:
                self._questions.skip(self._questions.why_unanswered)  # the root is incomplete anyway
                continue
            began = time.monotonic()
            try:
                self._follow(episode, onset)
            except CrashhuntError as error:
                self._questions.stop(error.message)
                self._questions.skip()
            finally:
                self._delay(time.monotonic() - began)

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the root with what its copies have found; the next trial begins."""
        onsets, copies, steps, asked = self._onsets, tuple(self._copies), self._steps, self._questions
        self._onsets, self._copies, self._steps = None, [], 0
        if onsets is None:
            return result
        forced = Forced(
            survival=onsets.survival,
            masses=dict(sorted(onsets.masses.items())),
            copies=copies,
            steps=steps,
            unanswered=asked.unanswered,
            why_unanswered=asked.why_unanswered,
            may_be_asked_again=asked.may_be_answered,
        )
        asked.begin_trial()
        return replace(result, forced=forced)

    def _begin(self, episode: Episode) -> FirstOnsets:
        names, dt, spec = episode.names, episode.simulator.step_length_s, episode.spec
        if self._sampler is None or (self._sampler.agents, self._sampler.step_length_s) != (names, dt):
            self._sampler = disturber_of(self._rates, agents=names, step_length_s=dt)
        assert spec.forcing is not None
        return FirstOnsets(self._sampler, spec.forcing, spec.seed, spec.max_steps)

    def _follow(self, episode: Episode, onset: Onset) -> None:
        """Have a copy run to the end of its trial, and note how that was."""

        def run(copy: Episode) -> Plain:
            copy.replan(onset.planned)
            while copy.result is None:
                copy.step()
            result = copy.result
            return {
                "outcome": str(result.outcome),
                "step": result.steps,
                "disturbed": result.disturbed,
                "planned": [one.to_json() for one in copy.spec.disturbances],
            }

        def attempt() -> tuple[Plain | None, NoAnswer | None]:
            copy = episode.fork(run, observed=False)
            return copy.answer(self._patience_s), copy.no_answer

        answer = self._questions.ask(attempt)
        if answer is None:
            return
        outcome, step = str(answer["outcome"]), cast(int, answer["step"])
        self._steps += step - episode.steps
        if outcome in (Outcome.SIMULATOR_ERROR, Outcome.INVALID):
            self._questions.skip(f"a copy ended by {outcome}")  # perhaps because it is a copy
            return
        crashed = outcome in self._crashes
        planned = cast("list[JsonObject]", answer["planned"])
        self._copies.append(
            ForcedCopy(
                cell=onset.cell,
                onset=onset.step,
                weight=onset.weight,
                branched=episode.steps,
                crash=outcome if crashed else "",
                step=step,
                disturbed=bool(answer["disturbed"]),
                disturbances=tuple(map(Disturbance.from_json, planned)) if crashed else (),
            )
        )


def _has_target(episode: Episode, planned: Disturbance) -> bool:
    """Whether a disturbance that begins in the next step finds a vehicle, as `DisturbanceInjector` looks for it."""
    simulator = episode.simulator
    if planned.agent not in simulator.agents or not supports(simulator, SupportsDisturbances):
        return False
    return bool(simulator.resolve_target(planned))
