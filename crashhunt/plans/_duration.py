"""``--for TIME`` and ``--probe TIME``: how long a hunt may go on, how often something is done."""

from __future__ import annotations

import math
import re
import sys

__all__ = ["check_duration", "check_probe", "seconds_of"]

_UNITS = (86400.0, 3600.0, 60.0, 1.0)  # days, hours, minutes, seconds
_TIME = re.compile(r"(?:(\d+(?:\.\d+)?)d)?(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?")


def seconds_of(text: str) -> float:
    """Return how many seconds ``90``, ``90s``, ``30m``, ``1h30m`` or ``2d`` are; without end where nothing is said.

    Raises:
        ValueError: it is no such time, or none at all.
    """
    if not text:
        return math.inf
    found = _TIME.fullmatch(text)
    parts = found.groups() if found else ()
    seconds = sum(float(part or 0) * unit for part, unit in zip(parts, _UNITS, strict=bool(parts)))
    if not 0 < seconds < math.inf:
        raise ValueError(f"{text!r} is no time")
    return seconds


def check_duration(text: str) -> str:
    """Return what to give instead of a text that is no time; empty where it is one."""
    try:
        seconds_of(text)
    except ValueError:
        return "give a time above 0, such as 90s, 30m, 2h or 1h30m"
    return ""


def check_probe(text: str) -> str:
    """Return what to give instead of how often copies are asked; empty where that is fine."""
    if check_duration(text):
        return "give a time above 0, such as 4s, or leave it out"
    return "" if not text or sys.platform == "linux" else "leave it out: processes are copied on Linux only"
