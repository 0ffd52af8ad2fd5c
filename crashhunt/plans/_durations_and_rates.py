"""Durations, shares and rates as texts of options, such as ``--for 30m``, ``--until-error 30%``, ``--bar 2/hour``."""

from __future__ import annotations

import math
import re
from typing import Literal, cast, get_args

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
    return "give a time above 0, such as 4s, or omit the option" if check_duration(text) else ""


def share_of(text: str) -> float:
    """Return the share in a text such as ``30%`` or ``0.3``, as a number from 0 to 1.

    >>> share_of("30%")
    0.3

    Raises:
        ValueError: the text is not a share above 0 and up to 1.
    """
    found = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    if not 0 < found <= 1:
        raise ValueError(f"{text!r} is not a share above 0 and up to 1")
    return found


def check_share(text: str) -> str:
    """Return the fix for a text that is not a share; empty for a valid or an empty text."""
    try:
        share_of(text or "1")
    except ValueError:
        return "give a share above 0 and up to 1, such as 30% or 0.3"
    return ""


RatePer = Literal["trial", "hour", "1000km"]
"""What a rate is per."""
RATE_PERS: tuple[RatePer, ...] = get_args(RatePer)
_MIN_BAR, _MAX_BAR = 1e-12, 1e12  # beyond these, trials decide nothing and floats overflow
_RATE = re.compile(r"(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)\s*/\s*(trial|hour|1000\s?km)")


def rate_of(text: str) -> tuple[float, RatePer]:
    """Return the rate and its unit from a text such as ``1e-3/trial``, ``2/hour`` or ``5/1000km``.

    >>> rate_of("2/hour")
    (2.0, 'hour')

    Raises:
        ValueError: the text is not such a rate, or the rate is out of range.
    """
    found = _RATE.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is not a rate, such as 1e-3/trial")
    value, per = float(found[1]), cast(RatePer, found[2].replace(" ", ""))
    if not _MIN_BAR <= value <= _MAX_BAR or (per == "trial" and value >= 1):
        raise ValueError(f"the rate {text!r} is out of range")
    return value, per


def check_rate(text: str) -> str:
    """Return the fix for a text that is not a rate; empty for a valid or an empty text."""
    try:
        if text:
            rate_of(text)
    except ValueError:
        return "give a rate from 1e-12 to 1e12, such as 1e-3/trial (below 1), 2/hour or 5/1000km"
    return ""
