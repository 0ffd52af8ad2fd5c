"""Which runner to copies are asked again, which stay open, and when the asking ends."""

from __future__ import annotations

import pytest

from crashhunt.base.forks import CannotForkError, NoAnswer, NoProcessError
from crashhunt.episode import _forks
from crashhunt.episode._forks import ForkRunner

KILLED = NoAnswer("was killed by SIGKILL", is_from_outside=True)
RAISED = NoAnswer("raised KeyError: 3")
ANSWER = {"steps": 3}


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(_forks, "_PAUSES_S", (0.0, 0.0))


def attempts(*ends):
    """What copies do, one after the other: an answer, a reason, or an error that is raised."""
    left = list(ends)

    def attempt():
        end = left.pop(0)
        if isinstance(end, Exception):
            raise end
        return (None, end) if isinstance(end, NoAnswer) else (end, None)

    return attempt, left


@pytest.mark.parametrize(
    ("ends", "answer", "left"),
    [
        ((ANSWER,), ANSWER, 0),
        ((KILLED, ANSWER), ANSWER, 0),
        ((KILLED, NoProcessError("no memory"), ANSWER), ANSWER, 0),
        ((KILLED, KILLED, KILLED, ANSWER), None, 1),
        ((RAISED, ANSWER), None, 1),
        ((KILLED, RAISED, ANSWER), None, 1),
    ],
)
def test_question_is_asked_of_three_copies_as_long_as_they_are_ended_from_outside(ends, answer, left):
    runner = ForkRunner("probes")
    attempt, rest = attempts(*ends)
    assert runner.run(attempt) == answer
    assert len(rest) == left
    assert runner.has_answer is (answer is not None)
    assert runner.unanswered == (answer is None)
    assert runner.may_be_answered is (answer is None and RAISED not in ends)
    assert not runner.is_over


def test_moment_that_is_gone_is_not_asked_again():
    runner = ForkRunner("branches")
    attempt, rest = attempts(KILLED, ANSWER)
    assert runner.run(attempt, can_retry=lambda: False) is None
    assert (len(rest), runner.may_be_answered) == (1, True)


def test_kills_end_the_asking_of_one_trial_and_failures_that_of_the_process():
    runner = ForkRunner("probes")
    for _ in range(3):
        assert not runner.is_over
        runner.miss(KILLED)
    assert (runner.is_over, runner.why_not) == (True, "")
    runner.skip()
    assert (runner.unanswered, runner.why_unanswered) == (4, "a copy was killed by SIGKILL")
    runner.begin_trial()
    assert (runner.is_over, runner.unanswered, runner.may_be_answered) == (False, 0, False)
    for _ in range(3):
        assert not runner.is_over
        runner.begin_trial()  # in turn, of whichever trials
        runner.miss(RAISED)
    assert runner.why_not == "3 copies in turn failed; the last raised KeyError: 3"
    runner.begin_trial()
    runner.skip()
    assert runner.is_over
    assert (runner.why_unanswered, runner.may_be_answered) == (runner.why_not, False)


def test_answer_begins_the_count_again():
    runner = ForkRunner("probes")
    for reason in (RAISED, KILLED):
        for _ in range(5):
            runner.miss(reason)
            runner.miss(reason)
            assert runner.run(lambda: (ANSWER, None)) == ANSWER
    assert not runner.is_over


def test_what_cannot_be_copied_is_not_tried_again():
    told = []
    runner = ForkRunner("probes", told.append)
    attempt, rest = attempts(CannotForkError("a process with several threads cannot be forked"), ANSWER)
    assert runner.run(attempt) is None
    assert (runner.why_not, runner.why_unanswered) == (
        "a process with several threads cannot be forked",
        "a process with several threads cannot be forked",
    )
    assert (len(rest), runner.may_be_answered, told) == (1, False, [])


def test_reason_is_one_short_line_whatever_an_exception_states():
    told = []
    runner = ForkRunner("probes", told.append)
    runner.run(lambda: (None, NoAnswer("raised Boom: \x1b[2J\n" + "x\n" * 10**6 + "\ud800")))
    (line,) = told
    assert line.startswith("probes: a copy raised Boom: \\x1b[2J x x x")
    assert len(line) < 300
    line.encode()
