"""Monitors a requirement while a trial runs: a violation is found at the step at which it is certain."""

from __future__ import annotations

import math
from array import array
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.requirements._formula import (
    Apply,
    Compare,
    Join,
    Not,
    Number,
    Proposition,
    Signal,
    Temporal,
    Truth,
    children,
    is_pointwise,
    looks_ahead_s,
    looks_back_s,
)
from crashhunt.requirements._robustness import Evaluation, steps_of, undefined

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from crashhunt.requirements._formula import Formula, Term, Window
    from crashhunt.requirements._requirement import Requirement

MAX_PREFIX = 4096
"""Samples up to which a formula with an unbounded operator inside is evaluated at each step; later violations of such a
formula are found at the end of the trial. Its evaluation reads all samples, so the time would grow with their square.
"""


class Monitor:
    """Receives the samples of a running trial, and reports when a violation is certain.

    A violation is certain if the formula is false with the best values of all later samples, wherever the trace ends.
    Parts of the formula without temporal operators are computed for each sample. Temporal operators are evaluated only
    after a sample in which such a part is unfavourable: any other sample changes nothing.

    Raises:
        FormulaError: a window does not fit the step length.
    """

    def __init__(self, requirement: Requirement, step_length_s: float) -> None:
        requirement.require_windows(step_length_s)
        self.requirement = requirement
        self.signals = requirement.signals
        self.step_length_s = step_length_s
        self.samples = [array("d") for _ in self.signals]
        """The values of each signal up to the last sample."""
        self.flags: set[str] = set()
        self._count = 0
        self._checks = [
            _Check(part, self._leaves(part), step_length_s, requirement.text)
            for part in _conjuncts(requirement.formula)
        ]

    def _leaves(self, formula: Formula) -> list[_Part]:
        return [
            _Part(part, positive, self._compiled(part)) for part, positive in _pointwise_parts(formula, positive=True)
        ]

    def _compiled(self, formula: Formula) -> Callable[[Sequence[float]], bool]:
        return _Compiler(self.signals, self.requirement.text, self).condition(formula)

    @property
    def count(self) -> int:
        """The number of samples."""
        return self._count

    def add(self, row: Sequence[float]) -> bool:
        """Add a sample, and return whether the formula is certainly violated.

        The values are in the order of `signals`.

        Raises:
            FormulaError: a term has no value, such as after a division by zero.
        """
        if not self._count:
            self.flags = {name for name, value in zip(self.signals, row, strict=True) if isinstance(value, bool)}
        for values, value in zip(self.samples, row, strict=True):
            values.append(value)
        self._count += 1
        violated = False
        for check in self._checks:
            violated = check.add(row, self._count) or violated
        return violated

    def trace(self) -> dict[str, NDArray[np.generic]]:
        """Return the samples as arrays, by signal."""
        return {
            name: np.array(values, bool if name in self.flags else float)
            for name, values in zip(self.signals, self.samples, strict=True)
        }


def _conjuncts(formula: Formula) -> list[Formula]:
    if isinstance(formula, Join) and formula.operator == "and":
        return [one for part in formula.parts for one in _conjuncts(part)]
    return [formula]


def _pointwise_parts(formula: Formula, *, positive: bool) -> list[tuple[Formula, bool]]:
    """Return the largest parts without temporal operators, and whether each is below an even number of negations."""
    if is_pointwise(formula):
        return [(formula, positive)]
    inner = not positive if isinstance(formula, Not) else positive
    parts = [child for child in children(formula) if not isinstance(child, Number | Signal | Apply)]
    return [one for part in parts for one in _pointwise_parts(part, positive=inner)]


class _Part:
    """A part of the formula without temporal operators, and its truth at each sample; `favourable` never violates."""

    __slots__ = ("favourable", "formula", "holds", "truths")

    def __init__(self, formula: Formula, favourable: bool, holds: Callable[[Sequence[float]], bool]) -> None:
        self.formula, self.favourable, self.holds = formula, favourable, holds
        self.truths = array("d")


