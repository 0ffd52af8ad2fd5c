"""When a trial over its time limit is ended: once it has written down where it is stuck, or cannot."""

from __future__ import annotations

import time

import pytest

from crashhunt.base import layout
from crashhunt.episode import scratch_of
from crashhunt.executors._hang import START_UP_S, has_hung

LIMIT_S = 5.0


@pytest.mark.parametrize(
    ("stack", "over_s", "ended"),
    [
        (None, -1.0, False),
        (None, 1.0, False),
        (None, 3.5, True),
        ("", 1.0, False),
        ("", 3.5, True),
        ("File", -1.0, False),
        ("File", 0.5, True),
    ],
)
def test_it_has_a_moment_and_a_while_where_the_machine_is_busy(tmp_path, stack, over_s, ended):
    folder = scratch_of(tmp_path, 3)
    folder.mkdir()
    if stack is not None:
        (folder / layout.STACK).write_text(stack)
    # Neither has begun, as far as its black box says, so both have the time in which a process starts as well.
    given_at = time.monotonic() - START_UP_S - LIMIT_S - over_s
    assert has_hung(tmp_path, 3, given_at=given_at, limit_s=LIMIT_S) is ended
    assert has_hung(tmp_path, 4, given_at=given_at, limit_s=LIMIT_S) is (over_s > 3)  # which has no folder
