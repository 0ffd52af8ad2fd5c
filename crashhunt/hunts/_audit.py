"""The audit: a sample of trials that did not crash is run again, and has to be the same to the bit.

A crash is confirmed in a fresh process anyway. A trial without one that depends on the trials before it in its worker,
on a thread or on the clock would go unnoticed, and with it the crash that it did not have.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import FreshProcessExecutor
from crashhunt.recording import Recording, first_divergence, read_black_box

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.trial import TrialResult

__all__ = ["Audit", "AuditData", "AuditReport", "Difference", "DifferenceData"]


class DifferenceData(TypedDict):
    """The plain data of a `Difference`."""

    trial: int
    step: int | None
    agent: str
    field: str
    recorded: object
    replayed: object


class AuditData(TypedDict):
    """The plain data of an `AuditReport`."""

    trials: int
    not_finished: int
    differences: list[DifferenceData]


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a trial went another way in a fresh process.

    Args:
        trial: its number.
        step: the first that differs; None where there was no recording to compare, and only the digest differs.
        agent: the agent or actor; empty where it is about neither.
        field: what of it.
        recorded: what it was in the hunt.
        replayed: what it was in the fresh process.
    """

    trial: int
    step: int | None
    agent: str
    field: str
    recorded: object
    replayed: object

    def __str__(self) -> str:
        whose = f" of {self.agent}" if self.agent else ""
        where = "" if self.step is None else f"at step {self.step}, "
        return (
            f"trial {self.trial} is another one in a fresh process: {where}{self.field}{whose} was "
            f"{self.recorded} and is {self.replayed}"
        )

    def to_json(self) -> DifferenceData:
        """Return plain strings and numbers."""
        return {
            "trial": self.trial,
            "step": self.step,
            "agent": self.agent,
            "field": self.field,
            "recorded": self.recorded,
            "replayed": self.replayed,
        }


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What came of an audit.

    Args:
        trials: how many trials were run again.
        differences: of those that were not the same.
        not_finished: how many more were to be run again, and were not run to the end.
    """

    trials: int = 0
    differences: tuple[Difference, ...] = ()
    not_finished: int = 0

    def to_json(self) -> AuditData:
        """Return the shape that ``run --json`` prints."""
        return {
            "trials": self.trials,
            "not_finished": self.not_finished,
            "differences": [found.to_json() for found in self.differences],
        }


class Audit:
    """Runs the sample again while the hunt goes on, one trial at a time.

    Args:
        settings: of the hunt; they say which trials.
        failed: gets those that were not the same.
    """

    def __init__(self, settings: WorkerSettings, failed: list[TrialResult]) -> None:
        self._settings = settings
        self._failed = failed
        self._scratch = settings.scratch / "audit"
        self._scratch.mkdir(exist_ok=True)
        again = replace(settings, scratch=self._scratch, audit=0.0, keep_trials=True)
        self._executor = FreshProcessExecutor(again)
        self._waiting: dict[int, TrialResult] = {}
        self._done = 0
        self._differences: list[Difference] = []
        self._killed: set[int] = set()

    @property
    def left(self) -> list[int]:
        """The numbers of the trials that were to be run again, and have not been run to the end yet."""
        return sorted(self._killed | self._waiting.keys())

    @property
    def waiting(self) -> int:
        """How many trials have not been run again yet."""
        return len(self._waiting)

    @property
    def report(self) -> AuditReport:
        """What has come of it so far."""
        return AuditReport(self._done, tuple(self._differences), len(self.left))

    @property
    def parallel(self) -> int:
        """How many trials run at a time."""
        return self._executor.capacity

    @parallel.setter
    def parallel(self, parallel: int) -> None:
        self._executor.capacity = parallel

    def add(self, result: TrialResult) -> TrialResult:
        """Take over the recording of a trial of the sample; return the trial as the hunt goes on with it."""
        if not self._settings.is_audited(result):
            return result
        number = result.spec.number
        recorded, folder = self._scratch / f"recorded-{number:06d}", scratch_of(self._settings.scratch, number)
        recorded.mkdir()
        (folder / layout.BLACK_BOX).rename(recorded / layout.BLACK_BOX)
        self._waiting[number] = result
        self._executor.submit(result.spec)
        if self._settings.keep_trials:
            return result
        shutil.rmtree(folder, ignore_errors=True)
        return replace(result, kept=False)

    def look(self, timeout_s: float = 0.0) -> list[Difference]:
        """Return what has been found since the last call, waiting so long for a trial to end, if one runs."""
        if not self._waiting:
            return []
        found = []
        for result in self._executor.completed(timeout_s):
            was = self._waiting.pop(result.spec.number)
            if result.was_killed_from_outside:  # which says nothing about the trial
                self._killed.add(result.spec.number)
                self._clean_up(result.spec.number)
                continue
            difference = self._compare(was, result)
            self._done += 1
            if difference is not None:
                found.append(difference)
                self._failed.append(result)
        self._differences += found
        return found

    def close(self) -> None:
        """Give up what has not been run again."""
        self._executor.close()

    def _compare(self, was: TrialResult, now: TrialResult) -> Difference | None:
        number = was.spec.number
        try:
            folders = self._folders(number)
            recorded, replayed = (Recording(read_black_box(folder / layout.BLACK_BOX)) for folder in folders)
            found = first_divergence(recorded, replayed)
        except BundleError:  # it could not even be set up
            found = None
        finally:
            self._clean_up(number)
        if found is not None:
            return Difference(number, found.step, found.agent, found.field, found.recorded, found.replayed)
        if (was.outcome, was.digest) != (now.outcome, now.digest):
            return Difference(number, now.steps, "", "the outcome", str(was.outcome), str(now.outcome))
        return None

    def _folders(self, number: int) -> tuple[Path, Path]:
        """Return where the recordings of a trial are: that of the hunt, and that of the fresh process."""
        return self._scratch / f"recorded-{number:06d}", scratch_of(self._scratch, number)

    def _clean_up(self, number: int) -> None:
        for folder in self._folders(number):
            shutil.rmtree(folder, ignore_errors=True)
