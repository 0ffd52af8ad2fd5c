"""Branches: that they crash from the start as they did, change nothing, and leave nothing behind."""

from __future__ import annotations

import pytest
from single_threaded import answer_of, wait_for_the_end_of


@pytest.fixture
def ask(tmp_path):
    """Asks a process of one thread."""
    return lambda what: answer_of("branching", what, tmp_path)


@pytest.mark.parametrize("scenario", ["toy", pytest.param("loop", marks=pytest.mark.nightly)])
def test_branches_crash_from_the_start_as_they_did_and_change_nothing(ask, scenario):
    found = ask(scenario)
    assert found["outcomes"] == ["survived", "survived"]
    assert found["same"]
    branches = found["branches"]
    assert branches["moments"] >= 2
    assert branches["asked"] >= 3
    assert 0 < branches["steps"] < 4 * 150 + 60
    assert branches["left_out"] > 0
    assert branches["crashes"]
    assert found["starts"] == [
        [crash["outcome"], crash["step"], crash["log_likelihood"]] for crash in branches["crashes"]
    ]
    for crash in branches["crashes"]:
        first = min(one["step"] for one in crash["disturbances"])
        assert crash["branched"] + 2 <= first <= crash["branched"] + 2 + 20
        assert first <= crash["step"] <= crash["branched"] + 60
        assert crash["log_likelihood"] < 0
    of_first = [crash for crash in branches["crashes"] if crash["branched"] == branches["crashes"][0]["branched"]]
    assert [len(crash["disturbances"]) for crash in of_first[:2]] == [2, 1]  # left out as long as it crashes
    assert of_first[0]["log_likelihood"] < of_first[1]["log_likelihood"]
    assert found["waited"]
    assert (found["left"], found["why_not"]) == (0, "")
    if scenario == "toy":
        assert found["again"]
        assert found["itself"][0] == "collision"
        assert found["itself"][1]["crashes"] == []  # it needed no other
        assert found["never"] is None
        assert found["alone"] == {"moments": 0, "asked": 0, "steps": 0, "left_out": 0, "crashes": []}  # nobody is near


def test_branches_end_when_they_hang_or_die_and_copies_with_their_process(ask):
    found = ask("ends")
    outcome, why_not, left, branches = found["hangs"]
    assert (outcome, why_not, left) == ("survived", "3 copies in turn failed; the last took longer than 0.3 s", 0)
    assert (branches["asked"], branches["may_be_asked_again"]) == (0, False)
    assert branches["unanswered"] > 3  # one for each second in which an actor is near
    outcome, why_not, left, branches = found["dies"]
    assert (outcome, why_not, left) == ("survived", "", 0)  # the next trial is asked
    assert (branches["why_unanswered"], branches["may_be_asked_again"]) == ("a copy was killed by SIGKILL", True)
    outcome, branches, told = found["full"]
    assert told == "less than 25 % of the memory is free: trials branch less than they might"
    assert (branches["asked"], branches["unanswered"]) == (0, 3)
    assert (branches["why_unanswered"], branches["may_be_asked_again"]) == (
        "less than 25 % of the memory was free",
        False,
    )
    assert len(found["left"]) == 3
    for pid in found["left"]:
        wait_for_the_end_of(pid)
