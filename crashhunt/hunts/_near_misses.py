"""The most dangerous trials without a crash, kept as bundles of their own.

They are run once more for that, each in a fresh process, after the last trial: so a hunt is no slower by them until
then, a hunt of before can be asked for them, and what is kept is known to happen again.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.crashes import list_near_misses, write_bundle
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor, read_map
from crashhunt.hunts._workers import settings_again
from crashhunt.snapshots import Snapshot

if TYPE_CHECKING:
    from collections.abc import Sized
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.hunts._directory import HuntDirectory
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.trial import TrialResult

__all__ = ["keep_near_misses"]

_LOOK_EVERY_S = 0.2  # how late Ctrl-C may be


def keep_near_misses(
    place: HuntDirectory, ledger: Ledger, settings: HuntSettings, notes: list[str], parallel: int, stops: Sized
) -> tuple[Bundle, ...]:
    """See that the most dangerous trials of a hunt are there as bundles, and no others; return them in that order.

    Args:
        place: of the hunt.
        ledger: of the hunt.
        settings: of the hunt; they say how many. Where that is none, those that are there stay.
        notes: gets a line for each of them that could not be kept, and why.
        parallel: how many trials run again at a time.
        stops: has something in it as soon as somebody wants to stop.
    """
    directory = place.path
    if not settings.run.near_misses or len(stops):
        return ()
    wanted = {number: result for number in ledger.most_dangerous(settings.run.near_misses)
              if (result := ledger.result(number)) is not None}  # fmt: skip
    for bundle in list_near_misses(directory):
        result = wanted.get(bundle.result.spec.number)
        if result is not None and result.digest == bundle.result.digest:
            del wanted[bundle.result.spec.number]
        else:
            shutil.rmtree(bundle.path)
    by_snapshot: dict[str, list[TrialResult]] = {}
    for result in wanted.values():
        by_snapshot.setdefault(ledger.snapshot_of(result.spec.number), []).append(result)
    for digest, results in by_snapshot.items():
        again = _Again(place, Snapshot(directory / layout.SNAPSHOTS / digest), settings, parallel)
        notes += again.run(results, stops)
    return tuple(list_near_misses(directory))


@dataclass(frozen=True, slots=True)
class _Again:
    """Runs trials of one snapshot again."""

    place: HuntDirectory
    snapshot: Snapshot
    settings: HuntSettings
    parallel: int

    def run(self, results: list[TrialResult], stops: Sized) -> list[str]:
        """Make bundles of trials; return why some have none."""
        scratch, notes = self.place.scratch / layout.NEAR_MISSES, []
        scratch.mkdir(exist_ok=True)
        executor = FreshProcessExecutor(settings_again(self.settings, self.snapshot, scratch), parallel=self.parallel)
        waiting = {result.spec.number: result for result in results}
        try:
            for result in results:
                executor.submit(result.spec)
            while waiting and not len(stops):
                for now in executor.completed(_LOOK_EVERY_S):
                    was = waiting.pop(now.spec.number)
                    if (was.outcome, was.digest) == (now.outcome, now.digest):
                        self._write(was, scratch)
                    else:
                        what = f"trial {now.spec.number}, a near miss, is another one in a fresh process"
                        notes.append(f"{what}: it has no bundle")
        except CrashhuntError as error:
            notes.append(f"near misses could not be run again: {error}")
        finally:
            executor.close()
            shutil.rmtree(scratch, ignore_errors=True)
        return notes

    def _write(self, result: TrialResult, scratch: Path) -> None:
        folder = scratch_of(scratch, result.spec.number)
        write_bundle(
            self.place.path,
            result,
            folder,
            hunt_seed=self.settings.seed,
            snapshot=self.snapshot.digest,
            lanes=read_map(scratch, folder),
            place=layout.NEAR_MISSES,
            confirmed=True,
        )
