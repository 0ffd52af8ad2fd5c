"""Crash types and their causes, in words: the counts of a type are of all its crashes."""

from __future__ import annotations

from types import SimpleNamespace

from crashhunt.crashes import Cause, CauseGroup, Group, Signature
from crashhunt.report import describe_causes

TYPE = Signature(outcome="collision", role="collider", manner="rear end")


def bundle(number, steps):
    return SimpleNamespace(id=f"{number:06}-collision", path=number, result=SimpleNamespace(steps=steps))


def test_crashes_without_a_bundle_have_a_line_of_their_own():
    bundles = (bundle(3, 7), bundle(5, 9))
    part = CauseGroup(cause=Cause("omission", "vehicle", "sped up"), members=bundles, judged=bundles[:1])
    group = Group(TYPE, bundles, dropped=19)
    lines = describe_causes([group], [[part]]).splitlines()
    counts = [int(line.split()[0]) for line in lines if line.split() and line.split()[0].isdigit()]
    assert counts == [1, 21, 2, 19]  # one cause; of the type; of the cause; the others
    assert "not judged: their bundles were deleted" in lines[-1]
    assert "deleted" not in describe_causes([Group(TYPE, bundles)], [[part]])