class _Check:
    """Decides one conjunct of the formula."""

    def __init__(self, formula: Formula, parts: list[_Part], step_length_s: float, text: str) -> None:
        self._parts = {id(part.formula): part for part in parts}
        self._step_length_s, self._text = step_length_s, text
        self._begin, self._inner = 0, formula
        end: int | None = 0
        if isinstance(formula, Temporal) and formula.operator == "always":
            (self._begin, end), self._inner = self._bounds(formula.window), formula.formula
        # Samples whose values count, relative to the last sample: infinity for an unbounded operator inside.
        self._ahead, self._back = (
            math.inf if math.isinf(reach_s) else round(reach_s / step_length_s)
            for reach_s in (looks_ahead_s(self._inner), looks_back_s(self._inner))
        )
        self._end = math.inf if end is None else end
        self._unfavourable_at = -math.inf
        self._is_settled = self._surely(self._inner, holds=True)
        self._open: deque[int] = deque()  # samples that later samples may make false

    def add(self, row: Sequence[float], count: int) -> bool:
        """Add a sample, and return whether the conjunct is certainly violated."""
        last = count - 1
        for part in self._parts.values():
            holds = part.holds(row)
            part.truths.append(math.inf if holds else -math.inf)
            if holds is not part.favourable:
                self._unfavourable_at = last
        low, high = max(self._begin, last - self._ahead), min(self._end, last)
        if not self._is_settled():
            self._open.append(last)
        while self._open and self._open[0] < low:
            self._open.popleft()
        if not self._open or self._open[0] > high:
            return False
        # A favourable sample changes nothing, unless operators of the past see an older one or an empty window.
        if last - self._unfavourable_at > self._back and last > self._back:
            return False
        reach = self._ahead + self._back
        if math.isinf(reach) and count > MAX_PREFIX:
            return False
        return self._is_violated(int(low), int(high), int(max(0, last - reach)))

    def _bounds(self, window: Window) -> tuple[int, int | None]:
        return steps_of(window, self._step_length_s, self._text)

    def _surely(self, formula: Formula, *, holds: bool) -> Callable[[], bool]:
        """Return a function that returns whether the last sample decides that a formula has a truth value.

        Later samples cannot change this value.
        """
        part = self._parts.get(id(formula))
        if part is not None:
            truths = part.truths
            return (lambda: truths[-1] > 0) if holds else (lambda: truths[-1] < 0)
        match formula:
            case Not(formula=inner):
                return self._surely(inner, holds=not holds)
            case Join(operator=operator, parts=parts):
                whether = [self._surely(one, holds=holds) for one in parts]
                if (operator == "or") is holds:
                    return lambda: True in [one() for one in whether]
                return lambda: False not in [one() for one in whether]
            case Temporal(operator=operator, window=window, formula=inner) if window.begin_s == 0:
                is_enough = (operator in ("eventually", "once")) is holds
                return self._surely(inner, holds=holds) if is_enough else lambda: False
            case _:
                return lambda: False

    def _is_violated(self, low: int, high: int, start: int) -> bool:
        """Return whether the formula inside is false at a sample from `low` to `high`; reads samples from `start`."""
        evaluation = Evaluation(
            lambda formula: np.array(self._parts[id(formula)].truths[start:]),
            lambda formula: id(formula) in self._parts,
            self._bounds,
            running=True,
        )
        return bool((evaluation.values(self._inner)[low - start : high - start + 1] < 0).any())


class _Compiler:
    """Makes Python functions of the parts without temporal operators, because NumPy is slow for one sample."""

    def __init__(self, signals: tuple[str, ...], text: str, monitor: Monitor) -> None:
        self._index = {name: number for number, name in enumerate(signals)}
        self._text, self._monitor = text, monitor

    def condition(self, formula: Formula) -> Callable[[Sequence[float]], bool]:
        match formula:
            case Truth(value=value):
                return lambda _: value
            case Not(formula=inner):
                negated = self.condition(inner)
                return lambda row: not negated(row)
            case Join(operator=operator, parts=parts):
                # All parts are computed, so that a part without a value is an error wherever the formula is computed.
                conditions = [self.condition(part) for part in parts]
                if operator == "and":
                    return lambda row: not [condition for condition in conditions if not condition(row)]
                return lambda row: bool([condition for condition in conditions if condition(row)])
            case Proposition(term=term):
                value_of = self.number(term)
                return lambda row: value_of(row) > 0
            case Compare(operator=operator, left=one, right=two):
                left, right = self.number(one), self.number(two)
                return _COMPARISONS[operator](left, right)
            case _:
                raise AssertionError("temporal operators are evaluated by Evaluation")

    def number(self, term: Term) -> Callable[[Sequence[float]], float]:
        match term:
            case Number(value=value):
                return lambda _: value
            case Signal(name=name):
                index = self._index[name]
                return lambda row: row[index]
            case Apply(operator=operator, terms=terms):
                computed = self._applied(operator, [self.number(one) for one in terms])

        def checked(row: Sequence[float]) -> float:
            try:
                value = computed(row)
            except ZeroDivisionError:
                raise undefined(term, self._text, self._monitor.count - 1, "divides by zero") from None
            except ValueError:
                value = math.nan
            if value != value:
                raise undefined(term, self._text, self._monitor.count - 1, "is not a number")
            return value

        return checked

    def _applied(
        self, operator: str, terms: list[Callable[[Sequence[float]], float]]
    ) -> Callable[[Sequence[float]], float]:
        first, last = terms[0], terms[-1]
        match operator:
            case "+":
                return lambda row: first(row) + last(row)
            case "-":
                return lambda row: first(row) - last(row)
            case "*":
                return lambda row: first(row) * last(row)
            case "/":
                return lambda row: first(row) / last(row)
            case "neg":
                return lambda row: -first(row)
            case "abs":
                return lambda row: abs(first(row))
            case "sqrt":
                return lambda row: math.sqrt(first(row))
            case "min":
                return lambda row: min([term(row) for term in terms])
            case _:
                return lambda row: max([term(row) for term in terms])


_COMPARISONS: dict[str, Callable[..., Callable[[Sequence[float]], bool]]] = {
    "<": lambda left, right: lambda row: left(row) < right(row),
    "<=": lambda left, right: lambda row: left(row) <= right(row),
    ">": lambda left, right: lambda row: left(row) > right(row),
    ">=": lambda left, right: lambda row: left(row) >= right(row),
    "==": lambda left, right: lambda row: left(row) == right(row),
    "!=": lambda left, right: lambda row: left(row) != right(row),
}
