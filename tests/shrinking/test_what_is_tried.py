"""What is tried to make a crash smaller, and in which order."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from crashhunt.shrinking import fewest, plainest


def first(good, seen):
    """Try candidates, and count them."""

    def tried(candidates):
        for place, candidate in enumerate(candidates):
            seen.append(candidate)
            if good(candidate):
                return place
        return None

    return tried


@given(st.integers(1, 60), st.data())
def test_exactly_what_it_takes_is_left(count, data):
    needed = data.draw(st.sets(st.integers(0, count - 1)))
    seen = []
    found = fewest(range(count), first(lambda some: needed <= set(some), seen))
    assert set(found) == needed
    assert list(found) == sorted(found)
    assert len(seen) <= 4 * (len(needed) + 1) * (count.bit_length() + len(needed) + 2)


def test_what_is_likely_is_tried_first():
    seen = []
    assert fewest(range(1000), first(lambda some: 7 in some, seen), [(3,), (7,)]) == (7,)
    assert seen == [(), (3,), (7,)]


def test_where_each_is_needed_none_is_left_out_and_nothing_of_nothing():
    assert fewest("abcd", first(lambda some: len(some) == 4, [])) == ("a", "b", "c", "d")
    assert fewest((), first(lambda some: True, [])) == ()
    assert fewest("abcd", first(lambda some: True, [])) == ()


@pytest.mark.parametrize(
    ("value", "default", "plainer"),
    [
        (17.2345, 15.0, [15.0, 20.0, 17.0, 17.2, 17.23]),
        (17.2345, None, [20.0, 17.0, 17.2, 17.23]),
        (20.0, None, []),
        (15.0, 15.0, []),
        (37, 20, [20, 40]),
        (True, False, [False]),
        ("firm", "gentle", ["gentle"]),
        ("firm", None, []),
        (float("nan"), None, []),
        (3.0, 1, []),
    ],
)
def test_values_become_plainer(value, default, plainer):
    assert plainest(value, default) == plainer
    assert list(map(type, plainest(value, default))) == list(map(type, plainer))
