"""What copies of trials have found, run from the start in fresh processes: only what crashes there again is a crash."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.temporary import remove_at_once
from crashhunt.replays import confirm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.disturbances import Disturber
    from crashhunt.hunts._again import RunsAgain
    from crashhunt.trial import TrialSpec

__all__ = ["Found", "FromTheStart"]


@dataclass(frozen=True, slots=True)
class Found:
    """How a copy of a trial crashed.

    Args:
        spec: the same from the start.
        outcome: of the copy.
        step: at which it ended.
    """

    spec: TrialSpec
    outcome: str
    step: int


@dataclass(frozen=True, slots=True)
class FromTheStart:
    """Runs from the start what copies have found.

    Args:
        again: runs trials of the hunt again.
        disturber: knows how likely disturbances are; None where the hunt has no models.
        kept: by folder and trial, what has been run already, and is not run again.
    """

    again: RunsAgain
    disturber: Disturber | None
    kept: dict[str, dict[int, Bundle]] = field(default_factory=dict)

    @property
    def is_stopped(self) -> bool:
        """Whether somebody wants to stop: what was found may not have been run from the start then."""
        return bool(len(self.again.stops))

    def crashes(self, found: Sequence[Found], folder: str) -> tuple[tuple[Bundle, ...], int]:
        """Return those that crashed in the same way at the same step, and once more to the bit, in their order.

        The second value is how many could not be run to their end, so that nothing is known about them.

        Args:
            found: of different trials.
            folder: of the hunt, for the bundles; what it had before is gone, but for what is kept. Where somebody wants
                to stop, it stays.
        """
        if self.is_stopped:
            return (), 0
        place, kept = self.again.place.path / folder, self.kept.get(folder, {})
        stay = {bundle.path.name for bundle in kept.values()}
        for path in [one for one in place.iterdir() if one.name not in stay] if kept else [place]:
            remove_at_once(path)
        crashed, unanswered = self._run([one for one in found if one.spec.number not in kept], folder)
        crashed = kept | crashed
        return tuple(crashed[one.spec.number] for one in found if one.spec.number in crashed), len(unanswered)

    def crash(self, found: Found, folder: str) -> Bundle | None:
        """Return one that crashed in the same way at the same step, and once more to the bit; it is kept.

        Args:
            found: how a copy crashed.
            folder: of the hunt, for its bundle.
        """
        if self.is_stopped:
            return None
        crashed, _ = self._run([found], folder)  # one that was killed is run once more at the end of the hunt
        self.kept.setdefault(folder, {}).update(crashed)
        return crashed.get(found.spec.number)

    def _run(self, found: Sequence[Found], folder: str) -> tuple[dict[int, Bundle], set[int]]:
        """Return the bundles of those that crashed as their copies did, and the numbers of those without an answer."""
        wanted = {one.spec.number: one for one in found}
        unanswered = set(wanted)
        bundles: dict[int, Bundle] = {}
        try:
            for one in self.again.run([one.spec for one in found], folder):
                result, copy = one.result, wanted[one.result.spec.number]
                if result.was_killed_from_outside:
                    continue
                unanswered.discard(result.spec.number)
                if (str(result.outcome), result.steps) != (copy.outcome, copy.step):
                    self.again.failed.append(result)
                    continue
                if self.disturber is not None:
                    result = replace(result, log_likelihood=self.disturber.log_likelihood_of(result))
                bundles[result.spec.number] = one.write(result)
        except CrashhuntError as error:
            self.again.notes.append(f"what copies have found could not be run from the start: {error}")
        with ThreadPoolExecutor(self.again.parallel) as threads:  # which only wait for their process
            confirmed = list(threads.map(lambda bundle: self._confirmed(bundle, unanswered), bundles.values()))
        return {bundle.result.spec.number: bundle for bundle in confirmed if bundle is not None}, unanswered

    def _confirmed(self, bundle: Bundle, unanswered: set[int]) -> Bundle | None:
        # It has just run here, so its code is trusted.
        found = confirm(bundle, lambda: self.is_stopped, failed=self.again.failed, trusted=True)
        if found is None or found.confirmed is None:
            unanswered.add(bundle.result.spec.number)
        if found is None or not found.confirmed:
            self.again.failed.append(bundle.result)  # nothing has come of this run either
            remove_at_once(bundle.path)
            return None
        found.write()
        return found
