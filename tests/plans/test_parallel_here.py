"""How much of a hunt's work that is not its trials this machine does at a time."""

from __future__ import annotations

import os

import pytest

from crashhunt.plans import parallel_here


@pytest.mark.parametrize(
    ("word", "parallel", "expected"),
    [("pool", 500, 500), ("pool", 0, 2), ("ray:head:6379", 500, 2), ("ray", 1, 1), ("ray", 0, 2)],
)
def test_the_crashes_of_a_cluster_are_not_confirmed_500_at_a_time_here(word, parallel, expected, monkeypatch):
    """Each is a process of its own on the machine of the hunt, and would hang there."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    assert parallel_here(word, parallel) == expected
