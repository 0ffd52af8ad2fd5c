"""Runs of copies of an episode (questions): which are repeated, which stay without a result, and when they end."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.forks import CannotForkError, NoAnswer, NoProcessError
from crashhunt.base.text import encodable, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.json_types import Plain
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult


__all__ = ["FirstCopy", "Questions"]


_MAX_ATTEMPTS: Final = 3  # copies per question, as long as something outside ends them
_PAUSES_S: Final = (0.05, 0.5)  # wall time before the second and the third, in which memory may become free
_MAX_CONSECUTIVE_FAILURES: Final = 3  # questions in turn that no copy answers
_MAX_REASON_LENGTH: Final = 200  # characters; an agent's exception may say anything


class Questions:
    """Runs copies, and counts the questions without a result.

    A copy that something outside ended (the kernel's out-of-memory killer, an administrator) is replaced by another
    copy. A copy that raised an exception, crashed or hung by itself would do so again, so it is not replaced. After
    three questions in a row without a result, no more copies run: in this trial if the cause was outside, in this
    process if copies failed by themselves.

    Args:
        what: name of the questions, in the plural: ``probes``.
        tell: called with messages for the user.

    Attributes:
        what: as given.
        why_not: why this process runs no more copies, in words; empty if it does.
        unanswered: number of questions of this trial without a result.
        why_unanswered: the reason for the first missing result, in words; empty if all have a result.
        may_be_answered: whether a cause was outside, so that another run of the trial may have all results.
        has_answer: whether the last question has a result.
    """

    def __init__(self, what: str, tell: Callable[[str], None] = lambda _: None) -> None:
        self.what = what
        self._tell = tell
        self._failures = 0  # questions in turn, of this process
        self.why_not = ""
        self.begin_trial()

    def begin_trial(self) -> None:
        """Reset the counts for the next trial."""
        self.unanswered = 0
        self.why_unanswered = ""
        self.may_be_answered = False
        self.has_answer = True
        self._killed = 0  # questions in turn, of this trial
        self._paused_because = ""

    @property
    def is_over(self) -> bool:
        """Return whether no more copies of this trial run."""
        return bool(self.why_not or self._paused_because)

    def ask(
        self,
        attempt: Callable[[], tuple[Plain | None, NoAnswer | None]],
        can_retry: Callable[[], bool] = lambda: True,
    ) -> Plain | None:
        """Return the result of a copy; None if no copy gives one, which is counted.

        Args:
            attempt: runs one copy; returns its result, or None and the reason.
            can_retry: whether another copy of the same moment can be made.
        """
        reason = NoAnswer("")
        for number in range(_MAX_ATTEMPTS):
            if number:
                time.sleep(_PAUSES_S[number - 1])
            try:
                answer, no_answer = attempt()
            except NoProcessError as error:
                answer, no_answer = None, NoAnswer(f"could not be made: {error.message}", is_from_outside=True)
            except CannotForkError as error:
                self.stop(error.message)
                self.skip()
                return None
            if answer is not None:
                self.has_answer, self._failures, self._killed = True, 0, 0
                return answer
            reason = _shortened(no_answer or NoAnswer("did not answer"))
            if not reason.is_from_outside or not can_retry():
                break
            self._tell(f"{self.what}: a copy of a trial {reason.why}, and another is asked")
        self.miss(reason)
        return None

    def miss(self, reason: NoAnswer) -> None:
        """Count a question without a result."""
        why = f"a copy {reason.why}"
        if reason.is_from_outside:
            self._killed += 1
            if self._killed >= _MAX_CONSECUTIVE_FAILURES:
                self._paused_because = why
        else:
            self._tell(f"{self.what}: {why}; what it was asked has no answer")
            self._failures += 1
            if self._failures >= _MAX_CONSECUTIVE_FAILURES:
                self.stop(f"{_MAX_CONSECUTIVE_FAILURES} copies in turn failed; the last {reason.why}")
        self.skip(why, is_from_outside=reason.is_from_outside)

    def skip(self, why: str = "", *, is_from_outside: bool = False) -> None:
        """Count a question without a result, without an effect on the next questions.

        Args:
            why: the reason, in words; empty if no more copies run.
            is_from_outside: whether another run of the trial may have a result.
        """
        if not why:
            why, is_from_outside = self.why_not or self._paused_because, not self.why_not
        self.has_answer = False
        self.unanswered += 1
        self.why_unanswered = self.why_unanswered or why
        self.may_be_answered = self.may_be_answered or is_from_outside

    def stop(self, why_not: str) -> None:
        """Run no more copies in this process."""
        self.why_not = self.why_not or why_not


def _shortened(reason: NoAnswer) -> NoAnswer:
    return NoAnswer(encodable(one_line(reason.why[:_MAX_REASON_LENGTH])), reason.is_from_outside)


# The first copy of a running episode: after one step it is known whether there can be any.


class FirstCopy:
    """Makes one copy of the first episode of a process, only to check that copies are possible.

    Args:
        refused: called with the reason why the episode cannot be copied.
    """

    def __init__(self, refused: Callable[[str], None]) -> None:
        self._refused = refused
        self._tried = False

    def is_due(self, episode: Episode) -> bool:
        """Return whether the check is still to be done."""
        return not self._tried and episode.steps > 0

    def ask(self, episode: Episode) -> None:
        """Check that the episode can be copied."""
        try:
            episode.fork(lambda _copy: {}, observed=False).end()
        except NoProcessError:
            return  # which says nothing about the trial: the next step tries again
        except CrashhuntError as error:
            self._refused(error.message)
        self._tried = True

    def result(self, result: TrialResult) -> TrialResult:
        """Return the argument unchanged."""
        return result
