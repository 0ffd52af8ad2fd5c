"""The value of a formula on a trace: space robustness, and the same operators on truth values.

A trace has a sample per step, at equal distances. Every operator returns a value for each sample. Truth is computed
like robustness, with positive infinity for true and negative infinity for false, so that minimum and maximum are
conjunction and disjunction.

Sources: robustness of signal temporal logic, Donzé and Maler, FORMATS 2010. Sliding minimum, van Herk 1992, and Gil and
Werman 1993. Bounded ``until`` by unbounded ``until``, Donzé, Ferrère and Maler, CAV 2013.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import ArgumentError, FormulaError
from crashhunt.requirements._formula import Apply, Compare, Join, Not, Number, Proposition, Signal, Temporal, Truth

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from crashhunt.requirements._formula import Formula, Term, Window

_STEP_TOLERANCE = 1e-6  # of a step: bounds in decimal seconds are seldom exact multiples of a step


def steps_of(window: Window, step_length_s: float, text: str) -> tuple[int, int | None]:
    """Return the bounds of a window in steps; None for a window without a farther bound.

    Raises:
        FormulaError: a bound is not a multiple of the step length.
    """
    bounds: list[int] = []
    for bound_s in (window.begin_s, window.end_s):
        if bound_s is None:
            return bounds[0], None
        exact = bound_s / step_length_s
        if abs(exact - round(exact)) > _STEP_TOLERANCE:
            below, above = (edge * step_length_s for edge in (math.floor(exact), math.ceil(exact)))
            raise FormulaError(
                f"a window has the bound {bound_s:g} s, not a multiple of the step length of {step_length_s:g} s",
                fix=f"give {below:.9g} or {above:.9g}", text=text, begin=window.span[0], end=window.span[1],
            )  # fmt: skip
        bounds.append(round(exact))
    return bounds[0], bounds[1]


def term_values(term: Term, signals: Mapping[str, NDArray[np.float64]], count: int, text: str) -> NDArray[np.float64]:
    """Return the value of a term at each sample.

    Raises:
        FormulaError: the term divides by zero, or is not a number at a sample.
    """
    match term:
        case Number(value=value):
            return np.full(count, value)
        case Signal(name=name):
            return signals[name]
        case Apply(operator=operator, terms=terms):
            operands = [term_values(one, signals, count, text) for one in terms]
    if operator == "/" and not operands[1].all():
        raise undefined(term, text, int(np.flatnonzero(operands[1] == 0.0)[0]), "divides by zero")
    with np.errstate(all="ignore"):
        found = _OPERATIONS[operator](operands)
    wrong = np.isnan(found)
    if wrong.any():
        raise undefined(term, text, int(np.flatnonzero(wrong)[0]), "is not a number")
    return found


def undefined(term: Term, text: str, sample: int, what: str) -> FormulaError:
    """Return the error for a term without a value at a sample."""
    begin, end = term.span
    return FormulaError(
        f"it {what} at sample {sample}: {' '.join(text[begin:end].split())}",
        fix="exclude this case, such as with: x > 0 -> …", text=text, begin=begin, end=end,
    )  # fmt: skip


def _reduced(ufunc: np.ufunc) -> Callable[[list[NDArray[np.float64]]], NDArray[np.float64]]:
    return lambda operands: np.asarray(ufunc.reduce(operands), float)


_OPERATIONS: dict[str, Callable[[list[NDArray[np.float64]]], NDArray[np.float64]]] = {
    "+": lambda operands: operands[0] + operands[1],
    "-": lambda operands: operands[0] - operands[1],
    "*": lambda operands: operands[0] * operands[1],
    "/": lambda operands: operands[0] / operands[1],
    "neg": lambda operands: -operands[0],
    "abs": lambda operands: np.abs(operands[0]),
    "sqrt": lambda operands: np.sqrt(operands[0]),
    "min": _reduced(np.minimum),
    "max": _reduced(np.maximum),
}


def proposition_values(
    formula: Compare | Proposition | Truth, signals: Mapping[str, NDArray[np.float64]], flags: frozenset[str],
    count: int, text: str, *, truth: bool,
) -> NDArray[np.float64]:  # fmt: skip
    """Return the value of a proposition at each sample.

    As a formula, a boolean signal is infinitely true or false. With ``truth``, truth values are returned in place of
    robustness.
    """
    match formula:
        case Truth(value=value):
            return np.full(count, math.inf if value else -math.inf)
        case Proposition(term=term):
            values = term_values(term, signals, count, text)
            if truth or (isinstance(term, Signal) and term.name in flags):
                return np.where(values > 0, math.inf, -math.inf)
            return values
        case Compare(operator=operator, left=one, right=two):
            left, right = (term_values(term, signals, count, text) for term in (one, two))
    if truth:
        return np.where(_TRUTHS[operator](left, right), math.inf, -math.inf)
    with np.errstate(invalid="ignore"):
        distance = np.where(left == right, 0.0, left - right)  # equal infinities have no difference
    if operator in ("<", "<="):
        return -distance
    if operator in (">", ">="):
        return distance
    return -np.abs(distance) if operator == "==" else np.abs(distance)


def lasting(truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for how many samples a truth value stays as it is, from each sample on: negative where it is false.

    What holds at the end of the trace counts as if it stayed for the length of the trace.
    """
    count, holds = len(truth), truth > 0
    ends = np.append(np.flatnonzero(holds[1:] != holds[:-1]) + 1, 2 * count)
    at = np.arange(count)
    lasts = ends[np.searchsorted(ends, at, side="right")] - at
    return np.where(holds, lasts, -lasts).astype(float)


