"""When a trial over its time limit is ended: once it has written down where it is stuck, or cannot."""

from __future__ import annotations

import pytest

from crashhunt.base import layout
from crashhunt.episode import scratch_of
from crashhunt.executors._remains import has_hung


@pytest.mark.parametrize(
    ("stack", "over_s", "ended"),
    [
        (None, -1.0, False),
        (None, 0.5, False),
        (None, 3.5, True),
        ("", 0.5, False),
        ("", 3.5, True),
        ("File", 0.1, False),
        ("File", 0.5, True),
    ],
)
def test_it_has_a_moment_and_a_while_where_the_machine_is_busy(tmp_path, stack, over_s, ended):
    folder = scratch_of(tmp_path, 3)
    folder.mkdir()
    if stack is not None:
        (folder / layout.STACK).write_text(stack)
    assert has_hung(tmp_path, 3, over_s) is ended
    assert has_hung(tmp_path, 4, over_s) is (over_s > 3)  # which has no folder
