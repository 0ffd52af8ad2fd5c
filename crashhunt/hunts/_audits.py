"""The audit: a sample of trials that did not crash is run again, and must be bit-identical.

A crash is confirmed in a new process anyway. A trial without a crash may depend on the trials before it in its worker,
on a thread or on the clock. Without an audit, that would go unnoticed, and so would the crash that it did not have.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import FreshProcessExecutor
from crashhunt.hunts._reports import AuditReport, Difference
from crashhunt.recording import Divergence, Recording, first_divergence, read_black_box

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.hunts._progress import Progress
    from crashhunt.hunts._verification import TrialReruns
    from crashhunt.ledger import Facts, Ledger
    from crashhunt.trial import TrialResult


class Audit:
    """Runs sampled trials again during the hunt, one at a time, and compares them.

    Args:
        settings: settings of the hunt, which determine the sampled trials.
        failed: list to which the trials that differed are added.
    """

    def __init__(self, settings: WorkerSettings, failed: list[TrialResult]) -> None:
        self._settings = settings
        self._failed = failed
        self._scratch = settings.scratch / "audit"
        self._scratch.mkdir(exist_ok=True)
        again = replace(settings, scratch=self._scratch, audit=0.0, keep_trials=True, reuses=())
        self._executor = FreshProcessExecutor(again)
        self._waiting: dict[int, TrialResult] = {}
        self._done = 0
        self._differences: list[Difference] = []
        self._killed: set[int] = set()

    @property
    def left(self) -> list[int]:
        """The numbers of the sampled trials whose second run has not finished."""
        return sorted(self._killed | self._waiting.keys())

    @property
    def waiting(self) -> int:
        """The number of trials that still wait for their second run."""
        return len(self._waiting)

    @property
    def report(self) -> AuditReport:
        """Return the present results of the audit."""
        return AuditReport(self._done, tuple(self._differences), len(self.left))

    @property
    def parallel(self) -> int:
        """The number of audited trials that run at a time."""
        return self._executor.capacity

    @parallel.setter
    def parallel(self, parallel: int) -> None:
        self._executor.capacity = parallel

    def add(self, result: TrialResult) -> TrialResult:
        """Keep the recording of a trial that is sampled for the audit; return the result for the rest of the hunt."""
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
        """Return the differences found since the previous call; wait at most ``timeout_s`` for a running trial."""
        if not self._waiting:
            return []
        found = []
        for result in self._executor.completed(timeout_s):
            was = self._waiting.pop(result.spec.number)
            if result.was_killed_from_outside:  # which says nothing about the trial
                self._killed.add(result.spec.number)
                self._clean_up(result.spec.number)
                continue
            divergence = self._divergence(result.spec.number)
            if result.is_no_answer_to(was.outcome) and (divergence is None or divergence.is_end):
                self._killed.add(result.spec.number)
                continue
            self._done += 1
            if divergence is None and not was.is_identical_run(result):
                divergence = Divergence(
                    step=result.steps, agent="", field="the outcome", recorded=str(was.outcome),
                    replayed=str(result.outcome),
                )  # fmt: skip
            if divergence is not None:
                found.append(
                    Difference(
                        trial=result.spec.number,
                        step=divergence.step,
                        agent=divergence.agent,
                        field=divergence.field,
                        recorded=divergence.recorded,
                        replayed=divergence.replayed,
                    )
                )
                self._failed.append(result)
        self._differences += found
        return found

    def close(self) -> None:
        """Cancel the trials that have not been run again."""
        self._executor.close()

    def _divergence(self, number: int) -> Divergence | None:
        """Return the first difference between both recordings of a trial, which are deleted."""
        try:
            folders = self._folders(number)
            recorded, replayed = (Recording(read_black_box(folder / layout.BLACK_BOX)) for folder in folders)
            return first_divergence(recorded, replayed)
        except BundleError:  # it could not even be set up
            return None
        finally:
            self._clean_up(number)

    def _folders(self, number: int) -> tuple[Path, Path]:
        """Return the paths of a trial's two recordings: from the hunt, and from the new process."""
        return self._scratch / f"recorded-{number:06d}", scratch_of(self._scratch, number)

    def _clean_up(self, number: int) -> None:
        for folder in self._folders(number):
            shutil.rmtree(folder, ignore_errors=True)


# Audits that an earlier run of a hunt did not bring to their end, as it was stopped or killed: made up for.
#
# The recordings are gone by then, so that digests are compared: they tell that a trial differs, and not where.

_AUDIT_FOLDER = "audits"  # of the scratch folder


class PendingAudits:
    """The sampled trials that earlier runs of a hunt have not run again."""

    def __init__(self, ledger: Ledger, before: Facts, settings: WorkerSettings) -> None:
        left = set(before.get("audits_left") or ()) if settings.audit > 0.0 else set()
        if settings.audit > 0.0 and before.get("state") == "running":
            # It was killed; what ended after its last heartbeat is not noted.
            ended = ledger.results_where("ended_at >= ?", before.get("heartbeat", 0.0))
            left |= {result.spec.number for result in ended if settings.is_audited(result)}
        self.numbers = sorted(left)  # numbers of these trials

    def note(self, audit: Audit, progress: Progress) -> None:
        """Add the result of the audit, and the trials left of all audits, to the progress of the hunt."""
        progress.audit = audit.report
        progress.audits_left = sorted({*audit.left, *self.numbers})

    def finish(self, again: TrialReruns) -> None:
        """Run the pending trials again, and add the results to the progress of the hunt."""
        progress = again.progress
        left_now = set(progress.audits_left) - set(self.numbers)
        now, (late, left) = progress.audit or AuditReport(), _finish(again, self.numbers)
        progress.audit = AuditReport(
            now.trials + late.trials, now.differences + late.differences, now.not_finished + late.not_finished
        )
        progress.audits_left = sorted({*left_now, *left})


def _finish(again: TrialReruns, numbers: Sequence[int]) -> tuple[AuditReport, list[int]]:
    """Run audited trials again; return the result, and the numbers of the trials that are still pending.

    A remark is added to the hunt's ledger for each trial that differs.
    """
    ledger = again.ledger
    wanted = {number: result for number in numbers if (result := ledger.result(number)) is not None and result.digest}
    left, differences = set(wanted), []
    if wanted:
        again.phases.begin("auditing", len(wanted))
    try:
        for one in again.run([result.spec for result in wanted.values()], _AUDIT_FOLDER):
            now, was = one.result, wanted[one.result.spec.number]
            if now.is_no_answer_to(was.outcome):
                continue
            left.discard(now.spec.number)
            again.phases.advance()
            if not was.is_identical_run(now):
                difference = Difference(
                    trial=now.spec.number,
                    step=None,
                    agent="",
                    field="the digest",
                    recorded=was.digest,
                    replayed=now.digest,
                )
                ledger.remark(f"audit: {difference}")
                differences.append(difference)
                again.progress.failed.append(now)
    except CrashhuntError as error:
        again.progress.notes.append(f"trials could not be run again for the audit: {error}")
    return AuditReport(len(wanted) - len(left), tuple(differences), len(left)), sorted(left)