_TRUTHS: dict[str, np.ufunc] = {
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal, "==": np.equal, "!=": np.not_equal,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Computes formulas on one trace."""

    # function that returns the values of a formula without temporal operators at each sample
    leaf: Callable[[Formula], NDArray[np.float64]]
    is_leaf: Callable[[Formula], bool]  # whether `leaf` computes a formula; otherwise its operands are computed
    bounds: Callable[[Window], tuple[int, int | None]]  # function that returns the bounds of a window in steps
    # whether the trace may continue. Samples after its end then have the value that is best for the whole formula, so
    # that a false formula stays false with every continuation.
    running: bool = False

    def values(self, formula: Formula, *, positive: bool = True) -> NDArray[np.float64]:
        """Return the value of a formula at each sample.

        ``positive`` is whether the formula is below an even number of negations.
        """
        if self.is_leaf(formula):
            return self.leaf(formula)
        match formula:
            case Not(formula=inner):
                return -self.values(inner, positive=not positive)
            case Join(operator=operator, parts=parts):
                reduce = np.minimum.reduce if operator == "and" else np.maximum.reduce
                return np.asarray(reduce([self.values(part, positive=positive) for part in parts]))
            case Temporal(operator=operator, formula=inner):
                values = self.values(inner, positive=positive)
                begin, end = self.bounds(formula.window)
                if operator in ("always", "eventually"):
                    after = self._after(positive, math.inf if operator == "always" else -math.inf)
                    return _future(values, begin, end, least=operator == "always", after=after)
                before = math.inf if operator == "historically" else -math.inf
                return _future(values[::-1], begin, end, least=operator == "historically", after=before)[::-1]
            case _:
                return self._until(formula, positive=positive)

    def _until(self, formula: Formula, *, positive: bool) -> NDArray[np.float64]:
        assert not isinstance(formula, Truth | Compare | Proposition | Not | Join | Temporal)
        left, right = (self.values(part, positive=positive) for part in (formula.left, formula.right))
        begin, end = self.bounds(formula.window)
        if formula.operator == "until":
            return _until(left, right, begin, end, self._after(positive, -math.inf))
        return _until(left[::-1], right[::-1], begin, end, -math.inf)[::-1]

    def _after(self, positive: bool, ended: float) -> float:
        """Return the value of the samples after the end of the trace."""
        return ended if not self.running else math.inf if positive else -math.inf


def _future(
    values: NDArray[np.float64], begin: int, end: int | None, *, least: bool, after: float
) -> NDArray[np.float64]:
    """Return the minimum or maximum in a window ahead of each sample.

    The bounds of the window are relative to each sample. Without an end, it reaches to the end of the trace and
    everything after it, where each sample is ``after``.
    """
    if not least:
        return -_future(-values, begin, end, least=True, after=-after)
    count = len(values)
    found = np.full(count, after)
    if begin >= count:
        return found
    rest = values[begin:]
    if end is None or end - begin + 1 >= len(rest):
        least_after = np.minimum.accumulate(rest[::-1])[::-1]
        # A shorter window does not reach the end.
        reaches = np.arange(len(rest)) + (len(rest) if end is None else end - begin) >= len(rest)
        found[: len(rest)] = np.where(reaches, np.minimum(least_after, after), least_after)
        return found
    width = end - begin + 1
    padded = np.full(-(-(len(rest) + width - 1) // width) * width, after)
    padded[: len(rest)] = rest
    blocks = padded.reshape(-1, width)
    up_to = np.minimum.accumulate(blocks, axis=1).ravel()
    from_there = np.minimum.accumulate(blocks[:, ::-1], axis=1)[:, ::-1].ravel()
    found[: len(rest)] = np.minimum(from_there[: len(rest)], up_to[width - 1 : width - 1 + len(rest)])
    return found


def _until(
    left: NDArray[np.float64], right: NDArray[np.float64], begin: int, end: int | None, after: float
) -> NDArray[np.float64]:
    """Return the greatest ``right`` in the window ahead, bounded by the least ``left`` before it."""
    count = len(left)
    found = np.full(count, after)
    if begin < count:
        # The recursion is x -> max(right, min(left, x)); pairs of such functions are of the same form, so doubling the
        # distance composes all of them.
        until, holds = right[begin:].copy(), left[begin:].copy()
        distance = 1
        while distance < len(until):
            until[:-distance] = np.maximum(until[:-distance], np.minimum(holds[:-distance], until[distance:]))
            holds[:-distance] = np.minimum(holds[:-distance], holds[distance:])
            distance *= 2
        until = np.maximum(until, np.minimum(holds, after))
        if end is not None:
            until = np.minimum(until, _future(right[begin:], 0, end - begin, least=False, after=after))
        found[: len(until)] = until
    if begin:
        found = np.minimum(found, _future(left, 0, begin - 1, least=True, after=math.inf))
    return found


def checked_signals(
    signals: Mapping[str, object], names: tuple[str, ...]
) -> tuple[dict[str, NDArray[np.float64]], frozenset[str]]:
    """Return the named signals as arrays of floats, and the names of those that are boolean.

    Raises:
        ArgumentError: a signal is not a row of numbers, has NaN, or has another length.
    """
    found: dict[str, NDArray[np.float64]] = {}
    flags = set()
    length = None
    for name in names or tuple(signals)[:1]:
        raw = np.asarray(signals[name])
        if raw.ndim != 1 or raw.dtype.kind not in "biuf":
            shape = f"{raw.dtype} {raw.shape}"
            raise ArgumentError(f"the signal {name!r} is no row of numbers: {shape}", fix="give an array of shape (T,)")
        values = raw.astype(float)
        if np.isnan(values).any():
            at = int(np.flatnonzero(np.isnan(values))[0])
            raise ArgumentError(f"the signal {name!r} is NaN at sample {at}", fix="give a number for every sample")
        if length is not None and len(values) != length:
            raise ArgumentError(
                f"the signal {name!r} has {len(values)} samples, and {next(iter(found))!r} has {length}",
                fix="give signals of the same length",
            )
        length = len(values)
        found[name] = values
        flags |= {name} if raw.dtype.kind == "b" else set()
    if length == 0:
        raise ArgumentError("the trace has no sample", fix="give at least one sample of each signal")
    return found, frozenset(flags)
