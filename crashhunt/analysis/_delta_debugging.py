"""Search for a minimal test case: delta debugging of a set, and simpler values of an argument.

The search is independent of trials: it works on items of any kind.

Delta debugging (Zeller and Hildebrandt, *Simplifying and Isolating Failure-Inducing Input*, 2002) reduces sets. For a
value, simpler values are tried first, as in Hypothesis. The search is deterministic, because the next candidate depends
on earlier results, and not on the number of workers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from crashhunt.trial import TrialSpec, Value

T = TypeVar("T")
Tried = Callable[[Sequence[T]], int | None]
"""Tries candidates; returns the place of the first that still crashes in the same manner, None if none does."""

_ROUNDING_DIGITS = (1, 2, 3, 4)


def fewest(items: Sequence[T], tried: Tried[tuple[T, ...]]) -> tuple[T, ...]:
    """Return a minimal part of some items that still passes a test: without any single remaining item, the test fails.

    The test is known to pass with all items.
    """
    found = tuple(items)
    if not found or tried([()]) is not None:
        return ()
    parts = 2
    while len(found) > 1:
        chunks = _chunks(found, min(parts, len(found)))
        rests = [tuple(item for item in found if item not in chunk) for chunk in map(set, chunks)]
        candidates = [*chunks, *rests] if len(chunks) > 2 else chunks
        good = tried(candidates)
        if good is None:
            if len(chunks) == len(found):
                break
            parts = len(chunks) * 2
        else:
            found = candidates[good]
            parts = 2 if good < len(chunks) else max(2, len(chunks) - 1)
    return found


def _chunks(items: tuple[T, ...], count: int) -> list[tuple[T, ...]]:
    ends = [len(items) * number // count for number in range(count + 1)]
    return [items[begin:end] for begin, end in pairwise(ends)]


def plainest(value: Value, default: Value | None) -> list[Value]:
    """Return simpler values to try instead of a value, the simplest first: its default, then rounder numbers."""
    found = list(_plainer(value, default))
    return list(dict.fromkeys(found[: found.index(value)] if value in found else found))


def as_type_of(value: Value, default: Value) -> Value | None:
    """Return a default in the type of a value; None if its value would change. ``speed=5`` may mean 5.0."""
    if isinstance(value, float) and isinstance(default, int) and not isinstance(default, bool):
        return float(default)
    return default if type(default) is type(value) else None


def _plainer(value: Value, default: Value | None) -> Iterator[Value]:
    if default is not None and (same := as_type_of(value, default)) is not None:
        yield same
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return
    for digits in _ROUNDING_DIGITS:
        rounded = float(f"{value:.{digits}g}")
        yield round(rounded) if isinstance(value, int) else rounded


def with_argument(spec: TrialSpec, key: tuple[str, str], value: Value | None) -> TrialSpec:
    """Return a trial with another value of the argument with a key, agent and name; None changes nothing."""
    agent, name = key
    if value is None:
        return spec
    if not agent:
        return replace(spec, scenario_arguments={**spec.scenario_arguments, name: value})
    return replace(spec, arguments={**spec.arguments, agent: {**spec.arguments[agent], name: value}})
