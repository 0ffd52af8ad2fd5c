"""A crash that a copy of a trial has found, and that comes again from the start, ends a hunt as any other does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.hunts._branched import likeliest
from crashhunt.hunts._probed import mildest

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.hunts._from_the_start import Found, FromTheStart
    from crashhunt.hunts._next_trials import Trials
    from crashhunt.hunts._progress import Progress
    from crashhunt.trial import TrialResult

__all__ = ["CopiedCrashes"]


class CopiedCrashes:
    """Runs from the start what copies of trials have crashed with, where a crash of that kind would end the hunt.

    That is one by disturbances of the kinds that the hunt has. A probe asks for all others as well, and with the worst
    that is plausible nearly every trial ends in a crash: that measures a trial, and is no crash that the hunt is after.
    Where kinds of crashes are counted, or those that are the agent's own fault, trials alone end the hunt.

    Args:
        copies: runs from the start what they have found.
        progress: of the hunt, which gets what has crashed there as well.
        trials: of the hunt that are still to run.
    """

    def __init__(self, copies: FromTheStart, progress: Progress, trials: Trials) -> None:
        self._copies, self._trials = copies, trials
        self._progress = progress
        run, disturber = copies.again.settings.run, copies.disturber
        self._ends = not run.keep_going and not run.only_at_fault and disturber is not None and bool(disturber.models)
        self._deterministic = run.deterministic
        self._waiting: list[TrialResult] = []

    def resume(self) -> None:
        """Look at trials that ended in earlier runs of the hunt, which may have been killed before it had."""
        ledger = self._copies.again.ledger
        if not self._ends or self._progress.is_done:
            return
        numbers = [
            plain["spec"]["number"]
            for plain in ledger.plain_results()
            if ((branches := plain.get("branches")) and branches["crashes"])
            or ((stress := plain.get("stress")) and stress["disturbance"])
        ]
        self._waiting = [result for number in numbers if (result := ledger.result(number)) is not None]
        self.look()

    def add(self, result: TrialResult) -> None:
        """Take in a trial that has ended without a crash."""
        if self._ends and self._found(result):
            self._waiting.append(result)

    def look(self, tell: Callable[[], None] = lambda: None) -> bool:
        """Run from the start what has been found of the trials that were taken in; return whether one ends the hunt.

        Args:
            tell: called before that, where there is any.
        """
        waiting = sorted(self._waiting, key=lambda result: result.spec.number)
        self._waiting = [result for result in waiting if self._comes_later(result.spec.number)]
        ends = False
        for result in waiting[: len(waiting) - len(self._waiting)]:
            number, least = result.spec.number, self._progress.last_wanted
            if least is not None and (number > least or not self._deterministic):
                continue
            tell()
            for folder, found in self._found(result):
                bundle = self._copies.crash(found, folder)
                if bundle is not None:
                    self._progress.copied[number] = bundle
                    ends = True
                    break
        return ends

    def _comes_later(self, number: int) -> bool:
        """Whether trials of lower numbers have not begun: it had ended when the hunt was killed, and they had not."""
        upcoming = self._trials.upcoming
        return self._deterministic and upcoming is not None and upcoming < number

    def _found(self, result: TrialResult) -> list[tuple[str, Found]]:
        """What copies of a trial have crashed with, of the kinds that its hunt has; of its branches the likeliest."""
        every = ((layout.BRANCHES, likeliest(result)), (layout.PROBES, mildest(result)))
        return [(folder, one) for folder, one in every if one is not None and self._is_of_the_hunt(one)]

    def _is_of_the_hunt(self, found: Found) -> bool:
        disturber = self._copies.disturber
        kinds = {model.what for model in disturber.models.values()} if disturber is not None else set()
        return all(one.what in kinds or (disturber and one in disturber.fixed) for one in found.spec.disturbances)
