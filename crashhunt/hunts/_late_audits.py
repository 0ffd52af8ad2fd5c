"""Audits that an earlier run of a hunt did not bring to their end, as it was stopped or killed: made up for.

The recordings are gone by then, so that digests are compared: they tell that a trial differs, and not where.
"""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import scratch_of
from crashhunt.hunts._audit import AuditReport, Difference

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.episode import WorkerSettings
    from crashhunt.hunts._again import RunsAgain
    from crashhunt.hunts._audit import Audit
    from crashhunt.hunts._data import Facts
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.hunts._progress import Progress

__all__ = ["AuditsLeft"]

_FOLDER = "audits"  # of the scratch folder


class AuditsLeft:
    """The trials that earlier runs of a hunt were to run again, and did not.

    Args:
        ledger: of the hunt.
        before: its facts, as the earlier runs left them.
        settings: of the workers; they say which trials belong to the sample.

    Attributes:
        numbers: of these trials.
    """

    def __init__(self, ledger: Ledger, before: Facts, settings: WorkerSettings) -> None:
        left = set(before.get("audits_left") or ()) if settings.audit > 0.0 else set()
        if settings.audit > 0.0 and before.get("state") == "running":
            # It was killed; what ended after its last heartbeat is not noted.
            ended = ledger.results_where("ended_at >= ?", before.get("heartbeat", 0.0))
            left |= {result.spec.number for result in ended if settings.is_audited(result)}
        self.numbers = sorted(left)

    def note(self, audit: Audit, progress: Progress) -> None:
        """Have the progress of the hunt say what came of its audit, and what is left of all audits."""
        progress.audit = audit.report
        progress.audits_left = sorted({*audit.left, *self.numbers})

    def finish(self, again: RunsAgain, progress: Progress) -> None:
        """Run them again, and add what comes of it to the progress of the hunt."""
        left_now = set(progress.audits_left) - set(self.numbers)
        now, (late, left) = progress.audit or AuditReport(), _finish(again, self.numbers)
        progress.audit = AuditReport(
            now.trials + late.trials, now.differences + late.differences, now.not_finished + late.not_finished
        )
        progress.audits_left = sorted({*left_now, *left})


def _finish(again: RunsAgain, numbers: Sequence[int]) -> tuple[AuditReport, list[int]]:
    """Run trials again that are to be audited; return what came of it, and the numbers that are still left.

    Args:
        again: runs trials of the hunt again. Its ledger gets a remark for each trial that differs.
        numbers: of the trials.
    """
    ledger = again.ledger
    wanted = {number: result for number in numbers if (result := ledger.result(number)) is not None and result.digest}
    left, differences = set(wanted), []
    try:
        for one in again.run([result.spec for result in wanted.values()], _FOLDER):
            now, was = one.result, wanted[one.result.spec.number]
            shutil.rmtree(scratch_of(one.scratch, now.spec.number), ignore_errors=True)
            if now.was_killed_from_outside:
                continue
            left.discard(now.spec.number)
            if (was.outcome, was.digest) != (now.outcome, now.digest):
                difference = Difference(now.spec.number, None, "", "the digest", was.digest, now.digest)
                ledger.remark(f"audit: {difference}")
                differences.append(difference)
                again.failed.append(now)
    except CrashhuntError as error:
        again.notes.append(f"trials could not be run again for the audit: {error}")
    return AuditReport(len(wanted) - len(left), tuple(differences), len(left)), sorted(left)
