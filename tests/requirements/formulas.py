"""Random formulas as text, and their values by the definition: nested loops, without any code of crashhunt."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from random import Random

Tree = tuple  # (operator, operands…), of which the text is written and the value computed

SIGNALS = ("a", "b", "c")


def random_term(draw: Random, depth: int) -> Tree:
    kind = draw.choice(["signal", "signal", "number", "sum", "function"] if depth else ["signal", "signal", "number"])
    if kind == "signal":
        return ("signal", draw.choice(SIGNALS))
    if kind == "number":
        return ("number", round(draw.uniform(-3, 3), 2))
    if kind == "sum":
        return (draw.choice(["+", "-", "*"]), random_term(draw, depth - 1), random_term(draw, depth - 1))
    name = draw.choice(["abs", "min", "max"])
    return (name, *(random_term(draw, depth - 1) for _ in range(1 if name == "abs" else 2)))


def random_formula(draw: Random, depth: int, *, past: bool = True, bound: int = 6) -> Tree:
    def below() -> Tree:
        return random_formula(draw, depth - 1, past=past, bound=bound)

    if depth <= 0 or draw.random() < 0.1:
        sign = draw.choice(["<", "<=", ">", ">="])
        return ("compare", sign, random_term(draw, 1), random_term(draw, 1))
    kind = draw.choice(["not", "and", "or", "->", "unary", "unary", "unary", "binary"])
    if kind == "not":
        return ("not", below())
    if kind in ("and", "or", "->"):
        return (kind, below(), below())
    window = None
    if draw.random() < 0.7:
        begin = draw.randint(0, bound)
        window = (begin, begin + draw.randint(0, bound))
    if kind == "unary":
        names = ["always", "eventually", *(["historically", "once"] if past else [])]
        return (draw.choice(names), window, below())
    return (draw.choice(["until", "since"] if past else ["until"]), window, below(), below())


def written(tree: Tree, step_s: float = 1.0) -> str:
    match tree:
        case ("signal", name):
            return name
        case ("number", value):
            return f"({value})" if value < 0 else f"{value}"
        case ("compare", sign, left, right):
            return f"({written(left)} {sign} {written(right)})"
        case ("not", inner):
            return f"not ({written(inner, step_s)})"
        case ("abs" | "min" | "max" as name, *terms):
            return f"{name}({', '.join(map(written, terms))})"
        case (name, window, *inner) if name in TEMPORAL:
            bounds = "" if window is None else f"[{window[0] * step_s:.9g}:{window[1] * step_s:.9g}]"
            parts = [f"({written(one, step_s)})" for one in inner]
            return f"{name}{bounds} {parts[0]}" if len(parts) == 1 else f"{parts[0]} {name}{bounds} {parts[1]}"
        case (operator, left, right):
            return f"({written(left, step_s)} {operator} {written(right, step_s)})"
    raise AssertionError(tree)


TEMPORAL = ("always", "eventually", "historically", "once", "until", "since")


def term_value(tree: Tree, trace: dict[str, list[float]], at: int) -> float:
    match tree:
        case ("signal", name):
            return trace[name][at]
        case ("number", value):
            return value
        case ("abs", one):
            return abs(term_value(one, trace, at))
    operator, *terms = tree
    left, right = (term_value(one, trace, at) for one in terms)
    return {"+": left + right, "-": left - right, "*": left * right, "min": min(left, right), "max": max(left, right)}[
        operator
    ]


class ByDefinition:
    """The value of formulas at each sample, with both bounds of what is not known yet.

    Args:
        trace: the samples of each signal.
        truth: whether to compute truth, as 1 and -1, in place of robustness.
        later: what a formula is worth after the end of the trace, as its least and its greatest value; None where the
            trace ends there.
    """

    def __init__(self, trace: dict[str, list[float]], *, truth: bool = False, later: bool = False) -> None:
        self.trace, self.truth, self.later = trace, truth, later
        self.count = len(next(iter(trace.values())))
        self.top = 1.0 if truth else math.inf
        self.known: dict[tuple[int, int], tuple[float, float]] = {}

    def value(self, tree: Tree, at: int) -> tuple[float, float]:
        key = id(tree), at
        if key not in self.known:
            self.known[key] = (-self.top, self.top) if at >= self.count else self._value(tree, at)
        return self.known[key]

    def _value(self, tree: Tree, at: int) -> tuple[float, float]:
        match tree:
            case ("compare", sign, left, right):
                one, two = term_value(left, self.trace, at), term_value(right, self.trace, at)
                difference = two - one if sign in ("<", "<=") else one - two
                if self.truth:
                    holds = difference >= 0 if "=" in sign else difference > 0
                    difference = 1.0 if holds else -1.0
                return difference, difference
            case ("not", inner):
                low, high = self.value(inner, at)
                return -high, -low
            case ("and", left, right):
                return self._least([self.value(left, at), self.value(right, at)])
            case ("or", left, right):
                return self._most([self.value(left, at), self.value(right, at)])
            case ("->", left, right):
                low, high = self.value(left, at)
                return self._most([(-high, -low), self.value(right, at)])
            case ("always" | "historically" as name, window, inner):
                return self._least([self.value(inner, one) for one in self._window(name, window, at)])
            case ("eventually" | "once" as name, window, inner):
                return self._most([self.value(inner, one) for one in self._window(name, window, at)])
            case ("until", window, left, right):
                return self._most(
                    [
                        self._least([self.value(right, one), *(self.value(left, held) for held in range(at, one))])
                        for one in self._window("until", window, at)
                    ]
                )
            case ("since", window, left, right):
                return self._most(
                    [
                        self._least(
                            [self.value(right, one), *(self.value(left, held) for held in range(one + 1, at + 1))]
                        )
                        for one in self._window("since", window, at)
                    ]
                )
        raise AssertionError(tree)

    def _window(self, name: str, window: tuple[int, int] | None, at: int) -> range:
        begin, end = window or (0, 10_000)
        if name in ("always", "eventually", "until"):
            # One sample after the end stands for all of them, because they have the same value.
            return range(at + begin, min(at + end, max(self.count, at + begin) if self.later else self.count - 1) + 1)
        return range(max(0, at - end), at - begin + 1)

    def _least(self, values: list[tuple[float, float]]) -> tuple[float, float]:
        ends = [self.top]
        return min([low for low, _ in values] + ends), min([high for _, high in values] + ends)

    def _most(self, values: list[tuple[float, float]]) -> tuple[float, float]:
        ends = [-self.top]
        return max([low for low, _ in values] + ends), max([high for _, high in values] + ends)


def random_trace(draw: Random, count: int) -> dict[str, list[float]]:
    # Few different values, so that equal ones occur, where a strict comparison differs from the other.
    return {
        name: [draw.choice([draw.uniform(-3, 3), float(draw.randint(-2, 2))]) for _ in range(count)] for name in SIGNALS
    }
