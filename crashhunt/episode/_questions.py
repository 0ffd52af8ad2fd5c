"""Questions to copies of an episode: which are asked again, which stay without an answer, and when the asking ends."""

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


_ATTEMPTS: Final = 3  # copies per question, as long as something outside ends them
_PAUSES_S: Final = (0.05, 0.5)  # wall time before the second and the third, in which memory may become free
_FAILURES_IN_TURN: Final = 3  # questions in turn that no copy answers
_MAX_REASON_LENGTH: Final = 200  # characters; an agent's exception may say anything


class Questions:
    """Runs the copies, and records the questions without an answer.

    A copy that something outside ended (the kernel's out-of-memory killer, an administrator) says nothing about the
    trial: another copy is asked. A copy that raised, crashed or hung by itself would do so again, and is not.

    Three questions in turn without an answer end the asking: of this trial where the cause was outside, of this process
    where copies failed by themselves.

    Args:
        what: name of the questions, in the plural: ``probes``.
        tell: called with what people should know.

    Attributes:
        why_not: why this process asks no copies any more, in words; empty if it does.
        unanswered: number of questions of this trial without an answer.
        why_unanswered: the reason for the first of them, in words; empty if all have an answer.
        may_be_answered: whether a cause was outside, so that the same trial, run again, may have all answers.
        has_answer: whether the last question has an answer.
    """

    def __init__(self, what: str, tell: Callable[[str], None] = lambda _: None) -> None:
        self._what = what
        self._tell = tell
        self._failures = 0  # questions in turn, of this process
        self.why_not = ""
        self.begin_trial()

    def begin_trial(self) -> None:
        """Forget what belongs to the last trial."""
        self.unanswered = 0
        self.why_unanswered = ""
        self.may_be_answered = False
        self.has_answer = True
        self._killed = 0  # questions in turn, of this trial
        self._paused_because = ""

    @property
    def is_over(self) -> bool:
        """Whether copies of this trial are not asked any more."""
        return bool(self.why_not or self._paused_because)

    def ask(
        self,
        attempt: Callable[[], tuple[Plain | None, NoAnswer | None]],
        can_retry: Callable[[], bool] = lambda: True,
    ) -> Plain | None:
        """Return the answer of a copy, or None if no copy answers, which is counted.

        Args:
            attempt: asks one copy; returns its answer, or None and the reason.
            can_retry: whether there can be another copy of the same moment.
        """
        reason = NoAnswer("")
        for number in range(_ATTEMPTS):
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
            self._tell(f"{self._what}: a copy of a trial {reason.why}, and another is asked")
        self.miss(reason)
        return None

    def miss(self, reason: NoAnswer) -> None:
        """Count a question that no copy has answered."""
        why = f"a copy {reason.why}"
        if reason.is_from_outside:
            self._killed += 1
            if self._killed >= _FAILURES_IN_TURN:
                self._paused_because = why
        else:
            self._tell(f"{self._what}: {why}; what it was asked has no answer")
            self._failures += 1
            if self._failures >= _FAILURES_IN_TURN:
                self.stop(f"{_FAILURES_IN_TURN} copies in turn failed; the last {reason.why}")
        self.skip(why, is_from_outside=reason.is_from_outside)

    def skip(self, why: str = "", *, is_from_outside: bool = False) -> None:
        """Count a question without an answer, which says nothing about the next one.

        Args:
            why: the reason, in words; if empty, that the asking is over.
            is_from_outside: whether the same trial, run again, may have an answer.
        """
        if not why:
            why, is_from_outside = self.why_not or self._paused_because, not self.why_not
        self.has_answer = False
        self.unanswered += 1
        self.why_unanswered = self.why_unanswered or why
        self.may_be_answered = self.may_be_answered or is_from_outside

    def stop(self, why_not: str) -> None:
        """Ask no copies any more in this process."""
        self.why_not = self.why_not or why_not


def _shortened(reason: NoAnswer) -> NoAnswer:
    return NoAnswer(encodable(one_line(reason.why[:_MAX_REASON_LENGTH])), reason.is_from_outside)


# The first copy of a running episode: after one step it is known whether there can be any.


class FirstCopy:
    """Copies the first episode of a process after its first step, and does nothing with that.

    Args:
        refused: called with why it could not be copied, in words.
    """

    def __init__(self, refused: Callable[[str], None]) -> None:
        self._refused = refused
        self._tried = False

    def is_due(self, episode: Episode) -> bool:
        """Whether it has not been tried."""
        return not self._tried and episode.steps > 0

    def ask(self, episode: Episode) -> None:
        """Try it."""
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
