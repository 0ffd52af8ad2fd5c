"""When a trial over its time limit is ended: once it has written down where it is stuck, or cannot."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.executors import _time_limits
from crashhunt.executors._time_limits import START_UP_S, ImportWatch, has_hung
from crashhunt.recording import BlackBoxHeader, Phase

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
def test_it_has_a_moment_and_a_while_where_the_machine_is_busy(tmp_path, monkeypatch, stack, over_s, ended):
    path = tmp_path / "stack"
    if stack is not None:
        path.write_text(stack)
    now = time.monotonic()
    monkeypatch.setattr(_time_limits, "time", SimpleNamespace(monotonic=lambda: now))  # however long this test waits

    def has_words():
        return path.exists() and path.stat().st_size > 0

    def hangs(header, *, begun, given_s):
        return has_hung(header, begun=begun, given_at=now - given_s - over_s, limit_s=LIMIT_S, has_words=has_words)

    # One that has not begun, as far as its black box says, has the time in which a process starts as well.
    assert hangs(None, begun=False, given_s=START_UP_S + LIMIT_S) is ended
    header = BlackBoxHeader(1, 3, now - LIMIT_S - over_s, 0, 0, Phase.SETUP, 0)
    assert hangs(header, begun=False, given_s=START_UP_S + LIMIT_S) is ended
    assert hangs(header, begun=True, given_s=START_UP_S + LIMIT_S) is ended
    # A start in the future, or before the trial was given, is forged.
    for forged in (now + 1e6, 0.0):
        assert hangs(replace(header, started=forged), begun=True, given_s=LIMIT_S) is ended


def test_of_what_is_imported_so_much_is_kept_as_a_message_may_have():
    watch = ImportWatch(1.0)
    watch.begin("x" * 500)  # foreign code may write its own messages
    assert watch.importing == "x" * 200
