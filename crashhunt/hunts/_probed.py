"""What probes have found in a hunt, and the mildest of it run from the start: only that is a crash."""

from __future__ import annotations

import shutil
import statistics
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import layout
from crashhunt.crashes import write_bundle
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor, read_map
from crashhunt.hunts._workers import settings_again
from crashhunt.replays import confirm
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Bundle, CrashSummary
    from crashhunt.disturbances import Disturber
    from crashhunt.hunts._directory import HuntDirectory
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.snapshots import Snapshot
    from crashhunt.trial import Stress, TrialSpec

__all__ = ["ProbeData", "ProbeReport", "look_at_probes"]

_MILDEST = 3  # trials; each takes two processes of its own
_LOOK_EVERY_S = 0.1


class ProbeData(TypedDict):
    """What ``run --json`` prints of them."""

    trials: int
    least: float | None
    median: float | None
    probes: int
    steps: int
    left_out: int
    run_again: int
    confirmed: int
    crashes: list[CrashSummary]


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """What came of the probes of a hunt.

    Args:
        margins: the stress margin of each trial that was asked.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        run_again: how many of the mildest were run from the start.
        crashes: those of them that crashed in the same way at the same step, and once more to the bit.
    """

    margins: tuple[float, ...]
    probes: int
    steps: int
    left_out: int
    run_again: int
    crashes: tuple[Bundle, ...]

    def to_json(self) -> ProbeData:
        """Return the shape that ``run --json`` prints."""
        return {
            "trials": len(self.margins),
            "least": min(self.margins, default=None),
            "median": statistics.median(self.margins) if self.margins else None,
            "probes": self.probes,
            "steps": self.steps,
            "left_out": self.left_out,
            "run_again": self.run_again,
            "confirmed": len(self.crashes),
            "crashes": [bundle.summary() for bundle in self.crashes],
        }


def look_at_probes(
    place: HuntDirectory,
    ledger: Ledger,
    settings: HuntSettings,
    snapshot: Snapshot,
    disturber: Disturber | None,
    stops: Sequence[int],
) -> ProbeReport | None:
    """Sum up what copies were asked, and run the mildest that made a trial crash from the start, in fresh processes.

    Args:
        place: of the hunt.
        ledger: of the hunt.
        settings: of the hunt.
        snapshot: of the code that ran.
        disturber: knows how likely disturbances are; None where the hunt has no models.
        stops: requests to stop, as they come.

    Returns:
        None where nobody has asked.
    """
    if not settings.probe:
        return None
    asked = [(result, result.stress) for result in map(TrialResult.from_json, ledger.plain_results()) if result.stress]
    found = sorted((pair for pair in asked if pair[1].disturbance is not None), key=lambda pair: pair[1].margin)
    mildest = {result.spec.number: (result, stress) for result, stress in found[:_MILDEST]}
    crashes: list[Bundle] = []
    directory, scratch = place.path, place.scratch / layout.PROBES
    shutil.rmtree(directory / layout.PROBES, ignore_errors=True)
    if mildest and not stops:
        scratch.mkdir(exist_ok=True)
        again = settings_again(settings, snapshot, scratch)
        executor = FreshProcessExecutor(again, parallel=settings.run.parallel or 1)
        waiting = dict(mildest)
        try:
            for result, stress in mildest.values():
                executor.submit(_specification(result, stress))
            while waiting and not stops:
                for ended in executor.completed(_LOOK_EVERY_S):
                    _, stress = waiting.pop(ended.spec.number)
                    if (str(ended.outcome), ended.steps) != (stress.outcome, stress.step):
                        continue
                    if disturber is not None:
                        ended = replace(ended, log_likelihood=disturber.log_likelihood_of(ended))
                    folder = scratch_of(scratch, ended.spec.number)
                    bundle = write_bundle(
                        directory, ended, folder, hunt_seed=settings.seed, snapshot=snapshot.digest,
                        lanes=read_map(scratch, folder), place=layout.PROBES,
                    )  # fmt: skip
                    crashes.append(bundle)
        finally:
            executor.close()
    confirmed = [bundle for bundle in (_confirmed(bundle, stops) for bundle in crashes) if bundle is not None]
    return ProbeReport(
        tuple(stress.margin for _, stress in asked),
        sum(stress.probes for _, stress in asked),
        sum(stress.steps for _, stress in asked),
        sum(stress.left_out for _, stress in asked),
        len(mildest),
        tuple(sorted(confirmed, key=lambda bundle: mildest[bundle.result.spec.number][1].margin)),
    )


def _confirmed(bundle: Bundle, stops: Sequence[int]) -> Bundle | None:
    found = confirm(bundle, lambda: bool(stops))
    if found is None or not found.confirmed:
        shutil.rmtree(bundle.path, ignore_errors=True)
        return None
    found.write()
    return found


def _specification(result: TrialResult, stress: Stress) -> TrialSpec:
    """The trial from the start, with what made its copy crash."""
    assert stress.disturbance is not None
    every = sorted((*result.spec.disturbances, stress.disturbance), key=lambda one: (one.step, one.agent, one.what))
    return replace(result.spec, disturbances=tuple(every), origin="probe")
