"""Trials that a resumed hunt runs again: something outside of them, such as a kill, kept answers from it."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from crashhunt.trial import KILLED

if TYPE_CHECKING:
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.hunts._progress import Progress
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["Unanswered", "find_unanswered"]

# Searching the text of a row takes a tenth of the time of parsing it. A few rows too many do no harm.
_KILLED = f"""(outcome = 'invalid' AND instr(result, '"kind": "{KILLED}"') > 0)"""
_UNASKED = """instr(result, '"may_be_asked_again": true') > 0"""


def find_unanswered(ledger: Ledger) -> list[TrialResult]:
    """Return the trials that are to run again, as the ledger of a hunt has them.

    Raises:
        HuntDirectoryError: one of them is not as it was written.
    """
    where = _KILLED if not ledger.facts().get("copies") else f"{_KILLED} OR {_UNASKED}"  # the latter reads every row
    return [result for result in ledger.results_where(where) if result.is_to_be_run_again]


class Unanswered:
    """The trials of a hunt that run again. Their rows stay in the ledger until what comes of it replaces them.

    Args:
        ledger: of the hunt.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._before = {result.spec.number: result for result in find_unanswered(ledger)}
        self._open: set[int] = set()  # of this run of the hunt

    def __len__(self) -> int:
        """How many are still to run again, in this run of the hunt or the next."""
        return len(self._open | self._before.keys())

    @property
    def specs(self) -> list[TrialSpec]:
        """Which trials run again, in order of their numbers."""
        return [result.spec for result in self._before.values()]

    def account(self, result: TrialResult, progress: Progress) -> bool:
        """Take note of any trial that has ended; return whether its result is to be recorded.

        Args:
            result: of the trial.
            progress: of the hunt, which has counted the trial before if it runs again.
        """
        if result.is_to_be_run_again:
            self._open.add(result.spec.number)
        before = self._before.pop(result.spec.number, None)
        if before is None:
            return True
        if result.was_killed_from_outside:
            return False  # the ledger has an answer that is as good, or better
        progress.outcomes -= Counter([str(before.outcome)])
        if before.digest and before.digest != result.digest:
            again = f"trial {result.spec.number} was run again for the answers of its copies"
            note = f"{again}, and is another one: it is not determined by its specification"
            self._ledger.remark(note)
            progress.notes.append(note)
        return True
