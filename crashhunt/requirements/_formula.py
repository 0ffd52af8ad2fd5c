"""The nodes of a parsed formula: numeric terms, propositions, and the operators that join them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Iterator

Span = tuple[int, int]
"""The place of a node in the text of its formula: the first character, and the character after the last."""

Comparison = Literal["<", "<=", ">", ">=", "==", "!="]
UnaryTemporal = Literal["always", "eventually", "historically", "once"]
BinaryTemporal = Literal["until", "since"]


@dataclass(frozen=True, slots=True)
class Window:
    """An interval of seconds relative to a sample, with both bounds included."""

    begin_s: float = 0.0  # distance of the nearer bound, in s; at least 0
    # distance of the farther bound, in s; None if the window reaches to the end of the trace (or, for an operator of
    # the past, to its beginning)
    end_s: float | None = None
    span: Span = (0, 0)  # place in the text; empty for an operator without a window


@dataclass(frozen=True, slots=True)
class Number:
    """A number, such as ``1.5``."""

    span: Span
    value: float


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal, such as ``gap_m``."""

    span: Span
    name: str


@dataclass(frozen=True, slots=True)
class Apply:
    """An arithmetic operator or a function, applied to terms."""

    span: Span  # place in the text
    operator: str  # ``+``, ``-``, ``*``, ``/``, ``neg`` or the name of a function
    terms: tuple[Term, ...]  # the operands


@dataclass(frozen=True, slots=True)
class Truth:
    """The formula ``true`` or ``false``."""

    span: Span
    value: bool


@dataclass(frozen=True, slots=True)
class Compare:
    """A comparison of two terms."""

    span: Span
    operator: Comparison
    left: Term
    right: Term


@dataclass(frozen=True, slots=True)
class Proposition:
    """A term in the place of a formula: a boolean signal as it is, and a number as ``number > 0``."""

    span: Span
    term: Term


@dataclass(frozen=True, slots=True)
class Not:
    """The negation of a formula."""

    span: Span
    formula: Formula


@dataclass(frozen=True, slots=True)
class Join:
    """A conjunction or disjunction; an implication is a disjunction whose first part is negated."""

    span: Span
    operator: Literal["and", "or"]
    parts: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Temporal:
    """A temporal operator with one operand."""

    span: Span
    operator: UnaryTemporal
    window: Window
    formula: Formula


@dataclass(frozen=True, slots=True)
class Until:
    """``until`` or ``since``: the right operand holds within the window, and the left operand holds up to there."""

    span: Span
    operator: BinaryTemporal
    window: Window
    left: Formula
    right: Formula


Term = Number | Signal | Apply
Formula = Truth | Compare | Proposition | Not | Join | Temporal | Until
Node = Term | Formula


def children(node: Node) -> tuple[Node, ...]:
    """Return the operands of a node."""
    match node:
        case Apply(terms=terms):
            return terms
        case Compare(left=left, right=right) | Until(left=left, right=right):
            return (left, right)
        case Proposition(term=term):
            return (term,)
        case Not(formula=formula) | Temporal(formula=formula):
            return (formula,)
        case Join(parts=parts):
            return parts
        case _:
            return ()


def nodes_of(node: Node) -> Iterator[Node]:
    """Yield a node and all nodes below it, in the order of the text."""
    yield node
    for child in children(node):
        yield from nodes_of(child)


def conjuncts(formula: Formula) -> list[Formula]:
    """Return formulas whose conjunction is the formula: those of ``and``, also below ``always`` and negated ``or``."""
    return _split(formula, "and", ("always", "historically"))


def disjuncts(formula: Formula) -> list[Formula]:
    """Return formulas whose disjunction is the formula: those of ``or``, also below ``eventually`` and negations."""
    return _split(formula, "or", ("eventually", "once"))


def _split(formula: Formula, operator: str, temporal: tuple[str, str]) -> list[Formula]:
    match formula:
        case Join(operator=found, parts=parts) if found == operator:
            return [one for part in parts for one in _split(part, operator, temporal)]
        case Not(span=span, formula=Join(operator=found, parts=parts)) if found != operator:
            return [one for part in parts for one in _split(Not(span, part), operator, temporal)]
        case Not(formula=Not(formula=inner)):
            return _split(inner, operator, temporal)
        case Temporal(operator=found, formula=inner) if found in temporal:
            return [replace(formula, formula=part) for part in _split(inner, operator, temporal)]
        case _:
            return [formula]


def is_pointwise(formula: Formula) -> bool:
    """Return whether a formula has no temporal operator, so that one sample decides it."""
    return not any(isinstance(node, Temporal | Until) for node in nodes_of(formula))


def looks_ahead_s(formula: Formula) -> float:
    """Return how far a formula looks ahead, in s; infinite if it contains an unbounded operator of the future."""
    return _reach_s(formula, ("always", "eventually", "until"))


def looks_back_s(formula: Formula) -> float:
    """Return how far a formula looks back, in s; infinite if it contains an unbounded operator of the past."""
    return _reach_s(formula, ("historically", "once", "since"))


def _reach_s(node: Node, operators: tuple[str, ...]) -> float:
    below = max((_reach_s(child, operators) for child in children(node)), default=0.0)
    if isinstance(node, Temporal | Until) and node.operator in operators:
        return below + (float("inf") if node.window.end_s is None else node.window.end_s)
    return below


def least_horizon_s(node: Node) -> float:
    """Return the latest time that bounds of windows name, in s; an unbounded window names only its beginning."""
    below = max((least_horizon_s(child) for child in children(node)), default=0.0)
    if isinstance(node, Temporal | Until) and node.operator in ("always", "eventually", "until"):
        return below + (node.window.begin_s if node.window.end_s is None else node.window.end_s)
    return below
