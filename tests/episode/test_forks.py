"""Which questions to copies are asked again, which stay open, and when the asking ends."""

from __future__ import annotations

import pytest

from crashhunt.base.forks import CannotForkError, NoAnswer, NoProcessError
from crashhunt.episode import _forks
from crashhunt.episode._forks import Questions

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
    questions = Questions("probes")
    attempt, rest = attempts(*ends)
    assert questions.ask(attempt) == answer
    assert len(rest) == left
    assert questions.has_answer is (answer is not None)
    assert questions.unanswered == (answer is None)
    assert questions.may_be_answered is (answer is None and RAISED not in ends)
    assert not questions.is_over


def test_moment_that_is_gone_is_not_asked_again():
    questions = Questions("branches")
    attempt, rest = attempts(KILLED, ANSWER)
    assert questions.ask(attempt, can_retry=lambda: False) is None
    assert (len(rest), questions.may_be_answered) == (1, True)


def test_kills_end_the_asking_of_one_trial_and_failures_that_of_the_process():
    questions = Questions("probes")
    for _ in range(3):
        assert not questions.is_over
        questions.miss(KILLED)
    assert (questions.is_over, questions.why_not) == (True, "")
    questions.skip()
    assert (questions.unanswered, questions.why_unanswered) == (4, "a copy was killed by SIGKILL")
    questions.begin_trial()
    assert (questions.is_over, questions.unanswered, questions.may_be_answered) == (False, 0, False)
    for _ in range(3):
        assert not questions.is_over
        questions.begin_trial()  # in turn, of whichever trials
        questions.miss(RAISED)
    assert questions.why_not == "3 copies in turn failed; the last raised KeyError: 3"
    questions.begin_trial()
    questions.skip()
    assert questions.is_over
    assert (questions.why_unanswered, questions.may_be_answered) == (questions.why_not, False)


def test_answer_begins_the_count_again():
    questions = Questions("probes")
    for reason in (RAISED, KILLED):
        for _ in range(5):
            questions.miss(reason)
            questions.miss(reason)
            assert questions.ask(lambda: (ANSWER, None)) == ANSWER
    assert not questions.is_over


def test_what_cannot_be_copied_is_not_tried_again():
    told = []
    questions = Questions("probes", told.append)
    attempt, rest = attempts(CannotForkError("a process with several threads cannot be forked"), ANSWER)
    assert questions.ask(attempt) is None
    assert (questions.why_not, questions.why_unanswered) == (
        "a process with several threads cannot be forked",
        "a process with several threads cannot be forked",
    )
    assert (len(rest), questions.may_be_answered, told) == (1, False, [])


def test_reason_is_one_short_line_whatever_an_exception_states():
    told = []
    questions = Questions("probes", told.append)
    questions.ask(lambda: (None, NoAnswer("raised Boom: \x1b[2J\n" + "x\n" * 10**6 + "\ud800")))
    (line,) = told
    assert line.startswith("probes: a copy raised Boom: \\x1b[2J x x x")
    assert len(line) < 300
    line.encode()
