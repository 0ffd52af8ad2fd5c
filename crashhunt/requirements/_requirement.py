"""A requirement: a parsed formula that is computed on traces."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import ArgumentError, FormulaError
from crashhunt.base.text import did_you_mean, listed
from crashhunt.requirements._formula import (
    Compare,
    Join,
    Not,
    Proposition,
    Signal,
    Temporal,
    Truth,
    Until,
    conjuncts,
    disjuncts,
    is_pointwise,
    least_horizon_s,
    nodes_of,
)
from crashhunt.requirements._robustness import (
    Evaluation,
    checked_signals,
    lasting,
    proposition_values,
    steps_of,
    term_values,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from numpy.typing import NDArray

    from crashhunt.requirements._formula import Formula, Node, Window

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Violation:
    """A part of a formula that contributes to a violation.

    Args:
        text: text of the part.
        holds: whether the part holds there; a part below a negation contributes by holding.
        first: first sample of the contribution.
        last: last sample of the contribution.
        worst: sample at which the part is nearest to the opposite value.
        values: values of the signals of the part at the worst sample.
    """

    text: str
    holds: bool
    first: int
    last: int
    worst: int
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Requirement:
    """A formula that must hold in a trial.

    Windows are in seconds, and are cut at the end of the trace. In an empty window, ``always`` and ``historically`` are
    infinitely true, and all other temporal operators are infinitely false.
    """

    text: str
    formula: Formula

    def __str__(self) -> str:
        return self.text

    @property
    def signals(self) -> tuple[str, ...]:
        """The names of the signals, in the order of the text."""
        return tuple(dict.fromkeys(node.name for node in nodes_of(self.formula) if isinstance(node, Signal)))

    @property
    def horizon_s(self) -> float:
        """The latest time that the bounds of windows name, in s: a shorter trace leaves a window empty."""
        return least_horizon_s(self.formula)

    def robustness(self, signals: Mapping[str, object], step_length_s: float) -> float:
        """Return the space robustness at the first sample: positive if the formula holds, negative if it is violated.

        Args:
            signals: values of each signal, shape (T,); a boolean signal is infinitely true or false.
            step_length_s: time between two samples, in s.

        Raises:
            FormulaError: a signal is missing, a window does not fit the step length, or a term has no value.
            ArgumentError: a signal is not a row of numbers, or the step length is not above 0.
        """
        return float(self.values(signals, step_length_s)[0])

    def satisfied(self, signals: Mapping[str, object], step_length_s: float) -> bool:
        """Return whether the formula holds at the first sample; arguments and errors as in `robustness`."""
        return bool(self.values(signals, step_length_s, truth=True)[0] > 0)

    def values(
        self, signals: Mapping[str, object], step_length_s: float, *, truth: bool = False
    ) -> NDArray[np.float64]:
        """Return the robustness at each sample; with `truth`, positive infinity for true, negative for false."""
        return self._evaluation(signals, step_length_s, truth=truth).values(self.formula)

    def parts(self, signals: Mapping[str, object], step_length_s: float) -> tuple[tuple[float, ...], ...]:
        """Return the robustness of the disjuncts of each conjunct; arguments and errors as in `robustness`.

        The least of the greatest value of each row is the robustness of the requirement.
        """
        evaluation = self._evaluation(signals, step_length_s, truth=False)
        return tuple(
            tuple(float(evaluation.values(part)[0]) for part in disjuncts(conjunct))
            for conjunct in conjuncts(self.formula)
        )

    def slack_s(self, signals: Mapping[str, object], step_length_s: float) -> tuple[float, ...]:
        """Return the time by which each conjunct holds, in s; negative if it is violated; arguments as in `robustness`.

        A comparison has the time for which it was, plus the time for which it will be, as it is at a sample. What an
        implication assumes counts as true or false. Space robustness cannot rank traces whose signals are flags or
        whole numbers, and this can.
        """
        truths = self._evaluation(signals, step_length_s, truth=True)
        assumed = {id(part) for part in _assumptions(self.formula)}

        def leaf(formula: Formula, order: slice) -> NDArray[np.float64]:
            values = truths.values(formula)
            return values if id(formula) in assumed else step_length_s * lasting(values[order])[order]

        def is_leaf(formula: Formula) -> bool:
            return id(formula) in assumed or truths.is_leaf(formula)

        ways = [replace(truths, leaf=partial(leaf, order=slice(None, None, way)), is_leaf=is_leaf) for way in (1, -1)]
        return tuple(sum(float(way.values(part)[0]) for way in ways) for part in conjuncts(self.formula))

    def comparisons(self, signals: Mapping[str, object], step_length_s: float) -> dict[str, dict[str, Floats]]:
        """Return the values of both sides of each comparison at each sample, by the texts of comparison and side."""
        _require_step_length(step_length_s)
        self.require_known(signals)
        arrays, _ = checked_signals(signals, self.signals)
        count = len(next(iter(arrays.values()))) if arrays else 1
        found = {}
        for node in nodes_of(self.formula):
            if isinstance(node, Compare):
                sides = {
                    self._text_of(side): term_values(side, arrays, count, self.text) for side in (node.left, node.right)
                }
                found[self._text_of(node)] = sides
        return found

    def _text_of(self, node: Node) -> str:
        begin, end = node.span
        return " ".join(self.text[begin:end].split())

    def require_known(self, known: Collection[str]) -> None:
        """Check that all signals are known.

        Raises:
            FormulaError: a signal is unknown; the error names the most similar known signal.
        """
        for node in nodes_of(self.formula):
            if isinstance(node, Signal) and node.name not in known:
                fix = did_you_mean(node.name, known) or f"the signals are {listed(sorted(known))}"
                raise FormulaError(
                    f"the signal {node.name!r} is unknown", fix=fix, text=self.text, begin=node.span[0],
                    end=node.span[1],
                )  # fmt: skip

    def require_windows(self, step_length_s: float) -> None:
        """Check that the windows fit a step length.

        Raises:
            FormulaError: a bound of a window is not a multiple of the step length.
        """
        for node in nodes_of(self.formula):
            if isinstance(node, Temporal | Until):
                steps_of(node.window, step_length_s, self.text)

    def explain(self, signals: Mapping[str, object], step_length_s: float) -> list[Violation]:
        """Return the parts that cause a violation at the first sample; empty if the formula holds.

        Args:
            signals: as in `robustness`.
            step_length_s: as in `robustness`.
        """
        if self.satisfied(signals, step_length_s):
            return []
        truths = self._evaluation(signals, step_length_s, truth=True)
        degrees = self._evaluation(signals, step_length_s, truth=False)
        arrays, _ = checked_signals(signals, self.signals)
        explainer = _Explainer(self.text, arrays, truths, degrees)
        found = explainer.causes(self.formula, [0], holds=False)
        return [one for number, one in enumerate(found) if one not in found[:number]]

    def _evaluation(self, signals: Mapping[str, object], step_length_s: float, *, truth: bool) -> Evaluation:
        _require_step_length(step_length_s)
        self.require_known(signals)
        arrays, flags = checked_signals(signals, self.signals)
        count = len(next(iter(arrays.values()))) if arrays else 1

        def leaf(formula: Formula) -> NDArray[np.float64]:
            assert isinstance(formula, Compare | Proposition | Truth)
            return proposition_values(formula, arrays, flags, count, self.text, truth=truth)

        def bounds(window: Window) -> tuple[int, int | None]:
            return steps_of(window, step_length_s, self.text)

        return Evaluation(leaf, lambda formula: isinstance(formula, Compare | Proposition | Truth), bounds)


def _assumptions(formula: Formula) -> Iterator[Formula]:
    """Yield the negated parts of disjunctions."""
    for node in nodes_of(formula):
        if isinstance(node, Join) and node.operator == "or":
            negated = [part for part in node.parts if isinstance(part, Not)]
            yield from negated if len(negated) < len(node.parts) else ()


def _require_step_length(step_length_s: float) -> None:
    try:
        valid = 0 < step_length_s < math.inf
    except TypeError:
        valid = False
    if not valid:
        raise ArgumentError(f"step_length_s is {step_length_s!r}", fix="give seconds above 0")


_MAX_CAUSES = 20


class _Explainer:
    """Finds the parts of a formula that cause its value."""

    def __init__(
        self, text: str, signals: Mapping[str, NDArray[np.float64]], truths: Evaluation, degrees: Evaluation
    ) -> None:
        self._text, self._signals, self._truths, self._degrees = text, signals, truths, degrees

    def causes(self, formula: Formula, samples: list[int], *, holds: bool) -> list[Violation]:
        """Return the parts that cause a formula to hold, or not to hold, at all of the given samples."""
        if not samples:
            return []
        match formula:
            case Not(formula=inner):
                return self.causes(inner, samples, holds=not holds)
            case Join(operator=operator, parts=parts):
                if (operator == "or") != holds:  # all parts contribute
                    return [one for part in parts for one in self.causes(part, samples, holds=holds)][:_MAX_CAUSES]
                return self.causes(self._deciding(parts, samples, holds=holds), samples, holds=holds)
            case Temporal(operator=operator, formula=inner, window=window):
                within = self._window(operator in ("always", "eventually"), window, samples)
                if (operator in ("eventually", "once")) != holds:  # one sample decides nothing
                    return self.causes(inner, within, holds=holds)
                truth = self._truths.values(inner)
                at = next((one for one in within if (truth[one] > 0) == holds), None)
                return [] if at is None else self.causes(inner, [at], holds=holds)
            case _:
                return [self._leaf(formula, samples, holds=holds)]

    def _deciding(self, parts: tuple[Formula, ...], samples: list[int], *, holds: bool) -> Formula:
        """Return the part that has the wanted value at most of the samples."""
        return max(parts, key=lambda part: int(((self._truths.values(part)[samples] > 0) == holds).sum()))

    def _window(self, future: bool, window: Window, samples: list[int]) -> list[int]:
        begin, end = self._truths.bounds(window)
        count = len(next(iter(self._signals.values()))) if self._signals else 1
        far = count if end is None else end
        found: dict[int, None] = {}
        for sample in samples:
            low, high = (sample + begin, sample + far) if future else (sample - far, sample - begin)
            found |= dict.fromkeys(range(max(0, low), min(count - 1, high) + 1))
        return sorted(found)

    def _leaf(self, formula: Formula, samples: list[int], *, holds: bool) -> Violation:
        degree = self._degrees.values(formula)
        first = last = samples[0]
        if len(samples) > 1:
            last = samples[-1]
        elif is_pointwise(formula):  # how long it keeps this value
            truth = self._truths.values(formula)
            while last + 1 < len(truth) and (truth[last + 1] > 0) == holds:
                last += 1
        chosen = np.array(samples)
        worst = int(chosen[np.argmin(degree[chosen]) if holds else np.argmax(degree[chosen])])
        names = dict.fromkeys(node.name for node in nodes_of(formula) if isinstance(node, Signal))
        begin, end = formula.span
        return Violation(
            text=self._text[begin:end], holds=holds, first=first, last=last, worst=worst,
            values={name: float(self._signals[name][worst]) for name in names},
        )  # fmt: skip
