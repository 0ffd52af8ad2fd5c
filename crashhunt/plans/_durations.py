"""Durations as text: the time limits ``--for TIME`` and the intervals ``--probe TIME``."""

from __future__ import annotations

import math
import re
import sys

_UNITS_S = (86400.0, 3600.0, 60.0, 1.0)  # days, hours, minutes, seconds
_DURATION = re.compile(r"(?:(\d+(?:\.\d+)?)d)?(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?")


def seconds_of(text: str) -> float:
    """Return the number of seconds in ``90``, ``90s``, ``30m``, ``1h30m`` or ``2d``; infinite for an empty text.

    >>> seconds_of("1h30m")
    5400.0

    Raises:
        ValueError: the text is not a duration.
    """
    if not text:
        return math.inf
    found = _DURATION.fullmatch(text)
    parts = found.groups() if found else ()
    seconds = sum(float(part or 0) * unit for part, unit in zip(parts, _UNITS_S, strict=bool(parts)))
    if not 0 < seconds < math.inf:
        raise ValueError(f"{text!r} is not a time, such as 90s, 30m or 1h30m")
    return seconds


def check_duration(text: str) -> str:
    """Return the fix for a text that is not a duration; empty for a valid text."""
    try:
        seconds_of(text)
    except ValueError:
        return "give a time above 0, such as 90s, 30m, 2h or 1h30m"
    return ""


def check_probe(text: str) -> str:
    """Return the fix for an invalid interval between robustness probes; empty if the interval is valid."""
    if check_duration(text):
        return "give a time above 0, such as 4s, or omit the option"
    return "" if not text or sys.platform == "linux" else "omit the option: forks need Linux"
