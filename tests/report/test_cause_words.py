"""Crash types and their causes, in words: the counts of a type are of all its crashes."""

from __future__ import annotations

from types import SimpleNamespace

from crashhunt.crashes import Cause, CauseGroup, Group, Signature
from crashhunt.report import describe_causes

TYPE = Signature(outcome="collision", role="collider", manner="rear end")


def bundle(number, steps):
    return SimpleNamespace(id=f"{number:06}-collision", path=number, result=SimpleNamespace(steps=steps))


def counts_of(lines):
    return [int(line.split()[0]) for line in lines if line.split() and line.split()[0].isdigit()]


def test_crashes_without_a_bundle_have_a_line_of_their_own():
    bundles = (bundle(3, 7), bundle(5, 9))
    part = CauseGroup(cause=Cause("omission", "vehicle", "sped up"), members=bundles, judged=bundles[:1])
    group = Group(TYPE, bundles, dropped=19)
    lines = describe_causes([group], [[part]]).splitlines()
    assert counts_of(lines) == [1, 2, 2, 19]  # one cause; of the cause; of its type; the others
    assert "not judged: their bundles were deleted" in lines[-1]
    assert "deleted" not in describe_causes([Group(TYPE, bundles)], [[part]])


def test_types_with_one_cause_stand_below_it():
    swipe = Signature(outcome="collision", role="collider", manner="side swipe")
    first, second = (bundle(1, 7), bundle(2, 9), bundle(3, 4)), (bundle(4, 8), bundle(5, 5))
    cause = Cause("omission", "gap left", "changed lanes")
    causes = [
        [CauseGroup(cause=cause, members=first, judged=first[:2])],
        [
            CauseGroup(cause=cause, members=second[:1], judged=second[:1]),
            CauseGroup(cause=Cause("unknown"), members=second[1:], judged=()),
        ],
    ]
    lines = describe_causes([Group(TYPE, first), Group(swipe, second)], causes).splitlines()
    assert lines[1] == "1 type by cause (the cause of 1 more crash is unknown):"  # as the hunt has counted
    assert counts_of(lines[2:]) == [4, 3, 1, 1, 1]
    assert lines[4].endswith("omission: changes to the left lane into a gap that is not safe")
    assert lines[5].split()[-3:] == ["2", "000003-collision", "4"]  # judged, the shortest, its steps
    assert [str(swipe) in line for line in lines[4:]] == [False, False, True, False, True]
