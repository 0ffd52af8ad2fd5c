"""How deep Python may recurse in a process that runs agents."""

from __future__ import annotations

import sys

import pytest

from crashhunt.episode._parts import MAX_RECURSION_LIMIT, bound_recursion


@pytest.fixture(autouse=True)
def bounded(monkeypatch):
    limit = sys.getrecursionlimit()
    monkeypatch.setattr(sys, "setrecursionlimit", sys.setrecursionlimit)
    bound_recursion()
    bound_recursion()
    yield
    sys.setrecursionlimit(limit)


def test_limit_above_the_bound_is_the_bound():
    sys.setrecursionlimit(10**9)
    assert sys.getrecursionlimit() == MAX_RECURSION_LIMIT
    sys.setrecursionlimit(5_000)
    assert sys.getrecursionlimit() == 5_000


@pytest.mark.parametrize("wrong", [0, -1, "x", None])
def test_wrong_limit_is_refused_as_python_does(wrong):
    with pytest.raises((ValueError, TypeError)):
        sys.setrecursionlimit(wrong)


def test_endless_recursion_ends_in_an_exception():
    def recurse():
        recurse()

    sys.setrecursionlimit(10**9)
    with pytest.raises(RecursionError):
        recurse()
