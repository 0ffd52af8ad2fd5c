"""Which trials hang, over their time limit; and how long they may write down where, before they are killed."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.episode import scratch_of
from crashhunt.executors._remains import where_it_is

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["START_UP_S", "has_hung"]

START_UP_S = 60.0  # for Python and the agent to be imported, before a trial counts as begun
_LAST_WORDS_S = 0.2  # after its time limit, for a hung process to write down where it is stuck
_NO_WORDS_S = 3.0  # the same, on a machine that has no time for it at once


def has_hung(scratch: Path, number: int, *, given_at: float, limit_s: float) -> bool:
    """Whether a trial is to be ended because it takes too long.

    Args:
        scratch: the folder in which the trial records.
        number: of the trial.
        given_at: when its process was given it, as of `time.monotonic`.
        limit_s: wall time that it may take from its beginning on, in s.
    """
    header = where_it_is(scratch, number)
    began, allowed_s = (header.started, limit_s) if header else (given_at, limit_s + START_UP_S)
    over_s = time.monotonic() - max(began, given_at) - allowed_s
    if over_s <= _LAST_WORDS_S:
        return False
    try:
        said = (scratch_of(scratch, number) / layout.STACK).stat().st_size > 0
    except OSError:
        said = False
    return said or over_s > _NO_WORDS_S
