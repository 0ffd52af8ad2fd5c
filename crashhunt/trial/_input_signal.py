"""Arguments that are signals: values over the time of a trial, given by some points.

``--arg throttle=signal:0:1:points=5:kind=linear`` varies five points from 0 to 1. A hunt stores such an argument as the
text ``signal:KIND:COUNT:DURATION``, and each of its points as an argument of its own: ``throttle[0]``, ``throttle[1]``
and so on. Samplers, ledger and minimization therefore see numbers, and the agent receives an `InputSignal`.

Arguments of a scenario are stored in the same way. The strength of a disturbance at a given step, such as ``brake@50``,
is stored as an argument of the scenario with this name.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from crashhunt.base.errors import ArgumentError
from crashhunt.base.text import one_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from crashhunt.trial._argument_distributions import Value

_PREFIX: Final = "signal:"
_KINDS: Final = ("constant", "linear", "pchip")
_MAX_POINTS: Final = 200
_DEFAULT_POINTS: Final = 5
_STORED: Final = re.compile(r"signal:(constant|linear|pchip):(\d+):([0-9.e+-]+)")
_POINT: Final = re.compile(r"(.+)\[(\d+)\]")
_MOST_CANDIDATES: Final = 12
_NOTATION: Final = "write signal:LOW:HIGH:points=N:kind=constant|linear|pchip, such as signal:0:1:points=5"


@dataclass(frozen=True)
class InputSignal:
    """A value over time, for an agent, a scenario or a disturbance that is driven by signals."""

    # values of the signal. With the kind ``constant``, each holds for the same share of the duration. Otherwise, the
    # first is the value at 0 s, and the last the value at the end.
    points: tuple[float, ...]
    kind: str  # ``constant``, ``linear`` or ``pchip`` (monotonic cubic interpolation; Fritsch and Carlson, 1980)
    duration_s: float  # duration of a trial, in s

    def __call__(self, time_s: float) -> float:
        """Return the value at a time in s; before the begin and after the end, the nearest value."""
        share = min(1.0, max(0.0, time_s / self.duration_s))
        count = len(self.points)
        if count == 1:
            return self.points[0]
        if self.kind == "constant":
            # A time on the edge of two parts, such as 0.3 / 0.1 parts, belongs to the later one.
            return self.points[min(count - 1, int(share * count + 1e-9))]
        return float(self._interpolate(np.array([share * (count - 1)]))[0])

    @cached_property
    def _interpolate(self) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        places = np.arange(len(self.points), dtype=float)
        if self.kind == "linear":
            return lambda at: np.interp(at, places, self.points)
        from scipy.interpolate import PchipInterpolator  # takes 0.2 s to import

        made: Callable[[NDArray[np.float64]], NDArray[np.float64]] = PchipInterpolator(places, self.points)
        return made


def expand_signal(name: str, spec: str, duration_s: float, *, where: str) -> dict[str, str]:
    """Return the specifications of an argument that is a signal, and of its points; empty for any other argument.

    The specification is as the user gave it. An error names ``where``, an option such as ``--arg throttle``.

    Raises:
        ArgumentError: the specification is invalid.
    """
    if not spec.startswith(_PREFIX):
        return {}
    bounds, settings = [], {"points": str(_DEFAULT_POINTS), "kind": "linear"}
    for word in spec.removeprefix(_PREFIX).split(":"):
        key, equals, value = word.partition("=")
        if not equals:
            bounds.append(word)
        elif key not in settings:
            raise ArgumentError(f"{spec!r} has an unknown setting {key!r}", fix=one_of(key, settings), where=where)
        else:
            settings[key] = value
    try:
        low, high = map(float, bounds)
        count = int(settings["points"])
    except ValueError:
        raise ArgumentError(f"{spec!r} is not a signal", fix=_NOTATION, where=where) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ArgumentError(f"the signal {spec!r} has no range", fix="give LOW below HIGH", where=where)
    if not 1 <= count <= _MAX_POINTS:
        raise ArgumentError(f"the signal {spec!r} has {count} points", fix=f"give 1 to {_MAX_POINTS}", where=where)
    if settings["kind"] not in _KINDS:
        fix = one_of(settings["kind"], _KINDS)
        raise ArgumentError(f"the signal {spec!r} has an unknown kind {settings['kind']!r}", fix=fix, where=where)
    points = {f"{name}[{number}]": f"{low!r}:{high!r}" for number in range(count)}
    return {name: f"{_PREFIX}{settings['kind']}:{count}:{duration_s!r}", **points}


def is_signal(spec: object) -> bool:
    """Return whether a specification or a stored value of an argument is a signal."""
    return isinstance(spec, str) and spec.startswith(_PREFIX)


def is_stored_signal(value: object) -> bool:
    """Return whether a value of an argument is the stored form of a signal, whose points are further arguments."""
    return isinstance(value, str) and _STORED.fullmatch(value) is not None


def with_fewer_points(arguments: Mapping[str, Value], name: str) -> list[dict[str, Value]]:
    """Return arguments in which a signal has fewer points, the fewest first; empty if the argument is no signal.

    The points of the smaller signals are values of the signal, at equal distances in time.
    """
    signal = fold_signals(arguments)[name] if name in arguments and f"{name}[0]" in arguments else None
    if not isinstance(signal, InputSignal):
        return []
    most = len(signal.points) - 1
    counts = dict.fromkeys(round(math.exp(math.log(max(1, most)) * share / 11)) for share in range(_MOST_CANDIDATES))
    return [_resampled(arguments, name, signal, count) for count in counts if count <= most]


def _resampled(arguments: Mapping[str, Value], name: str, signal: InputSignal, count: int) -> dict[str, Value]:
    if signal.kind == "constant":
        times = [(number + 0.5) / count for number in range(count)]
    else:
        times = [number / (count - 1) for number in range(count)] if count > 1 else [0.5]
    points = {f"{name}[{number}]": signal(share * signal.duration_s) for number, share in enumerate(times)}
    kept = {
        key: value for key, value in arguments.items() if key in points or (point_of_signal(key) or ("",))[0] != name
    }
    return {**kept, name: f"{_PREFIX}{signal.kind}:{count}:{signal.duration_s!r}", **points}


def point_of_signal(name: str) -> tuple[str, int] | None:
    """Return the signal and the number of a point, such as ``throttle`` and 2 for ``throttle[2]``; else None."""
    match = _POINT.fullmatch(name)
    return None if match is None else (match[1], int(match[2]))


def fold_signals(arguments: Mapping[str, Value]) -> dict[str, object]:
    """Return arguments with an `InputSignal` in place of each signal and its points.

    If another value has replaced the signal, as in a replay with ``--set``, its points are omitted.
    """
    found: dict[str, object] = {}
    for name, value in arguments.items():
        if (point := point_of_signal(name)) is not None and point[0] in arguments:
            continue
        match = _STORED.fullmatch(value) if isinstance(value, str) else None
        if match is None or f"{name}[0]" not in arguments:
            found[name] = value
            continue
        points = tuple(float(arguments[f"{name}[{number}]"]) for number in range(int(match[2])))
        found[name] = InputSignal(points, match[1], float(match[3]))
    return found
