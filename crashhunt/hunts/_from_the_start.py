"""What copies of trials have found, run from the start in fresh processes: only what crashes there again is a crash."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.crashes import write_bundle
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor, read_map
from crashhunt.hunts._workers import settings_again
from crashhunt.replays import confirm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.disturbances import Disturber
    from crashhunt.hunts._directory import HuntDirectory
    from crashhunt.plans import HuntSettings
    from crashhunt.snapshots import Snapshot
    from crashhunt.trial import TrialSpec

__all__ = ["Found", "FromTheStart"]

_LOOK_EVERY_S = 0.1


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
        place: of the hunt.
        settings: of the hunt.
        snapshot: of the code that ran.
        disturber: knows how likely disturbances are; None where the hunt has no models.
        stops: requests to stop, as they come.
    """

    place: HuntDirectory
    settings: HuntSettings
    snapshot: Snapshot
    disturber: Disturber | None
    stops: Sequence[int]

    def crashes(self, found: Sequence[Found], folder: str) -> tuple[Bundle, ...]:
        """Return those that crashed in the same way at the same step, and once more to the bit, in their order.

        Args:
            found: of different trials.
            folder: of the hunt, for the bundles; what it had before is gone.
        """
        directory, scratch = self.place.path, self.place.scratch / folder
        shutil.rmtree(directory / folder, ignore_errors=True)
        if not found or self.stops:
            return ()
        scratch.mkdir(exist_ok=True)
        again = settings_again(self.settings, self.snapshot, scratch)
        executor = FreshProcessExecutor(again, parallel=self.settings.run.parallel or 1)
        waiting = {one.spec.number: one for one in found}
        order, bundles = list(waiting), {}
        try:
            for one in found:
                executor.submit(one.spec)
            while waiting and not self.stops:
                for ended in executor.completed(_LOOK_EVERY_S):
                    wanted = waiting.pop(ended.spec.number)
                    if (str(ended.outcome), ended.steps) != (wanted.outcome, wanted.step):
                        continue
                    if self.disturber is not None:
                        ended = replace(ended, log_likelihood=self.disturber.log_likelihood_of(ended))
                    trial = scratch_of(scratch, ended.spec.number)
                    bundles[ended.spec.number] = write_bundle(
                        directory, ended, trial, hunt_seed=self.settings.seed, snapshot=self.snapshot.digest,
                        lanes=read_map(scratch, trial), place=folder,
                    )  # fmt: skip
        finally:
            executor.close()
        confirmed = (self._confirmed(bundles[number]) for number in order if number in bundles)
        return tuple(bundle for bundle in confirmed if bundle is not None)

    def _confirmed(self, bundle: Bundle) -> Bundle | None:
        found = confirm(bundle, lambda: bool(self.stops))
        if found is None or not found.confirmed:
            shutil.rmtree(bundle.path, ignore_errors=True)
            return None
        found.write()
        return found
