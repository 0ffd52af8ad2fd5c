"""Forks of an episode: makes them, and decides which run again, which have no result, and when no more are run."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Self, TypeVar

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.forks import CannotForkError, Copy, Held, NoAnswer, NoProcessError, SuspendedFork
from crashhunt.base.text import encodable, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.json_types import Plain
    from crashhunt.trial import TrialResult


_MAX_ATTEMPTS: Final = 3  # copies per fork that is asked for, as long as something outside ends them
_PAUSES_S: Final = (0.05, 0.5)  # wall time before the second and the third, in which memory may become free
_MAX_CONSECUTIVE_FAILURES: Final = 3  # forks in turn without a result
_MAX_REASON_LENGTH: Final = 200  # characters; an agent's exception may say anything


class ForkRunner:
    """Runs forks, and counts those without a result.

    A fork that was killed from outside, by the kernel because of memory or by an administrator, is replaced by another
    fork. A fork that raised an exception, crashed or hung by itself would do so again, so it is not replaced. After
    three consecutive forks without a result, no more forks run. The limit applies to the trial if the cause was
    outside, and to the process if forks failed by themselves.

    Attributes:
        what: name of the forks in the plural, as given to the constructor.
        why_not: why this process runs no more forks, as text; empty if it still runs forks.
        unanswered: number of forks of this trial without a result.
        why_unanswered: the reason for the first missing result, as text; empty if all forks have a result.
        may_be_answered: whether forks were killed from outside, so that another run of the trial may have all results.
        has_answer: whether the last fork has a result.
    """

    def __init__(self, what: str, tell: Callable[[str], None] = lambda _: None) -> None:
        self.what = what
        self._tell = tell
        self._failures = 0  # forks without a result in turn, of this process
        self.why_not = ""
        self.begin_trial()

    def begin_trial(self) -> None:
        """Reset the counts for the next trial."""
        self.unanswered = 0
        self.why_unanswered = ""
        self.may_be_answered = False
        self.has_answer = True
        self._killed = 0  # forks without a result in turn, of this trial
        self._paused_because = ""

    @property
    def is_over(self) -> bool:
        """Return whether no more forks of this trial run."""
        return bool(self.why_not or self._paused_because)

    def run(
        self,
        attempt: Callable[[], tuple[Plain | None, NoAnswer | None]],
        can_retry: Callable[[], bool] = lambda: True,
    ) -> Plain | None:
        """Return the result of a fork. If no fork returns a result, count the failure and return None.

        ``attempt`` runs one fork, and returns its result, or None and the reason. ``can_retry`` returns whether another
        fork can be made at the same step.
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
        """Count a fork without a result."""
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
        """Count a fork without a result, without consequences for the next forks.

        Without a reason, no more forks run. If the reason lies outside of the trial, another run of the trial may
        return a result.
        """
        if not why:
            why, is_from_outside = self.why_not or self._paused_because, not self.why_not
        self.has_answer = False
        self.unanswered += 1
        self.why_unanswered = self.why_unanswered or why
        self.may_be_answered = self.may_be_answered or is_from_outside

    def stop(self, why_not: str) -> None:
        """Start no more forks of trials in this process, and record the reason; forks that run already continue."""
        self.why_not = self.why_not or why_not


def _shortened(reason: NoAnswer) -> NoAnswer:
    return NoAnswer(encodable(one_line(reason.why[:_MAX_REASON_LENGTH])), reason.is_from_outside)


# Forks of a running episode, which are forks of its process.

C = TypeVar("C")


class Forkable:
    """The part of an `Episode` that forks the episode."""

    steps: int  # number of completed steps

    def __init__(self) -> None:
        super().__init__()
        self._held = Held()
        self._on_copied: list[Callable[[], None]] = []

    def _is_running(self) -> bool:
        raise NotImplementedError

    def _detach_observers(self) -> None:
        raise NotImplementedError

    def fork(self, work: Callable[[Self], Plain], *, observed: bool = True) -> Copy:
        """Fork this process between two steps; the fork continues exactly as the original process would.

        Args:
            work: Function that runs in the fork, which then ends; it may fork again. The return value of the function
                is sent to the original process.
            observed: Whether observers are still called in the fork. Recordings of the observers in the fork then go to
                other files.

        Raises:
            CannotForkError: The process has resources that a fork cannot copy, such as threads.
        """
        return self._copied(Copy, work, observed=observed)

    def suspend_fork(self, work: Callable[..., Plain]) -> SuspendedFork:
        """Leave a suspended fork. For each request, a fork of the suspended fork resumes here, without observers.

        Args:
            work: Function that runs in the resumed fork, with the request as its argument.

        Raises:
            CannotForkError: As for `fork`.
        """
        return self._copied(SuspendedFork, work, observed=False)

    def _copied(
        self, make: Callable[[Callable[..., Plain], Held], C], work: Callable[..., Plain], *, observed: bool
    ) -> C:
        if not self._is_running():
            raise RuntimeError("only a running episode can be forked")

        def run_copy(*asked: Plain) -> Plain:
            for tell in self._on_copied if observed else ():
                tell()
            if not observed:
                self._detach_observers()
            return work(self, *asked)

        copy = make(run_copy, self._held)
        self._held = replace(self._held, shared=None)  # the check is expensive, so it runs only once
        return copy


# The first copy of a running episode: after one step it is known whether there can be any.


class FirstCopy:
    """Makes one fork of the first episode of a process, to check that episodes can be forked."""

    def __init__(self, refused: Callable[[str], None]) -> None:
        self._refused = refused
        self._tried = False

    def is_due(self, episode: Forkable) -> bool:
        """Return whether the check has not been done yet."""
        return not self._tried and episode.steps > 0

    def ask(self, episode: Forkable) -> None:
        """Check that the episode can be forked."""
        try:
            episode.fork(lambda _copy: {}, observed=False).end()
        except NoProcessError:
            return  # which says nothing about the trial: the next step tries again
        except CrashhuntError as error:
            self._refused(error.message)
        self._tried = True

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result unchanged, because this check adds nothing to it."""
        return result
