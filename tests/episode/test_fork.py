"""Copies of running episodes: that they go on to the same bits, leave nothing behind, and what has no copy."""

from __future__ import annotations

import pytest
from single_threaded import answer_of, wait_for_the_end_of


class Words(str):
    """What a text begins with."""

    __slots__ = ()
    __hash__ = str.__hash__

    def __eq__(self, other):
        return other.startswith(str(self))


@pytest.fixture
def ask(tmp_path):
    """Asks a process of one thread."""
    return lambda what: answer_of("forking", what, tmp_path)


@pytest.mark.parametrize(
    "scenario", ["toy", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("loop", "highway"))]
)
def test_a_copy_and_a_copy_of_it_continue_to_the_same_bits(ask, scenario):
    unforked, *others = ask(scenario)["ends"]
    assert len(others) == 3
    assert unforked["steps"] >= 50  # on highway-env it drives off then
    assert "main" in unforked["said"] or "brake" in unforked["said"]  # it was disturbed
    for other in others:
        assert other == unforked


def test_what_has_no_copy_is_named(ask):
    assert ask("refused") == {
        "nothing": "",
        "thread": "a process with several threads cannot be forked: 1 further thread runs",
        "process": "a process with child processes cannot be forked",
        "socket": Words("a fork cannot copy a connection to others: socket:"),
        "pipe": Words("a fork cannot copy a connection to others: pipe:"),
        "memory": "a process that shares memory with other processes cannot be forked: /dev/zero (deleted)",
    }


def test_copies_end_with_their_process_and_before_it_when_they_hang(ask):
    found = ask("ends")
    assert found["answers"] == [None] * 7
    assert found["whys"] == {
        "hangs": ["took longer than 0.5 s", False],
        "is killed": ["was killed by SIGKILL", True],
        "segfaults": ["was killed by SIGSEGV", False],
        "exits": ["exited with 3", False],
        "divides": ["raised ZeroDivisionError: division by zero", False],
        "closes": ["closed its connection to the trial", False],
        "forges": ["sent data that are no answer", False],
        "sleeper": ["was killed by SIGKILL", True, False],
    }
    assert found["raised"] == "ZeroDivisionError: division by zero"
    wait_for_the_end_of(found["left"])


def test_probes_find_the_mildest_that_crashes_and_change_nothing(ask):
    found = ask("probes")
    assert found["outcomes"] == ["survived", "survived", "survived", "collision", "survived"]
    assert found["same"]
    stress = found["stress"]
    assert 0 < stress["margin"] < 1
    assert stress["disturbance"]["how_strong"] == 6.0 * stress["margin"]
    assert found["crashed"] == ["collision", stress["step"]]  # from the start, as in the copy
    assert stress["probes"] > 4
    assert stress["steps"] < 8 * 60
    assert stress["left_out"] > 0
    assert found["waited"]
    # Where nobody was asked, or it crashed anyway.
    assert found["never"] is None
    assert found["by itself"]["margin"] == 0.0
    assert found["by itself"]["disturbance"] is None
    stress, why_not = found["thread"]
    assert why_not == "a process with several threads cannot be forked: 1 further thread runs"
    assert (stress["margin"], stress["why_unasked"]) == (None, why_not)
    assert (stress["moments"], stress["moments_asked"], stress["probes"]) == (5, 0, 0)


@pytest.mark.nightly
def test_two_thousand_copies_leave_nothing(ask):
    begin, end = ask("soak").values()
    assert {**begin, "resident_mib": 0} == {**end, "resident_mib": 0}
    assert end["children"] == 0
    assert end["resident_mib"] < begin["resident_mib"] + 1  # 0.5 KiB a copy
