"""What is shown of a crash as evidence: where, how fast, and the lines of a stack that matter."""

from __future__ import annotations

import math

import pytest

from crashhunt.report._crash_summary import _evidence
from crashhunt.trial import Collision, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import Event

SPEC = TrialSpec(1, 1, {}, {}, max_steps=40)
ERROR = """Traceback (most recent call last):
  File "run.py", line 1, in run
    agent.act(seen)
  File "agent.py", line 9, in act
    return self.table[seen]
KeyError: 'seen'
"""
DUMP = """Current thread 0x00007f (most recent call first):
  File "agent.py", line 9 in act
  File "blame.py", line 5 in call
  File "run.py", line 1 in run
  File "zygote.py", line 3 in main
"""


def evidence(outcome, **more):
    return _evidence(TrialResult(SPEC, outcome, steps=4, **more))


@pytest.mark.parametrize(("kind", "outcome"), [("signal", Outcome.PROCESS_DIED), ("timeout", Outcome.HANG)])
def test_of_a_process_that_died_or_hung_the_innermost_calls_are_shown(kind, outcome):
    failure = Failure(kind, "SIGSEGV", traceback=DUMP, last_output="one\ntwo\n\n")
    lines = [line.strip() for line in evidence(outcome, failure=failure)]
    innermost = ['File "agent.py", line 9 in act', 'File "blame.py", line 5 in call', 'File "run.py", line 1 in run']
    assert lines == [*innermost, "last output: two"]


def test_of_an_exception_the_last_call_and_the_message_are_shown():
    failure = Failure("exception", "KeyError: 'seen'", traceback=ERROR, last_output=" \n")
    assert [line.strip() for line in evidence(Outcome.AGENT_ERROR, failure=failure)] == [
        "agent.act(seen)", 'File "agent.py", line 9, in act', "return self.table[seen]", "KeyError: 'seen'",
    ]  # fmt: skip


def test_refused_action_has_no_calls_but_those_of_the_agent():
    ours = "".join(
        f'File "/x/crashhunt/{file}", line 1, in f\n' for file in ("episode/_episode.py", "simulators/_actions.py")
    )
    assert evidence(Outcome.AGENT_ERROR, failure=Failure("bad action", "not in Discrete(5)", traceback=ours)) == []
    called = ours + 'File "agent.py", line 9, in act\n'
    (*_, last) = evidence(Outcome.AGENT_ERROR, failure=Failure("bad action", "not for agents", traceback=called))
    assert last == 'File "agent.py", line 9, in act'


def test_a_collision_has_its_place_and_both_speeds_where_they_are_known():
    hit = Collision("ego", "collider", "ego", "x", ("overlap",), "overlap", 1.5, 2.5, "a_0", 9.0, 3.0, math.nan)
    first, second = evidence(Outcome.COLLISION, collision=hit)
    assert first == "at (1.5, 2.5) on lane a_0; ego at 9.0 m/s, x at 3.0 m/s"
    assert second == "the outlines overlap; the simulator does not report it"
    nowhere = Collision("ego", "collider", "ego", "", ("reported",), "collision", math.nan, math.nan)
    assert evidence(Outcome.COLLISION, collision=nowhere) == []


def test_an_event_has_its_place():
    event = Event("off_road", "ego", "ego left the road", (), "b_1", 3.0, 4.0, 7.0)
    assert evidence(Outcome.OFF_ROAD, event=event) == ["ego at (3.0, 4.0) on lane b_1, at 7.0 m/s"]
